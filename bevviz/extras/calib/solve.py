"""Find the offsets at which the edges meet best, and judge each axis with its uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from bevviz.errors import UserError
from bevviz.extras.calib.result import (
    AXES,
    FLOOR,
    PRIOR,
    SCALES,
    TIME,
    Axis,
    AxisFinding,
    AxisResult,
    Calibration,
    error_pose,
    frames_text,
)
from bevviz.extras.calib.score import REACH, Scorer, Shot, Shots
from bevviz.extras.calib.search import FINEST, SAMPLE, Peak, climb, search, thin
from bevviz.model import geometry
from bevviz.model.frame import F64, Bool

SAMPLES = 41  # points of a score curve
EDGES = 500  # fewer edges give no result
RIVALS = 2  # with more peaks about as high as the best one, there are probably more still
FIT = 0.03  # mean score between that of unrelated images and of right calibrations (docs/extras/calib.md)
HALF = 3  # frames, least size of the halves that are compared
CERTAIN = 1.25  # intervals, that is 2.5 standard deviations: a larger offset is significant
ALONG = 0.005  # metres by which edges of other moving things shift the result along the robot's way
UNTIMED = 0.05  # metres along z where the motion is unknown: 5 ms at 10 m/s
TURNS, AHEAD = 3, 5  # number of turns in AXES; row of the shift along z
MOTIONLESS = "the motion of the robot is not known"
STILL = 1.0  # metres per second; at lower speeds the time of an image has no effect
REPLICATES = 24  # climbs with random weights
SETTLED = 0.05  # pixels, last step of the climb of a replicate
VIEW = 6.0  # hidden variance of a view, as a multiple of the variance of its parts (docs/extras/calib.md)
LEAD = 2.0  # standard errors by which the best peak must be higher than another

Progress = Callable[[float, str], None]


@dataclass(frozen=True, slots=True)
class _Estimate:
    """The best offsets and their uncertainty. ``rival`` describes another alignment that is as good."""

    offsets: F64  # (7,)
    interval: F64  # (7,) two standard deviations plus the distance to the rivals
    rival: str = ""


@dataclass(frozen=True, slots=True)
class _Judgement:
    """A finding and its reason."""

    finding: AxisFinding
    reason: str = ""


def calibrate(
    shots: Shots,
    progress: Progress = lambda done, what: None,
    stamps: Mapping[str, float] = MappingProxyType({}),
) -> Calibration:
    """Measure the error of the stated calibration and clock of one camera.

    The function maximises the score of ``score.py`` over three turns, three shifts and the time together. It
    starts from a grid and goes from coarse to fine. A weak prior (``Axis.prior``) holds the offsets that the
    scene does not determine. The uncertainty comes from this module and includes ``Axis.floor``.

    Args:
        shots: shots of one camera, from ``gather``.
        progress: called with the share that is done and the name of the next step.
        stamps: ``sync.offsets`` that the frames were made with.

    Raises:
        UserError: there is no shot.
    """
    if not shots.shots:
        reasons = "; ".join(f"{reason} ({count} frames)" for reason, count in shots.refused.items())
        raise UserError(f"camera '{shots.camera}': no frame to calibrate with: {reasons or 'no image'}")
    moving = all(shot.motion is not None for shot in shots.shots)
    free = np.array([True] * TIME + [moving])
    estimate = _Estimate(np.zeros(len(AXES)), 2 * PRIOR)
    trouble = _too_little(shots)
    if trouble is None:
        scorer, peaks = search(shots.shots, free, progress)
        estimate, trouble = _weigh(shots, scorer, peaks, free, progress)
    else:
        scorer = Scorer(shots.shots, FINEST)
    progress(0.8, "curves")
    axes = _judge(shots, estimate, trouble)
    off = np.array([axis.finding is AxisFinding.OFF for axis in axes])
    fixed = climb(scorer, np.where(off, estimate.offsets, 0.0), off).offsets
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
    """Yield the frames left out and a caution about the focal length."""
    for reason, n in shots.refused.items():
        yield f"{n} frames left out: {reason}"
    if off[AHEAD]:
        yield "a focal length that is wrong by a hundredth looks much like 10 cm along the camera's z axis"


# --- reasons for no result ----------------------------------------------------------------------


def _too_little(shots: Shots) -> _Judgement | None:
    """Return a finding UNKNOWN if cloud or images have too few edges, else None."""
    if shots.edges < EDGES:
        reason = f"too little data: only {shots.edges} edges in the clouds, {EDGES} are needed"
        return _Judgement(AxisFinding.UNKNOWN, reason)
    if not any(shot.maps.any() for shot in shots.shots):
        return _Judgement(AxisFinding.UNKNOWN, "too little data: the images show no edges")
    return None


def _weigh(
    shots: Shots, scorer: Scorer, peaks: list[Peak], free: Bool, progress: Progress
) -> tuple[_Estimate, _Judgement | None]:
    """Return the offsets with their uncertainty, and a finding that holds for all axes or None."""
    if not peaks:
        reason = "too little data: there is no place where it would hold the camera"
        return _Estimate(np.zeros(len(AXES)), 2 * PRIOR), _Judgement(AxisFinding.UNKNOWN, reason)
    best = peaks[0]
    nothing = _Estimate(best.offsets, 2 * PRIOR)
    rivals = [rival for rival in peaks[1:] if np.less(*_lead(best, rival))]
    error = float(np.sqrt((best.sums.score.sum(0) ** 2).sum()))
    if len(rivals) > RIVALS or best.height < LEAD * error:
        return nothing, _no_peak(scorer, best, error)
    progress(0.5, "uncertainty")
    if (judgement := _halves(scorer.shots, peaks, free)) is not None:
        return nothing, judgement
    spread = np.minimum(np.hypot(_data_deviation(scorer, best, free), _confusion(shots)), PRIOR)
    spread = np.where(free, spread, PRIOR)
    rival_offsets = (
        np.stack([rival.offsets - best.offsets for rival in rivals]) if rivals else np.zeros((1, len(AXES)))
    )
    turned = ", ".join(f"{angle:+.1f}" for angle in rival_offsets[0, :TURNS] * SCALES[:TURNS])
    rival = f"turned by {turned} deg, it fits about as well" if rivals else ""
    return _Estimate(best.offsets, np.abs(rival_offsets).max(0) + 2 * spread, rival), None


def _no_peak(scorer: Scorer, best: Peak, error: float) -> _Judgement:
    """Return the finding for a best peak that is not clearly higher than the others."""
    shown, taken = max(round(_independent_views(best)), 1), len(scorer.shots)
    # From two frames on, a right calibration would have a higher score.
    if shown > 1 and max(best.height, LEAD * error) < FIT * scorer.edges:
        within = f"{np.degrees(REACH):.1f} deg"
        reason = f"the edges of image and cloud do not agree anywhere within {within} of what is stated"
        return _Judgement(
            AxisFinding.CONFLICT, f"{reason} (another camera, wrong intrinsics, or further off?)"
        )
    frames = frames_text(shown)
    if shown < taken:
        frames = f"{taken} frames, which show as much as {shown} different one{'s' if shown > 1 else ''},"
    return _Judgement(
        AxisFinding.UNKNOWN, f"too little data: in {frames} several alignments fit about as well"
    )


def _halves(taken: Sequence[Shot], peaks: list[Peak], free: Bool) -> _Judgement | None:
    """Return a finding CONFLICT if the two halves of the frames disagree, else None."""
    middle = len(taken) // 2
    if middle < HALF:
        return None
    half_results = []
    for part in (slice(middle), slice(middle, None)):
        likely = max(peaks, key=lambda peak: float(peak.sums.score[part].sum()))
        scorer = Scorer(taken[part], FINEST)
        peak = climb(scorer, likely.offsets, free, likely)
        half_results.append((peak.offsets, _data_deviation(scorer, peak, free)))
    (first, doubt), (second, other) = half_results
    deviation = np.where(free, np.abs(second - first) / np.hypot(doubt, other), 0.0)
    row = int(np.argmax(deviation))
    if deviation[row] < 2 * CERTAIN:
        return None
    axis = AXES[row]
    values = ", ".join(f"{offsets[row] * axis.scale:+.{axis.decimals}f}" for offsets in (first, second))
    reason = f"the two halves of the frames disagree on the {axis.what} ({values} {axis.unit})"
    return _Judgement(AxisFinding.CONFLICT, f"{reason}, as if the camera had been moved on the way")


# --- each axis ---------------------------------------------------------------------------------


def _judge(shots: Shots, estimate: _Estimate, trouble: _Judgement | None) -> tuple[AxisResult, ...]:
    """Return the result of each axis with its score curve."""
    results: list[AxisResult] = []
    scorer = Scorer(thin(shots.shots, 2 * SAMPLE), FINEST)
    for row, axis in enumerate(AXES):
        abscissa = np.linspace(-axis.reach, axis.reach, SAMPLES)
        curve = []
        for value in abscissa:
            at = estimate.offsets.copy()
            at[row] = value / axis.scale
            curve.append(scorer(at, slopes=False).mean)
        offset, interval = (
            float(values[row]) * axis.scale for values in (estimate.offsets, estimate.interval)
        )
        judgement = trouble or _finding(shots, axis, offset, interval, estimate.rival)
        results.append(
            AxisResult(axis, offset, interval, judgement.finding, judgement.reason, abscissa, np.array(curve))
        )
    return tuple(results)


def _finding(shots: Shots, axis: Axis, offset: float, interval: float, rival: str) -> _Judgement:
    """Return the finding for one axis.

    Shift along z and time are told apart by differences between the frames alone. Too few frames to compare
    their halves agree by chance, so they do not confirm these two.
    """
    if axis is AXES[TIME]:
        speeds = _speeds(shots)
        if len(speeds) < len(shots.shots):
            return _Judgement(AxisFinding.UNKNOWN, f"{MOTIONLESS} (no fixed frame in TF, no odometry)")
        if speeds.max() < STILL:
            return _Judgement(AxisFinding.UNKNOWN, f"the robot hardly moved ({speeds.max():.1f} m/s at most)")
    if abs(offset) > max(CERTAIN * interval, axis.least):
        return _Judgement(AxisFinding.OFF)
    if abs(offset) + interval <= axis.sure:
        if axis.name in ("tz", "dt") and (taken := len(shots.shots)) < 2 * HALF:
            return _Judgement(
                AxisFinding.UNKNOWN, f"{frames_text(taken)} cannot hold it: it takes {2 * HALF} or more"
            )
        return _Judgement(AxisFinding.FINE)
    return _Judgement(AxisFinding.UNKNOWN, rival or _why_unsure(shots, axis))


def _why_unsure(shots: Shots, axis: Axis) -> str:
    """Return why the data does not determine an axis."""
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


# --- uncertainty of the data -------------------------------------------------------------------


def _data_deviation(scorer: Scorer, peak: Peak, free: Bool) -> F64:
    """Return the (7,) standard deviation from the data, including the floor of calibrated sensors.

    It is widened for few views: they have errors that they do not show.
    """
    caution = np.sqrt(1 + VIEW / _independent_views(peak))
    return np.asarray(caution * np.hypot(_scatter(scorer, peak, free), FLOOR), np.float64)


def _scatter(scorer: Scorer, peak: Peak, free: Bool) -> F64:
    """Return the (7,) standard deviation of a peak, from climbs with random weights of the data.

    The edges of one border have the same error, and so have the edges of one object in many frames: thirty
    images of one place are worth one image. So nothing here counts edges. The data is divided into frames and
    into parts of the image, and both are weighted at random, independently (Owen and Eckles 2012,
    "Bootstrapping data arrays of arbitrary order"). The weight of a frame varies more if other frames are
    like it: the weights of eight copies of a frame add up to the weight of one unique frame. If all frames
    are the same, the result is the scatter between the parts of one image.
    """
    rng = np.random.default_rng(0)
    frames, parts = peak.sums.score.shape
    shape = _independent_views(peak) / frames
    replicates = []
    for _ in range(REPLICATES):
        weight = np.outer(rng.gamma(shape, 1 / shape, frames), rng.exponential(size=parts))
        replicates.append(climb(scorer, peak.offsets, free, peak, weight / weight.mean(), SETTLED).offsets)
    return np.asarray(np.sqrt(((np.stack(replicates) - peak.offsets) ** 2).mean(0)), np.float64)


def _independent_views(peak: Peak) -> float:
    """Return how many frames have independent errors: 1 for the same frame thirty times.

    This is the participation ratio of the gradients of the frames' parts at the peak, correlated frame with
    frame.
    """
    values, vectors = np.linalg.eigh(peak.metric)
    pull = peak.sums.gradient @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    pull = pull.reshape(len(pull), -1)
    pull = pull[np.linalg.norm(pull, axis=1) > 0]
    if not len(pull):
        return 1.0
    correlation = np.corrcoef(pull) if len(pull) > 1 else np.ones((1, 1))
    return float(len(pull) ** 2 / (correlation**2).sum())


def _lead(best: Peak, rival: Peak) -> tuple[float, float]:
    """Return by how much the best peak is higher than another, and by how much it must be.

    The comparison goes part by part and frame by frame, as that of Vuong 1989, "Likelihood Ratio Tests for
    Model Selection and Non-Nested Hypotheses", goes sample by sample.
    """
    ahead = best.sums.score - rival.sums.score
    by_frame, by_part = ahead.sum(1), ahead.sum(0)
    n = len(by_frame)
    between = float(((by_frame - by_frame.mean()) ** 2).sum()) * n / (n - 1) if n > 1 else 0.0
    return float(ahead.sum()), LEAD * float(np.sqrt(max(between, float((by_part**2).sum()))))


def _confusion(shots: Shots) -> F64:
    """Return the (7,) standard deviation due to a steady drive.

    At a steady speed, late stamps and a camera too far back look the same. A change of speed separates them,
    so the error of the edges along the way is divided by that change.
    """
    speeds, confusion = _speeds(shots), np.zeros(len(AXES))
    if len(speeds):
        confusion[TIME] = min(ALONG / max(float(speeds.std()), 1e-6), PRIOR[TIME])
        confusion[AHEAD] = min(float(speeds.mean()) * confusion[TIME], PRIOR[AHEAD])
    else:
        confusion[AHEAD] = UNTIMED
    return confusion


def _speeds(shots: Shots) -> F64:
    """Return the (N,) metres per second at each shot with known motion."""
    seconds = 0.3  # the poses of a shot span this time
    poses = [shot.motion for shot in shots.shots if shot.motion is not None]
    shifts = [(motion[-1] @ geometry.inverse(motion[0]))[:3, 3] for motion in poses]
    return np.asarray(np.linalg.norm(shifts, axis=1) / seconds if shifts else np.zeros(0), np.float64)
