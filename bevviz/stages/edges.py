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

from bevviz.model import geometry
from bevviz.model.frame import F32, F64, I64, RING_FIELDS, U8, Bool, Cloud, Intrinsics
from bevviz.support.numba_kernel import kernel

NEAREST, FARTHEST = 2.0, 60.0  # metres: the robot itself is nearer; farther edges are wider than a pixel
ROW = np.radians(0.4)  # radians, height of a row of beams in a cloud without rings
JUMP = 0.12  # least share by which the inverse range falls at an edge
STEP = 0.4  # metres, least jump of the range
FLAT = 0.03  # largest share by which the inverse range changes at a step of reflectance
CONTRAST = 0.15  # least step of reflectance, as a share of the brightest point of the cloud
USUAL = 8.0  # pixels, blur that gives the usual change of the image around a pixel
NOISE = 4.0  # grey values by which an image changes without an edge
LEVELS = 60  # steps of image_edges for one multiple of the usual change
SHARE = 0.2  # share of the edges of a cloud that are visible in an image
AGAINST = 0.25  # weight of a change of the opposite sign: some surfaces (leaves) reflect more and look darker
TURN = 10.0  # radians, more than the azimuths of a ring span, so that ring and azimuth make one sort key

# Changes of the image that an edge of the cloud may show, as weights of the four rows of ``image_edges``:
# a change along u, a change along v; brighter to the right, to the left, downwards, upwards.
CHANGES = np.array(
    [
        [1, 1, 0, 0],
        [0, 0, 1, 1],
        [1, AGAINST, 0, 0],
        [AGAINST, 1, 0, 0],
        [0, 0, 1, AGAINST],
        [0, 0, AGAINST, 1],
    ],
    np.float32,
)
ALONG_V = np.array([0, 1, 0, 0, 1, 1], np.bool_)


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


def cloud_edges(cloud: Cloud, part: Bool | None = None) -> Edges:
    """Return the edges of one scan: jumps of range and steps of reflectance between neighbouring beams.

    Args:
        cloud: the scan.
        part: (N,) points among which edges are searched. None: all.
    """
    rings = _arrange(cloud, part)
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


def _arrange(cloud: Cloud, part: Bool | None) -> _Rings | None:
    """Sort the points by ring and azimuth and find their neighbours. Return None if they are too few."""
    ring = _ring(cloud)
    row = np.arange(len(cloud.xyz)) if part is None else np.flatnonzero(part)
    xyz = cloud.xyz[row].astype(np.float64)
    distance = np.linalg.norm(xyz, axis=1)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    ring = ring[row]
    order = np.argsort(ring * TURN + azimuth)  # faster than a sort by two keys
    order = order[distance[order] > 0.5]  # Nearer points are the robot itself, or beams without an echo.
    if len(order) < 100:
        return None
    xyz, distance, azimuth, ring = xyz[order], distance[order], azimuth[order], ring[order]
    together = ring[1:] == ring[:-1]
    turn = np.diff(azimuth)
    step = float(np.median(turn[together])) if together.any() else 0.0
    joined = together & (turn < 2.5 * step)
    place = np.arange(len(order))
    right = np.where(np.append(joined, False), place + 1, -1)
    left = np.where(np.insert(joined, 0, False), place - 1, -1)
    key = ring * TURN + azimuth
    below, above = (_nearest(key, key + shift, 0.75 * step) for shift in (-TURN, TURN))
    reflectance = None
    if (intensity := cloud.fields.get("intensity")) is not None:
        brightest = float(np.percentile(intensity[row], 99))
        if brightest > 0:
            reflectance = intensity[row[order]].astype(np.float64) / brightest
    return _Rings(xyz, distance, xyz / distance[:, None], reflectance, left, right, below, above)


def _ring(cloud: Cloud) -> I64:
    """Return the (N,) ring of each point: from its field, from the storage order, or from its elevation."""
    for name in RING_FIELDS:
        if name in cloud.fields:
            ring: I64 = cloud.fields[name].astype(np.int64)
            return ring
    turns = np.abs(np.diff(np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0]))) > np.pi
    if 4 <= turns.sum() <= 300:  # a plausible number of beams: the cloud is stored ring by ring
        return np.cumsum(np.insert(turns, 0, False), dtype=np.int64)
    xyz = cloud.xyz.astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        elevation = np.nan_to_num(np.arcsin(xyz[:, 2] / np.linalg.norm(xyz, axis=1)))
    row: I64 = np.floor(elevation / ROW).astype(np.int64)
    return row


@kernel
def _nearest(keys: F64, targets: F64, tolerance: float) -> I64:
    """Return the row of the key nearest to each target, -1 where none is within the tolerance.

    Keys and targets are sorted.
    """
    rows = np.full(len(targets), -1)
    after = 1
    for i in range(len(targets)):
        while after < len(keys) - 1 and keys[after] < targets[i]:
            after += 1
        nearest = after - 1 if targets[i] - keys[after - 1] < keys[after] - targets[i] else after
        if abs(keys[nearest] - targets[i]) < tolerance:
            rows[i] = nearest
    return rows


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


def image_edges(image: U8) -> U8:
    """Return (4, H, W) how much an image brightens to the right, to the left, downwards and upwards.

    The unit is 1 / LEVELS of the usual change around the pixel. So a bright wall does not outweigh a grey
    one, and a hedge scores no better than a road.
    """
    gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    gray = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 0.8)
    edges = np.empty((4, *gray.shape), np.uint8)
    for k, (dx, dy) in enumerate(((1, 0), (0, 1))):
        change = cv2.Sobel(gray, cv2.CV_32F, dx, dy)
        usual = cv2.GaussianBlur(np.abs(change), (0, 0), USUAL) + NOISE
        brighter = LEVELS * change / usual
        edges[2 * k] = np.clip(brighter, 0, 4 * LEVELS)
        edges[2 * k + 1] = np.clip(-brighter, 0, 4 * LEVELS)
    return edges


