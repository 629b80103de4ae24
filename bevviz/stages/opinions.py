"""Compare the objects of another method with the detections of the cameras and with our fused objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bevviz.config import OpinionsConfig
from bevviz.model import geometry
from bevviz.model.box_points import inside_each
from bevviz.model.class_names import accepted_names
from bevviz.model.frame import F32, I32, I64, Bool, Boxes3D
from bevviz.model.results import (
    CameraResult,
    Clusters,
    Decision,
    Detections,
    DetectionState,
    Objects,
    Opinion,
    Opinions,
)
from bevviz.stages.visibility import image_boxes, share_in_image, visible

MARGIN = 0.2  # metres around a box in which points still belong to it
MIN_SHARE = 0.5  # smallest share of a cluster's points in the box that it belongs to
# Share of a cluster relative to the box with the most of it. With less, only that box has the cluster.
MIN_RIVAL_SHARE = 0.7
MIN_MAIN_SHARE = 0.2  # like MIN_SHARE, for a cluster that has the most points in the box
DECIDED = (Opinion.CONFIRMED, Opinion.NAMED_OTHERWISE)
MIN_NEARBY_IOU = 0.1  # IoU from which a nearby detection is reported for a box without detections


@dataclass(frozen=True, slots=True)
class _CameraOpinions:
    """Opinion of one camera on each box. The fields are those of ``Opinions``."""

    opinion: I32
    detection: I32
    iou: F32
    held: F32
    shown: F32
    height: F32


def opinions(
    objects: Objects,
    fused: Objects,
    obstacles: F32 | None,
    clusters: Clusters | None,
    cameras: Sequence[CameraResult],
    ranges: F32,
    config: OpinionsConfig,
    known: Sequence[str] = (),
) -> Opinions:
    """Compare objects of another method with the objects that our fusion would make.

    A detection belongs to a box in one of two ways. If the fusion matched it with a cluster, the cluster is
    in the box: half of its points, or a fifth if it has the most points in the box. If another box has far
    more of these points, the detection also has to overlap this box in the image with IoU ``min_iou``. A
    detection without a cluster belongs to the box that it overlaps most in the image, if the IoU is
    ``min_iou`` or more and the box is not hidden. A detection whose cluster is elsewhere belongs to no box.
    The opinion of a camera on a box is

    - CONFIRMED if a detection of a matching class belongs to it;
    - NAMED_OTHERWISE if only detections of other classes do;
    - CONTRADICTED if no detection does, although ``min_shown`` of the box is in the image, ``min_visible`` of
      it is not hidden, it is ``min_height`` high, and the detector knows a matching class;
    - otherwise unseen, with the reason.

    With several cameras the opinion that comes first in this list counts. For equal opinions the camera that
    shows more of the box counts.

    Args:
        objects: objects of the other method, in the frame of the points.
        fused: objects from ``fusion.merge``.
        obstacles: (P, 3) points of the clusters, or None.
        clusters: clusters of those points.
        cameras: detections and fusion of each camera.
        ranges: from ``visibility.range_image``.
        config: conditions under which a camera has to find a box.
        known: classes that the detector knows; empty if unknown.
    """
    boxes, count = objects.boxes, len(objects)
    visible_share = visible(ranges, boxes)
    named = _named_clusters(fused, cameras, clusters)
    share = _cluster_shares(boxes, obstacles, clusters, named)
    least = _least_iou(share, objects.cluster[:, None] == named[None], config)
    best = _initial_opinions(count, Opinion.NOT_ASKED)
    camera = [""] * count
    for result in cameras:
        if result.detections is None:
            continue
        camera_opinions = _camera_opinions(
            result, result.detections, objects, visible_share, named, share, least, config, known
        )
        better = (camera_opinions.opinion < best.opinion) | (
            (camera_opinions.opinion == best.opinion) & (camera_opinions.shown > best.shown)
        )
        rows = np.flatnonzero(better)
        for field in _CameraOpinions.__slots__:
            getattr(best, field)[rows] = getattr(camera_opinions, field)[rows]
        for k in rows.tolist():
            # An object can be named by its cluster although its box is beside the image.
            is_shown = camera_opinions.shown[k] > 0 or camera_opinions.opinion[k] in DECIDED
            camera[k] = result.camera.name if is_shown else ""
    return Opinions(
        fused=fused,
        opinion=best.opinion,
        camera=tuple(camera),
        detection=best.detection,
        iou=best.iou,
        held=best.held,
        shown=best.shown,
        visible=visible_share,
        height=best.height,
        partner=_partners(fused, named, share, least),
    )


def matching_names(label: str, known: Sequence[str]) -> frozenset[str]:
    """Return the detector's class names that match a label of another method, in lower case."""
    wanted, names = accepted_names(label, known), {name.lower() for name in known}
    if right := wanted & names:
        return right
    # The method may use the names of a detector, and the detector those of a data set.
    return frozenset(name.lower() for name in known if label.lower() in accepted_names(name, ()))


