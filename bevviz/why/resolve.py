"""Resolve a selection to the subjects it refers to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from bevviz.config import BevConfig
from bevviz.errors import UserError
from bevviz.model import box_overlap, geometry
from bevviz.model.class_names import accepted_names
from bevviz.model.frame import F32, I64, Boxes3D
from bevviz.model.results import CameraResult, DetectionState, Opinion
from bevviz.support.text import did_you_mean
from bevviz.why.false_objects import false_reasons
from bevviz.why.frame_index import CORE, FEW, Fate, FrameIndex, detection_subject
from bevviz.why.selection import Selection
from bevviz.why.subject import LINK, NOISE, Subject
from bevviz.why.subject_matches import OVERLAP

PIXELS = 6.0  # pixels, half edge of the box around a selected pixel
SPACING = 1.0  # pixels; subjects whose points are this much farther from the pixel may still show there
SURFACE = 1.0  # metres behind the nearest return at a pixel; subjects within it show there, too
AS_GOOD = 0.8  # share of the best fit to a box from which a subject is as good an answer


def select_subjects(traces: FrameIndex, selection: Selection) -> list[Subject]:
    """Return the subjects of a selection. A pixel, box, point or cell is a subject itself.

    Raises:
        UserError: unknown class, camera or row, pixel outside the image, or several cameras and none named.
    """
    result = traces.result
    if selection.truth is not None:
        _check_row(selection.truth, len(traces.truth), "object in the ground truth of this frame of number")
        return [traces.truth[selection.truth]]
    if selection.object is not None:
        return [object_subject(traces, selection.object)]
    if selection.cluster is not None:
        return [cluster_subject(traces, selection.cluster)]
    if selection.track is not None:
        return [track_subject(traces, selection.track)]
    if selection.detection is not None:
        camera = camera_of(traces, selection.camera)
        number, where = len(camera.detections or ()), f" in {camera.camera.name}"
        _check_row(selection.detection, number, "detection", where)
        return [detection_subject(result, camera, selection.detection)]
    if selection.point or selection.cell:
        return [_surroundings(traces, selection)]
    if selection.box:
        return [_pixel(traces, selection)]
    if selection.camera:
        camera_of(traces, selection.camera)
    subjects = [subject for subject in traces.truth if traces.in_view(subject, selection.camera)]
    subjects += _strange_detections(traces, selection.camera)
    subjects += _wrong_objects(traces, selection.camera)
    if not selection.label:
        return subjects
    truth = result.frame.truth
    object_names = result.objects.names if result.opinions is not None and result.objects is not None else ()
    known = dict.fromkeys([*traces.classes, *(truth.labels if truth is not None else ()), *object_names])
    wanted = selection.label.lower()
    if not any(wanted == name.lower() or wanted in accepted_names(name, ()) for name in known):
        names = ", ".join(sorted(known)) or "none"
        hint = did_you_mean(selection.label, known, 0.5) or f"; there are {names}"
        raise UserError(f"--class {selection.label}: no such class{hint}")
    return [subject for subject in subjects if subject.label.lower() == wanted or _is_called(subject, wanted)]


def _is_called(subject: Subject, name: str) -> bool:
    """Return whether a class name of the detector also means the subject."""
    if subject.kind == "object":
        return name in accepted_names(subject.label, ())
    return subject.kind == "truth" and subject.accepts(name)


def _check_row(row: int, number: int, what: str, where: str = "") -> None:
    """Check that there is a row, else raise a UserError."""
    if not 0 <= row < number:
        raise UserError(f"there is no {what} {row}{where}: it has {number}")


def object_subject(traces: FrameIndex, row: int) -> Subject:
    """Return an object of the frame's result as a subject.

    Raises:
        UserError: the frame has no such object.
    """
    objects = traces.result.objects
    _check_row(row, len(objects or ()), "object", " in this frame")
    assert objects is not None
    box, name = objects.boxes.chosen([row]), objects.names[row]
    away = float(box.distance[0])
    cluster = int(objects.cluster[row])
    points = np.flatnonzero(traces.cluster == cluster) if cluster >= 0 else None
    title = f"the {name} {objects.score[row]:.2f} at {away:.1f} m"
    return Subject("object", title, name, frozenset({name.lower()}), row, box=box, points=points)


def cluster_subject(traces: FrameIndex, row: int) -> Subject:
    """Return a cluster of the frame as a subject.

    Raises:
        UserError: the frame has no such cluster.
    """
    clusters = traces.result.clusters
    _check_row(row, len(clusters or ()), "cluster", " in this frame")
    assert clusters is not None
    points = np.flatnonzero(traces.cluster == row)
    box = clusters.boxes(traces.result.config.clustering).chosen([row])
    name = f"cluster {row} at {box.distance[0]:.1f} m"
    return Subject("cluster", name, row=row, box=box, points=points)


def track_subject(traces: FrameIndex, number: int) -> Subject:
    """Return a live track as a subject: its cluster in this frame, or its expected position.

    Raises:
        UserError: no track has that id, or the frame was run by itself.
    """
    tracks, frame = traces.result.tracks, traces.result.frame
    if tracks is None:
        raise UserError(f"there is no track {number}: tracks are known in a run over the drive only")
    rows = np.flatnonzero(tracks.id == number)
    if not len(rows):
        known = ", ".join(map(str, tracks.id[:10].tolist())) or "none"
        raise UserError(f"there is no track {number} in this frame; there are {known}")
    row = int(rows[0])
    box, name, cluster = tracks.boxes.chosen([row]), tracks.names[row], int(tracks.cluster[row])
    if tracks.absolute:
        box = geometry.transform_boxes(box, geometry.inverse(frame.pose))
    title = f"track {number}{f' ({name})' if name else ''} at {float(box.distance[0]):.1f} m"
    points = np.flatnonzero(traces.cluster == cluster) if cluster >= 0 else None
    accepted = frozenset({name.lower()} if name else ())
    return Subject("track", title, name, accepted, number, box=box, points=points)


def _surroundings(traces: FrameIndex, selection: Selection) -> Subject:
    """Return the surroundings of a point or of a cell of the bird's-eye view as a subject."""
    edge = 2 * selection.radius
    if selection.point:
        center, size = selection.point, (edge, edge, edge)
        kind, name = "point", "what is at {:g}, {:g}, {:g} m".format(*center)
    else:
        points = traces.result.frame.points
        x, y = _cell_center(traces.result.config.bev, *selection.cell[:2])
        low, high = (float(points[:, 2].min()), float(points[:, 2].max())) if len(points) else (0.0, 0.0)
        center, size = (x, y, (low + high) / 2), (edge, edge, high - low)
        kind, name = "cell", f"what is at {x:.2f}, {y:.2f} m of the bird's-eye view"
    box = Boxes3D(np.array([center], np.float32), np.array([size], np.float32), np.zeros(1, np.float32))
    return Subject("point" if kind == "point" else "cell", name, box=box)


