"""Assume the object that an image box shows, for frames without ground truth."""

from __future__ import annotations

import numpy as np

from bevviz.evaluate import Truth
from bevviz.model import geometry
from bevviz.model.class_names import accepted_names
from bevviz.model.frame import F32, Bool, ImageLabels
from bevviz.model.results import CameraResult, Detections, DetectionState
from bevviz.stages.clustering import describe_clusters
from bevviz.stages.frustum_fusion import claim_clusters
from bevviz.why.frame_index import FEW, FrameIndex
from bevviz.why.ideal import NO_LIMITS, SURE
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
    points, fusion = result.voxels.points[rows], result.config.fusion.model_copy(update=NO_LIMITS)
    asked = CameraResult(view, _detections_of(xyxy, names), None, uv[rows], depth[rows])
    clustering = result.config.clustering.model_copy(update={"min_cluster_points": 1})
    noise = describe_clusters(points, np.full(len(rows), -1, np.int32), clustering)
    known = None if np.isnan(height[rows]).any() else height[rows]
    _, (claims,), _ = claim_clusters(
        points, known, noise, (asked,), fusion, result.config.objects, clustering
    )
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
        return traces.camera(subject.camera), xyxy
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


def _detections_of(xyxy: F32, names: tuple[str, ...]) -> Detections:
    """Return a sure detection of each class in one image box."""
    count = len(names)
    return Detections(
        np.repeat(xyxy[None], count, axis=0).astype(np.float32),
        np.full(count, SURE, np.float32),
        np.arange(count, dtype=np.int32),
        names,
        np.full(count, DetectionState.KEPT, np.int32),
        np.full(count, -1, np.int32),
        np.zeros(count, np.float32),
    )
