"""Class ids of raw points by quantity, such as height or intensity. A view shows one quantity.

A quantity is logged as one byte per point (two for rings). Colours and labels belong to the class ids. A view
maps one of these components to the points' class ids, so the positions are logged only once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from bevviz.config.sections import Quantity
from bevviz.model.colors import palette, turbo
from bevviz.model.frame import F32, RING_FIELDS
from bevviz.model.results import FrameResult
from bevviz.recording import entities
from bevviz.recording.annotations import point_classes
from bevviz.stages.voxel import spread_to_points
from bevviz.support.kernel import kernel

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
_STEPS, _DEPTHS, _SHARES, _RINGS = 64, entities.DEPTH_BINS, 32, 256  # ids of each scale


class ColoredPoints(rr.AsComponents):
    """Points with class ids by further quantities."""

    def __init__(self, points: rr.Points3D, ids_by_quantity: Mapping[Quantity, ClassIds]) -> None:
        self._points, self._ids_by_quantity = points, ids_by_quantity

    def as_component_batches(self) -> list[rr.DescribedComponentBatch]:
        """Return the components of the points and of the further class ids."""
        batches = self._points.as_component_batches()
        if self._ids_by_quantity:
            columns: dict[str, Any] = {name: pa.array(ids) for name, ids in self._ids_by_quantity.items()}
            batches += rr.DynamicArchetype(COMPONENTS, components=columns).as_component_batches()
        return batches


@np.errstate(over="ignore", invalid="ignore")  # fields may hold any value
def class_ids(
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
            ids_by_quantity[name] = rings.astype(np.uint16) % _RINGS + np.uint16(_RING)
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


def annotation_context() -> rr.AnnotationContext:
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
        _info(_ABSENT, "not in this cloud", (130, 130, 140)),
    ]
    return rr.AnnotationContext([*point_classes(), *scales])


def visualizer(by: Quantity) -> rrb.Visualizer:
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
