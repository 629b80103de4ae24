"""Faults that one sensor shows alone: frozen images and scans, covered lenses, lost returns.

Each sensor is compared with its own last seconds by content, not by bytes: a frozen image may be compressed
again, and a frozen scan may have new noise. Whether the scene moves is told by the other kind of sensor.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from bevviz.model.frame import F32, F64, U8, Bool, Cloud, Image

PAST = 20  # frames that a sensor is compared with
LEAST_PAST = 4  # frames; fewer tell nothing
REPEATS = 2  # copies of an image or a scan in a row that count as frozen
VIDEO_REPEATS = 10  # the same for pictures of a video, whose codec may leave out small changes

WIDTH = 320  # pixels, width of the images that are compared
BLACK = 4.0  # grey values, largest mean and largest spread of a black image
WHITE = 245.0  # grey values, least mean of a white image
DARK = 0.4  # share of the usual brightness below which an image is dark, if its contrast fell as well
FLAT = 0.25  # share of the usual contrast below which an image shows nothing: fog, dirt, a cover
ADAPTS = 10.0  # seconds after which another brightness is usual

SECTORS = 36  # parts of a turn in which returns are counted
NEAREST = 1.5  # metres; nearer returns may come from the object that blocks the sensor
BLOCKED = 0.3  # share of the usual returns below which a sector is blocked
SCANS = 3  # scans in a row that show it
LEAST_RETURNS = 50  # usual returns of a sector that can be judged
POINTS = 10_000  # most points of a scan that are counted
LEAST_POINTS = 500  # of a scan that can be called frozen

SAME = 0.25  # ratio of a change to the usual one below which an image or a scan repeats the one before
MOVES = 0.6  # ratio of a change to the usual one above which the scene goes on as before
LEAST_CHANGE = 1.5  # grey values, usual change of images in which a repetition can be told
LEAST_SCAN_CHANGE = 0.01  # mean logarithm of the range, the same for scans
CHANGE_WIDTH = 80  # pixels, width of the images whose change is measured: noise and compression average out
MISSING = 1.6  # ratio of the time between two images to the usual time above which one is missing
TWO_STEPS = 1.2  # least ratio of the change over two images to that over one: a camera that moves

REGIONS = (9, 12)  # rows and columns of the regions in which fine details are compared
DETAIL = 5  # pixels; finer details are compared. Defocus and covers lose them, and brightness keeps them
DETAIL_LEFT = 0.35  # ratio of the usual details of a region below which something covers or blurs it
FEWEST = 0.05  # quantile of the details of a region that are usual; a camera that swings sees sky at times
LEAST_SEEN = 8  # images; the details of fewer are not the usual ones
LEAST_DETAIL = 2.0  # grey values, usual details of a region that can be judged
COVERED = 0.1  # least share of the judged regions that fall together
DEFOCUSED = 0.85  # the same where the lens is out of focus, and nothing covers it
TOGETHER = 2  # images within which the regions fall
LEAST_REGIONS = 20  # judged regions; fewer show too little of the scene
LASTING = 4  # images in a row after which they are told: what drives past is gone by then
FORGOTTEN = 100  # images in a row after which fewer details are usual

RINGS = (
    3.0,
    6.0,
    10.0,
    15.0,
    20.0,
    30.0,
    45.0,
    70.0,
)  # metres, bounds of the rings that returns are counted in
GONE = 0.1  # share of the usual returns beyond a range below which they are lost
UNSEEN = 0.6  # least part of the lost returns that no nearer return replaces
FEWER = 0.75  # share of the earlier returns, near and in all, below which the LiDAR returns less
SAMPLE = 1.0  # seconds between the samples of the returns of earlier scans
SAMPLES = 60
NEAR_RINGS = 4  # rings, up to 15 m, in which every drive has ground: few returns there are no open place


@dataclass(frozen=True, slots=True)
class SensorFault:
    """A fault of one sensor, and the stamp at which it began."""

    sensor: str  # with its kind, such as "camera front"
    name: str  # such as "frozen image"
    since: int
    detail: str = ""  # end of the sentence
    rank: float = 0.95  # severity, 0 to 1


class UsualChange:
    """Usual change of a sensor from frame to frame, and how the newest change compares with it."""

    def __init__(self, least: float) -> None:
        self._least = least
        self._past: deque[float] = deque(maxlen=PAST)
        self.usual = 0.0  # 0: unknown, or too small to judge

    def ratio(self, change: float) -> float:
        """Return the ratio of a change to the usual one, NaN if that is not known.

        A change so small that it is a repetition is no part of the usual ones.
        """
        self.usual = float(np.median(self._past)) if len(self._past) >= LEAST_PAST else 0.0
        ratio = change / self.usual if self.usual >= self._least else float("nan")
        if not ratio < SAME:
            self._past.append(change)
        return ratio


class ImageWatch:
    """Detector of frozen, late, black, dark, white, blank, covered and blurred images of one camera."""

    def __init__(self, sensor: str) -> None:
        self.gray: U8 | None = None  # the last image, ``WIDTH`` pixels wide
        self._sensor = sensor
        self._image: Image | None = None
        self._copies, self._frozen_since = 0, 0
        self._change, self._change_of_two = UsualChange(LEAST_CHANGE), UsualChange(LEAST_CHANGE)
        self._before: deque[tuple[int, F32]] = deque(maxlen=2)  # stamp and content of the last images
        self._interval = 0  # nanoseconds, usual time between two images
        self._regions = RegionWatch(sensor)
        self.moves = False  # whether the newest image shows a scene that moves as usual
        self._light: deque[tuple[float, float]] = deque(maxlen=PAST)  # mean and spread of usual images
        self._dim_since: int | None = None
        self._faults: tuple[SensorFault, ...] = ()

    def update(self, image: Image, scan_moves: bool = False) -> tuple[SensorFault, ...]:
        """Return the faults of the newest image. An image that several frames share is judged once.

        Args:
            image: the newest image.
            scan_moves: whether the scans show a scene that moves as usual.
        """
        if self._image is None or image.stamp != self._image.stamp:
            gray = _small(image.bgr)
            faults = tuple(self._exposure(image.stamp, gray))
            content = _content(gray)
            faults = faults or tuple(self._repetition(image, gray, content, scan_moves))
            self._faults = faults or tuple(self._regions.update(image.stamp, gray))
            self._before.append((image.stamp, content))
            self._image, self.gray = image, gray
        return self._faults

    def update_alone(self, image: Image) -> SensorFault | None:
        """Return the fault of an image that shows nothing. It does not follow the image before."""
        self._dim_since = None
        return next(self._exposure(image.stamp, _small(image.bgr)), None)

    def _repetition(self, image: Image, gray: U8, content: F32, scan_moves: bool) -> Iterator[SensorFault]:
        """Yield a frozen image, the image after one that came twice, or a late one after a missing one."""
        before = self._image
        if before is None or self.gray is None:
            return
        interval, last = image.stamp - before.stamp, self._before[-1][1]
        change = _difference(content, last)
        is_missing = self._interval > 0 and interval > MISSING * self._interval
        if is_missing:
            yield from self._late_after_gap(image, change)
            return
        self._interval = interval
        ratio = self._change.ratio(change)
        if len(self._before) == 2:
            self._change_of_two.ratio(_difference(content, self._before[0][1]))
        self.moves = ratio >= MOVES
        copied = np.array_equal(self.gray, gray) and np.array_equal(before.bgr, image.bgr)
        copied |= scan_moves and ratio < SAME
        if copied:
            if self._copies == 0:
                self._frozen_since = before.stamp
            self._copies += 1
        if image.clip is None and not copied and self._copies == 1:
            detail = ": an image came twice, and those after it may be late by one"
            yield SensorFault(self._sensor, "late image", self._frozen_since, detail, 0.8)
        elif copied and self._copies >= (REPEATS if image.clip is None else VIDEO_REPEATS):
            yield SensorFault(self._sensor, "frozen image", self._frozen_since)
        if not copied:
            self._copies = 0

    def _late_after_gap(self, image: Image, change: float) -> Iterator[SensorFault]:
        """Yield a late image: after a missing one the scene moved by one step, not by two."""
        one, two = self._change.usual, self._change_of_two.usual
        if one >= LEAST_CHANGE and two >= TWO_STEPS * one and change < (one * two) ** 0.5:
            detail = ": an image is missing, and those after it may be late by one"
            yield SensorFault(self._sensor, "late image", image.stamp, detail, 0.8)

    def _exposure(self, stamp: int, gray: U8) -> Iterator[SensorFault]:
        """Yield an image that shows nothing or little. Such an image is no part of the camera's past."""
        mean, spread = float(gray.mean()), float(gray.std())
        usual_mean = usual_spread = 0.0
        if len(self._light) >= LEAST_PAST:
            usual_mean, usual_spread = np.median(self._light, axis=0).tolist()
        name = ""
        if mean <= BLACK and spread <= BLACK:
            name = "black image"
        elif mean >= WHITE:
            name = "white image"
        elif mean < DARK * usual_mean and spread < DARK * usual_spread:
            name = "dark image"
        elif spread < FLAT * usual_spread:
            name = "blank image"
        if not name:
            self._light.append((mean, spread))
            self._dim_since = None
            return
        self._dim_since = stamp if self._dim_since is None else self._dim_since
        if stamp - self._dim_since > ADAPTS * 1e9:
            self._light.append((mean, spread))
        detail = f", mean grey value {mean:.0f}" + (f" instead of {usual_mean:.0f}" if usual_mean else "")
        yield SensorFault(self._sensor, name, self._dim_since, detail)