def undistort(image: U8, intrinsics: Intrinsics) -> U8:
    """Return the image without distortion, with the same camera matrix."""
    if not geometry.has_distortion(intrinsics):
        return image
    if intrinsics.distortion_model in geometry.FISHEYE:
        return np.asarray(
            cv2.fisheye.undistortImage(image, intrinsics.K, intrinsics.D[:4], Knew=intrinsics.K)
        )
    return np.asarray(cv2.undistort(image, intrinsics.K, geometry.coefficients(intrinsics)))


def shrink(image: U8, K: F64, pixels: int) -> tuple[U8, F64]:
    """Return the image scaled down to this number of pixels, if it has more, and its camera matrix."""
    height, width = image.shape[:2]
    scale = np.sqrt(pixels / (height * width))
    if scale >= 1:
        return image, K
    size = round(width * scale), round(height * scale)
    sx, sy = size[0] / width, size[1] / height
    smaller = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8), smaller @ K


# --- agreement of both -------------------------------------------------------------------------


def edges_in_view(
    edges: Edges, camera_from_cloud: F64, view: Intrinsics, reach: float
) -> tuple[F32, F32, U8]:
    """Return the edges that project into an image without distortion, or beside it by up to ``reach``.

    Args:
        edges: edges of a cloud.
        camera_from_cloud: stated pose of the camera.
        view: size and camera matrix of the image.
        reach: angle in radians.

    Returns:
        xyz: (E, 3) edges.
        uv: (E, 2) their pixels.
        change: (E,) expected change of the image at each edge: a row of ``CHANGES``.
    """
    uv, depth = geometry.project(geometry.apply(camera_from_cloud, edges.xyz), view)
    margin = np.tan(reach) * np.array([view.K[0, 0], view.K[1, 1]], np.float32)
    size = np.array([view.width, view.height], np.float32)
    with np.errstate(invalid="ignore"):
        inside = ((uv > -margin) & (uv < size + margin)).all(axis=1)
    inside &= (depth > NEAREST) & (depth < FARTHEST)
    xyz, towards, uv = edges.xyz[inside], edges.towards[inside], uv[inside]
    displaced = xyz + towards * np.linalg.norm(xyz, axis=1, keepdims=True)
    away = geometry.project(geometry.apply(camera_from_cloud, displaced), view)[0] - uv
    return xyz, uv, _expected_change(away, edges.bright[inside])


def _expected_change(away: F32, bright: Bool) -> U8:
    """Return the row of ``CHANGES`` for edges with (E, 2) directions in the image."""
    along_v = np.abs(away[:, 1]) > np.abs(away[:, 0])
    negative = np.where(along_v, away[:, 1], away[:, 0]) < 0
    return np.where(bright, 2 + 2 * along_v + negative, along_v).astype(np.uint8)


def densities(change: U8, maps: U8, sigma: float) -> tuple[F32, I64, Bool]:
    """Return the densities that the edges of a shot are drawn from.

    Returns:
        density: (D, H, W) of mean 1, one for each of ``CHANGES`` that the shot has.
        row: (E,) the density of each edge.
        along_v: (D,) whether the density changes along v.
    """
    changes, row = np.unique(change, return_inverse=True)
    blurred = [cv2.GaussianBlur(rows.astype(np.float32), (0, 0), sigma) for rows in maps]
    density = np.ones((len(changes), *maps.shape[1:]), np.float32)
    for made, expected in zip(density, changes, strict=True):
        total = sum(float(CHANGES[expected, k]) * blurred[k] for k in np.flatnonzero(CHANGES[expected]))
        mean = float(np.mean(total))
        if mean > 0:
            np.divide(total, mean, out=made)
    return density, row.astype(np.int64), ALONG_V[changes]


def log_densities(density: F32) -> F32:
    """Return the score of an edge at each pixel of its density."""
    return np.asarray(np.log(1 - SHARE + SHARE * density), np.float32)


@kernel
def add_scores(xyz: F32, density_row: I64, logs: F32, turns: F32, shift: F32, score: F64) -> None:
    """Add the score of one shot at each of the (T, 3, 3) pixels_from_camera."""
    rows, columns = logs.shape[1:]
    height, width, half, one = np.float32(rows), np.float32(columns), np.float32(0.5), np.float32(1)
    flat = logs.reshape(len(logs), rows * columns)
    # The turns are side by side and the look-up is a loop of its own, so that the first loop runs on vectors.
    m, count = turns.reshape(-1, 9).T.copy(), len(turns)
    place, total = np.empty(count, np.int32), np.zeros(count)
    for i in range(len(xyz)):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        for j in range(count):
            depth = one / (m[6, j] * x + m[7, j] * y + m[8, j] * z + shift[2])
            u = (m[0, j] * x + m[1, j] * y + m[2, j] * z + shift[0]) * depth + half
            v = (m[3, j] * x + m[4, j] * y + m[5, j] * z + shift[1]) * depth + half
            inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
            place[j] = np.int32(v) * np.int32(columns) + np.int32(u) if inside else -1
        values = flat[density_row[i]]
        for j in range(count):
            if place[j] >= 0:
                total[j] += values[place[j]]
    score += total
