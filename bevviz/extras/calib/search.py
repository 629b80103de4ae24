"""Search for the peaks of the score: a grid over turns and sideways shifts, and climbs from its best points.

An error of one degree is many times wider than a peak. So a climb from the stated calibration ends on any
peak in between. The grid finds all peaks. The result depends on how the other peaks compare to the highest
one.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from bevviz.extras.calib.result import AXES, PRIOR, error_pose
from bevviz.extras.calib.score import REACH, Scorer, Shot, Sums
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, I64, Bool
from bevviz.stages.edges import SHARE, add_scores, densities, log_densities

STEP = np.radians(0.32)  # radians, step of the grid about x and y
ROLL = np.radians(0.7)  # radians about z, where an error moves the middle of the image little
ROLLS = 4  # steps of ROLL to both sides
SHIFTS = (-0.15, 0.0, 0.15)  # metres along x and y
SAMPLE = 5000  # edges, about, for the grid; more edges of the same borders add little
MOST = 6 * SAMPLE  # edges, most that any step uses
STARTS = 16  # peaks of the grid that are climbed
FINALISTS = 6  # peaks that are climbed to the end
LADDER = 2.5  # pixels of blur between that of the grid and the finest
FINEST = 1.5
APART = np.radians(0.3)  # radians; peaks with larger differences of their turns are distinct
WORTH = 1000.0  # the edges weigh at most as much as this number of independent edges, relative to the prior
ROUNDS = 30  # steps at one blur, at most
SETTLED = 0.01  # pixels; a climb ends with a smaller step
FARTHEST = 2.0  # blurs that a step may move the edges
HALVINGS = 4


@dataclass(frozen=True, slots=True)
class Peak:
    """A local maximum of the score."""

    offsets: F64  # (7,)
    sums: Sums
    metric: F64  # (7, 7) about the inverse of the curvature
    pixels: F64  # (7, 7) mean square of the pixels by which offsets move the edges

    @property
    def height(self) -> float:
        """Score at the peak, summed over all edges."""
        return float(self.sums.score.sum())


def search(
    shots: Sequence[Shot], free: Bool, progress: Callable[[float, str], None]
) -> tuple[Scorer, list[Peak]]:
    """Search the offsets over the (7,) ``free`` axes. Return the last scorer and the peaks, highest first.

    Without data, there may be no peak.
    """
    progress(0.0, "grid")
    blur, starts = _grid(thin(shots, SAMPLE))
    starts.insert(0, np.zeros(len(AXES)))
    progress(0.1, "coarse")
    peaks = _climbs(Scorer(thin(shots, 2 * SAMPLE), blur), starts, free)
    progress(0.2, "fine")
    shots = thin(shots, MOST)
    peaks = _climbs(
        Scorer(thin(shots, MOST // 2), LADDER), [peak.offsets for peak in peaks[:FINALISTS]], free
    )
    progress(0.4, "finest")
    scorer = Scorer(shots, FINEST)
    return scorer, _climbs(scorer, [peak.offsets for peak in peaks], free)


def _climbs(scorer: Scorer, starts: list[F64], free: Bool) -> list[Peak]:
    """Climb from each start. Return the distinct peaks within two priors of zero, highest first."""
    peaks = [climb(scorer, start, free) for start in starts]
    near = [peak for peak in peaks if (np.abs(peak.offsets) < 2 * PRIOR).all()]
    kept: list[Peak] = []
    for peak in sorted(near, key=lambda peak: -peak.height):
        if all(np.abs(peak.offsets - other.offsets)[:3].max() > APART for other in kept):
            kept.append(peak)
    return kept


def climb(
    scorer: Scorer,
    start: F64,
    free: Bool,
    near: Peak | None = None,
    weight: F64 | float = 1.0,
    settled: float = SETTLED,
) -> Peak:
    """Climb the score plus the prior by BFGS (Nocedal and Wright 2006, chapter 6) over the ``free`` axes.

    Args:
        scorer: gives the score.
        start: (7,) offsets.
        free: (7,) whether an axis moves.
        near: peak of about the same shape. Without it, the first step is one of expectation-maximisation.
        weight: (S, PARTS) or one number: weight of each part of each shot.
        settled: pixels. A step that moves the edges by less is the last.
    """
    worth = min(1.0, WORTH / max(scorer.edges, 1))
    hold = np.where(free, 1 / PRIOR**2, 0.0)
    offsets = start
    sums = scorer(offsets, information=near is None)
    if near is None:
        pixels = sums.information * scorer.variance / max(SHARE * scorer.edges, 1.0)
        metric = np.asarray(np.linalg.inv(worth * sums.information + np.diag(1 / PRIOR**2)), np.float64)
    else:
        pixels, metric = near.pixels, near.metric
    metric = metric * np.outer(free, free)
    slope = worth * _total(sums.gradient, weight) - hold * offsets
    for _ in range(ROUNDS):
        step = metric @ slope
        step *= min(1.0, FARTHEST * scorer.sigma / max(float(np.sqrt(step @ pixels @ step)), 1e-12))
        for _ in range(HALVINGS):
            tried = scorer(offsets + step)
            gain = worth * float(((tried.score - sums.score) * weight).sum())
            gain -= 0.5 * float((hold * ((offsets + step) ** 2 - offsets**2)).sum())
            if gain > 0:
                break
            step = step / 4
        else:
            break
        offsets, sums, before = offsets + step, tried, slope
        slope = worth * _total(sums.gradient, weight) - hold * offsets
        bend = (before - slope) * free
        if (along := float(step @ bend)) > 0:
            project = np.eye(len(step)) - np.outer(step, bend) / along
            metric = project @ metric @ project.T + np.outer(step, step) / along
        if step @ pixels @ step < settled**2:
            break
    return Peak(offsets, sums, metric, pixels)


def _total(gradient: F64, weight: F64 | float) -> F64:
    """Sum a gradient over all parts of all shots, with weights."""
    return np.asarray((gradient * np.asarray(weight)[..., None]).sum((0, 1)), np.float64)


def thin(shots: Sequence[Shot], edges: int) -> list[Shot]:
    """Return the same shots with about this number of edges, or fewer."""
    every = -(-sum(len(shot.xyz) for shot in shots) // edges)
    return [
        replace(shot, xyz=shot.xyz[::every], change=shot.change[::every], cell=shot.cell[::every])
        if every > 1
        else shot
        for shot in shots
    ]


# --- the grid ----------------------------------------------------------------------------------


def _grid(shots: Sequence[Shot]) -> tuple[float, list[F64]]:
    """Return the blur of the grid in pixels, and the (7,) offsets of its highest peaks."""
    focal = float(np.mean([shot.K[0, 0] for shot in shots]))
    blur = max(focal * STEP, FINEST)
    shrink = max(1, round(blur))
    sides = round(REACH / STEP)
    axis = np.arange(-sides, sides + 1) * STEP
    roll = np.arange(-ROLLS, ROLLS + 1) * ROLL
    turns = np.stack(np.meshgrid(axis, axis, roll, indexing="ij"), -1)
    rotations = np.stack([error_pose(np.append(turn, np.zeros(4)))[:3, :3] for turn in turns.reshape(-1, 3)])
    parts = [_shrunk(shot, blur, shrink) for shot in shots if len(shot.xyz)]
    peaks: list[tuple[float, F64]] = []
    for along_x, along_y in itertools.product(SHIFTS, SHIFTS):
        shift = np.array([along_x, along_y, 0.0])
        sums = np.zeros(len(rotations))
        for xyz, row, logs, K in parts:
            add_scores(
                xyz, row, logs, (K @ rotations).astype(np.float32), (K @ shift).astype(np.float32), sums
            )
        score = sums.reshape(turns.shape[:3])
        for place in np.argwhere(_highest(score) & (score > 0)):
            at = tuple(place)
            peaks.append((float(score[at]), np.concatenate([turns[at], shift, [0.0]])))
    peaks.sort(key=lambda peak: -peak[0])
    return blur, [offsets for _, offsets in peaks[:STARTS]]


def _shrunk(shot: Shot, blur: float, shrink: int) -> tuple[F32, I64, F32, F64]:
    """Return the edges in the stated camera, the density of each, the log densities, and their K."""
    density, row, _ = densities(shot.change, shot.maps, blur)
    height, width = (-(-size // shrink) for size in density.shape[1:])
    small = [cv2.resize(d, (width, height), interpolation=cv2.INTER_AREA) for d in density]
    sx, sy = width / density.shape[2], height / density.shape[1]
    scale = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
    xyz = geometry.apply(shot.camera_from_points(0.0), shot.xyz)
    return xyz, row, log_densities(np.stack(small)), scale @ shot.K


def _highest(score: F64) -> Bool:
    """Return which cells of a grid have no higher neighbour."""
    around = np.pad(score, 1, constant_values=-np.inf)
    highest = np.ones(score.shape, np.bool_)
    for steps in itertools.product(range(3), repeat=score.ndim):
        inner = [slice(step, step + size) for step, size in zip(steps, score.shape, strict=True)]
        highest &= score >= around[tuple(inner)]
    return highest