def _cell_center(config: BevConfig, row: int, column: int) -> tuple[float, float]:
    """Return the x, y of the middle of a cell, in metres of the points' frame."""
    rows, columns = (round(2 * reach / config.resolution) for reach in (config.range_x, config.range_y))
    if not (0 <= row < rows and 0 <= column < columns):
        raise UserError(
            f"cell {row}, {column}: outside the bird's-eye view, which has {rows} rows and {columns} columns"
        )
    x, y = (row + 0.5) * config.resolution, (column + 0.5) * config.resolution
    return config.range_x - x, config.range_y - y


def _pixel(traces: FrameIndex, selection: Selection) -> Subject:
    """Return a pixel or image box as a subject."""
    camera = camera_of(traces, selection.camera)
    image_box = _selected_box(camera, selection)
    u, v = (image_box[:2] + image_box[2:]) / 2
    asked = image_box if len(selection.box) == len(image_box) else None
    name = f"what is at pixel {u:g}, {v:g}"
    return Subject("pixel", name, camera=camera.camera.name, xyxy=image_box, asked=asked)


def _selected_box(camera: CameraResult, selection: Selection) -> F32:
    """Return the (4,) image box in question: the selected box, or the surroundings of the pixel."""
    intrinsics, image = camera.camera.intrinsics, camera.camera.image
    if intrinsics is not None:
        width, height = intrinsics.width, intrinsics.height
    elif image is not None:
        height, width = image.bgr.shape[:2]
    else:
        raise UserError(f"--box: {camera.camera.name} has no image in this frame")
    low, high = np.array(selection.box[:2]), np.array(selection.box[-2:])
    if (low < -0.5).any() or (high > [width - 0.5, height - 0.5]).any() or (high < low).any():
        raise UserError(
            f"--box {','.join(f'{v:g}' for v in selection.box)}: outside the image of {camera.camera.name}, "
            f"which has {width} x {height} pixels"
        )
    around = PIXELS if len(selection.box) == 2 else 0.0
    return np.concatenate([low - around, high + around]).astype(np.float32)


