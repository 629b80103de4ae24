"""Ground segmentation: one plane as in the reference, or a surface that follows slopes and kerbs."""

from __future__ import annotations

import math

import numpy as np

from bevviz.config import GroundConfig
from bevviz.model.frame import F32, F64, I32, Bool
from bevviz.model.results import Ground
from bevviz.stages.cells import sort_by
from bevviz.support.numba_kernel import kernel

# A ring is sqrt(r^2 + RING_SCALE^2) / RING_COUNT wide: half a metre near the sensor, 4% of the range
# far away, where the beams are sparse.
RING_SCALE = 12.5
RING_COUNT = 25.0
FIRST_PLANE_RADIUS = 20.0  # metres: radius around the sensor in which the first plane is searched
OVERHANG_HEIGHT = 2.0  # metres: a higher point may hang over the ground, like a tree crown or a bridge
SLOPE_MEMORY = 5.0  # metres over which the slope of the ground is remembered
BANK_SLOPE = 0.7  # metres up for each metre outwards: the steepest bank, 35 degrees
BANK_SPAN = 0.5  # smallest share of a bin's depth that a bank spans; the side of a vehicle spans less
GRASS_HEIGHT = 0.1  # metres: height of the grass on a bank
BANK_WIDTH = 4.0  # metres: a bank is at least this wide; a car's bonnet is narrower


def segment_ground(points: F32, config: GroundConfig) -> Ground:
    """Separate the ground from the obstacles.

    ``plane`` takes the plane with the most points within ``distance_threshold``, as Open3D's
    ``segment_plane`` does. This plane may be a wall. The heights are above this plane.

    ``polar`` follows the ground outward from the sensor over sectors and rings (Himmelsbach et al. 2010), but
    through all sectors at once. Each bin offers its lowest point that is within ``max_step`` of the height
    that the inner rings predict. A bin with an object whose foot may be hidden offers nothing. The ground
    moves to the median of the offers of the neighbouring sectors. So it follows a kerb. A car is too high a
    step, and a reflection below the road is too low. Without offers the ground continues with its last slope.
    Points below the ground count as ground.

    Args:
        points: (N, 3) float32 finite points, z up, the sensor near x = y = 0.
        config: the method and its parameters.

    Returns:
        Ground. Without a first plane no point is ground and all heights are NaN. This happens with fewer than
        three points, with all points on a line, or with no points near the height that ``sensor_height``
        predicts.
    """
    return _segment_plane(points, config) if config.method == "plane" else _segment_polar(points, config)


# --- one plane ---------------------------------------------------------------------------------


def _segment_plane(points: F32, config: GroundConfig) -> Ground:
    inliers = _largest_plane(points, config.distance_threshold, config)
    if not inliers.any():
        return no_ground(len(points))
    plane = _fit_plane(points, inliers)
    return Ground(inliers, _above(points, plane), plane)


def no_ground(count: int) -> Ground:
    """Return Ground of points of which none is ground, and whose heights above it are not known."""
    return Ground(np.zeros(count, np.bool_), np.full(count, np.nan, np.float32))


@kernel
def _above(points: F32, plane: F64) -> F32:
    """Return the (N,) signed distances of points from a plane a, b, c, d with a unit normal."""
    a, b, c, d = np.float32(plane[0]), np.float32(plane[1]), np.float32(plane[2]), np.float32(plane[3])
    distance = np.empty(len(points), np.float32)
    for i in range(len(points)):
        distance[i] = a * points[i, 0] + b * points[i, 1] + c * points[i, 2] + d
    return distance


def _largest_plane(points: F32, threshold: float, config: GroundConfig, upright: float = 0.0) -> Bool:
    """Find the best plane through three random points (RANSAC). Return its (N,) inlier mask.

    Only planes whose unit normal has |z| of at least ``upright`` are considered.
    The mask is all False if no three points span such a plane.
    """
    if len(points) < 3:
        return np.zeros(len(points), np.bool_)
    sample = np.random.default_rng(config.seed).integers(len(points), size=(config.iterations, 3))
    a, b, c = points[sample].astype(np.float64).transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    taking_part = (length > 0) & (np.abs(normal[:, 2]) >= upright * length)
    normal = (normal[taking_part] / length[taking_part, None]).astype(np.float32)
    return _best_support(points, a[taking_part].astype(np.float32), normal, np.float32(threshold))