# --- clusters in boxes -------------------------------------------------------------------------


def _named_clusters(fused: Objects, cameras: Sequence[CameraResult], clusters: Clusters | None) -> I64:
    """Return the rows of clusters that a detection has named, in order."""
    matched = np.zeros(0 if clusters is None else len(clusters), np.bool_)
    for result in cameras:
        if result.fusion is not None:
            matched |= result.fusion.cluster_decision == Decision.MATCHED
    matched[fused.cluster] = True
    return np.flatnonzero(matched)


def _cluster_shares(boxes: Boxes3D, points: F32 | None, clusters: Clusters | None, named: I64) -> F32:
    """Return the (K, len(named)) share of the points of each named cluster that are in each box."""
    share = np.zeros((len(boxes), len(named)), np.float32)
    if points is None or clusters is None or share.size == 0:
        return share
    column = np.full(len(clusters) + 1, -1, np.int64)  # noise has label -1, the last element
    column[named] = np.arange(len(named))
    column_of_point = column[clusters.labels]
    rows = np.flatnonzero(column_of_point >= 0)
    points, column_of_point = points[rows], column_of_point[rows]
    wide = Boxes3D(boxes.center, boxes.size + np.float32(2 * MARGIN), boxes.yaw)
    for k, inside in inside_each(points, wide):
        share[k] = np.bincount(column_of_point[inside], minlength=len(named))
    whole: F32 = np.maximum(np.bincount(column_of_point, minlength=len(named)), 1).astype(np.float32)
    return share / whole


def _least_iou(share: F32, has_most: Bool, config: OpinionsConfig) -> F32:
    """Return the (K, C) IoU that a detection with that cluster needs to belong to each box, inf for never.

    Args:
        share: (K, C) share of the cluster in the box.
        has_most: (K, C) whether the cluster has the most points in the box.
        config: gives the IoU needed if another box has far more of the cluster.
    """
    of_box = has_most & (share >= MIN_MAIN_SHARE)
    first = share >= MIN_RIVAL_SHARE * share.max(axis=0, initial=0)
    of_box |= first & (share >= MIN_SHARE)
    return np.where(of_box, np.where(first, 0, config.min_iou), np.inf).astype(np.float32)


def _partners(fused: Objects, named: I64, share: F32, least: F32) -> I32:
    """Return the (J,) box that holds most of the cluster of each of our objects, -1 for none."""
    partner = np.full(len(fused), -1, np.int32)
    if len(share):
        columns = np.searchsorted(named, fused.cluster)
        clear_share = np.where(np.isfinite(least), share, 0)[:, columns]
        has_partner = clear_share.max(axis=0) > 0
        partner[has_partner] = clear_share.argmax(axis=0)[has_partner]
    return partner


# --- one camera --------------------------------------------------------------------------------


def _initial_opinions(count: int, opinion: Opinion) -> _CameraOpinions:
    """Return the initial opinions of a camera, to be filled in."""
    zero = np.zeros(count, np.float32)
    return _CameraOpinions(
        np.full(count, opinion, np.int32),
        np.full(count, -1, np.int32),
        zero,
        np.full(count, np.nan, np.float32),
        zero.copy(),
        zero.copy(),
    )


