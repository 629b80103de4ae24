"""How well the edges of clouds lie on the edges of images, and which way they would rather go.

The edges of an image, blurred by ``sigma`` pixels, are taken for the density that the projected edges of the
cloud are drawn from, beside a share that fits nowhere: the score is the mean of log(1 + density / OUTLIER).
It has the same peak as the inverse distance transform of Levinson and Thrun, is smooth, needs no
threshold, and its gradient with its information matrix gives the step of an expectation-maximisation,
which climbs without a step size to choose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from bevviz.calib.axes import AXES, TIME, error_pose
from bevviz.calib.shots import GROUPS, Shot
from bevviz.frame import F32, F64, I32, U8
from bevviz.stages.kernel import kernel

OUTLIER = 0.5  # density, in multiples of the usual change, at which an edge fits as well as not
PIXEL = 1.5  # pixels^2, variance of the edges themselves
MOMENT = 0.01  # seconds over which the motion of the robot is differenced


@dataclass(frozen=True, slots=True)
class Sums:
    """Over the edges of each group, so that a part of the frames can be left out."""

    score: F64  # (G,)
    count: F64  # (G,)
    gradient: F64  # (G, 7)
    information: F64  # (G, 7, 7)


class Scorer:
    """The score of all shots of one camera, at one blur.

    Args:
        shots: what is compared.
        sigma: blur in pixels.
    """

    def __init__(self, shots: Sequence[Shot], sigma: float) -> None:
        self._shots = shots
        self._maps = [np.stack([cv2.GaussianBlur(m, (0, 0), sigma) for m in shot.maps]) for shot in shots]
        self.variance = sigma * sigma + PIXEL

    def __call__(self, offsets: F64, slopes: bool = True) -> Sums:
        """At (7,) offsets: radians, metres, seconds. Without ``slopes``, score and count alone."""
        size = len(AXES)
        score, count = np.zeros(GROUPS), np.zeros(GROUPS)
        gradient, information = np.zeros((GROUPS, size)), np.zeros((GROUPS, size, size))
        error, late = error_pose(offsets), float(offsets[TIME])
        for shot, density in zip(self._shots, self._maps, strict=True):
            pose = error @ shot.camera_from_points(late)
            before, after = (shot.camera_from_points(late + t) for t in (-MOMENT / 2, MOMENT / 2))
            change = error @ (after - before) / MOMENT
            _add(
                shot.xyz,
                shot.across,
                shot.group,
                pose,
                change,
                shot.K,
                density,
                self.variance,
                slopes,
                score,
                count,
                gradient,
                information,
            )
        return Sums(score, count, gradient, information)


@kernel
def _add(
    xyz: F32,
    across: U8,
    group: I32,
    pose: F64,
    change: F64,
    K: F64,
    density: F32,
    variance: float,
    slopes: bool,
    score: F64,
    count: F64,
    gradient: F64,
    information: F64,
) -> None:
    """Add the edges of one shot. ``change`` is how ``pose`` changes in a second of time offset."""
    height, width = density.shape[1:]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    ju, jv, p, speed = np.zeros(7), np.zeros(7), np.zeros(3), np.zeros(3)
    for i in range(len(xyz)):
        for a in range(3):
            p[a] = pose[a, 0] * xyz[i, 0] + pose[a, 1] * xyz[i, 1] + pose[a, 2] * xyz[i, 2] + pose[a, 3]
        g = group[i]
        count[g] += 1
        if p[2] < 1.0:
            continue
        x, y = p[0] / p[2], p[1] / p[2]
        u, v = fx * x + cx, fy * y + cy
        if not (0 <= u < width - 1 and 0 <= v < height - 1):
            continue
        col, row, k = int(u), int(v), across[i]
        s, t = u - col, v - row
        d00, d01 = density[k, row, col], density[k, row, col + 1]
        d10, d11 = density[k, row + 1, col], density[k, row + 1, col + 1]
        d = (1 - t) * ((1 - s) * d00 + s * d01) + t * ((1 - s) * d10 + s * d11)
        score[g] += np.log(1 + d / OUTLIER)
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
        weight = 1 / (d + OUTLIER)
        for a in range(7):
            gradient[g, a] += weight * (du * ju[a] + dv * jv[a])
            ja = ju[a] if k == 0 else jv[a]
            for b in range(7):
                information[g, a, b] += d * weight / variance * ja * (ju[b] if k == 0 else jv[b])