def camera_of(traces: FrameIndex, name: str) -> CameraResult:
    """Return the camera of that name. An empty name means the only camera.

    Raises:
        UserError: there is no such camera, or there are several and none is named.
    """
    cameras = traces.result.cameras
    names = [c.camera.name for c in cameras]
    if not names:
        raise UserError("this recording has no camera: ask with --point x,y,z")
    if not name and len(names) > 1:
        raise UserError(f"several cameras: say which with --camera, one of {', '.join(names)}")
    if name and name not in names:
        raise UserError(f"--camera {name}: there is none of that name; there are {', '.join(names)}")
    return cameras[names.index(name) if name else 0]


def _strange_detections(traces: FrameIndex, camera: str) -> Iterator[Subject]:
    """Yield the detections of no object of the ground truth, without duplicates that NMS suppressed."""
    objects = traces.result.objects
    for camera_result in traces.result.cameras:
        detections = camera_result.detections
        if detections is None or camera not in ("", camera_result.camera.name):
            continue
        strange = (detections.state != DetectionState.SUPPRESSED) & (traces.owners(camera_result) < 0)
        if objects is not None:  # Those that named false objects are subjects with these.
            own = [row for row in false_reasons(traces) if objects.camera[row] == camera_result.camera.name]
            strange[objects.detection[own]] = False
        for row in np.flatnonzero(strange).tolist():
            yield detection_subject(traces.result, camera_result, row)


def _wrong_objects(traces: FrameIndex, camera: str) -> Iterator[Subject]:
    """Yield the objects that a camera contradicts and no label explains, then the false and doubtful ones."""
    objects, opinions, false = traces.result.objects, traces.result.opinions, false_reasons(traces)
    if objects is None:
        return
    if opinions is not None:
        real = Boxes3D.joined([subject.box for subject in traces.truth if subject.box is not None])
        in_truth = box_overlap.bev_iou(objects.boxes, real).max(axis=1, initial=0) >= OVERLAP
        for row in np.flatnonzero((opinions.opinion == Opinion.CONTRADICTED) & ~in_truth).tolist():
            if row not in false and camera in ("", opinions.camera[row]):
                yield object_subject(traces, row)
    yield from (object_subject(traces, row) for row in false if camera in ("", objects.camera[row]))


# --- subjects at a place -----------------------------------------------------------------------


def subjects_at_place(traces: FrameIndex, selection: Selection) -> list[tuple[Subject, bool]]:
    """Return the subjects at a pixel, in an image box or around a point, and whether each is visible there.

    An object of the ground truth includes its detections and clusters. A detection includes the cluster that
    it named.

    Raises:
        UserError: as ``select_subjects``.
    """
    around = bool(selection.point or selection.cell)
    return list(_in_space(traces, selection) if around else _in_image(traces, selection))