@kernel
def _best_support(points: F32, anchor: F32, normal: F32, threshold: np.float32) -> Bool:
    """Return the (N,) inlier mask of the plane with the most inliers.

    Each row of ``anchor`` and ``normal`` defines a plane.
    """
    x, y, z = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    near = np.zeros(len(x), np.bool_)
    most, best = 0, -1
    for k in range(len(normal)):
        px, py, pz = anchor[k]
        a, b, c = normal[k]
        count = 0
        for i in range(len(x)):
            count += abs(a * (x[i] - px) + b * (y[i] - py) + c * (z[i] - pz)) < threshold
        if count > most:
            most, best = count, k
    if best >= 0:
        px, py, pz = anchor[best]
        a, b, c = normal[best]
        for i in range(len(x)):
            near[i] = abs(a * (x[i] - px) + b * (y[i] - py) + c * (z[i] - pz)) < threshold
    return near


def _fit_plane(points: F32, inliers: Bool) -> F64:
    """Fit a plane by least squares along the axis nearest to its normal, as Open3D does.

    Returns:
        (4,) a, b, c, d with a unit normal that points upwards.
    """
    center, scatter = _moments(points, inliers)
    # The rows of the cofactors of the scatter matrix are parallel to the normal. The row with the largest
    # diagonal element is the most accurate.
    cofactors = np.cross(scatter[[1, 2, 0]], scatter[[2, 0, 1]])
    normal = cofactors[np.argmax(np.diagonal(cofactors))]
    normal = normal / (np.linalg.norm(normal) * (-1 if normal[2] < 0 else 1))
    return np.append(normal, -normal @ center)


@kernel
def _moments(points: F32, chosen: Bool) -> tuple[F64, F64]:
    """Return the (3,) mean of the chosen points and their (3, 3) scatter about it."""
    center, scatter = np.zeros(3), np.zeros((3, 3))
    count = 0
    for i in range(len(points)):
        if chosen[i]:
            count += 1
            for axis in range(3):
                center[axis] += points[i, axis]
    center /= count
    for i in range(len(points)):
        if chosen[i]:
            x, y, z = points[i, 0] - center[0], points[i, 1] - center[1], points[i, 2] - center[2]
            scatter[0, 0] += x * x
            scatter[0, 1] += x * y
            scatter[0, 2] += x * z
            scatter[1, 1] += y * y
            scatter[1, 2] += y * z
            scatter[2, 2] += z * z
    scatter[1, 0], scatter[2, 0], scatter[2, 1] = scatter[0, 1], scatter[0, 2], scatter[1, 2]
    return center, scatter


# --- a surface over rings and sectors ----------------------------------------------------------


def _segment_polar(points: F32, config: GroundConfig) -> Ground:
    rings = math.ceil(RING_COUNT * math.asinh(config.max_range / RING_SCALE))
    ring, sector, order, start = _sort_into_bins(points, rings, config.sectors)
    plane = _first_plane(points, order, start, config)
    if plane is None:
        return no_ground(len(points))
    radius = RING_SCALE * np.sinh(np.arange(0.5, rings) / RING_COUNT)
    steepest = math.tan(math.radians(config.max_slope))
    height, below = _heights(
        points,
        plane,
        ring,
        sector,
        order,
        start,
        radius,
        config.sectors,
        config.max_step,
        steepest,
        config.distance_threshold,
    )
    return Ground(below, height)


def _first_plane(points: F32, order: I32, start: I32, config: GroundConfig) -> F64 | None:
    """Fit a plane to the ground around the sensor, from the lowest points of the bins.

    A ceiling is no ground: where the sensor sees little floor, most of these points are on the ceiling.
    """
    steepest = math.radians(config.max_slope)
    expected = math.nan if config.sensor_height is None else -config.sensor_height
    low = _near_ground(points, _lowest(points, order, start), expected, config.max_step, math.tan(steepest))
    while len(low):
        inliers = _largest_plane(low, config.distance_threshold, config, math.cos(steepest))
        if not inliers.any():
            return None
        plane = _fit_plane(low, inliers)
        height = _above(low, plane)
        below = height < -config.distance_threshold
        # A road above the origin, in a frame that is not the sensor's, has most points above it.
        is_above_sensor = config.sensor_height is None and -plane[3] > config.distance_threshold * plane[2]
        if not is_above_sensor or below.sum() < (height > config.distance_threshold).sum():
            return plane
        low = low[below & ~inliers]
    return None


