"""Assume the object that an image box shows, for frames without ground truth."""

from __future__ import annotations

import numpy as np

from bevviz.evaluate import Truth
from bevviz.model import geometry
from bevviz.model.class_names import accepted_names
from bevviz.model.frame import F32, Bool, ImageLabels
from bevviz.model.results import CameraResult, Detections
from bevviz.why.frame_index import FEW, FrameIndex
from bevviz.why.ideal import SURE, claim_freely, ideal_config
from bevviz.why.subject import Subject
from bevviz.why.verdict import ROAD

NARROW, WIDE = 0.6, 1.5  # factors on the shape of a class seen along and across, within which a box shows it


def assumed_truth(subject: Subject, traces: FrameIndex) -> Truth | None:
    """Return the object that the image box of a subject shows, as the only one of a ground truth.

    It is what our fusion makes of the box and of all points above the road in it, without its limits. Where
    no detection tells the class, it is the class of known size that suits the points best.

    Returns:
        The ground truth. None: the subject has no image box, or too few points are in it.
    """
    result, (camera, xyxy) = traces.result, _image_box(subject, traces)
    if camera is None or xyxy is None or result.voxels is None or result.ground is None:
        return None
    view = camera.camera
    if view.intrinsics is None or view.camera_from_points is None:
        return None
    names = (subject.label,) if subject.label else _likely_names(traces, xyxy)
    uv, depth = geometry.project(
        geometry.apply(view.camera_from_points, result.voxels.points), view.intrinsics
    )
    height = result.ground.height
    rows = np.flatnonzero(~(height < ROAD) & _in_box(uv, depth, xyxy))
    if len(rows) < FEW or not names:
        return None
    sure = np.full(len(names), SURE, np.float32)  # A detection of each class has the same box.
    detections = Detections.of_boxes(np.tile(xyxy, (len(names), 1)).astype(np.float32), sure, names)
    asked = CameraResult(view, detections, None, uv[rows], depth[rows])
    known = None if np.isnan(height[rows]).any() else height[rows]
    config = ideal_config(result.config, ("clustering",))
    claims = claim_freely(result.voxels.points[rows], known, asked, config)
    if claims is None or claims.cluster.max() < 0:
        return None
    best = int(claims.cluster.argmax())
    nothing = np.zeros(1, np.float32)
    image = ImageLabels(xyxy[None], nothing, nothing.astype(np.int32), np.zeros((0, 4), np.float32))
    accepted = accepted_names(names[best], traces.classes) | {names[best].lower()}
    must = np.ones(1, np.bool_)
    return Truth(claims.boxes.chosen([best]), (names[best],), (accepted,), must, image=image, camera=view)


def _in_box(uv: F32, depth: F32, xyxy: F32) -> Bool:
    """Return which pixels are in an image box or at most its width beside it, where its object may go on."""
    u, v = uv.T
    wide, tall = xyxy[2:] - xyxy[:2]
    with np.errstate(invalid="ignore"):
        beside = (u >= xyxy[0] - wide) & (u <= xyxy[2] + wide)
        return np.asarray((depth > 0) & beside & (v >= xyxy[1] - tall) & (v <= xyxy[3] + tall), np.bool_)


def _image_box(subject: Subject, traces: FrameIndex) -> tuple[CameraResult | None, F32 | None]:
    """Return the image box of a subject and its camera. A cluster has that which it fits best."""
    xyxy = subject.xyxy if subject.asked is None else subject.asked
    if subject.kind != "cluster":
        return traces.result.camera(subject.camera), xyxy
    best: tuple[CameraResult | None, F32 | None] = None, xyxy
    most = 0.0
    for camera in traces.result.cameras:
        around = None if camera.fusion is None else camera.fusion.cluster_uv[subject.row]
        if around is None or not np.isfinite(around).all():
            continue
        fit = float(geometry.iou(around[None], around[None] if xyxy is None else xyxy[None])[0, 0])
        if fit > most:
            best, most = (camera, around if xyxy is None else xyxy), fit
    return best


def _likely_names(traces: FrameIndex, xyxy: F32) -> tuple[str, ...]:
    """Return the classes of the detector of a known size that an image box of this shape may show."""
    sizes, (wide, tall) = traces.result.config.objects.sizes, xyxy[2:] - xyxy[:2]
    known = {name: size for name in traces.classes if (size := sizes.get(name.lower())) is not None}
    likely = [
        name
        for name, (length, width, height, *_) in known.items()
        if NARROW * width / height <= wide / max(tall, 1.0) <= WIDE * length / height
    ]
    return tuple(likely or known)