def _small(bgr: U8) -> U8:
    """Return the image in grey, ``WIDTH`` pixels wide."""
    step = max(round(bgr.shape[1] / (2 * WIDTH)), 1)
    size = bgr.shape[1] // step, bgr.shape[0] // step
    if step > 1:
        bgr = np.asarray(cv2.resize(bgr, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    gray = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)
    size = WIDTH, max(round(WIDTH * bgr.shape[0] / bgr.shape[1]), 1)
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.uint8)


def _content(gray: U8) -> F32:
    """Return a coarse image without its mean, whose noise is small."""
    size = CHANGE_WIDTH, max(CHANGE_WIDTH * gray.shape[0] // gray.shape[1], 1)
    coarse = cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.asarray(coarse - coarse.mean(), np.float32)


def _difference(content: F32, other: F32) -> float:
    """Return the mean difference of two coarse images in grey values, infinite for other sizes."""
    return float(np.abs(content - other).mean()) if content.shape == other.shape else float("inf")


class RegionWatch:
    """Detector of regions of an image that lose their details together, by a cover, mud or defocus."""

    def __init__(self, sensor: str) -> None:
        self._sensor = sensor
        self._past: deque[F64] = deque(maxlen=PAST)  # (regions,) details of usual images
        self._usual = np.zeros(REGIONS)
        self._low = np.zeros(REGIONS, np.int64)  # images in a row without the usual details
        self._stamps: deque[int] = deque(maxlen=FORGOTTEN + 1)

    def update(self, stamp: int, gray: U8) -> Iterator[SensorFault]:
        """Yield regions of the newest image that lost their details at one time. Objects come bit by bit."""
        details = _details(gray)
        self._stamps.append(stamp)
        if len(self._past) >= LEAST_SEEN:
            self._usual = np.where(self._low > 0, self._usual, np.quantile(self._past, FEWEST, axis=0))
            is_low = (self._usual >= LEAST_DETAIL) & (details < DETAIL_LEFT * self._usual)
            self._low = np.where(is_low & (self._low < FORGOTTEN), self._low + 1, 0)
        self._past.append(np.where(self._low > 0, self._usual, details))
        judged = int(np.count_nonzero(self._usual >= LEAST_DETAIL))
        ages = np.bincount(self._low.ravel(), minlength=LASTING + TOGETHER)[LASTING:]
        together = np.convolve(ages, np.ones(TOGETHER, np.int64))[: len(ages)]
        age = LASTING + int(together.argmax())
        fell = (self._low > age - TOGETHER) & (self._low <= age) & (self._low >= LASTING)
        share = int(np.count_nonzero(fell)) / max(judged, 1)
        if share < COVERED or judged < LEAST_REGIONS:
            return
        since = self._stamps[-int(np.median(self._low[fell]))]
        if share >= DEFOCUSED:
            yield SensorFault(self._sensor, "blurred image", since, ": fine details are lost everywhere")
            return
        detail = f", {_region(fell)}: {100 * share:.0f} % of the image lost its details at once"
        yield SensorFault(self._sensor, "covered lens", since, detail)


def _details(gray: U8) -> F64:
    """Return the mean strength of the fine details of each region of an image, in grey values."""
    rows, columns = REGIONS
    height, width = gray.shape[0] // rows * rows, gray.shape[1] // columns * columns
    detail = cv2.absdiff(gray, cv2.blur(gray, (DETAIL, DETAIL)))[:height, :width].astype(np.float32)
    return np.asarray(cv2.resize(detail, (columns, rows), interpolation=cv2.INTER_AREA), np.float64)


def _region(cells: Bool) -> str:
    """Return where most of the regions of an image are, such as ``left`` or ``upper right``."""
    rows, columns = np.nonzero(cells)
    y, x = (rows.mean() + 0.5) / cells.shape[0], (columns.mean() + 0.5) / cells.shape[1]
    vertical = "upper" if y < 0.4 else ("lower" if y > 0.6 else "")
    horizontal = "left" if x < 0.4 else ("right" if x > 0.6 else "")
    return f"{vertical} {horizontal}".strip() + " part" if vertical or horizontal else "middle"


class ScanWatch:
    """Detector of frozen scans, blocked sectors and lost returns of one LiDAR."""

    def __init__(self, sensor: str) -> None:
        self._sensor = sensor
        self._stamp = 0
        self._xyz: F32 | None = None
        self._copies, self._frozen_since = 0, 0
        self._returns: deque[F64] = deque(maxlen=PAST)  # (SECTORS,) returns of usual scans
        self._low = np.zeros(SECTORS, np.int64)  # scans in a row below the limit
        self._usual = np.zeros(SECTORS)
        self._low_since = np.zeros(SECTORS, np.int64)
        self._rings: deque[F64] = deque(maxlen=PAST)  # (RINGS + 1,) returns of usual scans
        self._samples: deque[F64] = deque(maxlen=SAMPLES)  # (RINGS + 1,) one of each ``SAMPLE``
        self._sampled = 0
        self._far_low, self._far_since, self._few, self._few_since = 0, 0, 0, 0

    def update(self, cloud: Cloud) -> Iterator[SensorFault]:
        """Yield the faults of the newest scan."""
        if self._xyz is not None and cloud.stamp == self._stamp:
            return
        yield from self._repetition(cloud)
        faults = [*self._sectors(cloud)]
        yield from faults or self._ranges(cloud)
        self._stamp, self._xyz = cloud.stamp, cloud.xyz

    def _repetition(self, cloud: Cloud) -> Iterator[SensorFault]:
        """Yield a frozen scan. Measured ranges are never all equal, even where nothing moves."""
        few = len(cloud.xyz) < LEAST_POINTS
        if self._xyz is None or few or not np.array_equal(self._xyz, cloud.xyz):
            self._copies = 0
            return
        if self._copies == 0:
            self._frozen_since = self._stamp
        self._copies += 1
        if self._copies >= REPEATS:
            yield SensorFault(self._sensor, "frozen scan", self._frozen_since)

    def _sectors(self, cloud: Cloud) -> Iterator[SensorFault]:
        """Yield sectors that return far less than in the scans before."""
        returns = _count_returns(cloud.xyz)
        if len(self._returns) >= LEAST_PAST:
            self._usual = np.where(self._low > 0, self._usual, np.median(self._returns, axis=0))
            low = (returns < BLOCKED * self._usual) & (self._usual >= LEAST_RETURNS)
            self._low_since = np.where(self._low > 0, self._low_since, cloud.stamp)
            self._low = np.where(low, self._low + 1, 0)
        self._returns.append(np.where(self._low > 0, self._usual, returns))
        blocked = self._low >= SCANS
        if not blocked.any():
            return
        since = int(self._low_since[blocked].min())
        left = 100 * returns[blocked].sum() / self._usual[blocked].sum()
        if (blocked | (self._usual < LEAST_RETURNS)).all():
            detail = f": {left:.0f} % of the usual returns left"
            yield SensorFault(self._sensor, "returns lost", since, detail)
            return
        width = int(blocked.sum()) * 360 // SECTORS
        detail = f", {_direction(blocked)}, {width} degrees wide: {left:.0f} % of the usual returns left"
        yield SensorFault(self._sensor, "blocked sector", since, detail)

    def _ranges(self, cloud: Cloud) -> Iterator[SensorFault]:
        """Yield returns that are lost beyond a range, or that become fewer at all ranges."""
        returns = _count_rings(cloud.xyz)
        usual = np.median(self._rings, axis=0) if len(self._rings) >= LEAST_PAST else np.zeros(len(returns))
        beyond, usual_beyond = np.cumsum(returns[::-1])[::-1], np.cumsum(usual[::-1])[::-1]
        lost = usual_beyond - beyond
        is_gone = (usual_beyond >= LEAST_RETURNS) & (beyond < GONE * usual_beyond)
        is_gone &= usual.sum() - returns.sum() > UNSEEN * lost
        ring = int(is_gone.argmax())
        if not is_gone[1:].any():
            self._far_low = 0
            self._rings.append(returns)
            yield from self._fewer(cloud, returns)
            return
        self._far_since = self._far_since if self._far_low else cloud.stamp
        self._far_low += 1
        if self._far_low >= SCANS:
            left = 100 * beyond[ring] / usual_beyond[ring]
            detail = f" beyond {RINGS[ring - 1]:.0f} m: {left:.0f} % of the usual returns left"
            yield SensorFault(self._sensor, "far returns lost", self._far_since, detail)

    def _fewer(self, cloud: Cloud, returns: F64) -> Iterator[SensorFault]:
        """Yield a LiDAR that returns less than earlier in the drive, near and in all."""
        near, everything = returns[:NEAR_RINGS].sum(), returns.sum()
        earlier = np.median(self._samples, axis=0) if self._samples else np.zeros(len(returns))
        is_few = earlier[:NEAR_RINGS].sum() >= LEAST_RETURNS and near < FEWER * earlier[:NEAR_RINGS].sum()
        if not (is_few and everything < FEWER * earlier.sum()):
            self._few = 0
            if cloud.stamp - self._sampled >= SAMPLE * 1e9:
                self._samples.append(returns)
                self._sampled = cloud.stamp
            return
        self._few_since = self._few_since if self._few else cloud.stamp
        self._few += 1
        if self._few >= SCANS:
            left = 100 * everything / earlier.sum()
            detail = f": {left:.0f} % of the returns of earlier scans left, at all ranges"
            yield SensorFault(self._sensor, "fewer returns", self._few_since, detail)


def _count_rings(xyz: F32) -> F64:
    """Return the number of returns in each ring around the sensor."""
    step = -(-len(xyz) // POINTS) or 1
    x, y, _ = xyz[::step].T
    ring = np.searchsorted(np.square(RINGS, dtype=np.float32), x * x + y * y)
    return step * np.bincount(ring, minlength=len(RINGS) + 1).astype(np.float64)


def _count_returns(xyz: F32) -> F64:
    """Return the (SECTORS,) number of returns beyond ``NEAREST``, counted from -180 degrees of azimuth on."""
    step = -(-len(xyz) // POINTS) or 1
    x, y, _ = xyz[::step].T
    far = x * x + y * y > NEAREST**2
    azimuth = np.arctan2(y[far], x[far])
    sector = ((azimuth + np.float32(np.pi)) * np.float32(SECTORS / (2 * np.pi))).astype(np.int64) % SECTORS
    return step * np.bincount(sector, minlength=SECTORS).astype(np.float64)


def _direction(blocked: np.ndarray) -> str:
    """Return the direction of the middle of the blocked sectors, in degrees left or right of x."""
    angle = (np.flatnonzero(blocked) + 0.5) * 2 * np.pi / SECTORS - np.pi
    middle = float(np.degrees(np.arctan2(np.sin(angle).sum(), np.cos(angle).sum())))
    return f"{abs(middle):.0f} degrees to the {'left' if middle > 0 else 'right'}"