def _camera_opinions(
    result: CameraResult,
    detections: Detections,
    objects: Objects,
    visible_share: F32,
    named: I64,
    share: F32,
    least: F32,
    config: OpinionsConfig,
    known: Sequence[str],
) -> _CameraOpinions:
    """Return the opinion of one camera on each box."""
    count, around = len(objects), image_boxes(objects.boxes, result.camera)
    overlap = geometry.iou(around, detections.xyxy)
    by_cluster, has_cluster = _by_cluster(result, detections, overlap, named, share, least)
    looks = ~np.isnan(by_cluster)
    open_overlap = np.where(visible_share[:, None] >= config.min_visible, overlap, 0)
    free = np.flatnonzero(detections.kept & ~has_cluster)
    if count and len(free):
        most = open_overlap[:, free].argmax(axis=0)
        sure = open_overlap[most, free] >= config.min_iou
        looks[most[sure], free[sure]] = True

    names = tuple(dict.fromkeys([*known, *detections.names]))
    right = {label: matching_names(label, names) for label in dict.fromkeys(objects.names)}
    fits = np.array([[n.lower() in right[label] for n in detections.names] for label in objects.names], bool)
    fits = fits.reshape(count, len(detections))

    # Of the detections that belong to a box, the best has a matching class, a cluster, and the most overlap.
    rank = np.where(looks, 8 + 4 * fits + np.where(np.isnan(by_cluster), 0, 2 * by_cluster) + overlap, 0)
    # Without such a detection the nearest is reported, even a weak one. A matching class is preferred.
    beside = (overlap >= MIN_NEARBY_IOU) & (detections.state != DetectionState.SUPPRESSED)
    rank = np.maximum(rank, np.where(beside, 2 * fits + overlap, 0))
    camera_opinions = _initial_opinions(count, Opinion.CONTRADICTED)
    camera_opinions.shown[:] = share_in_image(objects.boxes, result.camera)
    camera_opinions.height[:] = np.nan_to_num(around[:, 3] - around[:, 1])
    knows = np.array([not known or bool(right[label]) for label in objects.names], bool)
    camera_opinions.opinion[~knows] = Opinion.NO_CLASS
    camera_opinions.opinion[camera_opinions.height < config.min_height] = Opinion.TOO_SMALL
    camera_opinions.opinion[visible_share < config.min_visible] = Opinion.HIDDEN
    camera_opinions.opinion[(camera_opinions.shown < config.min_shown) | (camera_opinions.shown == 0)] = (
        Opinion.OUT_OF_VIEW
    )
    if len(detections):
        all_boxes = np.arange(count)
        best = rank.argmax(axis=1)
        has_detection = rank[all_boxes, best] > 0
        camera_opinions.detection[has_detection] = best[has_detection]
        camera_opinions.iou[has_detection] = overlap[all_boxes, best][has_detection]
        camera_opinions.held[has_detection] = by_cluster[all_boxes, best][has_detection]
        seen = has_detection & looks[all_boxes, best]
        camera_opinions.opinion[seen] = Opinion.NAMED_OTHERWISE
        camera_opinions.opinion[seen & fits[all_boxes, best]] = Opinion.CONFIRMED
    return camera_opinions


def _by_cluster(
    result: CameraResult, detections: Detections, overlap: F32, named: I64, share: F32, least: F32
) -> tuple[F32, Bool]:
    """Return how much of each detection's cluster is in each box.

    Returns:
        (K, D) share of the cluster in a box that it belongs to, else NaN.
        (D,) whether the detection has a cluster.
    """
    box_share = np.full((len(share), len(detections)), np.nan, np.float32)
    has_cluster = np.zeros(len(detections), np.bool_)
    if result.fusion is None:
        return box_share, has_cluster
    matched = np.flatnonzero(result.fusion.cluster_decision == Decision.MATCHED)
    detection = result.fusion.cluster_detection[matched]
    has_cluster[detection] = True
    for d, column in zip(detection.tolist(), np.searchsorted(named, matched).tolist(), strict=True):
        looks = overlap[:, d] >= least[:, column]
        share_in_box = np.where(looks, share[:, column], np.nan)  # One box can name several clusters.
        box_share[:, d] = np.fmax(box_share[:, d], share_in_box)
    return box_share, has_cluster
