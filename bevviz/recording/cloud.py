"""Log point clouds: raw points by several quantities, voxels of ground and obstacles, clusters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from bevviz.config import ClusteringConfig
from bevviz.config.sections import Quantity
from bevviz.model.frame import F32, I32, I64, RING_FIELDS, Bool, Frame
from bevviz.model.results import Clusters, ClusterState, FrameResult, Tracks
from bevviz.recording import entities, retention
from bevviz.recording.addresses import Rows
from bevviz.recording.boxes import track_class_ids, track_ids_of_clusters
from bevviz.recording.components import Components
from bevviz.recording.entities import ClassId
from bevviz.recording.layers import Layer, Style, draw
from bevviz.recording.primitives import point_classes, rounded, transform
from bevviz.recording.retention import RawCloud
from bevviz.recording.writer import Writer
from bevviz.stages.voxel import spread_to_points
from bevviz.support.colors import UNNAMED, palette, turbo
from bevviz.support.numba_kernel import kernel


def log_cloud_style(to: Writer, lidars: Iterable[str]) -> None:
    """Log the static style of the raw points of each LiDAR."""
    for lidar in lidars:
        radii = rr.Points3D.from_fields(radii=rr.Radius.ui_points(1.0))
        to.static(entities.POINTS.path(lidar), radii, quantity_annotations())


def log_cloud(to: Writer, result: FrameResult, quantities: Sequence[Quantity]) -> None:
    """Log every raw point without loss, with the quantities that can colour it.

    With several LiDARs, each cloud is logged in its own frame.
    """
    frame = result.frame
    log_cloud_poses(to, frame)
    heights = height_ids(result) if "height" in quantities else np.zeros(len(frame.points), np.uint8)
    cloud_fields = {entities.POINTS.path(cloud.name): cloud.fields for cloud in frame.clouds}
    start = 0
    for path, points, class_ids in raw_clouds(result):
        end = start + len(points)
        further = cloud_fields[path] if len(frame.clouds) > 1 else frame.fields
        ids_by_quantity = quantity_ids(quantities, points, heights[start:end], further)
        fields = {"positions": points, "class_ids": class_ids}
        to.put(path, Components(rr.Points3D, fields, ids_by_quantity, COMPONENTS))
        to.note_rows(path, Rows("point", range(start, end)))
        start = end


def log_cloud_poses(to: Writer, frame: Frame) -> None:
    """Log the pose of each LiDAR if there are several."""
    if len(frame.clouds) > 1:
        for cloud, points_from_cloud in zip(frame.clouds, frame.points_from_clouds, strict=True):
            to.put(entities.SENSOR.path(cloud.name), transform(frame.pose @ points_from_cloud))


def raw_clouds(result: FrameResult) -> list[RawCloud]:
    """Return the raw clouds that have points."""
    frame = result.frame
    class_ids = np.zeros(len(frame.points), np.uint16)
    if result.voxels is not None and result.ground is not None:
        voxel_ids = np.where(result.ground.mask, ClassId.GROUND, ClassId.OBSTACLE).astype(np.uint16)
        class_ids = spread_to_points(voxel_ids, result.voxels.inverse)
    if len(frame.clouds) <= 1:
        return [(entities.POINTS.path(frame.lidar), frame.points, class_ids)] if len(frame.points) else []
    clouds, end = [], 0
    for cloud in frame.clouds:
        start, end = end, end + len(cloud.xyz)
        if len(cloud.xyz):
            clouds.append((entities.POINTS.path(cloud.name), cloud.xyz, class_ids[start:end]))
    return clouds


def log_ground(to: Writer, result: FrameResult, voxel_size: float, *, packed: bool = False) -> None:
    """Log the ground voxels.

    Args:
        to: writer of the recording.
        result: results of the frame.
        voxel_size: metres.
        packed: round and sort the points, as in recordings that do not keep everything.
    """
    if result.voxels is None or result.ground is None:
        return
    ground = result.voxels.points.compress(result.ground.mask, axis=0)
    ground = packed_points(ground, voxel_size) if packed else round_voxels(ground, voxel_size)
    _log_class(to, entities.GROUND.path(result.frame.lidar), ground, ClassId.GROUND)


def log_obstacles(to: Writer, frame: Frame, obstacles: F32) -> None:
    """Log the obstacle points. ``round_voxels`` has rounded them."""
    _log_class(to, entities.OBSTACLES.path(frame.lidar), obstacles, ClassId.OBSTACLE)


def _log_class(to: Writer, path: str, points: F32, class_id: ClassId) -> None:
    draw(to, Layer(path, points, Style(width=1.5), class_ids=[class_id]))


def round_voxels(points: F32, voxel_size: float) -> F32:
    """Round voxel points, which halves their compressed size. With a voxel size of 0, return them unchanged.

    The step is a power of two of a metre, from an eighth to a quarter of a voxel. No coordinate moves by more
    than an eighth of a voxel.
    """
    if voxel_size == 0:
        return points
    return rounded(points, 2.0 ** np.floor(np.log2(8 / voxel_size)))


def packed_points(points: F32, voxel_size: float) -> F32:
    """Round and sort voxels outside of clusters, as in recordings that do not keep everything."""
    scale = retention.rounding_scale(voxel_size, retention.OTHER_STEPS)
    return round_points(points.take(retention.sorted_rows(points, scale), axis=0), scale)


def round_points(points: F32, scale: float) -> F32:
    """Round points to the nearest 1 / scale. With a scale of 0, return them unchanged."""
    return rounded(points, scale) if scale else points


# --- quantities that colour raw points ---------------------------------------------------------
#
# A quantity is logged as one byte per point (two for rings). Colours and labels belong to the class ids.
# A view maps one of these components to the points' class ids, so the positions are logged only once.

ClassIds: TypeAlias = NDArray[np.unsignedinteger]

COMPONENTS = "ColorBy"  # archetype of the components
FIELD_NAMES: dict[Quantity, tuple[str, ...]] = {  # names of a quantity in clouds
    "intensity": ("intensity", "reflectivity", "i"),
    "ring": RING_FIELDS,
    "time": ("time", "t", "offset_time", "timestamp", "time_stamp", "time_offset"),
}
HEIGHT_RANGE = 4.0  # metres above the ground, end of the colour scale

_ABSENT = 3  # class id of a missing field
_HEIGHT, _DISTANCE, _INTENSITY, _TIME, _RING = 16, 80, 144, 176, 256  # first class id of each scale
_STEPS, _DEPTHS, _SHARES, _RINGS = 64, entities.DEPTH_BINS, 32, 256  # ids of each scale, powers of two


@np.errstate(over="ignore", invalid="ignore")  # fields may hold any value
def quantity_ids(
    quantities: Sequence[Quantity],
    points: F32,
    heights: NDArray[np.uint8],
    fields: Mapping[str, NDArray[Any]],
) -> dict[Quantity, ClassIds]:
    """Return class ids of each point by quantity: (N,), or (1,) if the cloud lacks the field.

    Args:
        quantities: quantities to return.
        points: (N, 3) metres, in the LiDAR frame.
        heights: (N,) class ids from ``height_ids``.
        fields: further (N,) fields of the cloud.
    """
    ids_by_quantity: dict[Quantity, ClassIds] = {}
    for name in quantities:
        if name == "height":
            ids_by_quantity[name] = heights
        elif name == "distance":
            steps_per_metre = np.float32(_DEPTHS / entities.DEPTH_RANGE)
            ids_by_quantity[name] = _distance_ids(points, steps_per_metre)
        elif (
            values := next((fields[field] for field in FIELD_NAMES[name] if field in fields), None)
        ) is None:
            ids_by_quantity[name] = np.array([_ABSENT], np.uint8)
        elif name == "intensity":
            ids_by_quantity[name] = _scaled(values, 0.0, _brightest(values), _INTENSITY, _SHARES)
        elif name == "ring":
            rings = values.astype(np.int64) if values.dtype.kind == "f" else values
            ids_by_quantity[name] = (rings.astype(np.uint16) & np.uint16(_RINGS - 1)) + np.uint16(_RING)
        else:
            is_finite = np.isfinite(values)
            finite = values if is_finite.all() else values[is_finite]
            first, last = (finite.min(), finite.max()) if len(finite) else (0, 0)
            ids_by_quantity[name] = _scaled(values - first, 0.0, float(last - first), _TIME, _SHARES)
    return ids_by_quantity


def height_ids(result: FrameResult) -> NDArray[np.uint8]:
    """Return (N,) class ids by the height of each point's voxel above the ground.

    Without a ground, the height is measured from the lowest points.
    """
    if result.voxels is not None and result.ground is not None:
        voxel_ids = _scaled(result.ground.height, 0.0, HEIGHT_RANGE, _HEIGHT, _STEPS)
        return spread_to_points(voxel_ids, result.voxels.inverse)
    z = result.frame.points[:, 2]
    lowest = float(np.percentile(z[:: len(z) // 5_000 + 1], 1)) if len(z) else 0.0
    return _scaled(z, lowest, lowest + HEIGHT_RANGE, _HEIGHT, _STEPS)


def quantity_annotations() -> rr.AnnotationContext:
    """Return colours and labels of all class ids that raw points can have."""
    steps, shares = _ramp(_STEPS), _ramp(_SHARES)
    depth = entities.DEPTH_RANGE / _DEPTHS
    rings = palette().tolist()
    scales = [
        *(
            _info(_HEIGHT + step, f"{step * HEIGHT_RANGE / _STEPS:.1f} m high", color)
            for step, color in enumerate(steps)
        ),
        *(
            _info(_DISTANCE + step, f"{step * depth:.0f} m away", color)
            for step, color in enumerate(steps[::-1])
        ),
        *(
            _info(_INTENSITY + step, f"intensity {100 * step // _SHARES} %", color)
            for step, color in enumerate(shares)
        ),
        *(
            _info(_TIME + step, f"{100 * step // _SHARES} % into the scan", color)
            for step, color in enumerate(shares)
        ),
        *(_info(_RING + step, f"ring {step}", rings[step % len(rings)]) for step in range(_RINGS)),
        _info(_ABSENT, "not in this cloud", UNNAMED),
    ]
    return rr.AnnotationContext([*point_classes(), *scales])


def quantity_visualizer(by: Quantity) -> rrb.Visualizer:
    """Return a visualizer that colours raw points by a quantity."""
    return rr.Points3D.from_fields().visualizer(
        mappings=[
            VisualizerComponentMapping(
                "Points3D:class_ids",
                ComponentSourceKind.SourceComponent,
                source_component=f"{COMPONENTS}:{by}",
            ),
            VisualizerComponentMapping("Points3D:colors", ComponentSourceKind.AnnotationContext),
        ]
    )


def _info(number: int, label: str, color: Sequence[int]) -> rr.AnnotationInfo:
    return rr.AnnotationInfo(id=number, label=label, color=color)


def _ramp(count: int) -> list[list[int]]:
    """Return ``count`` colours of the turbo map, without the dark end that is invisible on black."""
    dark = count // 10
    ramp: list[list[int]] = turbo(count + dark)[dark:].tolist()
    return ramp


def _scaled(values: NDArray[Any], low: float, high: float, base: int, count: int) -> NDArray[np.uint8]:
    """Map values linearly to ``count`` class ids from ``base``. Large values and NaN get the last id."""
    factor = np.float32(count / max(high - low, 1e-9))
    if values.dtype == np.float32:
        return _scaled_ids(values, np.float32(low), factor, base, count)
    rows = (values - low) * factor
    return (np.fmax(np.fmin(rows, np.float32(count - 1)), np.float32(0)) + np.float32(base)).astype(np.uint8)


@kernel
def _scaled_ids(values: F32, low: np.float32, factor: np.float32, base: int, count: int) -> NDArray[np.uint8]:
    """Return ``_scaled`` of 32-bit values, in one pass."""
    ids = np.empty(len(values), np.uint8)
    first, last = np.float32(base), np.float32(count - 1)
    for i in range(len(values)):
        row = (values[i] - low) * factor
        if not row < last:
            row = last
        ids[i] = np.uint8(max(row, np.float32(0)) + first)
    return ids


@kernel
def _distance_ids(points: F32, steps_per_metre: np.float32) -> NDArray[np.uint8]:
    """Return the class id of each point by its distance from the LiDAR."""
    ids = np.empty(len(points), np.uint8)
    first, last = np.float32(_DISTANCE), np.float32(_DEPTHS - 1)
    for i in range(len(points)):
        x, y, z = points[i]
        row = np.sqrt(x * x + y * y + z * z) * steps_per_metre
        if not row < last:
            row = last
        ids[i] = np.uint8(row + first)
    return ids


def _brightest(values: NDArray[Any]) -> float:
    """Return the end of the intensity scale: the 99th percentile, rounded up to 1, 1.4, 2, 2.8 and so on.

    The coarse steps keep the scale constant between most scans.
    """
    sample = values[:: len(values) // 5_000 + 1]
    sample = sample[np.isfinite(sample)]
    percentile = float(np.percentile(sample, 99)) if len(sample) else 0.0
    return float(2.0 ** (np.ceil(np.log2(percentile) * 2) / 2)) if percentile > 0 else 1.0


# --- clusters ----------------------------------------------------------------------------------


def log_clusters(
    to: Writer,
    frame: Frame,
    clusters: Clusters,
    tracked: Tracks | None,
    obstacles: F32,
    config: ClusteringConfig,
    packed: float | None = None,
) -> None:
    """Log clusters with the class ids of their tracks. The annotation context colours them grey.

    Args:
        to: writer of the recording.
        frame: frame of the clusters.
        clusters: all clusters of the frame.
        tracked: tracks that give the colours; None: there are no tracks.
        obstacles: (P, 3) points, in the order of ``clusters.labels``.
        config: parameters of the clustering.
        packed: steps per metre to which points are rounded (0: no rounding). Points are also sorted by
            cluster. None: points are logged unchanged.
    """
    boxes = clusters.boxes(config)
    kept, others = np.flatnonzero(clusters.kept), np.flatnonzero(~clusters.kept)
    if len(kept):
        member = _in_kept_clusters(clusters)
        points, labels = obstacles.compress(member, axis=0), clusters.labels.compress(member)
        if packed is not None:
            rows = retention.sorted_rows(points, packed, labels)
            points, labels = round_points(points.take(rows, axis=0), packed), labels.take(rows)
        point_ids, box_ids = _cluster_colors(clusters, tracked, labels, kept)
        path, style = entities.CLUSTERS.path(frame.lidar), Style(width=2.0, labels=False)
        outline, numbers = Style(width=1.0, labels=False, wire=True), [f"{row}" for row in kept]
        draw(
            to,
            Layer(path, points, style, class_ids=point_ids),
            Layer(path, boxes.chosen(kept), outline, numbers, class_ids=box_ids),
        )
    states = [ClusterState(state) for state in clusters.state[others].tolist()]
    counts = zip(others, clusters.count[others], strict=True)
    draw(
        to,
        Layer(
            entities.SET_ASIDE.path(frame.lidar),
            boxes.chosen(others),
            Style(labels=False),
            [f"{row}: {count} points" for row, count in counts],
            class_ids=[entities.CLUSTER_CLASS[state] for state in states],
            rows=Rows("cluster", others),
        ),
    )


def unclustered(obstacles: F32, clusters: Clusters) -> F32:
    """Return the obstacle points outside of kept clusters."""
    return obstacles.compress(~_in_kept_clusters(clusters), axis=0)


def _in_kept_clusters(clusters: Clusters) -> Bool:
    """Return the (P,) mask of obstacle points in kept clusters."""
    return np.append(clusters.kept, False).take(clusters.labels)  # the label -1 is noise


def _cluster_colors(
    clusters: Clusters, tracked: Tracks | None, labels: I32, kept: I64
) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    """Return class ids of the points with these labels, and of the boxes of the kept clusters."""
    colors = track_class_ids(track_ids_of_clusters(tracked, len(clusters)))
    return colors.take(labels), colors[kept]
