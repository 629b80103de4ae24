"""Edges of a point cloud and of an image.

The method follows Levinson and Thrun 2013, "Automatic Online Calibration of Cameras and Lasers": where the
range jumps between neighbouring beams, the image should have an edge. This module adds three things:

- Jumps are searched along the rings and across them.
- An edge of the cloud lies half-way between the two beams that it separates. On the nearer point, it would
  shift all left borders to the right and all right borders to the left.
- Steps of reflectance (road markings, kerbs) count as edges too. They lie on the ground, where silhouettes
  are few. A surface that reflects more is mostly brighter in the image, so these edges have a sign, as in
  mutual information (Pandey et al. 2012, "Automatic Targetless Extrinsic Calibration of a 3D Lidar and Camera
  by Maximizing Mutual Information"). The reflectance need not be calibrated. Beams are seldom calibrated to
  each other, so steps of reflectance are searched within a ring only.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bevviz.model.frame import F32, F64, I64, RING_FIELDS, U8, Bool, Cloud

ROW = np.radians(0.4)  # radians, height of a row of beams in a cloud without rings
JUMP = 0.12  # least share by which the inverse range falls at an edge
STEP = 0.4  # metres, least jump of the range
FLAT = 0.03  # largest share by which the inverse range changes at a step of reflectance
CONTRAST = 0.15  # least step of reflectance, as a share of the brightest point of the cloud
USUAL = 8.0  # pixels, blur that gives the usual change of the image around a pixel
NOISE = 4.0  # grey values by which an image changes without an edge
LEVELS = 60  # steps of image_edges for one multiple of the usual change
TURN = 10.0  # radians, more than the azimuths of a ring span, so that ring and azimuth make one sort key


@dataclass(frozen=True, slots=True)
class Edges:
    """Edge points of a cloud, in the frame of the cloud."""

    xyz: F32  # (E, 3)
    towards: F32  # (E, 3) across the edge, to the farther side or the side that reflects more
    bright: Bool  # (E,) whether it is a step of reflectance. The others are jumps of range.


@dataclass(frozen=True, slots=True)
class _Rings:
    """Points sorted by ring and azimuth, with the rows of their four neighbours (-1: no neighbour)."""

    xyz: F64
    range: F64
    unit: F64  # (N, 3) directions from the sensor
    reflectance: F64 | None  # (N,) 1: the brightest point of the cloud
    left: I64
    right: I64
    below: I64
    above: I64


def cloud_edges(cloud: Cloud) -> Edges:
    """Return the edges of one scan: jumps of range and steps of reflectance between neighbouring beams."""
    rings = _arrange(cloud)
    if rings is None:
        return Edges(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.bool_))
    sides = (
        (rings.right, rings.left),
        (rings.left, rings.right),
        (rings.above, rings.below),
        (rings.below, rings.above),
    )
    edges = [_jumps(rings, beyond, before) for beyond, before in sides]
    jumps = sum(len(xyz) for xyz, _ in edges)
    if rings.reflectance is not None:
        edges.append(_steps_along(rings, rings.reflectance))
    xyz, towards = (np.concatenate(parts).astype(np.float32) for parts in zip(*edges, strict=True))
    return Edges(xyz, towards, np.arange(len(xyz)) >= jumps)


def _arrange(cloud: Cloud) -> _Rings | None:
    """Sort the points by ring and azimuth and find their neighbours. Return None if they are too few."""
    xyz = cloud.xyz.astype(np.float64)
    distance = np.linalg.norm(xyz, axis=1)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    ring = _ring(cloud, azimuth, distance)
    order = np.lexsort((azimuth, ring))
    order = order[distance[order] > 0.5]  # Nearer points are the robot itself, or beams without an echo.
    if len(order) < 100:
        return None
    xyz, distance, azimuth, ring = xyz[order], distance[order], azimuth[order], ring[order]
    together = ring[1:] == ring[:-1]
    turn = np.diff(azimuth)
    step = float(np.median(turn[together])) if together.any() else 0.0
    joined = together & (turn < 2.5 * step)
    row = np.arange(len(order))
    right = np.where(np.append(joined, False), row + 1, -1)
    left = np.where(np.insert(joined, 0, False), row - 1, -1)
    key = ring * TURN + azimuth
    below, above = (_nearest(key, key + shift, 0.75 * step) for shift in (-TURN, TURN))
    reflectance = None
    if (intensity := cloud.fields.get("intensity")) is not None:
        brightest = float(np.percentile(intensity, 99))
        if brightest > 0:
            reflectance = intensity[order].astype(np.float64) / brightest
    return _Rings(xyz, distance, xyz / distance[:, None], reflectance, left, right, below, above)


def _ring(cloud: Cloud, azimuth: F64, distance: F64) -> I64:
    """Return the (N,) ring of each point: from its field, from the storage order, or from its elevation."""
    for name in RING_FIELDS:
        if name in cloud.fields:
            ring: I64 = cloud.fields[name].astype(np.int64)
            return ring
    turns = np.abs(np.diff(azimuth)) > np.pi
    if 4 <= turns.sum() <= 300:  # a plausible number of beams: the cloud is stored ring by ring
        return np.cumsum(np.insert(turns, 0, False), dtype=np.int64)
    with np.errstate(invalid="ignore", divide="ignore"):
        elevation = np.nan_to_num(np.arcsin(cloud.xyz[:, 2] / distance))
    row: I64 = np.floor(elevation / ROW).astype(np.int64)
    return row


def _nearest(keys: F64, targets: F64, tolerance: float) -> I64:
    """Return the row of the sorted key nearest to each wanted key, -1 where none is within the tolerance."""
    after = np.clip(np.searchsorted(keys, targets), 1, len(keys) - 1)
    nearest = np.where(targets - keys[after - 1] < keys[after] - targets, after - 1, after)
    return np.where(np.abs(keys[nearest] - targets) < tolerance, nearest, -1)


def _jumps(rings: _Rings, beyond: I64, before: I64) -> tuple[F64, F64]:
    """Return the (J, 3) jumps of range from each point to its neighbour ``beyond``, and their directions.

    On a plane, the inverse range is almost linear from beam to beam, even where beams meet the plane at a
    small angle. So a jump is measured against the range extrapolated from the neighbour ``before``. Otherwise
    the road far ahead would give a row of edges.
    """
    near = np.flatnonzero(beyond >= 0)
    far, behind = beyond[near], before[near]
    inverse = 1 / rings.range
    slope = np.where(behind >= 0, inverse[near] - inverse[behind], 0.0)
    expected = np.clip(inverse[near] + slope, 0.3 * inverse[near], inverse[near])
    jump = (inverse[far] < (1 - JUMP) * expected) & (rings.range[far] - rings.range[near] > STEP)
    near, far = near[jump], far[jump]
    between = rings.unit[near] + rings.unit[far]
    xyz = between * (rings.range[near] / np.linalg.norm(between, axis=1))[:, None]
    return xyz, rings.unit[far] - rings.unit[near]


def _steps_along(rings: _Rings, reflectance: F64) -> tuple[F64, F64]:
    """Return the steps of reflectance within a ring, and their directions towards the higher reflectance.

    The two beams on either side of a step must be alike.
    """
    before = np.flatnonzero((rings.left >= 0) & (rings.right >= 0))
    before = before[rings.right[rings.right[before]] >= 0]
    after = before + 1
    inverse = 1 / rings.range
    near, far = (reflectance[before - 1], reflectance[before]), (reflectance[after], reflectance[after + 1])
    is_step = _clear_step(near, far) & (np.abs(inverse[before] - inverse[after]) < FLAT * inverse[before])
    before, after = before[is_step], after[is_step]
    sign = np.sign(far[0] + far[1] - near[0] - near[1])[is_step]
    across = rings.unit[after] - rings.unit[before]
    return (rings.xyz[before] + rings.xyz[after]) / 2, across * sign[:, None]


def _clear_step(near: tuple[F64, F64], far: tuple[F64, F64]) -> Bool:
    """Return where the two samples on one side of a step differ from the two on the other side.

    Args:
        near: two samples of reflectance before the step. The second is next to the step.
        far: two samples behind the step. The first is next to the step.
    """
    step = np.abs(near[0] + near[1] - far[0] - far[1]) / 2
    noise = np.maximum(np.abs(near[0] - near[1]), np.abs(far[0] - far[1]))
    clear: Bool = (step > CONTRAST) & (np.abs(near[1] - far[0]) > 0.5 * step) & (noise < step)
    return clear


def image_edges(bgr: U8) -> U8:
    """Return (4, H, W) how much the image brightens to the right, to the left, downwards and upwards.

    The unit is 1 / LEVELS of the usual change around the pixel. So a bright wall does not outweigh a grey
    one, and a hedge scores no better than a road.
    """
    gray = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY).astype(np.float32)
    gray = cv2.GaussianBlur(gray, (0, 0), 0.8)
    edges = np.empty((4, *gray.shape), np.uint8)
    for k, (dx, dy) in enumerate(((1, 0), (0, 1))):
        change = cv2.Sobel(gray, cv2.CV_32F, dx, dy)
        usual = cv2.GaussianBlur(np.abs(change), (0, 0), USUAL) + NOISE
        for sign in (0, 1):
            edges[2 * k + sign] = np.clip((1 - 2 * sign) * LEVELS * change / usual, 0, 4 * LEVELS)
    return edges
