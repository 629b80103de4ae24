"""Boxes in messages other than vision_msgs': Autoware's, radars', markers, and types of the user."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np

from bevviz.errors import UserError
from bevviz.messages.decoders import frame_name, stamp_ns
from bevviz.messages.guard import describe_kind, field_names
from bevviz.messages.poses import UPRIGHT, quaternion_of, vector_of, yaw_of
from bevviz.model.frame import F32, F64, Bool, Boxes3D, LabelledBoxes2D, LabelledBoxes3D
from bevviz.support.limits import MAX_BOXES

T = TypeVar("T")

CUBE, CYLINDER, TEXT, ADD = 1, 3, 9, 0  # values of visualization_msgs/Marker
POLYGON = 2  # value of Autoware's Shape
LARGEST = 1e9  # metres; no measured coordinate or size is larger
LEAN = math.radians(1)  # radians; a box that leans less is upright


@dataclass(frozen=True, slots=True)
class Fields:
    """Paths of the fields that describe a box.

    A path is ``a.b.c``. ``|`` separates names of different versions.

    Attributes:
        objects: list of objects in the message; empty: the message's only list of messages.
        center: centre, with x, y and z.
        size: lengths along the box's axes, with x, y and z, or as three numbers.
        orientation: quaternion; empty: the field ``orientation`` beside the centre, or no rotation.
        yaw: rotation about z in radians, in place of the quaternion.
        label: text, or a number that is a constant of the message definition.
        score: score of the box.
        id: identity of the box.
    """

    objects: str = ""
    center: str = "pose.position"
    size: str = "size"
    orientation: str = ""
    yaw: str = ""
    label: str = ""
    score: str = ""
    id: str = ""


AUTOWARE = Fields(
    objects="objects",
    center="kinematics.pose_with_covariance|initial_pose_with_covariance.pose.position",
    size="shape.dimensions",
    label="classification.label",
    score="existence_probability",
    id="object_id|id|uuid",
)
RADAR = Fields(objects="tracks", center="position", size="size", label="classification", id="uuid")
TYPES = re.compile(
    r"autoware(_auto)?_perception_msgs/(msg/)?(Detected|Tracked|Predicted)Objects$|radar_msgs/(msg/)?RadarTracks$"
)


def holds_boxes(msgtype: str) -> bool:
    """Return whether the fields of a message type's boxes are known."""
    return TYPES.search(msgtype) is not None


def check_boxes_setting(stated: Mapping[str, str]) -> None:
    """Check the setting ``source.boxes``.

    Raises:
        UserError: a key is unknown, or the topic is missing.
    """
    known = ["topic", *(field.name for field in fields(Fields))]
    for name in stated:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f", did you mean {near[0]}? There are" if near else "; there are"
            raise UserError(f"source.boxes: {name} is not known{hint} {', '.join(known)}")
    if stated and "topic" not in stated:
        raise UserError("source.boxes: topic is missing: of which the boxes are")


def decode_objects(msg: Any, topic: str, received: int, stated: Mapping[str, str]) -> LabelledBoxes3D:
    """Decode the boxes of a message that is no Detection3DArray.

    In a MarkerArray each added CUBE or CYLINDER is a box. Its label is the text of a TEXT_VIEW_FACING marker
    with the same id, in the same namespace or in a namespace without boxes. Without such a marker the
    namespace is the label.

    Args:
        msg: message that has a header, or objects that have one.
        topic: topic of the message.
        received: time of receipt, nanoseconds.
        stated: ``source.boxes`` if it is for this topic; empty: only known types are decoded.

    Raises:
        ValueError: a field is missing. The error lists the fields that exist.
    """
    paths = {name: path for name, path in stated.items() if name != "topic"}
    if hasattr(msg, "markers") and not paths:
        return _markers(msg.markers, topic, received)
    known = RADAR if hasattr(msg, "tracks") else AUTOWARE
    where = Fields(**paths) if paths else known
    items = _read(list, msg, where.objects) if where.objects else list(_only_list(msg))
    header = getattr(msg, "header", None)
    rows, headers = list[BoxRow](), list[Any]()
    for item in items:
        label = _label(item, where.label) if where.label else ""
        identity = _identity(_follow(item, where.id)[1]) if _has(item, where.id) else ""
        score = _read(float, item, where.score) if _has(item, where.score) else 1.0
        rows.append(BoxRow(_row(item, where), label, score, identity))
        item_header = getattr(item, "header", None)
        headers.append(header if item_header is None or (header and header.frame_id) else item_header)
    columns = box_columns(rows, 10)
    if None in [item_header for item_header, usable in zip(headers, columns.usable, strict=True) if usable]:
        raise ValueError("neither the message nor its objects have a header, which says the frame")
    boxes = _boxes(columns, headers, topic, received)
    if len(boxes.boxes) or header is None:
        return boxes
    return replace(boxes, stamp=stamp_ns(header.stamp), frame_id=frame_name(str(header.frame_id)))


