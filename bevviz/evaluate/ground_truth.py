"""Ground truth of a frame, and which of its objects have to be found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from bevviz.datasets.kitti_labels import label_files, read_labels
from bevviz.errors import UserError
from bevviz.messages.foreign_boxes import box_name
from bevviz.messages.roles import Roles
from bevviz.model import geometry
from bevviz.model.box_overlap import bev_iou_and_share
from bevviz.model.box_points import inside_each
from bevviz.model.class_names import judged_names, rule_of
from bevviz.model.frame import I64, Bool, Boxes3D, Camera, Frame, ImageLabels, LabelledBoxes3D
from bevviz.stages.robot_results import in_points_frame

if TYPE_CHECKING:
    from bevviz.model.protocols import FrameSource

MIN_HITS = 10  # least number of LiDAR points on an object to be found
MAX_DISTANCE = 2.0  # metres between the centres of a box and its object, on the ground plane
SAME_PLACE = 0.8  # metres between the centres of two labels of one object
HALF = 0.5  # share of a box from which it is on another one
RANGE = 40.0  # metres, largest distance of an object to be found


TruthLookup: TypeAlias = "Callable[[Frame], Truth | None]"


@dataclass(frozen=True, slots=True)
class Truth:
    """Ground truth of a frame, in the frame of the points."""

    boxes: Boxes3D
    labels: tuple[str, ...]
    accepted: tuple[frozenset[str], ...]  # names accepted for each box, in lower case
    must: Bool  # (K,) whether the object has to be found; the others may be found
    ids: tuple[str, ...] = ()  # (K,) constant from frame to frame; (): unknown
    image: ImageLabels | None = None  # labels in the image, if the data set has them
    camera: Camera | None = None  # camera of that image
    unusable: tuple[str, ...] = ()  # one sentence for each label that cannot be used
    judged: Bool | None = None  # (K,) False: an object on it is neither right nor wrong; None: all are judged
    whole: bool = True  # whether an object without a label can be false

    @property
    def judged_names(self) -> frozenset[str]:
        """Names, in lower case, of which an object without a label is false."""
        return judged_names(self.labels).union(*self.accepted) if self.whole else frozenset()

    def unjudged_label(self, boxes: Boxes3D) -> I64:
        """Return (J,) the row of the label of an unjudged type that a box is on, -1: none.

        The two are no farther apart than a match may be, or half of the smaller one lies in the other.
        """
        none = np.full(len(boxes), -1, np.int64)
        if self.judged is None or self.judged.all() or not len(boxes):
            return none
        labels = np.flatnonzero(~self.judged)
        unjudged = self.boxes.chosen(labels)
        offset = boxes.center[:, None, :2] - unjudged.center[None, :, :2]
        is_on = np.linalg.norm(offset, axis=2) <= MAX_DISTANCE
        is_on |= bev_iou_and_share(boxes, unjudged)[1] >= HALF
        return np.where(is_on.any(axis=1), labels[is_on.argmax(axis=1)], none)

    def unlabelled(self, boxes: Boxes3D) -> Bool:
        """Return (J,) whether a box has its centre in an image region without labels (KITTI's DontCare)."""
        none = np.zeros(len(boxes), bool)
        if self.image is None or self.camera is None or len(self.image.dont_care) == 0:
            return none
        assert self.camera.camera_from_points is not None
        assert self.camera.intrinsics is not None
        centers = geometry.apply(self.camera.camera_from_points, boxes.center)
        uv, _ = geometry.project(centers, self.camera.intrinsics)
        low, high = self.image.dont_care[:, :2], self.image.dont_care[:, 2:]
        with np.errstate(invalid="ignore"):
            inside = ((uv[:, None] >= low) & (uv[:, None] <= high)).all(axis=2)
        return np.asarray(np.any(inside, axis=1), bool)


def truth_source(
    frames: FrameSource, topic: str | None = None, kitti: Path | None = None
) -> TruthLookup | None:
    """Return a function that returns the ground truth of a drive's frames. None: there is no ground truth.

    Args:
        frames: a bag, or frames that come with their own ground truth.
        topic: requested Detection3DArray; None: the topic called ground truth.
        kitti: requested label file, or a folder with one for each scan.

    Raises:
        UserError: there is no such topic or file, the numbers of label files and scans differ, or the frames
            come with their own.
    """
    roles: Roles | None = getattr(frames, "roles", None)
    if roles is None and (topic or kitti):
        option = f"--truth {topic}" if topic else f"--kitti-labels {kitti}"
        raise UserError(f"{option}: {frames.scene.name} has its own truth, leave it out")
    if roles is None:
        return own_truth if frames.scene.truth else None
    if kitti is not None:
        files = label_files(kitti)
        if len(files) != len(frames.scans):
            count = f"{len(files)} label file{'s' * (len(files) > 1)} and {len(frames.scans)} scans"
            raise UserError(f"--kitti-labels {kitti}: {count}: one for each scan, in order, is needed")

        def of_kitti(frame: Frame) -> Truth | None:
            return truth_of(frame, read_labels(files[frame.index]))

        return of_kitti
    topics = (*roles.robot_detections_3d, *([roles.truth] if roles.truth else []))
    if topic is not None and topic not in topics:
        raise UserError(
            f"--truth {topic}: no such Detection3DArray topic; there are: {', '.join(topics) or 'none'}"
        )
    if topic is None and not roles.truth:
        return None

    def of_topic(frame: Frame) -> Truth | None:
        labelled = frame.truth if topic in (None, roles.truth) else None
        labelled = labelled or next((boxes for boxes in frame.robot_boxes if boxes.topic == topic), None)
        return None if labelled is None else truth_of(frame, labelled)

    return of_topic


def truth_in(frames: FrameSource, topic: str | None = None, kitti: Path | None = None) -> TruthLookup:
    """Return what ``truth_source`` returns.

    Raises:
        UserError: as ``truth_source``, and if there is no ground truth.
    """
    if (truths := truth_source(frames, topic, kitti)) is not None:
        return truths
    roles: Roles | None = getattr(frames, "roles", None)
    if roles is None:
        raise UserError(f"{frames.scene.name}: there is no ground truth")
    topics = ", ".join(roles.robot_detections_3d) or "none"
    raise UserError(
        f"{frames.scene.name}: no .../ground_truth in it; give --truth TOPIC (Detection3DArray there: "
        f"{topics}) or --kitti-labels"
    )


def own_truth(frame: Frame) -> Truth | None:
    """Return the ground truth that a frame comes with."""
    return None if frame.truth is None else truth_of(frame, frame.truth)


def truth_of(frame: Frame, labelled: LabelledBoxes3D) -> Truth:
    """Return labelled boxes as the ground truth of a frame.

    A box without a size holds no points, and need not be found; ``unusable`` lists it.

    Args:
        frame: the frame.
        labelled: boxes in any frame, with its pose. A label of a data set accepts the names that detectors
            of COCO's classes use for it (``rule_of``). Any other label accepts its own name only.
    """
    boxes = in_points_frame(frame.pose, labelled)
    must = must_be_found(frame, boxes, labelled.labels)
    flat = [
        f"{box_name(k, labelled.labels[k], '')}: a side of it is 0 m long"
        for k in np.flatnonzero((boxes.size <= 0).any(axis=1)).tolist()
    ]
    rules = {label: rule_of(label, frame.label_names) for label in {*labelled.labels}}
    camera = next((camera for camera in frame.cameras if _can_see(camera)), None)
    return Truth(
        boxes,
        labelled.labels,
        tuple(rules[label].names for label in labelled.labels),
        must,
        labelled.ids,
        labelled.image,
        camera,
        (*labelled.unusable, *flat),
        np.array([rules[label].judged for label in labelled.labels], bool),
    )


def must_be_found(frame: Frame, boxes: Boxes3D, labels: Sequence[str]) -> Bool:
    """Return (K,) whether the object of a box has to be found.

    Its centre lies within 40 m, and in the image of some camera if there is one, and its box holds 10 LiDAR
    points or more. Its label is of a type that detectors know, and no second label of one object.
    """
    rules = {label: rule_of(label, frame.label_names) for label in {*labels}}
    wanted = np.array([rules[label].judged for label in labels], bool)
    must = np.asarray((boxes.distance <= RANGE) & _in_view(frame, boxes) & wanted, bool)
    rows_of: dict[str, list[int]] = {}  # by label in lower case
    for k, label in enumerate(labels):
        rows_of.setdefault(label.lower(), []).append(k)
    for row in np.flatnonzero(must).tolist():
        whole = rows_of.get(rules[labels[row]].whole, [])
        if whole:
            away = np.hypot(*(boxes.center[whole, :2] - boxes.center[row, :2]).T)
            must[row] = not (away <= SAME_PLACE).any()
    rows = np.flatnonzero(must)
    must[rows] = [len(hits) >= MIN_HITS for _, hits in inside_each(frame.points, boxes.chosen(rows))]
    return must


def _in_view(frame: Frame, boxes: Boxes3D) -> Bool:
    """Return (K,) whether the centre lies in the image of some camera. Without a located camera, all do."""
    visible, has_camera = np.zeros(len(boxes), bool), False
    for camera in frame.cameras:
        if not _can_see(camera):
            continue
        assert camera.intrinsics is not None
        assert camera.camera_from_points is not None
        has_camera = True
        uv, _ = geometry.project(geometry.apply(camera.camera_from_points, boxes.center), camera.intrinsics)
        size = np.array([camera.intrinsics.width, camera.intrinsics.height], np.float32)
        with np.errstate(invalid="ignore"):
            visible |= ((uv >= -0.5) & (uv < size - 0.5)).all(axis=1)
    return visible if has_camera else ~visible


def _can_see(camera: Camera) -> bool:
    """Return whether a camera has an image, intrinsics and a pose."""
    return (
        camera.image is not None and camera.intrinsics is not None and camera.camera_from_points is not None
    )
