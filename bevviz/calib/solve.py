"""Finds the offsets at which the edges meet best, and says how far that is to be believed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from bevviz.calib.evidence import LEAD, caution, lead, scatter, views
from bevviz.calib.offsets import AXES, FLOOR, PRIOR, SCALES, TIME, Axis, error_pose
from bevviz.calib.result import AxisResult, Calibration, Finding
from bevviz.calib.samples import REACH, Shot, Shots
from bevviz.calib.score import Scorer
from bevviz.calib.search import FINEST, SAMPLE, Peak, climb, search, thin
from bevviz.errors import UserError
from bevviz.model import geometry
from bevviz.model.frame import F64, Bool

SAMPLES = 41  # points of a curve
EDGES = 500  # fewer say nothing
RIVALS = 2  # peaks about as high as the best one, at most, that are likely to be all
FIT = 0.035  # mean score that the worst of real scenes has where the calibration is right (docs/calib.md)
HALF = 3  # frames, least, that are held against as many others
CERTAIN = 1.25  # intervals, that is 2.5 standard deviations: an offset that is no chance
ALONG = 0.005  # metres by which edges that move with others than the robot pull along its way
UNTIMED = 0.05  # metres along z: what 5 ms are worth at 10 m/s, where the motion is not known
TURNS, AHEAD = 3, 5  # how many of the axes are turns; the shift along z
MOTIONLESS = "the motion of the robot is not known"
STILL = 1.0  # metres per second: an image of a robot that hardly moves has no time

Progress = Callable[[float, str], None]


@dataclass(frozen=True, slots=True)
class _Found:
    """The best offsets and how far from them the truth may be. ``rival``: another alignment as good."""

    offsets: F64  # (7,)
    interval: F64  # (7,) two standard deviations and the way to the rivals
    rival: str = ""


@dataclass(frozen=True, slots=True)
class _Said:
    """A finding and why."""

    finding: Finding
    reason: str = ""


def calibrate(
    shots: Shots,
    progress: Progress = lambda done, what: None,
    stamps: Mapping[str, float] = MappingProxyType({}),
) -> Calibration:
    """How wrong the stated calibration and clock of one camera are.

    Maximises the score of ``bevviz.calib.score`` over three turns, three shifts and the time together, from a
    grid and coarse to fine, with a weak prior (``Axis.prior``) that holds what the scene does not. How sure
    that is: ``bevviz.calib.evidence``; ``Axis.floor`` is part of every uncertainty.

    Args:
        shots: of one camera, from ``gather``.
        progress: told which share is done, and what is done next.
        stamps: ``sync.offsets`` that the frames were made with.

    Raises:
        UserError: there is no shot.
    """
    if not shots.shots:
        reasons = "; ".join(f"{reason} ({n} frames)" for reason, n in shots.refused.items())
        raise UserError(f"camera '{shots.camera}': no frame to calibrate with: {reasons or 'no image'}")
    moving = all(shot.motion is not None for shot in shots.shots)
    free = np.array([True] * TIME + [moving])
    found = _Found(np.zeros(len(AXES)), 2 * PRIOR)
    trouble = _too_little(shots)
    if trouble is None:
        scorer, peaks = search(shots.shots, free, progress)
        found, trouble = _weigh(shots, scorer, peaks, free, progress)
    else:
        scorer = Scorer(shots.shots, FINEST)
    progress(0.8, "curves")
    axes = _judge(shots, found, trouble)
    off = np.array([axis.finding is Finding.OFF for axis in axes])
    fixed = climb(scorer, np.where(off, found.offsets, 0.0), off).offsets
    frame, stated = shots.shots[0].frame, shots.shots[0].mounting
    if frame.upright is not None:
        stated = stated @ frame.upright
    image = shots.shots[0].camera.image
    assert image is not None
    return Calibration(
        camera=shots.camera,
        parent=frame.points_frame,
        child=image.frame_id.lstrip("/"),
        topic=image.topic,
        offset=stamps.get(image.topic, 0.0),
        axes=axes,
        frames=len(shots.shots),
        edges=shots.edges,
        stated=geometry.inverse(stated),
        corrected=geometry.inverse(error_pose(fixed) @ stated),
        correction=fixed,
        score_stated=scorer(np.zeros(len(AXES)), slopes=False).mean,
        score_corrected=scorer(fixed, slopes=False).mean,
        notes=tuple(_notes(shots, off)),
    )


def _notes(shots: Shots, off: Bool) -> Iterator[str]:
    for reason, n in shots.refused.items():
        yield f"{n} frames left out: {reason}"
    if off[AHEAD]:
        yield "a focal length that is wrong by a hundredth looks much like 10 cm along the camera's z axis"


# --- what forbids to say anything ---------------------------------------------------------------


def _too_little(shots: Shots) -> _Said | None:
    if shots.edges < EDGES:
        reason = f"too little data: only {shots.edges} edges in the clouds, {EDGES} are needed"
        return _Said(Finding.UNKNOWN, reason)
    if not any(shot.maps.any() for shot in shots.shots):
        return _Said(Finding.UNKNOWN, "too little data: the images show no edges")
    return None


def _weigh(
    shots: Shots, scorer: Scorer, peaks: list[Peak], free: Bool, progress: Progress
) -> tuple[_Found, _Said | None]:
    """How far the truth may be from the best peak, and what forbids to say anything."""
    if not peaks:
        reason = "too little data: there is no place where it would hold the camera"
        return _Found(np.zeros(len(AXES)), 2 * PRIOR), _Said(Finding.UNKNOWN, reason)
    best = peaks[0]
    nothing = _Found(best.offsets, 2 * PRIOR)
    rivals = [rival for rival in peaks[1:] if np.less(*lead(best, rival))]
    error = float(np.sqrt((best.sums.score.sum(0) ** 2).sum()))
    if len(rivals) > RIVALS or best.height < LEAD * error:
        return nothing, _no_peak(scorer, best, error)
    progress(0.5, "uncertainty")
    if (said := _halves(scorer.shots, peaks, free)) is not None:
        return nothing, said
    spread = np.minimum(np.hypot(_told(scorer, best, free), _confusion(shots)), PRIOR)
    spread = np.where(free, spread, PRIOR)
    ways = (
        np.stack([rival.offsets - best.offsets for rival in rivals]) if rivals else np.zeros((1, len(AXES)))
    )
    turned = ", ".join(f"{angle:+.1f}" for angle in ways[0, :TURNS] * SCALES[:TURNS])
    rival = f"turned by {turned} deg, it fits about as well" if rivals else ""
    return _Found(best.offsets, np.abs(ways).max(0) + 2 * spread, rival), None


def _no_peak(scorer: Scorer, best: Peak, error: float) -> _Said:
    """What it means that no peak is higher than all others."""
    if max(best.height, LEAD * error) < FIT * scorer.edges:  # what fits would have shown
        within = f"{np.degrees(REACH):.1f} deg"
        reason = f"the edges of image and cloud do not agree anywhere within {within} of what is stated"
        return _Said(Finding.CONFLICT, f"{reason} (another camera, wrong intrinsics, or further off?)")
    shown, taken = max(round(views(best)), 1), len(scorer.shots)
    frames = f"{shown} frame{'s' if shown > 1 else ''}"
    if shown < taken:
        frames = f"{taken} frames, which show as much as {shown} different one{'s' if shown > 1 else ''},"
    return _Said(Finding.UNKNOWN, f"too little data: in {frames} several alignments fit about as well")


def _halves(taken: Sequence[Shot], peaks: list[Peak], free: Bool) -> _Said | None:
    """Whether the first half of the frames says what the second half says."""
    middle = len(taken) // 2
    if middle < HALF:
        return None
    found = []
    for part in (slice(middle), slice(middle, None)):
        likely = max(peaks, key=lambda peak: float(peak.sums.score[part].sum()))
        scorer = Scorer(taken[part], FINEST)
        peak = climb(scorer, likely.offsets, free, likely)
        found.append((peak.offsets, _told(scorer, peak, free)))
    (first, doubt), (second, other) = found
    apart = np.where(free, np.abs(second - first) / np.hypot(doubt, other), 0.0)
    row = int(np.argmax(apart))
    if apart[row] < 2 * CERTAIN:
        return None
    axis = AXES[row]
    said = ", ".join(f"{offsets[row] * axis.scale:+.{axis.decimals}f}" for offsets in (first, second))
    reason = f"the two halves of the frames disagree on the {axis.what} ({said} {axis.unit})"
    return _Said(Finding.CONFLICT, f"{reason}, as if the camera had been moved on the way")


# --- each axis ---------------------------------------------------------------------------------


def _judge(shots: Shots, found: _Found, trouble: _Said | None) -> tuple[AxisResult, ...]:
    results: list[AxisResult] = []
    scorer = Scorer(thin(shots.shots, 2 * SAMPLE), FINEST)
    for row, axis in enumerate(AXES):
        abscissa = np.linspace(-axis.reach, axis.reach, SAMPLES)
        curve = []
        for value in abscissa:
            at = found.offsets.copy()
            at[row] = value / axis.scale
            curve.append(scorer(at, slopes=False).mean)
        offset, interval = (float(values[row]) * axis.scale for values in (found.offsets, found.interval))
        said = trouble or _finding(shots, axis, offset, interval, found.rival)
        results.append(
            AxisResult(axis, offset, interval, said.finding, said.reason, abscissa, np.array(curve))
        )
    return tuple(results)


def _finding(shots: Shots, axis: Axis, offset: float, interval: float, rival: str) -> _Said:
    if axis is AXES[TIME]:
        speeds = _speeds(shots)
        if len(speeds) < len(shots.shots):
            return _Said(Finding.UNKNOWN, f"{MOTIONLESS} (no fixed frame in TF, no odometry)")
        if speeds.max() < STILL:
            return _Said(Finding.UNKNOWN, f"the robot hardly moved ({speeds.max():.1f} m/s at most)")
    if abs(offset) > max(CERTAIN * interval, axis.least):
        return _Said(Finding.OFF)
    if abs(offset) + interval <= axis.sure:
        return _Said(Finding.FINE)
    return _Said(Finding.UNKNOWN, rival or _why_unsure(shots, axis))


def _why_unsure(shots: Shots, axis: Axis) -> str:
    speeds = _speeds(shots)
    steady = len(speeds) and speeds.mean() > STILL and speeds.std() < 0.2 * speeds.mean()
    if axis.name in ("tz", "dt") and steady:
        per = float(speeds.mean()) / 10
        return (
            f"at a steady {speeds.mean():.1f} m/s, {per:.1f} cm ahead and 1 ms late look the same; "
            "it takes a drive with curves, braking or a stop"
        )
    if axis.name == "tz" and not len(speeds):
        return f"{MOTIONLESS}, and what lies ahead hardly moves in the image with it"
    return "too little data to hold it: it takes frames of more places, and things nearby"


# --- what the data cannot hold -----------------------------------------------------------------


def _told(scorer: Scorer, peak: Peak, free: Bool) -> F64:
    """(7,) standard deviation of what the data says, and of what remains on calibrated sensors."""
    return np.asarray(caution(peak) * np.hypot(scatter(scorer, peak, free), FLOOR), np.float64)


def _confusion(shots: Shots) -> F64:
    """(7,) standard deviation that comes of a steady drive: there, late and too far back are the same.

    Only a change of speed tells them apart, and what edges err along the way is divided by it.
    """
    speeds, confusion = _speeds(shots), np.zeros(len(AXES))
    if len(speeds):
        confusion[TIME] = min(ALONG / max(float(speeds.std()), 1e-6), PRIOR[TIME])
        confusion[AHEAD] = min(float(speeds.mean()) * confusion[TIME], PRIOR[AHEAD])
    else:
        confusion[AHEAD] = UNTIMED
    return confusion


def _speeds(shots: Shots) -> F64:
    """(N,) metres per second at each shot whose motion is known."""
    seconds = 0.3  # that the poses of a shot span
    poses = [shot.motion for shot in shots.shots if shot.motion is not None]
    ways = [(p[-1] @ geometry.inverse(p[0]))[:3, 3] for p in poses]
    return np.asarray(np.linalg.norm(ways, axis=1) / seconds if ways else np.zeros(0), np.float64)