def _row(item: Any, where: Fields) -> tuple[float, ...]:
    """Return centre, size and quaternion of an object."""
    holder, _ = _follow(item, where.center)
    x, y, z = _read(vector_of, item, where.center)
    turn = UPRIGHT
    if where.yaw:
        half = _read(float, item, where.yaw) / 2
        turn = 0.0, 0.0, math.sin(half), math.cos(half)
    elif where.orientation:
        turn = _read(quaternion_of, item, where.orientation)
    elif hasattr(holder, "orientation"):
        turn = quaternion_of(holder.orientation)
    length, width, height = _read(vector_of, item, where.size)
    shape = getattr(item, "shape", None)
    if shape is not None and getattr(shape, "type", None) == POLYGON and hasattr(shape, "footprint"):
        outline = np.array([(p.x, p.y) for p in shape.footprint.points], np.float64).reshape(-1, 2)
        if len(outline):  # in the axes of the object
            low, high = outline.min(axis=0), outline.max(axis=0)
            (length, width), (dx, dy) = (high - low).tolist(), ((low + high) / 2).tolist()
            yaw = float(yaw_of(np.array(turn)))
            c, s = math.cos(yaw), math.sin(yaw)
            x, y = x + c * dx - s * dy, y + s * dx + c * dy
    return x, y, z, length, width, height, *turn


def _markers(markers: Iterable[Any], topic: str, received: int) -> LabelledBoxes3D:
    shown = [marker for marker in markers if marker.action == ADD]
    solids = [marker for marker in shown if marker.type in (CUBE, CYLINDER)]
    texts = {(marker.ns, marker.id): str(marker.text) for marker in shown if marker.type == TEXT}
    of_solids = {marker.ns for marker in solids}
    others = {number: text for (ns, number), text in texts.items() if ns not in of_solids}
    rows = []
    for marker in solids:
        place, turn = vector_of(marker.pose.position), quaternion_of(marker.pose.orientation)
        text = texts.get((marker.ns, marker.id)) or others.get(marker.id) or str(marker.ns)
        rows.append(BoxRow((*place, *vector_of(marker.scale), *turn), text, 1.0, f"{marker.ns}/{marker.id}"))
    columns = box_columns(rows, 10, lambda number, label, identity: f"marker {identity}")
    return _boxes(columns, [marker.header for marker in solids], topic, received)


def _boxes(columns: BoxColumns, headers: Sequence[Any], topic: str, received: int) -> LabelledBoxes3D:
    """Make the result of boxes with a header each. The stamp is that of the first usable box."""
    headers = [header for header, usable in zip(headers, columns.usable, strict=True) if usable]
    frames = tuple(frame_name(str(header.frame_id)) for header in headers)
    stamp = stamp_ns(headers[0].stamp) if headers else received
    return boxes_3d(columns._replace(frames=frames), topic, received, stamp, next(iter(frames), ""))


# --- boxes as columns ----------------------------------------------------------------------------


