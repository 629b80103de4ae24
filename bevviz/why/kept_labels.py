"""Labels that a user keeps: ground truth of single objects, which says nothing about the rest of a frame."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from bevviz.evaluate import Truth
from bevviz.model import geometry
from bevviz.model.class_names import accepted_names
from bevviz.model.frame import Boxes3D, Frame
from bevviz.pipeline.notes import Note
from bevviz.why.assumed_truth import assumed_truth
from bevviz.why.evidence import MOST
from bevviz.why.frame_index import FrameIndex
from bevviz.why.identity import Identity
from bevviz.why.subject import LINK, Subject, points_in_box, projected_box

NEAR = 0.3  # metres from the box of a label within which a place is on it
USUAL = "person"  # class of an object that nothing tells the class of


def kept_truth(notes: Iterable[Note], frame: Frame, classes: Iterable[str] = ()) -> Truth | None:
    """Return the labels that a user keeps of a frame, as its ground truth. None: there are none.

    No object without a label is false by them.

    Args:
        notes: notes of the drive.
        frame: the frame.
        classes: names of the classes that the detector knows.
    """
    labels = [note for note in notes if is_label_in(note, frame)]
    if not labels:
        return None
    known = {*classes}
    return Truth(
        Boxes3D.joined([box_of(note.box) for note in labels]),
        tuple(note.label for note in labels),
        tuple(accepted_names(note.label, known) | {note.label.lower()} for note in labels),
        np.ones(len(labels), np.bool_),
        tuple(note.pick for note in labels),
        whole=False,
    )


def is_label_in(note: Note, frame: Frame) -> bool:
    """Return whether a note is the label of an object in a frame."""
    return bool(note.label) and (note.stamp, note.points_frame) == (frame.stamp, frame.points_frame)


def box_of(values: Iterable[float]) -> Boxes3D:
    """Return the box of a centre x, y, z, length, width, height and yaw."""
    row = np.array([*values], np.float32)
    return Boxes3D(row[None, :3], row[None, 3:6], row[6:])


def label_of(subject: Subject, traces: FrameIndex, labels: FrameIndex) -> int:
    """Return the row of the label that a subject is on, -1: none.

    Args:
        subject: a subject of the frame.
        traces: index of the frame.
        labels: the same with the labels as its ground truth.
    """
    truth = labels.labels_in_evaluate
    picks = () if truth is None else truth.ids
    fits = [_fit(subject, label, pick, traces) for label, pick in zip(labels.truth, picks, strict=True)]
    return int(np.argmax(fits)) if max(fits, default=0.0) >= LINK else -1


def _fit(subject: Subject, label: Subject, pick: str, traces: FrameIndex) -> float:
    """Return how well a subject fits a label. A detection may be the one that the label was drawn for."""
    assert label.box is not None
    if subject.kind in ("detection", "pixel"):
        camera = traces.result.camera(subject.camera)
        around = None if camera is None else projected_box(label.box, camera.camera)
        if subject.xyxy is None:
            return 0.0
        if subject.kind == "detection":
            labelled = Identity.parse(pick)
            own = np.array(labelled.box, np.float32) if labelled.camera == subject.camera else np.zeros(0)
            boxes = [box for box in (around, own) if box is not None and len(box)]
            return max((float(geometry.iou(subject.xyxy[None], box[None])[0, 0]) for box in boxes), default=0)
        if around is None:
            return 0.0
        pixel = (subject.xyxy[:2] + subject.xyxy[2:]) / 2
        return float((pixel >= around[:2]).all() and (pixel <= around[2:]).all())
    if subject.is_place and subject.box is not None:
        return float(points_in_box(label.box, subject.box.center.astype(np.float32), NEAR)[0])
    if subject.kind != "cluster":
        return 0.0
    inside = points_in_box(label.box, traces.result.frame.points[traces.place(subject)])
    return float(len(inside) > 0 and inside.mean() >= MOST)


def proposed_label(subject: Subject, traces: FrameIndex) -> tuple[str, Boxes3D]:
    """Return class and box that a label of a subject may begin with.

    They are those of the object that its image box shows, else of its cluster, else of an object of the usual
    size at its place.
    """
    assumed = assumed_truth(subject, traces)
    if assumed is not None:
        return assumed.labels[0], assumed.boxes
    label, result = subject.label or USUAL, traces.result
    if subject.kind == "cluster" and result.clusters is not None:
        return label, result.clusters.boxes(result.config.clustering).chosen([subject.row])
    points = result.frame.points[traces.place(subject)]
    place = np.zeros(3) if not len(points) else np.median(points, axis=0)
    if subject.box is not None:
        place = subject.box.center[0]
    length, width, height = (result.config.objects.sizes.get(label.lower()) or (1.0, 1.0, 1.0))[:3]
    bottom = points[:, 2].min() if len(points) else place[2] - height / 2
    return label, box_of((*place[:2], bottom + height / 2, length, width, height, 0.0))
