"""Score of how well the edges of clouds lie on the edges of images, and its gradient.

The edges of an image, blurred by ``sigma`` pixels, are a density of mean 1. A ``SHARE`` of the projected
edges of the cloud is drawn from this density, and the others fall anywhere. So the score of an edge is the
logarithm of 1 - SHARE + SHARE * density. An edge outside the image scores 0. This makes the scores of
different poses and of different images comparable. The score has the same peak as the inverse distance
transform of Levinson and Thrun, is smooth, and needs no threshold. Its gradient, with the information of the
edges that fit, gives one step of expectation-maximisation, with which a climb can start.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bevviz.calib.offsets import AXES, TIME, error_pose
from bevviz.calib.samples import CELLS, Shot
from bevviz.model.frame import F32, F64, I32, I64, Bool
from bevviz.stages.edges import SHARE, densities
from bevviz.support.kernel import kernel

PIXEL = 1.5  # pixels^2, variance of the edges themselves
MOMENT = 0.01  # seconds over which the motion of the robot is differenced
PARTS = CELLS[0] * CELLS[1]


@dataclass(frozen=True, slots=True)
class Sums:
    """Score and slopes summed over the edges in each part of each shot.

    Shots and parts can be compared and left out.
    """

    score: F64  # (S, PARTS)
    count: F64  # (S, PARTS)
    gradient: F64  # (S, PARTS, 7)
    information: F64  # (7, 7) of the edges that fit

    @property
    def mean(self) -> float:
        """Mean score of an edge."""
        return float(self.score.sum() / max(float(self.count.sum()), 1.0))


class Scorer:
    """The score of all shots of one camera, at one blur.

    Args:
        shots: shots of the camera.
        sigma: blur in pixels.
    """

    def __init__(self, shots: Sequence[Shot], sigma: float) -> None:
        self.shots = shots
        self.sigma = sigma
        self.variance = sigma * sigma + PIXEL
        self.edges = sum(len(shot.xyz) for shot in shots)
        self._densities = [densities(shot.change, shot.maps, sigma) for shot in shots]

    def __call__(self, offsets: F64, slopes: bool = True, information: bool = False) -> Sums:
        """Return the sums at (7,) offsets in radians, metres and seconds. Sums not asked for are zero."""
        size = len(AXES)
        score, count = np.zeros((2, len(self.shots), PARTS))
        gradient, fitting = np.zeros((len(self.shots), PARTS, size)), np.zeros((size, size))
        error, late = error_pose(offsets), float(offsets[TIME])
        for i, (shot, (density, row, along_v)) in enumerate(zip(self.shots, self._densities, strict=True)):
            pose, change = error @ shot.camera_from_points(late), np.zeros((4, 4))
            if slopes and shot.motion is not None:
                before, after = (shot.camera_from_points(late + t) for t in (-MOMENT / 2, MOMENT / 2))
                change = error @ (after - before) / MOMENT
            _add(
                shot.xyz,
                row,
                along_v,
                shot.cell,
                pose,
                change,
                shot.K,
                density,
                self.variance,
                slopes,
                information,
                score[i],
                count[i],
                gradient[i],
                fitting,
            )
        return Sums(score, count, gradient, fitting)


@kernel
def _add(
    xyz: F32,
    density_row: I64,
    along_v: Bool,
    cell: I32,
    pose: F64,
    change: F64,
    K: F64,
    density: F32,
    variance: float,
    slopes: bool,
    information: bool,
    score: F64,
    count: F64,
    gradient: F64,
    fitting: F64,
) -> None:
    """Add the edges of one shot. ``change`` is the change of ``pose`` per second of time offset."""
    height, width = density.shape[1:]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    ju, jv, p, speed = np.zeros(7), np.zeros(7), np.zeros(3), np.zeros(3)
    for i in range(len(xyz)):
        for a in range(3):
            p[a] = pose[a, 0] * xyz[i, 0] + pose[a, 1] * xyz[i, 1] + pose[a, 2] * xyz[i, 2] + pose[a, 3]
        g = cell[i]
        count[g] += 1
        if p[2] < 1.0:
            continue
        x, y = p[0] / p[2], p[1] / p[2]
        u, v = fx * x + cx, fy * y + cy
        if not (0 <= u < width - 1 and 0 <= v < height - 1):
            continue
        col, row, k = int(u), int(v), density_row[i]
        s, t = u - col, v - row
        d00, d01 = density[k, row, col], density[k, row, col + 1]
        d10, d11 = density[k, row + 1, col], density[k, row + 1, col + 1]
        d = (1 - t) * ((1 - s) * d00 + s * d01) + t * ((1 - s) * d10 + s * d11)
        fit = 1 - SHARE + SHARE * d
        score[g] += np.log(fit)
        if not slopes:
            continue
        du = (1 - t) * (d01 - d00) + t * (d11 - d10)
        dv = (1 - s) * (d10 - d00) + s * (d11 - d01)
        for a in range(3):
            speed[a] = change[a, 3]
            speed[a] += change[a, 0] * xyz[i, 0] + change[a, 1] * xyz[i, 1] + change[a, 2] * xyz[i, 2]
        ju[0], jv[0] = -fx * x * y, -fy * (1 + y * y)
        ju[1], jv[1] = fx * (1 + x * x), fy * x * y
        ju[2], jv[2] = -fx * y, fy * x
        ju[3], jv[4] = fx / p[2], fy / p[2]
        ju[5], jv[5] = -fx * x / p[2], -fy * y / p[2]
        ju[6] = fx * (speed[0] - x * speed[2]) / p[2]
        jv[6] = fy * (speed[1] - y * speed[2]) / p[2]
        du, dv = SHARE / fit * du, SHARE / fit * dv
        for a in range(7):
            gradient[g, a] += du * ju[a] + dv * jv[a]
        if not information:
            continue
        j, weight = jv if along_v[k] else ju, SHARE * d / fit / variance
        for a in range(7):
            for b in range(7):
                fitting[a, b] += weight * j[a] * j[b]