def _in_space(traces: FrameIndex, selection: Selection) -> Iterator[tuple[Subject, bool]]:
    """Yield the subjects around a point or in a cell."""
    place = _surroundings(traces, selection)
    points = traces.place(place)
    assert place.box is not None
    axes = slice(2 if place.kind == "cell" else 3)
    covered: set[int] = set()
    for subject in traces.truth:
        assert subject.box is not None
        away = float(np.linalg.norm((subject.box.center - place.box.center)[0, axes]))
        if away > np.linalg.norm(subject.box.size[0]) / 2 + selection.radius:
            continue
        own_points = traces.place(subject)
        if away <= selection.radius or len(np.intersect1d(own_points, points, assume_unique=True)):
            covered.update(_clusters_of(traces, own_points))
            yield subject, True
    for cluster in np.unique(traces.cluster[points]).tolist():
        if cluster >= 0 and cluster not in covered:
            yield cluster_subject(traces, cluster), True


def _in_image(traces: FrameIndex, selection: Selection) -> Iterator[tuple[Subject, bool]]:
    """Yield the subjects at a pixel or in an image box."""
    camera = camera_of(traces, selection.camera)
    image_box = _selected_box(camera, selection)
    pixel = len(selection.box) == 2
    things: list[tuple[Subject, float]] = []  # with their fit
    covered: set[int] = set()
    for subject, fit in _truth_at_box(traces, camera, image_box, pixel):
        covered.update(_clusters_of(traces, traces.place(subject)))
        things.append((subject, fit))
    rows = {subject.row for subject, _ in things}
    for row, fit in _detections_at_box(camera, image_box, pixel):
        if camera.detections is not None and traces.owners(camera)[row] not in rows:
            subject = detection_subject(traces.result, camera, row)
            is_weak = not camera.detections.kept[row]
            if pixel and is_weak and not _shows_at(traces, camera, subject, image_box):
                continue
            if camera.fusion is not None:
                covered.add(camera.fusion.matched_cluster(row))
            things.append((subject, fit))
    for cluster, fit in _clusters_at_box(traces, camera, image_box, pixel):
        if cluster not in covered:
            things.append((cluster_subject(traces, cluster), fit))
    if pixel:
        yield from _nearest_first(traces, camera, [subject for subject, _ in things], image_box)
        return
    best = max((fit for _, fit in things), default=0.0)
    if traces.result.frame.truth is None:  # With labels nothing depends on the selected box.
        things = [(replace(subject, asked=image_box), fit) for subject, fit in things]
    yield from ((subject, fit >= AS_GOOD * best) for subject, fit in things)


def _shows_at(traces: FrameIndex, camera: CameraResult, subject: Subject, image_box: F32) -> bool:
    """Return whether a weak detection shows at a pixel, and not the road or the sky in its box.

    An obstacle of it has to be there or, without any point there, the middle of its box.
    """
    assert subject.xyxy is not None and camera.detections is not None
    if camera.detections.score[subject.row] < NOISE:
        return False
    middle, size = (subject.xyxy[:2] + subject.xyxy[2:]) / 2, subject.xyxy[2:] - subject.xyxy[:2]
    points = traces.place(Subject("pixel", "", camera=camera.camera.name, xyxy=image_box))
    if not len(points):
        pixel = (image_box[:2] + image_box[2:]) / 2
        return bool((np.abs(pixel - middle) < CORE * size / 2).all())
    obstacles = points[traces.fate[points] != Fate.GROUND]
    return bool(np.isin(obstacles, traces.place(subject)).any())


def _nearest_first(
    traces: FrameIndex, camera: CameraResult, things: Sequence[Subject], image_box: F32
) -> Iterator[tuple[Subject, bool]]:
    """Yield the subjects at a pixel, and whether each is the nearest with points there.

    A scan is sparse in an image, so several subjects may have points around a pixel.
    """
    if not things:
        return
    near = [_nearest(traces, camera, _own_points(traces, camera, subject), image_box) for subject in things]
    pixels, depth = np.array(near).T
    if pixels.min() > PIXELS:
        yield from ((subject, True) for subject in things)
        return
    close = pixels <= pixels.min() + SPACING
    shown = close & (depth <= depth[close].min() + SURFACE)
    yield from zip(things, shown.tolist(), strict=True)