class BoxRow(NamedTuple):
    """Box of a message.

    Attributes:
        numbers: centre, size and quaternion; centre, angle, size and 0 for a box in an image.
        label: class.
        score: score.
        identity: identity; empty: none.
        frame: frame of the box; empty: the message states none.
    """

    numbers: tuple[float, ...]
    label: str
    score: float
    identity: str = ""
    frame: str = ""


class BoxColumns(NamedTuple):
    """Usable boxes of a message, as columns.

    Attributes:
        values: (K, width) numbers of the boxes.
        labels: classes.
        scores: (K,) scores.
        ids: identities.
        frames: frames.
        usable: whether each box of the message is usable.
        unusable: a sentence for each box that is not.
    """

    values: F64
    labels: tuple[str, ...]
    scores: F32
    ids: tuple[str, ...]
    frames: tuple[str, ...]
    usable: Bool
    unusable: tuple[str, ...]


def box_columns(
    rows: Sequence[BoxRow], width: int, name: Callable[[int, str, str], str] | None = None
) -> BoxColumns:
    """Collect the usable boxes of a message. Boxes that are not finite or have a negative size are left out.

    Args:
        rows: boxes of the message.
        width: how many numbers a box has.
        name: returns the name of an unusable box by number, label and identity; None: ``box_name``.

    Raises:
        ValueError: there are more than ``MAX_BOXES`` boxes.
    """
    check_box_count(len(rows))
    values = np.array([row.numbers for row in rows]).reshape(-1, width)
    usable = (np.abs(values) < LARGEST).all(axis=1) & (values[:, 3:6] >= 0).all(axis=1)
    kept = [row for row, is_usable in zip(rows, usable, strict=True) if is_usable]
    unusable = [
        f"{(name or box_name)(number, rows[number].label, rows[number].identity)}: "
        f"{_why_unusable(rows[number].numbers)}"
        for number in np.flatnonzero(~usable).tolist()
    ]
    scores = np.array([row.score for row in kept], np.float32)
    if not scores.any():  # A node that publishes a box does not rate it 0: it left the score unset.
        scores[:] = 1.0
    return BoxColumns(
        values[usable].astype(np.float64),
        tuple(row.label for row in kept),
        np.nan_to_num(scores),
        tuple(row.identity for row in kept),
        tuple(row.frame for row in kept),
        usable,
        tuple(unusable),
    )


def check_box_count(count: int) -> None:
    """Raise ValueError if a message or a frame of a file has more than ``MAX_BOXES`` boxes."""
    if count > MAX_BOXES:
        raise ValueError(f"it has {count:,} boxes: {MAX_BOXES:,} at most are taken")


def boxes_3d(columns: BoxColumns, topic: str, received: int, stamp: int, frame_id: str) -> LabelledBoxes3D:
    """Make the result of columns."""
    boxes, turns = turned_boxes(columns.values)
    return LabelledBoxes3D(
        topic=topic,
        stamp=stamp,
        frame_id=frame_id,
        boxes=boxes,
        labels=columns.labels,
        scores=columns.scores,
        received=received,
        ids=columns.ids if all(columns.ids) else (),
        turns=turns,
        frames=columns.frames if len(set(columns.frames)) > 1 else (),
        unusable=columns.unusable,
    )


def boxes_2d(columns: BoxColumns, topic: str, received: int, stamp: int, frame_id: str) -> LabelledBoxes2D:
    """Make the result of columns of image boxes. A rotated box becomes the upright box around it."""
    x, y, theta, w, h, _ = columns.values.T
    cos, sin = np.abs(np.cos(theta)), np.abs(np.sin(theta))
    dx, dy = (w * cos + h * sin) / 2, (w * sin + h * cos) / 2
    xyxy = np.stack([x - dx, y - dy, x + dx, y + dy], axis=1).astype(np.float32)
    return LabelledBoxes2D(
        *(topic, stamp, frame_id, xyxy, columns.labels, columns.scores),
        received=received,
        unusable=columns.unusable,
    )


