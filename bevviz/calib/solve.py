"""Finds the offsets at which the edges meet best, and how far the data is to be believed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bevviz import geometry
from bevviz.calib.axes import AXES, PRIOR, TIME, Axis, error_pose
from bevviz.calib.result import AxisResult, Calibration, Finding
from bevviz.calib.score import Scorer, Sums
from bevviz.calib.shots import GROUPS, Shots
from bevviz.errors import UserError
from bevviz.frame import F64, Bool

LADDERS = ((8.0, 4.0), (3.0,))  # pixels of blur, coarse to fine: for errors large and small
FINE = (2.0, 1.0)  # pixels, how every ladder ends
CURVE_BLUR = 2.0  # pixels, of the curves that are shown
SAMPLES = 41  # points of a curve
ROUNDS = 30  # steps at one blur, at most
SETTLED = 0.01  # pixels: a step that moves the edges less is the last
HURRY = 1.7  # over-relaxation: such steps are safe and rather short
EDGES = 500  # fewer say nothing
PEAK = 4.0  # standard errors that a peak must stand out by
RIVAL = 0.9  # share of the height at which another peak is a rival
CERTAIN = 1.25  # intervals, that is 2.5 standard deviations: an offset that is no chance
ALONG = 0.005  # metres by which edges that move with others than the robot pull along its way
STILL = 1.0  # metres per second: an image of a robot that hardly moves has no time


@dataclass(frozen=True, slots=True)
class _Fit:
    offsets: F64  # (7,)
    deviation: F64  # (7,) standard deviation, of the edges and of the prior
    score: float  # mean over the edges


def calibrate(shots: Shots, progress: Callable[[str], None] = lambda _: None) -> Calibration:
    """How wrong the stated calibration and clock of one camera are.

    Maximises the score of ``bevviz.calib.score`` over three turns, three shifts and the time together,
    coarse to fine, with a weak prior (``Axis.prior``) that holds what the scene does not. The uncertainty is
    the greater one of that of the fit and of the jackknife over ``GROUPS`` parts of the frames (Efron and
    Tibshirani 1993, chapter 11), plus ``Axis.floor``.

    Args:
        shots: of one camera, from ``gather``.
        progress: told what is done next.

    Raises:
        UserError: there is no shot.
    """
    if not shots.shots:
        reasons = "; ".join(f"{reason} ({n} frames)" for reason, n in shots.refused.items())
        raise UserError(f"camera '{shots.camera}': no frame to calibrate with: {reasons or 'no image'}")
    moving = all(shot.motion is not None for shot in shots.shots)
    free = np.array([True] * TIME + [moving])
    best = _Fit(np.zeros(len(AXES)), PRIOR, 0.0)
    everything = np.ones(GROUPS, np.bool_)
    scorer = Scorer(shots.shots, FINE[-1])
    if shots.edges >= EDGES:
        best = _search(shots, scorer, free, progress)
    deviation = best.deviation
    if shots.edges >= EDGES:
        progress("jackknife")
        deviation = np.maximum(deviation, _jackknife(scorer, best.offsets, free))
    deviation = np.where(free, np.hypot(deviation, _confusion(shots)), PRIOR)
    progress("curves")
    axes = _judge(shots, best.offsets, deviation)
    off = np.array([axis.finding is Finding.OFF for axis in axes])
    fixed = _climb(scorer, np.where(off, best.offsets, 0.0), off, everything) if off.any() else None
    correction = np.zeros(len(AXES)) if fixed is None else fixed.offsets
    stated = shots.shots[0].mounting
    before = _mean(scorer(np.zeros(len(AXES))))
    image = shots.shots[0].camera.image
    assert image is not None
    return Calibration(
        camera=shots.camera,
        parent=shots.shots[0].frame.points_frame,
        child=image.frame_id.lstrip("/"),
        axes=axes,
        frames=len(shots.shots),
        edges=shots.edges,
        stated=geometry.inverse(stated),
        corrected=geometry.inverse(error_pose(correction) @ stated),
        correction=correction,
        score_stated=before,
        score_corrected=before if fixed is None else fixed.score,
        notes=tuple(f"{n} frames left out: {reason}" for reason, n in shots.refused.items()),
    )


def _search(shots: Shots, finest: Scorer, free: Bool, progress: Callable[[str], None]) -> _Fit:
    """The best of the peaks that the ladders lead to: a wide blur finds far ones, and may miss a near one."""
    everything = np.ones(GROUPS, np.bool_)
    fits = [_Fit(np.zeros(len(AXES)), PRIOR, 0.0)] * len(LADDERS)
    for blur in sorted({*FINE, *(blur for ladder in LADDERS for blur in ladder)}, reverse=True):
        progress(f"blur {blur:.0f} px")
        scorer = finest if blur == FINE[-1] else Scorer(shots.shots, blur)
        for i, ladder in enumerate(LADDERS):
            if blur in (*ladder, *FINE):
                fits[i] = _climb(scorer, fits[i].offsets, free, everything)
    return max(fits, key=lambda fit: fit.score)


def _climb(scorer: Scorer, start: F64, free: Bool, kept: Bool) -> _Fit:
    """Expectation-maximisation with the prior, from ``start``, over the ``free`` axes and ``kept`` groups."""
    hold = np.where(free, 1 / PRIOR**2, 1e18)
    offsets, hurry = start, HURRY
    sums = scorer(offsets)
    trust = _trust(sums, kept)
    for _ in range(ROUNDS):
        information = sums.information[kept].sum(0)
        precision = trust * information + np.diag(hold)
        pull = trust * sums.gradient[kept].sum(0) - hold * (offsets - np.where(free, 0.0, start))
        step = hurry * np.linalg.solve(precision, pull)
        tried = scorer(offsets + step)
        gain = trust * float((tried.score - sums.score)[kept].sum())
        gain -= 0.5 * float((hold[free] * ((offsets + step)[free] ** 2 - offsets[free] ** 2)).sum())
        if gain < 0:
            hurry /= 2
            if hurry < 0.2:
                break
            continue
        offsets, sums = offsets + step, tried
        moved = step @ information @ step * scorer.variance / max(float(sums.count[kept].sum()), 1.0)
        if moved < SETTLED**2:
            break
    precision = trust * sums.information[kept].sum(0) + np.diag(hold)
    return _Fit(offsets, np.sqrt(np.diag(np.linalg.inv(precision))), _mean(sums))


def _trust(sums: Sums, kept: Bool) -> float:
    """The share of the edges that count as independent: neighbours on one border err together.

    For a true likelihood, the scatter of the groups' gradients is the information.
    """
    information = sums.information[kept].sum(0)
    unit = 1 / np.sqrt(np.maximum(np.diag(information), 1e-12))
    gradient = sums.gradient[kept]
    scatter = (gradient - gradient.mean(0)) * unit
    return min(1.0, len(unit) / max(float((scatter**2).sum()), 1e-12))


def _jackknife(scorer: Scorer, best: F64, free: Bool) -> F64:
    """(7,) standard error from fits that leave one group out."""
    fits = [_climb(scorer, best, free, np.arange(GROUPS) != left).offsets for left in range(GROUPS)]
    scatter = np.stack(fits) - np.mean(fits, axis=0)
    return np.asarray(np.sqrt((GROUPS - 1) / GROUPS * (scatter**2).sum(0)), np.float64)


def _mean(sums: Sums) -> float:
    return float(sums.score.sum() / max(float(sums.count.sum()), 1.0))


# --- findings ----------------------------------------------------------------------------------


def _judge(shots: Shots, best: F64, deviation: F64) -> tuple[AxisResult, ...]:
    scorer = Scorer(shots.shots, CURVE_BLUR)
    top = scorer(best)
    found: list[AxisResult] = []
    chance = ""  # any true match fixes where the camera looks: without that, other peaks are chance
    for row, axis in enumerate(AXES):
        abscissa = np.linspace(-axis.reach, axis.reach, SAMPLES)
        curve = []
        for value in abscissa:
            at = best.copy()
            at[row] = value / axis.scale
            curve.append(scorer(at, slopes=False))
        offset = float(best[row]) * axis.scale
        interval = 2 * float(np.hypot(deviation[row] * axis.scale, axis.floor))
        scores = np.array([_mean(sums) for sums in curve])
        reason = chance or _doubt(shots, axis, abscissa, curve, top, offset)
        sure = interval <= axis.sure or abs(offset) > CERTAIN * interval
        if not reason and not sure:
            reason = _why_unsure(shots, axis)
        if row < 2 and reason:
            chance = reason
        finding = Finding.FINE
        if reason:
            finding = Finding.UNKNOWN
        elif abs(offset) > max(CERTAIN * interval, axis.least):
            finding = Finding.OFF
        found.append(AxisResult(axis, offset, interval, finding, reason, abscissa, scores))
    return tuple(found)


def _doubt(shots: Shots, axis: Axis, abscissa: F64, curve: list[Sums], top: Sums, offset: float) -> str:
    """Why the peak of this axis is no peak; empty where it is one."""
    if shots.edges < EDGES:
        return f"only {shots.edges} edges in the clouds, {EDGES} are needed"
    if axis is AXES[TIME]:
        if any(shot.motion is None for shot in shots.shots):
            return "the motion of the robot is not known (no fixed frame in TF, no odometry)"
        if _speed(shots) < STILL:
            return f"the robot hardly moved ({_speed(shots):.1f} m/s at most)"
    count = np.maximum(top.count, 1.0)
    groups = np.stack([sums.score / count for sums in curve])  # (S, G)
    height = top.score / count - np.median(groups, axis=0)
    used = top.count > 0
    error = float(height[used].std(ddof=1)) / np.sqrt(used.sum()) if used.sum() > 1 else np.inf
    if float(height[used].mean()) <= PEAK * error:
        return "the score is flat: the edges of image and cloud do not agree anywhere"
    mean = np.array([_mean(sums) for sums in curve])
    rise = (mean - np.median(mean)) / max(_mean(top) - float(np.median(mean)), 1e-12)
    peak = np.flatnonzero((mean[1:-1] > mean[:-2]) & (mean[1:-1] > mean[2:])) + 1
    far = peak[np.abs(abscissa[peak] - offset) > axis.reach / 5]
    rivals = [float(abscissa[i]) for i in far if rise[i] > RIVAL]
    if rivals:
        return f"the score has another peak at {rivals[0]:+.{axis.decimals}f} {axis.unit}"
    return ""


def _confusion(shots: Shots) -> F64:
    """(7,) standard deviation that comes of a steady drive: there, late and too far back are the same.

    Only a change of speed tells them apart, and what edges err along the way is divided by it.
    """
    speeds, confusion = _speeds(shots), np.zeros(len(AXES))
    if len(speeds):
        confusion[TIME] = min(ALONG / max(float(speeds.std()), 1e-6), PRIOR[TIME])
        confusion[TIME - 1] = min(float(speeds.mean()) * confusion[TIME], PRIOR[TIME - 1])
    return confusion


def _why_unsure(shots: Shots, axis: Axis) -> str:
    if axis.name in ("tz", "dt") and all(shot.motion is not None for shot in shots.shots):
        speeds = _speeds(shots)
        if speeds.mean() > STILL and speeds.std() < 0.2 * speeds.mean():
            per = float(speeds.mean()) / 10
            return (
                f"at a steady {speeds.mean():.1f} m/s, {per:.1f} cm ahead and 1 ms late look the same; "
                "it takes a drive with curves, braking or a stop"
            )
    return "too few edges constrain it, or the frames disagree"


def _speeds(shots: Shots) -> F64:
    """(N,) metres per second at each shot whose motion is known."""
    seconds = 0.3  # that the poses of a shot span
    poses = [shot.motion for shot in shots.shots if shot.motion is not None]
    ways = [(p[-1] @ geometry.inverse(p[0]))[:3, 3] for p in poses]
    return np.asarray(np.linalg.norm(ways, axis=1) / seconds if ways else np.zeros(0), np.float64)


def _speed(shots: Shots) -> float:
    return float(_speeds(shots).max(initial=0.0))
