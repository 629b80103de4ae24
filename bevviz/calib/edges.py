"""Edges of a cloud and of an image that show the same border of the same thing.

After Levinson and Thrun 2013, "Automatic Online Calibration of Cameras and Lasers": where the range jumps
between neighbouring beams, the image should have an edge. Three things are done beyond that: the jump is
looked for along the rings and across them; an edge of the cloud lies half-way between the two beams that it
separates, not on the nearer point, which would shift all left borders to the right and all right ones to the
left; and borders of reflectance (road markings, kerbs) count too, which lie near and on the ground where
silhouettes are few. What reflects more is mostly brighter in the image as well, so that such a border is
looked for with its sign, as mutual information would (Pandey et al. 2012, "Automatic Targetless Extrinsic
Calibration of a 3D Lidar and Camera by Maximizing Mutual Information"), but without calibrated reflectance.
They count within a ring only: beams are seldom calibrated to each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bevviz.model.frame import F32, F64, I64, RING_FIELDS, U8, Bool, Cloud

ROW = np.radians(0.4)  # height of a row of beams where the cloud does not tell its rings
JUMP = 0.12  # least share by which the inverse range falls at a border
STEP = 0.4  # metres, least jump of the range
FLAT = 0.03  # largest share by which the inverse range changes at a border of reflectance
CONTRAST = 0.15  # least step of reflectance, as share of the cloud's brightest
USUAL = 8.0  # pixels around, over which the usual change of an image is taken
NOISE = 4.0  # grey values by which an image changes without an edge
LEVELS = 60  # steps of a change in an image that are told apart, for each multiple of what is usual
TURN = 10.0  # more than the azimuths of a ring span, so that ring and azimuth are one number


@dataclass(frozen=True, slots=True)
class Edges:
    """Points on borders, in the frame of the cloud."""

    xyz: F32  # (E, 3)
    towards: F32  # (E, 3) across the border, to where it is farther or reflects more
    bright: Bool  # (E,) of reflectance, not of range


@dataclass(frozen=True, slots=True)
class _Rings:
    """The cloud in order of ring and azimuth, and the neighbours of each point (-1: none)."""

    xyz: F64
    range: F64
    unit: F64  # (N, 3) directions
    reflectance: F64 | None  # 1: the cloud's brightest
    left: I64
    right: I64
    below: I64
    above: I64


def cloud_edges(cloud: Cloud) -> Edges:
    """The borders in one scan: jumps of range and steps of reflectance between neighbouring beams."""
    rings = _arrange(cloud)
    if rings is None:
        return Edges(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.bool_))
    sides = (
        (rings.right, rings.left),
        (rings.left, rings.right),
        (rings.above, rings.below),
        (rings.below, rings.above),
    )
    found = [_jumps(rings, beyond, before) for beyond, before in sides]
    jumps = sum(len(xyz) for xyz, _ in found)
    if rings.reflectance is not None:
        found.append(_steps_along(rings, rings.reflectance))
    xyz, towards = (np.concatenate(parts).astype(np.float32) for parts in zip(*found, strict=True))
    return Edges(xyz, towards, np.arange(len(xyz)) >= jumps)


def _arrange(cloud: Cloud) -> _Rings | None:
    xyz = cloud.xyz.astype(np.float64)
    distance = np.linalg.norm(xyz, axis=1)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    ring = _ring(cloud, azimuth, distance)
    order = np.lexsort((azimuth, ring))
    order = order[distance[order] > 0.5]  # nearer: the robot itself, or no echo at all
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
    """Which ring each point belongs to: as told, as stored ring by ring, or by its elevation."""
    for name in RING_FIELDS:
        if name in cloud.fields:
            told: I64 = cloud.fields[name].astype(np.int64)
            return told
    turns = np.abs(np.diff(azimuth)) > np.pi
    if 4 <= turns.sum() <= 300:  # as many as there are beams, where each ring is stored in turn
        return np.cumsum(np.insert(turns, 0, False), dtype=np.int64)
    with np.errstate(invalid="ignore", divide="ignore"):
        elevation = np.nan_to_num(np.arcsin(cloud.xyz[:, 2] / distance))
    row: I64 = np.floor(elevation / ROW).astype(np.int64)
    return row


def _nearest(keys: F64, wanted: F64, tolerance: float) -> I64:
    """Row of the sorted key that is nearest to each wanted one, -1 where none is within the tolerance."""
    after = np.clip(np.searchsorted(keys, wanted), 1, len(keys) - 1)
    nearest = np.where(wanted - keys[after - 1] < keys[after] - wanted, after - 1, after)
    return np.where(np.abs(keys[nearest] - wanted) < tolerance, nearest, -1)


def _jumps(rings: _Rings, beyond: I64, before: I64) -> tuple[F64, F64]:
    """(J, 3) borders of what is nearer than its neighbour ``beyond``, and where that lies.

    On a plane the inverse range is all but linear from beam to beam, however flat the beam meets it: the road
    far ahead is no row of borders. So the neighbour must lie behind what the one ``before`` leads to.
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
    """Steps of reflectance within a ring, two beams on either side being alike, and where it is more."""
    a = np.flatnonzero((rings.left >= 0) & (rings.right >= 0))
    a = a[rings.right[rings.right[a]] >= 0]
    b = a + 1
    inverse = 1 / rings.range
    near, far = (reflectance[a - 1], reflectance[a]), (reflectance[b], reflectance[b + 1])
    found = _clear_step(near, far) & (np.abs(inverse[a] - inverse[b]) < FLAT * inverse[a])
    a, b = a[found], b[found]
    more = np.sign(reflectance[b] + reflectance[b + 1] - reflectance[a] - reflectance[a - 1])
    return (rings.xyz[a] + rings.xyz[b]) / 2, (rings.unit[b] - rings.unit[a]) * more[:, None]


def _clear_step(near: tuple[F64, F64], far: tuple[F64, F64]) -> Bool:
    """Where two samples on one side, the second next to the border, differ from two on the other."""
    step = np.abs(near[0] + near[1] - far[0] - far[1]) / 2
    noise = np.maximum(np.abs(near[0] - near[1]), np.abs(far[0] - far[1]))
    clear: Bool = (step > CONTRAST) & (np.abs(near[1] - far[0]) > 0.5 * step) & (noise < step)
    return clear


def image_edges(bgr: U8) -> U8:
    """(4, H, W) how much it brightens to the right, to the left, downwards and upwards.

    In 1 / LEVELS of what is usual around there, so that a bright wall does not outshout a grey one, and a
    hedge is no better a place than a road.
    """
    gray = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY).astype(np.float32)
    gray = cv2.GaussianBlur(gray, (0, 0), 0.8)
    found = np.empty((4, *gray.shape), np.uint8)
    for k, (dx, dy) in enumerate(((1, 0), (0, 1))):
        change = cv2.Sobel(gray, cv2.CV_32F, dx, dy)
        usual = cv2.GaussianBlur(np.abs(change), (0, 0), USUAL) + NOISE
        for sign in (0, 1):
            found[2 * k + sign] = np.clip((1 - 2 * sign) * LEVELS * change / usual, 0, 4 * LEVELS)
    return found