def _nearest(traces: FrameIndex, camera: CameraResult, rows: I64, image_box: F32) -> tuple[float, float]:
    """Return the pixels from the middle of the selected box to the nearest of these points, and its depth."""
    view = camera.camera
    away = np.linalg.norm(traces.uv(camera)[rows] - (image_box[:2] + image_box[2:]) / 2, axis=1)
    away = np.where(np.isfinite(away), away, np.inf)
    if view.camera_from_points is None or not np.isfinite(away).any():
        return np.inf, np.inf
    row = int(away.argmin())
    point = traces.result.frame.points[rows[row]]
    return float(away[row]), float(geometry.apply(view.camera_from_points, point[None])[0, 2])


def _own_points(traces: FrameIndex, camera: CameraResult, subject: Subject) -> I64:
    """Return the rows of the subject's raw points. A detection has those of the cluster that it named."""
    cluster = -1
    if subject.kind == "detection" and camera.fusion is not None:
        cluster = camera.fusion.matched_cluster(subject.row)
    return traces.place(subject) if cluster < 0 else np.flatnonzero(traces.cluster == cluster)


def _clusters_of(traces: FrameIndex, points: I64) -> list[int]:
    """Return the clusters of an object's points that lie mostly on objects of the ground truth."""
    return [
        cluster
        for cluster in np.unique(traces.cluster[points]).tolist()
        if cluster >= 0 and traces.of_truth[cluster]
    ]


def _truth_at_box(
    traces: FrameIndex, camera: CameraResult, image_box: F32, pixel: bool
) -> Iterator[tuple[Subject, float]]:
    """Yield the objects of the ground truth at the selected box, with their fit."""
    boxes, _ = traces.image_boxes(camera)
    for subject in traces.truth:
        if not np.isfinite(boxes[subject.row]).all():
            continue
        fit = _fit(image_box, boxes[subject.row], pixel)
        if not pixel:
            uv = traces.uv(camera)[traces.place(subject)]
            uv = uv[np.isfinite(uv).all(axis=1)]
            if len(uv) >= FEW:
                fit = max(fit, _fit(image_box, np.concatenate([uv.min(0), uv.max(0)]), pixel))
        if fit:
            yield subject, fit


def _detections_at_box(camera: CameraResult, image_box: F32, pixel: bool) -> Iterator[tuple[int, float]]:
    """Yield the rows of the detections at the selected box, with their fit."""
    detections = camera.detections
    if detections is None:
        return
    for row in np.flatnonzero(detections.state != DetectionState.SUPPRESSED).tolist():
        fit = _fit(image_box, detections.xyxy[row], pixel)
        if fit:
            yield row, fit


def _clusters_at_box(
    traces: FrameIndex, camera: CameraResult, image_box: F32, pixel: bool
) -> Iterator[tuple[int, float]]:
    """Yield the clusters at the selected box, with their fit."""
    clusters = traces.result.clusters
    if clusters is None:
        return
    if pixel:
        pixel_subject = Subject("pixel", "", camera=camera.camera.name, xyxy=image_box)
        yield from (
            (cluster, 1.0)
            for cluster in np.unique(traces.cluster[traces.place(pixel_subject)]).tolist()
            if cluster >= 0
        )
        return
    if camera.fusion is None:
        return
    for cluster in np.flatnonzero(clusters.kept).tolist():
        around = camera.fusion.cluster_uv[cluster]
        fit = _fit(image_box, around, pixel) if np.isfinite(around).all() else 0.0
        if fit:
            yield cluster, fit


def _fit(image_box: F32, box: F32, pixel: bool) -> float:
    """Return the IoU of two boxes, 0 if it is too low. For a pixel, return 1 inside the box."""
    if pixel:
        u, v = (image_box[:2] + image_box[2:]) / 2
        return float(box[0] <= u <= box[2] and box[1] <= v <= box[3])
    overlap = float(geometry.iou(image_box[None], box[None])[0, 0])
    return overlap if overlap >= LINK else 0.0
