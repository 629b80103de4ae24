"""Identity of a subject: find the same object in another frame, or with other parameter values."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import asdict, dataclass

import numpy as np
from pydantic import TypeAdapter, ValidationError

from bevviz.errors import UserError
from bevviz.model import geometry
from bevviz.model.frame import Boxes3D
from bevviz.model.results import FrameResult, Tracks
from bevviz.stages.robot_results import in_points_frame
from bevviz.support.json_form import json_form
from bevviz.why.selection import Selection
from bevviz.why.subject import Subject

NEAR = 1.0  # metres between the places of one object without an id in two results
GAP = 5  # frames over which a place can mean the same object
SAME_BOX = 0.3  # IoU of the image boxes of one detection in two results


@json_form
@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """Everything that tells an object apart in other frames.

    Attributes:
        kind: kind of the subject.
        label: class, or the whole name of a place.
        frame: number of its frame.
        id: id in the ground truth.
        track: id of its track. -1: unknown.
        at: x, y, z in the fixed frame.
        camera: camera of a detection.
        box: image box of a detection.
        place: address of a place that was asked about.
    """

    kind: str
    label: str
    frame: int
    id: str = ""
    track: int = -1
    at: tuple[float, ...] = ()
    camera: str = ""
    box: tuple[float, ...] = ()
    place: str = ""

    def __str__(self) -> str:
        return json.dumps({key: value for key, value in asdict(self).items() if value not in ("", (), -1)})

    @staticmethod
    def parse(text: str) -> Identity:
        """Return the identity of a text that ``str`` made.

        Raises:
            UserError: the text is not valid.
        """
        with suppress(ValidationError):
            identity = _FORM.validate_json(text)
            if len(identity.at) in (0, 3) and len(identity.box) in (0, 4):
                return identity
        raise UserError(f"'{text}' is nothing that can be asked about")

    @property
    def name(self) -> str:
        """Name in sentences, without a distance, which differs from frame to frame."""
        if self.place:
            return self.label
        return f"the {self.label}{f' (track {self.track})' if self.track >= 0 else ''}"


_FORM = TypeAdapter(Identity)


def identify(
    subject: Subject, selection: Selection, result: FrameResult, tracks: Tracks | None = None
) -> Identity:
    """Return the identity of a subject.

    Args:
        subject: the subject of an answer.
        selection: selection that was asked about.
        result: result of the frame.
        tracks: tracks whose rows are those of the result, if they are known.
    """
    frame, kind, row = result.frame.index, subject.kind, subject.row
    if subject.is_place or kind == "track":
        return Identity(kind=kind, label=subject.name, frame=frame, place=str(selection))
    label = (subject.label or kind).lower()
    if kind == "truth":
        truth = result.frame.truth
        id_ = truth.ids[row] if truth is not None and truth.ids else ""
        return Identity(kind=kind, label=label, frame=frame, id=id_, at=_fixed(result, subject.box))
    object_row, cluster = _rows(result, subject)
    track, at = -1, _fixed(result, subject.box)
    if tracks is not None:
        same = (tracks.object == object_row) if object_row >= 0 else np.zeros(len(tracks), np.bool_)
        same |= (tracks.cluster == cluster) if cluster >= 0 else False
        track = int(tracks.id[np.flatnonzero(same)[0]]) if same.any() else -1
    if not at and cluster >= 0 and result.clusters is not None:
        at = _fixed(result, result.clusters.aabb.chosen(np.array([cluster])))
    box = () if subject.xyxy is None else tuple(round(float(value), 1) for value in subject.xyxy)
    return Identity(kind=kind, label=label, frame=frame, track=track, at=at, camera=subject.camera, box=box)


def find(
    identity: Identity, result: FrameResult, opened: FrameResult, tracks: Tracks | None
) -> tuple[Selection | None, str]:
    """Find the object of an identity in a frame.

    Args:
        identity: the identity.
        result: result of the frame, with any values.
        opened: result of the frame with the values that the tracks were made with.
        tracks: tracks in that frame. None: unknown.

    Returns:
        selection: the object; None: it is not there.
        reason: how it was found, or why it was not.
    """
    number = result.frame.index
    if identity.place:
        if number == identity.frame:
            return Selection.parse(identity.place), "by its place"
        return None, f"a place is asked in its own frame, {identity.frame}"
    if identity.kind == "truth":
        return _find_truth(identity, result)
    if number != identity.frame and identity.track >= 0 and tracks is not None:
        (rows,) = np.nonzero(tracks.id == identity.track)
        if not len(rows) or tracks.cluster[rows[0]] < 0:
            return None, f"track {identity.track} is not seen there"
        object_row, cluster = int(tracks.object[rows[0]]), int(tracks.cluster[rows[0]])
        how = f"by track {identity.track}"
        if result is opened:
            return Selection(object=object_row) if object_row >= 0 else Selection(cluster=cluster), how
        boxes = opened.objects.boxes if object_row >= 0 and opened.objects else None
        if boxes is None and opened.clusters is not None:
            boxes, object_row = opened.clusters.aabb, cluster
        at = () if boxes is None else _fixed(opened, boxes.chosen(np.array([object_row])))
        return _find_at(at, identity, result)[0], how
    if abs(number - identity.frame) > GAP:
        return None, f"without a track it cannot be followed from frame {identity.frame}"
    if identity.kind == "detection" and identity.box and (row := _find_detection(identity, result)) >= 0:
        return Selection(detection=row, camera=identity.camera), "by its box in the image"
    return _find_at(identity.at, identity, result)


def _find_truth(identity: Identity, result: FrameResult) -> tuple[Selection | None, str]:
    """Find an object of the ground truth by its id; without ids, by its class and place."""
    truth = result.frame.truth
    if truth is not None and truth.ids and identity.id:
        if identity.id in truth.ids:
            return Selection(truth=truth.ids.index(identity.id)), f"by id {identity.id} of the ground truth"
        return None, f"the ground truth has no {identity.label} of id {identity.id} there"
    if truth is None or abs(result.frame.index - identity.frame) > GAP:
        return None, f"without an id it cannot be followed from frame {identity.frame}"
    boxes = in_points_frame(result.frame.pose, truth)
    named = [row for row, label in enumerate(truth.labels) if label.lower() == identity.label]
    row = _nearest(identity.at, result, boxes, named)
    return (
        (None, "no object of its class is at its place")
        if row < 0
        else (Selection(truth=row), "by its place")
    )


def _find_detection(identity: Identity, result: FrameResult) -> int:
    """Return the row of the detection of the same class and place in the image, -1: none."""
    camera = result.camera(identity.camera)
    if camera is None or camera.detections is None:
        return -1
    overlap = geometry.iou(np.array([identity.box], np.float32), camera.detections.xyxy)[0]
    overlap[[name.lower() != identity.label for name in camera.detections.names]] = 0
    return int(overlap.argmax()) if overlap.max(initial=0) >= SAME_BOX else -1


def _find_at(at: tuple[float, ...], identity: Identity, result: FrameResult) -> tuple[Selection | None, str]:
    """Find an object of the same class at a place of the fixed frame, else the cluster there."""
    objects, clusters = result.objects, result.clusters
    if at and objects is not None and identity.kind != "cluster":
        named = [row for row, name in enumerate(objects.names) if name.lower() == identity.label]
        if (row := _nearest(at, result, objects.boxes, named)) >= 0:
            return Selection(object=row), "by its place"
    if at and clusters is not None and (row := _nearest(at, result, clusters.aabb)) >= 0:
        return Selection(cluster=row), "by its place"
    return None, "nothing of its kind is at its place"


def _nearest(
    at: tuple[float, ...], result: FrameResult, boxes: Boxes3D, rows: list[int] | None = None
) -> int:
    """Return the only row with its centre near a place, -1: none, or several that could be meant."""
    if not at or not len(boxes):
        return -1
    place = geometry.apply(geometry.inverse(result.frame.pose), np.array([at], np.float64))[0]
    away = np.hypot(*(boxes.center[:, :2] - place[:2]).T)
    if rows is not None:
        away[np.setdiff1d(np.arange(len(away)), rows)] = np.inf
    order = np.argsort(away, kind="stable")
    first = float(away[order[0]])
    second = float(away[order[1]]) if len(order) > 1 else np.inf
    return int(order[0]) if first <= NEAR and second >= 2 * first + 0.1 else -1


def _rows(result: FrameResult, subject: Subject) -> tuple[int, int]:
    """Return the rows of the object and of the cluster of a subject, -1: none."""
    objects, row = result.objects, subject.row
    if subject.kind == "object" and objects is not None:
        return row, int(objects.cluster[row])
    cluster = row if subject.kind == "cluster" else -1
    if subject.kind == "detection" and (fusion := result.fusion(subject.camera)) is not None:
        cluster = fusion.matched_cluster(row)
    if cluster < 0 or objects is None:
        return -1, cluster
    rows = np.flatnonzero(objects.cluster == cluster)
    return int(rows[0]) if len(rows) else -1, cluster


def _fixed(result: FrameResult, box: Boxes3D | None) -> tuple[float, ...]:
    """Return the centre of a box in the fixed frame."""
    if box is None:
        return ()
    return tuple(round(value, 2) for value in geometry.apply(result.frame.pose, box.center[:1])[0].tolist())