def _why_unusable(row: Sequence[float]) -> str:
    """Return why centre, size and quaternion of an unusable box cannot be used."""
    for name, values in (("centre", row[:3]), ("size", row[3:6]), ("orientation", row[6:])):
        if not all(abs(value) < LARGEST for value in values):  # false for NaN, too
            return f"its {name} is not finite: {_numbers(values)}"
    return f"its size is negative: {_numbers(row[3:6])}"


def box_name(number: int, label: str, identity: str) -> str:
    """Return a name for a box of a message: ``box 3 (Car, id 17)``. Numbers count from 0."""
    words = [label, f"id {identity}" if identity else ""]
    about = ", ".join(filter(None, words))
    return f"box {number}{f' ({about})' if about else ''}"


def _numbers(values: Iterable[float]) -> str:
    return ", ".join(f"{value:.6g}" for value in values)


def turned_boxes(values: F64) -> tuple[Boxes3D, F64 | None]:
    """Convert (K, 10) centres, sizes and quaternions to boxes. Return the quaternions, too, if a box leans.

    A quaternion of zero is no rotation.
    """
    turns = values[:, 6:].copy()
    turns[~turns.any(axis=1)] = UPRIGHT
    x, y, z, w = turns.T
    leans = x * x + y * y > math.sin(LEAN / 2) ** 2 * (x * x + y * y + z * z + w * w)
    boxes = Boxes3D(values[:, :3], values[:, 3:6].astype(np.float32), yaw_of(turns).astype(np.float32))
    return boxes, turns if leans.any() else None


# --- fields ------------------------------------------------------------------------------------


def _follow(item: Any, path: str) -> tuple[Any, Any]:
    """Follow a path. Return the object that holds its last attribute, and the attribute's value.

    Within a list the object with the highest probability or score is followed.
    """
    holder, value = item, item
    for name in path.split("."):
        holder = _likeliest(value)
        attribute = next((option for option in name.split("|") if hasattr(holder, option)), None)
        if attribute is None:
            raise ValueError(
                f"no field {name} (of {path}); there are {', '.join(field_names(holder) or ['none'])}"
            )
        value = getattr(holder, attribute)
    return holder, value


def _read(kind: Callable[[Any], T], item: Any, path: str) -> T:
    """Return the field at a path, converted by ``kind``.

    Raises:
        ValueError: the field does not exist or cannot be converted.
    """
    value = _follow(item, path)[1]
    try:
        return kind(value)
    except (TypeError, ValueError, AttributeError):
        raise ValueError(f"the field '{path}' cannot be used: it is {describe_kind(value)}") from None


def _has(item: Any, path: str) -> bool:
    try:
        _follow(item, path if path else "-")
    except ValueError:
        return False
    return True


def _likeliest(value: Any) -> Any:
    if not isinstance(value, list | tuple):
        return value
    if not value:
        return None
    return max(value, key=_probability)


def _probability(candidate: Any) -> float:
    return float(getattr(candidate, "probability", getattr(candidate, "score", 0.0)))


def _only_list(msg: Any) -> Any:
    lists = {name: value for name in field_names(msg) or () if isinstance(value := getattr(msg, name), list)}
    if len(lists) != 1:
        raise ValueError(
            f"objects is not stated, and there are {len(lists)} lists: {', '.join(lists) or 'none'}"
        )
    return next(iter(lists.values()))


def _label(item: Any, path: str) -> str:
    """Return a text as it is, and a number as the name of its constant in the definition, in lower case."""
    if not _has(item, path):
        return ""  # the list of classes is empty
    holder, value = _follow(item, path)
    if not isinstance(value, int | np.integer):
        return str(value)
    field = path.rpartition(".")[2].upper()
    named = [name for name in dir(type(holder)) if name.isupper() and getattr(type(holder), name) == value]
    named = [name for name in named if name.startswith(field)] or named
    return named[0].removeprefix(f"{field}_").lower() if len(named) == 1 else str(value)


def _identity(value: Any) -> str:
    inner = getattr(value, "uuid", value)
    return bytes(inner).hex() if isinstance(inner, np.ndarray | bytes | list) else str(inner)
