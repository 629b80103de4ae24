"""Faults that one sensor shows alone: frozen images and scans, collapsed exposures, blocked sectors."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from bevviz.model.frame import F32, F64, U8, Cloud, Image

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


@dataclass(frozen=True, slots=True)
class SensorFault:
    """A fault of one sensor, and the stamp at which it began."""

    sensor: str  # with its kind, such as "camera front"
    name: str  # such as "frozen image"
    since: int
    detail: str = ""  # end of the sentence
    rank: float = 0.95  # severity, 0 to 1


class ImageWatch:
    """Detector of frozen, black, dark, white and blank images of one camera."""

    def __init__(self, sensor: str) -> None:
        self.gray: U8 | None = None  # the last image, ``WIDTH`` pixels wide
        self._sensor = sensor
        self._image: Image | None = None
        self._copies, self._frozen_since = 0, 0
        self._light: deque[tuple[float, float]] = deque(maxlen=PAST)  # mean and spread of usual images
        self._dim_since: int | None = None
        self._faults: tuple[SensorFault, ...] = ()

    def update(self, image: Image) -> tuple[SensorFault, ...]:
        """Return the faults of the newest image. An image that several frames share is judged once."""
        if self._image is None or image.stamp != self._image.stamp:
            gray = _small(image.bgr)
            faults = tuple(self._exposure(image.stamp, gray))
            self._faults = faults or tuple(self._repetition(image, gray))
            self._image, self.gray = image, gray
        return self._faults

    def update_alone(self, image: Image) -> SensorFault | None:
        """Return the fault of an image that shows nothing. It does not follow the image before."""
        self._dim_since = None
        return next(self._exposure(image.stamp, _small(image.bgr)), None)

    def _repetition(self, image: Image, gray: U8) -> Iterator[SensorFault]:
        """Yield a frozen image, or the image after one that came twice."""
        before = self._image
        copied = (
            before is not None
            and self.gray is not None
            and np.array_equal(self.gray, gray)
            and np.array_equal(before.bgr, image.bgr)
        )
        if copied and before is not None:
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


class ScanWatch:
    """Detector of frozen scans and of blocked sectors of one LiDAR."""

    def __init__(self, sensor: str) -> None:
        self._sensor = sensor
        self._stamp = 0
        self._xyz: F32 | None = None
        self._copies, self._frozen_since = 0, 0
        self._returns: deque[F64] = deque(maxlen=PAST)  # (SECTORS,) returns of usual scans
        self._low = np.zeros(SECTORS, np.int64)  # scans in a row below the limit
        self._usual = np.zeros(SECTORS)
        self._low_since = np.zeros(SECTORS, np.int64)

    def update(self, cloud: Cloud) -> Iterator[SensorFault]:
        """Yield the faults of the newest scan."""
        if self._xyz is not None and cloud.stamp == self._stamp:
            return
        yield from self._repetition(cloud)
        yield from self._sectors(cloud)
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