def _sort_into_bins(points: F32, rings: int, sectors: int) -> tuple[F32, F32, I32, I32]:
    """Return ring and sector of each point with fractions, and the points sorted by both."""
    # NumPy has vectorised arcsinh and arctan2; compiled loops do not.
    ring, turn = np.arcsinh(_range(points)), np.arctan2(points[:, 1], points[:, 0])
    return (ring, *_bin(ring, turn, rings, sectors))


@kernel
def _range(points: F32) -> F32:
    """Return the (N,) horizontal distances from the sensor, in units of RING_SCALE."""
    scale = np.float32(1 / RING_SCALE)
    distance = np.empty(len(points), np.float32)
    for i in range(len(points)):
        distance[i] = scale * np.sqrt(points[i, 0] * points[i, 0] + points[i, 1] * points[i, 1])
    return distance


@kernel
def _bin(ring: F32, turn: F32, rings: int, sectors: int) -> tuple[F32, I32, I32]:
    """Return the sector of each point, and the points sorted by ring and sector.

    ``ring`` comes in as arcsinh of the range and is scaled in place. ``turn`` is in radians.
    """
    scale, whole = np.float32(sectors / (2 * math.pi)), np.float32(sectors)
    sector = np.empty(len(ring), np.float32)
    row = np.empty(len(ring), np.int32)
    for i in range(len(ring)):
        ring[i] *= np.float32(RING_COUNT)
        s = scale * turn[i]
        s += whole if s < 0 else np.float32(0)
        # A tiny negative angle is rounded to a whole turn, which is the first sector again.
        sector[i] = s if s < whole else np.float32(0)
        # The last ring continues beyond max_range.
        row[i] = min(int(ring[i]), rings - 1) * sectors + np.int32(sector[i])
    order, start = sort_by(row, rings * sectors)
    return sector, order, start


@kernel
def _near_ground(points: F32, lowest: I32, expected: float, max_step: float, steepest: float) -> F32:
    """Return the lowest points to fit the first plane to.

    Points within FIRST_PLANE_RADIUS of the sensor are used if there are at least three of them.
    ``expected`` is the height of the ground below the sensor, NaN if it is not known.
    """
    chosen = np.empty(len(lowest), np.int32)
    distance = np.empty(len(lowest))
    count = near = 0
    for i in lowest:
        reach = math.hypot(points[i, 0], points[i, 1])
        if abs(points[i, 2] - expected) >= max_step + steepest * reach:
            continue
        chosen[count], distance[count] = i, reach
        near += reach < FIRST_PLANE_RADIUS
        count += 1
    low = np.empty((near if near >= 3 else count, 3), np.float32)
    kept = 0
    for k in range(count):
        if near < 3 or distance[k] < FIRST_PLANE_RADIUS:
            for axis in range(3):
                low[kept, axis] = points[chosen[k], axis]
            kept += 1
    return low


@kernel
def _heights(
    points: F32,
    plane: F64,
    ring: F32,
    sector: F32,
    order: I32,
    start: I32,
    radius: F64,
    sectors: int,
    max_step: float,
    steepest: float,
    threshold: float,
) -> tuple[F32, Bool]:
    """Return the (N,) heights above the ground, and a mask of the heights below the threshold."""
    rise = _above(points, plane) / np.float32(plane[2])
    surface = _follow(rise, ring, order, start, radius, sectors, max_step, steepest)
    _settle(surface, rise, order, start, threshold / 2)
    height = _height(rise, ring, sector, surface)
    return height, height < threshold


@kernel
def _lowest(points: F32, order: I32, start: I32) -> I32:
    """Return the index of the lowest point of each occupied bin."""
    lowest = np.empty(len(start) - 1, np.int32)
    count = 0
    for b in range(len(start) - 1):
        if start[b] == start[b + 1]:
            continue
        low = order[start[b]]
        for k in range(start[b] + 1, start[b + 1]):
            if points[order[k], 2] < points[low, 2]:
                low = order[k]
        lowest[count] = low
        count += 1
    return lowest[:count]


