"""Fingerprints of the results of a frame, so that a second run can be compared with the first."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from hashlib import sha256
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bevviz.model.frame import U8
from bevviz.model.results import Detections, FrameResult, Masks
from bevviz.stages.odometry import ESTIMATED

Arrays = Mapping[str, NDArray[Any]]

WHOLE = 1 << 14  # Arrays of up to this many elements are stored, so that the size of a change can be stated.
ROUNDING = 1e-5  # relative to the number, or to 1 if it is smaller. Processors round differently.


class LargeArray(NamedTuple):
    """Fingerprint of an array that is too large to be stored."""

    fingerprint: str
    rows: str
    total: str  # sum of the elements


@dataclass(frozen=True, slots=True)
class StageDigest:
    """Fingerprint of the results of one stage in a frame."""

    name: str  # followed by the camera if there is one: "detector zed"
    fingerprint: str  # SHA-256 over names, types, shapes and bytes of its arrays
    whole: Arrays  # arrays of at most ``WHOLE`` elements
    large: Mapping[str, LargeArray]  # the other arrays


@dataclass(frozen=True, slots=True)
class DigestDifference:
    """Difference between two runs of a stage.

    ``amount`` is relative, as ``ROUNDING``. It is infinite if more than numbers differ.
    """

    stage: str
    text: str
    amount: float


def digest(result: FrameResult) -> tuple[StageDigest, ...]:
    """Return the fingerprint of each stage, in the order in which the stages depend on each other.

    Times and texts are left out, because times differ from run to run and texts follow from the arrays. The
    encoded image is left out as well, because its pixels are included.
    """
    return tuple(_stage(name, arrays) for name, arrays in _stages(result))


def compare(stored: tuple[StageDigest, ...], current: tuple[StageDigest, ...]) -> DigestDifference | None:
    """Return the first stage that differs by more than rounding, else the largest rounding, else None.

    Numbers within ``ROUNDING`` of each other count as rounding if everything else is equal.
    """
    worst: DigestDifference | None = None
    before, after = {stage.name: stage for stage in stored}, {stage.name: stage for stage in current}
    for name in dict.fromkeys([*before, *after]):
        if name not in after or name not in before:
            owner = "the report has" if name in before else "this run has"
            return DigestDifference(name, f"only {owner} results of it", float("inf"))
        if before[name].fingerprint == after[name].fingerprint:
            continue
        difference = _difference(before[name], after[name])
        if difference.amount > ROUNDING:
            return difference
        if worst is None or difference.amount > worst.amount:
            worst = difference
    return worst


def pack(stages: tuple[StageDigest, ...]) -> tuple[list[str], U8]:
    """Pack fingerprints for a recording: lines of text and a block of bytes. Rerun compresses the block.

    The block is a line of JSON, which lists the arrays, and the bytes of the arrays.
    """
    listed = [
        (stage.name, name, array.dtype.str, array.shape)
        for stage in stages
        for name, array in stage.whole.items()
    ]
    large = [(stage.name, name, *large) for stage in stages for name, large in stage.large.items()]
    content = [array.tobytes() for stage in stages for array in stage.whole.values()]
    block = b"\n".join([json.dumps({"whole": listed, "large": large}).encode(), b"".join(content)])
    return [f"{stage.fingerprint} {stage.name}" for stage in stages], np.frombuffer(block, np.uint8)


def unpack(lines: list[str], block: U8) -> tuple[StageDigest, ...]:
    """Return the fingerprints that ``pack`` packed."""
    whole: dict[str, dict[str, NDArray[Any]]] = defaultdict(dict)
    large: dict[str, dict[str, LargeArray]] = defaultdict(dict)
    head, _, content = bytearray(block).partition(b"\n")
    listed, start = json.loads(head), 0
    for stage, name, *values in listed["large"]:
        large[stage][name] = LargeArray(*values)
    for stage, name, kind, shape in listed["whole"]:
        end = start + np.dtype(kind).itemsize * math.prod(shape)
        whole[stage][name] = np.frombuffer(content[start:end], kind).reshape(shape)
        start = end
    split = [line.partition(" ")[::2] for line in lines]
    return tuple(StageDigest(name, fingerprint, whole[name], large[name]) for fingerprint, name in split)


def detections_of(stages: tuple[StageDigest, ...]) -> dict[tuple[str, int], Detections]:
    """Return the detections of the network, bit by bit, by camera and stamp of the image."""
    arrays = {stage.name: stage.whole for stage in stages}
    detections = {}
    for name, values in arrays.items():
        kind, _, camera = name.partition(" ")
        if kind == "detector" and values:
            boxes: dict[str, Any] = {**values, "names": tuple(values["names"].tolist())}
            masks = {key.removeprefix("masks."): boxes.pop(key) for key in values if key.startswith("masks.")}
            if masks:
                boxes["masks"] = Masks(**masks)
            detections[camera, int(arrays[f"image {camera}"]["stamp"][0])] = Detections(**boxes)
    return detections


# --- stages ------------------------------------------------------------------------------------


def _stages(result: FrameResult) -> Iterator[tuple[str, Arrays]]:
    """Yield the name and the arrays of each stage."""
    frame = result.frame
    yield "cloud", {"xyz": frame.points, "stamp": np.array([frame.stamp])}
    yield "fields", dict(sorted(frame.fields.items()))
    poses = {} if frame.world_from_points is None else {"world_from_points": frame.world_from_points}
    if frame.world_frame == ESTIMATED:  # depends on the processor in more than rounding
        poses = {}
    yield "transforms", poses
    for camera_result in result.cameras:
        camera = camera_result.camera
        if camera.image is not None:
            yield (
                f"image {camera.name}",
                {"pixels": camera.image.bgr, "stamp": np.array([camera.image.stamp])},
            )
        calibration = {"camera_from_points": camera.camera_from_points}
        if camera.intrinsics is not None:
            calibration |= {"K": camera.intrinsics.K, "D": camera.intrinsics.D}
        yield (
            f"transforms {camera.name}",
            {key: value for key, value in calibration.items() if value is not None},
        )
    for name in ("voxels", "ground", "clusters"):
        yield name, dict(_arrays(getattr(result, name)))
    for camera_result in result.cameras:
        for name, stage_result in (("detector", camera_result.detections), ("fusion", camera_result.fusion)):
            yield f"{name} {camera_result.camera.name}", dict(_arrays(stage_result))
    yield "objects", dict(_arrays(result.objects))
    if result.bev is not None:
        yield "bev", {"picture": result.bev.image, **result.bev.channels}
    yield "failures", {"stage": np.array([failure.stage for failure in result.failures], np.str_)}


def _arrays(instance: Any, prefix: str = "") -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the arrays of a dataclass and of the dataclasses in it."""
    if instance is None:
        return
    for attribute in fields(instance):
        value = getattr(instance, attribute.name)
        if isinstance(value, np.ndarray):
            yield prefix + attribute.name, value
        elif isinstance(value, tuple):
            yield prefix + attribute.name, np.array(value, np.str_)
        elif is_dataclass(value):
            yield from _arrays(value, f"{prefix}{attribute.name}.")


def _stage(name: str, arrays: Arrays) -> StageDigest:
    """Return the fingerprint of one stage."""
    content = sha256()
    whole, large = {}, {}
    for key, value in arrays.items():
        array = np.ascontiguousarray(value)
        data = "\n".join(array.tolist()).encode() if array.dtype.kind == "U" else array.data
        fingerprint = sha256(data).hexdigest()
        kind = "text" if array.dtype.kind == "U" else array.dtype.str
        content.update(f"{key} {kind} {array.shape} {fingerprint}\n".encode())
        # Masks are always stored, so that a check does not have to run the network again.
        if array.size <= WHOLE or key == "masks.packed":
            whole[key] = array
        else:
            large[key] = LargeArray(fingerprint, str(len(array)), f"{np.sum(array, dtype=np.float64):.17g}")
    return StageDigest(name, content.hexdigest(), whole, large)


# --- differences -------------------------------------------------------------------------------


def _difference(stored: StageDigest, current: StageDigest) -> DigestDifference:
    """Return the largest difference between two stages whose fingerprints differ."""
    worst = DigestDifference(current.name, "equal in value, but not in every bit", 0.0)  # 0.0 and -0.0
    for name in dict.fromkeys([*stored.whole, *stored.large, *current.whole, *current.large]):
        amount, text = _array_difference(stored, current, name)
        if amount > worst.amount:
            worst = DigestDifference(current.name, f"{name}: {text}", amount)
    return worst


def _array_difference(stored: StageDigest, current: StageDigest, name: str) -> tuple[float, str]:
    """Return the difference of one array: its amount, infinite if more than numbers differ, and its text."""
    rows, new_rows = _rows(stored, name), _rows(current, name)
    if rows != new_rows:
        return float("inf"), f"{rows} rows became {new_rows}"
    if name in stored.large and name in current.large:
        if stored.large[name] == current.large[name]:
            return 0.0, ""
        change = float(current.large[name].total) - float(stored.large[name].total)
        return float("inf"), f"{rows} rows as before with other values, their sum {change:+g}"
    if (
        name not in stored.whole
        or name not in current.whole
        or stored.whole[name].shape != current.whole[name].shape
    ):
        return float("inf"), "another shape"
    old, new = stored.whole[name].reshape(-1), current.whole[name].reshape(-1)
    if old.dtype.kind == "f" and new.dtype.kind == "f":
        return _step(old, new)
    changed = np.flatnonzero(old != new)
    if not len(changed):
        return 0.0, ""
    became = f"{old[changed[0]]} became {new[changed[0]]}"
    return float("inf"), f"{len(changed)} of {old.size} values differ, the first: {became}"


def _step(old: NDArray[Any], new: NDArray[Any]) -> tuple[float, str]:
    """Return the largest relative difference of two float arrays, and its text."""
    same = (old == new) | (np.isnan(old) & np.isnan(new))
    with np.errstate(invalid="ignore"):
        step = np.nan_to_num(np.abs(new.astype(np.float64) - old), nan=np.inf)[~same]
        relative = step / np.maximum(1.0, np.abs(old[~same], dtype=np.float64))
    text = f"{len(step)} of {old.size} values differ, by up to {step.max(initial=0.0):.3g}"
    return float(relative.max(initial=0.0)), text


def _rows(stage: StageDigest, name: str) -> int:
    """Return the number of rows of an array."""
    if name in stage.large:
        return int(stage.large[name].rows)
    return len(stage.whole[name]) if name in stage.whole else 0