@kernel
def _follow(
    rise: F32, ring: F32, order: I32, start: I32, radius: F64, sectors: int, max_step: float, steepest: float
) -> F64:
    """Return the (R, S) heights of the ground above the first plane, computed ring by ring outwards."""
    surface = np.zeros((len(radius), sectors))
    level = np.zeros(sectors)
    slope = np.zeros(sectors)
    # Metres since the last offer. The first plane is valid for FIRST_PLANE_RADIUS.
    unseen = np.full(sectors, -FIRST_PLANE_RADIUS)
    offer, banked = np.empty(sectors), np.empty(sectors)
    for r in range(len(radius)):
        step = radius[r] - radius[r - 1] if r > 0 else radius[0]
        keep = math.exp(-step / SLOPE_MEMORY)
        for s in range(sectors):
            level[s] += slope[s] * step
            # The longer the ground was hidden, the less certain its next height is.
            gate = max_step * (1 + max(unseen[s], 0.0) / SLOPE_MEMORY)
            offer[s] = banked[s] = np.inf
            lowest, top, near, far = np.inf, -np.inf, np.inf, -np.inf
            for k in range(start[r * sectors + s], start[r * sectors + s + 1]):
                above = rise[order[k]] - level[s]
                if abs(above) <= gate:
                    offer[s] = min(offer[s], rise[order[k]])
                if -gate <= above < OVERHANG_HEIGHT:
                    lowest, top = min(lowest, above), max(top, above)
                    near, far = min(near, ring[order[k]]), max(far, ring[order[k]])
            if top <= gate:
                continue
            # Points that rise no steeper than a bank over most of the bin are a bank. Points that rise at
            # once are an object, and its lowest point need not be its foot.
            across = (far - near) * step
            bank = across >= BANK_SPAN * step and top - lowest <= BANK_SLOPE * across + GRASS_HEIGHT
            banked[s] = level[s] + lowest if bank and lowest <= gate + BANK_SLOPE * step else np.inf
            if offer[s] > level[s]:
                offer[s] = np.inf
        _widen(offer, banked, BANK_WIDTH * sectors / (2 * math.pi * radius[r]))
        # The median is over the sectors within a metre to each side.
        reach = min(max(2, math.ceil(sectors / (2 * math.pi * radius[r]))), 8)
        around = np.empty(2 * reach + 1)
        for s in range(sectors):
            count = 0
            for k in range(s - reach, s + reach + 1):
                value = offer[k % sectors]
                if value < np.inf:
                    place = count
                    while place > 0 and around[place - 1] > value:
                        around[place] = around[place - 1]
                        place -= 1
                    around[place] = value
                    count += 1
            if count > 0:
                change = (around[(count - 1) // 2] + around[count // 2]) / 2 - level[s]
                level[s] += change
                slope[s] += (1 - keep) / step * change
                slope[s] = min(max(slope[s], -steepest), steepest)
                unseen[s] = 0
            else:
                slope[s] *= keep
                unseen[s] += step
            surface[r, s] = level[s]
    return surface


@kernel
def _widen(offer: F64, banked: F64, least: float) -> None:
    """Accept the offers of banks where at least ``least`` adjacent sectors have one."""
    sectors = len(offer)
    run = 0
    for place in range(2 * sectors):  # Two rounds, because a run may cross the first sector.
        if banked[place % sectors] < np.inf:
            run += 1
            continue
        if run >= least:
            for back in range(1, min(run, sectors) + 1):
                offer[(place - back) % sectors] = banked[(place - back) % sectors]
        run = 0


@kernel
def _settle(surface: F64, rise: F32, order: I32, start: I32, band: float) -> None:
    """Move each bin of the surface to the mean of the points within the band around it.

    The surface was made from the lowest points, which lie below the ground by the noise of the sensor.
    """
    flat = surface.ravel()
    for b in range(len(flat)):
        total, count = 0.0, 0
        for k in range(start[b], start[b + 1]):
            if abs(rise[order[k]] - flat[b]) < band:
                total += rise[order[k]]
                count += 1
        if count > 0:
            flat[b] = total / count


@kernel
def _height(rise: F32, ring: F32, sector: F32, surface: F64) -> F32:
    """Return the (N,) heights above the surface, which is interpolated bilinearly between the bin centres."""
    rings, sectors = surface.shape
    height = np.empty(len(rise), np.float32)
    for i in range(len(rise)):
        r = min(max(ring[i] - 0.5, 0.0), rings - 1.0)
        r0 = min(int(r), rings - 2)
        s = sector[i] + sectors - 0.5
        s0 = int(s) % sectors
        s1 = (s0 + 1) % sectors
        u, v = r - r0, s - int(s)
        near = surface[r0, s0] * (1 - v) + surface[r0, s1] * v
        far = surface[r0 + 1, s0] * (1 - v) + surface[r0 + 1, s1] * v
        height[i] = rise[i] - (near * (1 - u) + far * u)
    return height
