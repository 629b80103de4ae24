"""Two opinions: objects of somebody else's method and those of our fusion, each held against the other."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bevviz.bags.source import BagSource
from bevviz.config import OpinionsConfig, changed_config, load
from bevviz.config.trust import USER
from bevviz.datasets.kitti_labels import label_files, read_labels
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.extras.sweep.run import SweepOutcome
from bevviz.findings.frame_findings import find_findings
from bevviz.model import geometry
from bevviz.model.class_names import accepted_names
from bevviz.model.counts import OPINIONS
from bevviz.model.decisions import explain
from bevviz.model.frame import F32, Boxes3D, Camera, LabelledBoxes3D
from bevviz.model.reasons import ReasonKind, owner_of
from bevviz.model.results import Explanation, FrameResult, Objects, Opinion, Opinions
from bevviz.pipeline.session import Session
from bevviz.recording import entities
from bevviz.recording.frame_logger import FrameLogger, logged_rows
from bevviz.recording.projection import image_outlines
from bevviz.recording.sinks import open_recording
from bevviz.stages.detector.names import COCO
from bevviz.stages.opinions import matching_names, opinions
from bevviz.stages.user_stages import make_objects
from bevviz.stages.visibility import image_boxes, range_image, visible
from bevviz.support.colors import OPINION_COLORS as OPINION_COLORS
from bevviz.why import FrameExplainer, Selection
from bevviz.why.click import select_click
from bevviz.workbench.page_messages import controls
from bevviz.workbench.trials import trial_effects
from tests.support import kept_drives
from tests.support.recordings import Recording

Drive = list[tuple[FrameResult, LabelledBoxes3D]]
KNOWN = ("car", "person", "cyclist", "truck", "bicycle")


@cache
def ours() -> FrameResult:
    """Return the result of our fusion for a frame of the synthetic drive."""
    frame = SyntheticSource(frames=12).snapshot(8).frame
    return Session(load(settings=["detector.model=demo"])).run_single(frame)


def held(
    result: FrameResult,
    boxes: Boxes3D,
    names: Sequence[str],
    known: Sequence[str] = KNOWN,
    config: OpinionsConfig | None = None,
) -> tuple[Objects, Opinions]:
    """Return the objects of a method's boxes on that frame, and the opinions about them."""
    scores = np.full(len(boxes), 0.9, np.float32)
    objects = make_objects(boxes, names, scores, result.obstacles, result.clusters)
    fused = result.objects
    assert fused is not None
    image = range_image(result.frame.points)
    least = config or OpinionsConfig()
    found = opinions(objects, fused, result.obstacles, result.clusters, result.cameras, image, least, known)
    return objects, found


def words(found: Opinions) -> list[str]:
    return [Opinion(o).word for o in found.opinion.tolist()]


def box_at(center: Sequence[float], size: Sequence[float]) -> Boxes3D:
    return Boxes3D(np.array([center], np.float32), np.array([size], np.float32), np.zeros(1, np.float32))


def moved(boxes: Boxes3D, by: Sequence[float]) -> Boxes3D:
    return Boxes3D(boxes.center + np.array(by, np.float32), boxes.size, boxes.yaw)


def texts(result: FrameResult, objects: Objects, found: Opinions) -> list[Explanation]:
    said = explain(result.cameras, result.clusters, result.config, None, True, objects, found)
    return [e for e in said if e.subject in ("object", "fused")]


# --- on a drive whose objects are known --------------------------------------------------------


def test_common_objects_are_confirmed_and_none_is_missed() -> None:
    result = ours()
    fused = result.objects
    assert fused is not None and len(fused) >= 3
    objects, found = held(result, fused.boxes, fused.names)
    assert set(words(found)) == {"confirmed"}
    assert not found.missed.any()
    assert found.partner.tolist() == list(range(len(fused)))
    detections = {c.camera.name: c.detections for c in result.cameras}
    for k in range(len(fused)):
        by = detections[found.camera[k]]
        assert by is not None and by.names[found.detection[k]] == fused.names[k]
        assert found.held[k] > 0.5 and found.iou[k] > 0.3
    for said in texts(result, objects, found):
        assert (said.subject, said.state) in (("object", "confirmed"), ("fused", "found"))


def test_objects_that_only_the_fusion_has_count_as_missed() -> None:
    result = ours()
    fused = result.objects
    assert fused is not None and result.clusters is not None
    objects, found = held(result, Boxes3D.empty(), ())
    assert len(found.opinion) == 0 and found.missed.all() and found.fused is fused
    for j, said in enumerate(texts(result, objects, found)):
        assert said.subject == "fused" and said.state == "missed" and said.row == j
        k = int(fused.cluster[j])
        assert f"cluster {k}, {result.clusters.count[k]} points" in said.text
        assert f"{fused.names[j]} {fused.score[j]:.2f} of {fused.camera[j]}" in said.text


def test_a_box_of_another_class_is_named_otherwise() -> None:
    result = ours()
    fused = result.objects
    assert fused is not None
    wrong = {"car": "person", "person": "car"}
    names = [wrong.get(name, "truck") for name in fused.names]
    objects, found = held(result, fused.boxes, names)
    assert set(words(found)) == {"named otherwise"}
    assert not found.missed.any()  # something is there: the other has it under another name
    assert all("named otherwise by" in e.text for e in texts(result, objects, found) if e.subject == "object")


def test_a_box_where_nothing_is_is_contradicted() -> None:
    """In the air above the road, in full view."""
    result = ours()
    box = box_at((12, 0, 1.5), (4, 1.8, 1.5))
    camera = result.cameras[0]
    around = geometry.apply(camera.camera.camera_from_points, box.center)  # type: ignore[arg-type]
    assert around[0, 2] > 5
    objects, found = held(result, box, ["car"])
    assert words(found) == ["contradicted"]
    [said] = [e for e in texts(result, objects, found) if e.subject == "object"]
    assert said.text.startswith("car 0.90 at 12.0 m: contradicted by ")


@pytest.mark.parametrize(
    ("center", "size", "label", "opinion"),
    [
        ((-15, 0, 0), (4, 1.8, 1.5), "car", Opinion.OUT_OF_VIEW),
        ((12, 0, 1.5), (4, 1.8, 1.5), "barrier", Opinion.NO_CLASS),
        ((12, 0, 1.5), (0.1, 0.1, 0.1), "car", Opinion.TOO_SMALL),
    ],
)
def test_boxes_outside_every_image_are_not_contradicted(
    center: tuple[float, ...], size: tuple[float, ...], label: str, opinion: Opinion
) -> None:
    box = box_at(center, size)
    result = ours()
    objects, found = held(result, box, [label])
    assert found.opinion.tolist() == [opinion] and words(found) == ["unseen"]
    [said] = [e for e in texts(result, objects, found) if e.subject == "object"]
    assert said.state == "unseen" and ": unseen, " in said.text


@pytest.mark.parametrize(
    ("limit", "opinion", "said"),
    [
        ({}, Opinion.CONTRADICTED, "contradicted by "),
        ({"min_height": 80}, Opinion.TOO_SMALL, " px high in zed, opinions.min_height is 80 px"),
        ({"min_shown": 0.6}, Opinion.OUT_OF_VIEW, "in the image of zed, opinions.min_shown is 0.6"),
        ({"min_visible": 0.95}, Opinion.HIDDEN, "behind what is nearer, opinions.min_visible is 0.95"),
    ],
)
def test_when_a_camera_has_to_find_a_box_can_be_said(
    limit: dict[str, float], opinion: Opinion, said: str
) -> None:
    """A box of which a part is outside of the image and another behind a car."""
    result = ours()
    config = load(settings=[f"opinions.{key}={value}" for key, value in limit.items()])
    objects, found = held(result, box_at((12, -8, 0), (4, 1.8, 1.5)), ["car"], config=config.opinions)
    assert found.opinion.tolist() == [opinion]
    told = texts(replace(result, config=config), objects, found)
    assert [e for e in told if e.subject == "object" and said in e.text]


def test_the_overlap_of_unclustered_detections_is_configurable() -> None:
    result = ours()
    fused = result.objects
    assert fused is not None
    loose = replace(result, cameras=tuple(replace(c, fusion=None) for c in result.cameras))
    car = fused.boxes.chosen([4])
    _, found = held(loose, car, ["car"])
    assert words(found) == ["confirmed"] and 0.3 < found.iou[0] < 0.95
    config = load(settings=["opinions.min_iou=0.95"])
    objects, found = held(loose, car, ["car"], config=config.opinions)
    assert words(found) == ["contradicted"]
    [said] = [e.text for e in texts(replace(loose, config=config), objects, found) if e.subject == "object"]
    assert said.endswith(f", IoU {found.iou[0]:.2f}, opinions.min_iou is 0.95")


def test_a_box_is_not_confirmed_by_what_fits_another_one_better() -> None:
    """1.2 m beside a car with half of the car's points in it, alone and beside the right one."""
    result = ours()
    fused = result.objects
    assert fused is not None and fused.names[0] == "car"
    car = fused.boxes.chosen([0])
    beside = moved(car, (0, 1.2, 0))
    _, alone = held(result, beside, ["car"])
    assert words(alone) == ["confirmed"] and 0.2 < alone.held[0] < 0.5 and alone.iou[0] < 0.3
    _, both = held(result, Boxes3D.joined([car, beside]), ["car", "car"])
    assert words(both) == ["confirmed", "contradicted"]
    nearer = moved(car, (-2, 0, 0))  # which the camera cannot tell from the right one
    _, both = held(result, Boxes3D.joined([car, nearer]), ["car", "car"])
    assert words(both) == ["confirmed", "confirmed"]


def test_what_a_cluster_confirms_beside_the_image_has_its_words() -> None:
    """A cluster that reaches into the image from a box that is outside of it."""
    result = ours()
    fused = result.objects
    assert fused is not None
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])  # the camera looks back, and what was found stays
    cameras = tuple(
        replace(c, camera=replace(c.camera, camera_from_points=turned @ c.camera.camera_from_points))
        for c in result.cameras
    )
    away = replace(result, cameras=cameras)
    objects, found = held(away, fused.boxes, fused.names)
    assert set(words(found)) == {"confirmed"} and not found.shown.any() and all(found.camera)
    assert all(": confirmed by " in e.text for e in texts(away, objects, found) if e.subject == "object")
    lax = OpinionsConfig(min_shown=0, min_height=0, min_visible=0)
    objects, found = held(away, box_at((12, 0, 1.5), (4, 1.8, 1.5)), ["car"], config=lax)
    assert found.opinion.tolist() == [Opinion.OUT_OF_VIEW]
    assert len(texts(away, objects, found)) == 1 + len(fused)


def test_objects_behind_others_are_hidden() -> None:
    """Of a car, the place behind it on the same ray."""
    result = ours()
    fused = result.objects
    assert fused is not None
    cars = [j for j, name in enumerate(fused.names) if name == "car"]
    j = min(cars, key=lambda j: float(np.hypot(*fused.boxes.center[j, :2])))
    center = fused.boxes.center[j].copy()
    center[:2] *= 1 + 5 / np.hypot(*center[:2])
    small = box_at(center.tolist(), (0.8, 0.8, 0.8))
    _, found = held(result, small, ["person"])
    assert found.opinion.tolist() == [Opinion.HIDDEN] and found.visible[0] < 0.5


def test_without_detections_no_camera_is_asked() -> None:
    result = ours()
    fused = result.objects
    assert fused is not None
    blind = replace(result, cameras=tuple(replace(c, detections=None, fusion=None) for c in result.cameras))
    _, found = held(blind, fused.boxes, fused.names)
    assert set(found.opinion.tolist()) == {Opinion.NOT_ASKED} and set(found.camera) == {""}


@settings(max_examples=30, deadline=None)
@given(st.randoms(use_true_random=False), st.floats(-6, 6), st.floats(-6, 6))
def test_the_order_of_the_boxes_does_not_matter(random: Random, x: float, y: float) -> None:
    """Each box has one opinion whoever stands before it, and each of ours a partner that holds it."""
    result = ours()
    fused = result.objects
    assert fused is not None
    boxes = Boxes3D.joined([fused.boxes, moved(fused.boxes, (x, y, 0))])
    names = [*fused.names, *fused.names]
    order = list(range(len(boxes)))
    random.shuffle(order)
    _, plain = held(result, boxes, names)
    _, mixed = held(result, boxes.chosen(order), [names[k] for k in order])
    for field in ("opinion", "detection", "iou", "held", "shown", "visible", "height"):
        np.testing.assert_array_equal(getattr(plain, field)[order], getattr(mixed, field), field)
    assert set(plain.opinion[: len(fused)].tolist()) == {Opinion.CONFIRMED}
    assert not plain.missed.any() and not mixed.missed.any()


# --- in the frame step -------------------------------------------------------------------------


def test_the_frame_step_keeps_both() -> None:
    """The robot's own boxes: ours but for the first, in its place one in the air."""
    frame, fused = ours().frame, ours().objects
    assert fused is not None
    boxes = Boxes3D.joined([fused.boxes.chosen(range(1, len(fused))), box_at((12, 0, 1.5), (4, 1.8, 1.5))])
    names = (*fused.names[1:], "car")
    scores = np.ones(len(boxes), np.float32)
    stated = LabelledBoxes3D("/objects", frame.stamp, frame.points_frame, boxes, names, scores, frame.pose)
    theirs = load(settings=["detector.model=demo", "objects.method=topic:/objects"])
    result = Session(theirs).run_single(replace(frame, robot_boxes=(stated,)))
    assert result.failures == () and result.opinions is not None and result.ranges is not None
    assert words(result.opinions) == ["confirmed"] * (len(fused) - 1) + ["contradicted"]
    assert result.opinions.fused.names == fused.names
    assert np.flatnonzero(result.opinions.missed).tolist() == [0]
    said = {(e.subject, e.state) for e in result.explanations}
    assert {("object", "confirmed"), ("object", "contradicted"), ("fused", "missed")} <= said
    assert result.timings["opinions"] > 0
    labelled = replace(stated, topic="/ground_truth")  # a data set's own topic, as bevviz has it
    of_people = load(settings=["detector.model=demo", "objects.method=topic:/ground_truth"])
    again = Session(of_people).run_single(replace(frame, truth=labelled))
    assert again.opinions is not None and words(again.opinions) == words(result.opinions)
    silent = Session(theirs).run_single(frame)  # it has published nothing at this time
    assert [failure.stage for failure in silent.failures] == ["objects"] and silent.opinions is None
    no_model = load(settings=["objects.method=topic:/objects"])
    assert Session(no_model).run_single(replace(frame, robot_boxes=(stated,))).opinions is None


def test_the_names_of_networks_meet_those_of_detectors() -> None:
    assert matching_names("Car", COCO) == {"car"} == matching_names("vehicle.car", COCO)
    assert matching_names("Pedestrian", COCO) == {"person"} == matching_names("human.pedestrian.adult", COCO)
    assert matching_names("Cyclist", COCO) == {"person", "bicycle"}
    assert matching_names("person", ("Pedestrian", "Car")) == {"pedestrian"}
    assert matching_names("barrier", COCO) == frozenset()
    assert accepted_names("vehicle.truck", ("truck",)) == {"truck"}


# --- on real scans -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def kitti(shared: Path) -> Drive:
    """Twelve frames and their labels."""
    config = load(settings=[f"detector.model={shared / 'models/yolox_nano.onnx'}"])
    session = Session(config)
    with BagSource([shared / "kitti"], config) as source:
        results = [session.run_single(frame) for frame in source]
    files = label_files(shared / "kitti/label_2")
    return list(zip(results, map(read_labels, files), strict=True))


def counted(kitti: Drive, by: float | None = 0.0) -> tuple[Counter[str], int, int]:
    """Opinions on labels that many metres aside, None: on no box; what was missed, and how many we have."""
    counts: Counter[str] = Counter()
    missed = ours = 0
    for result, labelled in kitti:
        boxes, names = labelled.boxes, labelled.labels
        rows = (
            [k for k, name in enumerate(names) if name not in ("Misc", "DontCare")] if by is not None else []
        )
        boxes, names = boxes.chosen(rows), tuple(names[k] for k in rows)
        if by:
            away = boxes.center[:, :2] / np.linalg.norm(boxes.center[:, :2], axis=1, keepdims=True)
            aside = np.column_stack([-away[:, 1], away[:, 0], np.zeros(len(boxes))]) * by
            boxes = Boxes3D((boxes.center + aside).astype(np.float32), boxes.size, boxes.yaw)
        _, found = held(result, boxes, names, COCO)
        counts.update(words(found))
        missed += int(found.missed.sum())
        ours += len(found.fused)
    return counts, missed, ours


def test_labels_are_confirmed_and_few_of_our_objects_missed(kitti: Drive) -> None:
    """What is contradicted is what the small detector does not find: the far and the hidden."""
    counts, missed, ours = counted(kitti)
    assert counts["confirmed"] >= 22 and counts["contradicted"] <= 8 and counts["named otherwise"] <= 2
    assert counts["confirmed"] >= 0.7 * sum(n for word, n in counts.items() if word != "unseen")
    assert missed <= 4 and ours >= 24


def test_labels_five_metres_aside_are_contradicted(kitti: Drive) -> None:
    counts, missed, ours = counted(kitti, 5.0)
    seen = sum(n for word, n in counts.items() if word != "unseen")
    assert seen >= 10 and counts["contradicted"] >= 0.7 * seen
    assert missed >= 0.7 * ours


def test_distance_of_a_detection_is_that_of_its_cluster(kitti: Drive) -> None:
    """Boxes six metres behind what is labelled: the two distances of a sentence are of one kind."""
    counted = 0
    for result, labelled in kitti:
        boxes = labelled.boxes
        away = boxes.center * [1, 1, 0] / np.hypot(*boxes.center[:, :2].T)[:, None]
        behind = moved(boxes, (6 * away).astype(np.float32))
        lax = OpinionsConfig(min_visible=0)
        objects, found = held(result, behind, labelled.labels, COCO, lax)
        said = {e.row: e.text for e in result.explanations if e.subject == "cluster"}
        for told in texts(result, objects, found):
            if went := re.search(r"which is cluster (\d+) at (.+ m)$", told.text):
                assert f" at {went[2]}: " in said[int(went[1])]
                counted += 1
    assert counted >= 5


def test_without_robot_boxes_all_our_objects_are_missed(kitti: Drive) -> None:
    counts, missed, ours = counted(kitti, None)
    assert not counts and missed == ours


def test_occlusion_agrees_with_the_labels_of_kitti(kitti: Drive) -> None:
    """KITTI's occlusion, which people have judged in the image: 0 seen whole, 2 largely hidden."""
    shares: list[float] = []
    occluded: list[int] = []
    for result, labelled in kitti:
        assert labelled.image is not None
        shares += visible(range_image(result.frame.points), labelled.boxes).tolist()
        occluded += labelled.image.occluded.tolist()
    whole, hidden = (np.array(shares)[np.array(occluded) == degree] for degree in (0, 2))
    assert len(whole) >= 25 and len(hidden) >= 5
    assert whole.min() > 0.6 and np.mean(whole > 0.99) >= 0.75 and hidden.max() <= 0.5


# --- in a recording ----------------------------------------------------------------------------


def foreign() -> FrameResult:
    """Our own boxes of that frame as somebody else's: one kept, one in the air, one under another name."""
    result = ours()
    fused = result.objects
    assert fused is not None
    boxes = Boxes3D.joined([fused.boxes.chosen([0]), box_at((12, 0, 1.5), (4, 1.8, 1.5))])
    objects, found = held(result, boxes, [fused.names[0], "car"])
    config = load(settings=["detector.model=demo", "objects.method=topic:/objects"])
    result = replace(result, objects=objects, opinions=found, config=config)
    return replace(result, explanations=(*result.explanations, *texts(result, objects, found)))


def recorded(path: Path, result: FrameResult) -> Recording:
    scene = kept_drives.scene()
    with open_recording(scene, result.config, save=path) as sinks:
        logger = FrameLogger(sinks.recording, result.config, scene)
        logger.log_static()
        logger.log(result)
    return Recording(path)


def test_the_recording_shows_both(tmp_path: Path) -> None:
    result = foreign()
    fused, index = result.opinions.fused, result.frame.index  # type: ignore[union-attr]
    found = recorded(tmp_path / "a.rrd", result)
    assert found.at[entities.FUSED]["opinion"][index] == ["confirmed", "contradicted"]
    assert found.at[entities.FUSION]["missed"][index] == [False] + [True] * (len(fused) - 1)
    says = found.at[entities.OUTLINES.path(entities.FUSED)]["says"][index]
    assert ": confirmed by " in says[0] and ": contradicted by " in says[1]
    written = found.at[entities.NAMES.path(entities.FUSED)]["Points3D:labels"][index]
    assert "car 0.90, contradicted" in written
    beside = found.at[entities.NAMES.path(entities.FUSION)]["Points3D:labels"][index]
    assert beside[0] == "" and any(label.endswith(", missed") for label in beside)
    counts = {what: found.at[entities.COUNT.path(what)]["Scalars:scalars"][index] for what in OPINIONS}
    assert counts["confirmed"] == counts["contradicted"] == [1.0] and counts["missed"] == [len(fused) - 1.0]
    [page] = found.text(entities.EXPLAIN)
    assert "**contradicted** car 0.90 at 12.0 m" in page.replace("\\", "")


def test_the_images_and_the_look_from_above_show_what_is_said(tmp_path: Path) -> None:
    """Each box by what is said of it; whatever is clicked asks about the same."""
    result = foreign()
    assert result.opinions is not None and result.bev is not None
    fused, index = result.opinions.fused, result.frame.index
    told = {e.text: e.row for e in result.explanations if e.subject in ("object", "fused")}
    found = recorded(tmp_path / "a.rrd", result)
    views: list[Callable[[str], str]] = [entities.OVERLAY_OPINION.path]
    views += [partial(entities.IMAGE_OPINION.path, camera.name) for camera in result.frame.cameras]
    seen, rows = Counter[str](), logged_rows(result)
    for view, (opinion, color) in product(views, OPINION_COLORS.items()):
        path = view(opinion)
        if not (says := found.at[path]["says"].get(index, [])):
            continue
        [packed] = found.static[path]["LineStrips2D:colors"]
        assert tuple(packed.to_bytes(4, "big")[:3]) == color
        for instance, said in enumerate(says):
            assert f": {opinion} by " in said
            row = told[said]
            asked = Selection(object=row)
            if opinion == "missed":
                asked = Selection(detection=int(fused.detection[row]), camera=fused.camera[row])
            assert select_click(result, None, rows, path, instance, (0.0, 0.0)) == asked
            if (name := entities.NAMES.path(path)) in rows:
                assert select_click(result, None, rows, name, instance, (0.0, 0.0)) == asked
        seen[opinion] += len({*says})
    assert seen["contradicted"] >= 2 and seen["confirmed"] >= 2
    assert seen["missed"] > result.opinions.missed.sum()
    names = found.at[entities.NAMES.path(entities.OVERLAY_OPINION.path("contradicted"))]["Points2D:labels"][
        index
    ]
    assert names == ["car contradicted"] * 2  # a single row stands twice


def test_a_view_that_is_not_there_costs_nothing(tmp_path: Path) -> None:
    result = foreign()
    blind = tuple(
        replace(c, camera=replace(c.camera, camera_from_points=None, intrinsics=None)) for c in result.cameras
    )
    found = recorded(tmp_path / "a.rrd", replace(result, bev=None, cameras=blind))
    assert found.at[entities.FUSED] and not [path for path in found.at if "/opinions/" in path]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-30, 30)] * 2, st.floats(-3, 3), st.floats(-4, 4)), max_size=5))
def test_what_is_drawn_of_a_box_spans_what_it_does_in_the_image(places: list[tuple[float, ...]]) -> None:
    camera = ours().cameras[0].camera
    where = np.array(places, np.float32).reshape(-1, 4)
    sizes = np.tile(np.array([4, 1.8, 1.5], np.float32), (len(where), 1))
    boxes = Boxes3D(where[:, :3], sizes, where[:, 3])
    strokes = image_outlines(boxes, camera)
    for around, stroke in zip(image_boxes(boxes, camera), strokes, strict=True):
        if len(stroke):  # cut at the image's edge it may span less than both of its ends do, never more
            assert (stroke >= around[:2] - 0.1).all() and (stroke <= around[2:] + 0.1).all()
        else:
            assert np.isnan(around).any() or not clear_of_the_edge(around, camera)
        if len(stroke) == 16:
            np.testing.assert_allclose([*stroke.min(axis=0), *stroke.max(axis=0)], around, atol=0.1)


def clear_of_the_edge(around: F32, camera: Camera) -> bool:
    """Whether nothing of a box can be outside of the image."""
    assert camera.intrinsics is not None
    size = np.array([camera.intrinsics.width, camera.intrinsics.height])
    return bool((around[:2] > 0).all() and (around[2:] < size - 1).all())


def test_of_our_own_objects_nothing_is_made_or_logged(tmp_path: Path) -> None:
    result = ours()
    assert result.opinions is None and result.ranges is None and "opinions" not in result.timings
    assert not [e for e in result.explanations if e.subject in ("object", "fused")]
    found = recorded(tmp_path / "a.rrd", result)
    logged = {*found.at, *found.static}
    assert not [path for path in logged if path.startswith(entities.FUSION) or "/opinions" in path]
    assert not any(found.at[entities.COUNT.path(what)] for what in OPINIONS)


# --- when asked --------------------------------------------------------------------------------


def without_truth(result: FrameResult) -> FrameResult:
    return replace(result, frame=replace(result.frame, truth=None))


def test_why_tells_what_the_method_lost_and_the_fusion_has() -> None:
    result = without_truth(foreign())
    assert result.opinions is not None
    fused = result.opinions.fused
    questioner = FrameExplainer(result, classes=KNOWN)
    for j in np.flatnonzero(result.opinions.missed).tolist():
        [answer] = questioner.ask(Selection(detection=int(fused.detection[j]), camera=fused.camera[j]))
        assert answer.verdict.kind is ReasonKind.NOT_AMONG and not answer.folded
        named = f"named by {fused.names[j]} {fused.score[j]:.2f} of {fused.camera[j]}"
        assert f"our fusion has it: cluster {fused.cluster[j]} (" in answer.verdict.text
        assert named in answer.verdict.text
        assert [step.numbers for step in answer.steps if step.numbers.get("missed")]
    lost = [a for a in questioner.ask(Selection()) if "our fusion has it" in a.verdict.text]
    assert len(lost) == result.opinions.missed.sum()
    asked = [a for a in questioner.ask(Selection()) if a.subject.kind == "detection" and a.evidence.best]
    weak = [a for a in asked if a.evidence.best is not None and not a.evidence.best.kept]
    assert weak and all(a.folded for a in weak)


def test_why_tells_what_a_camera_denies() -> None:
    result = without_truth(foreign())
    questioner = FrameExplainer(result, classes=KNOWN)
    [denied] = [a for a in questioner.ask(Selection()) if a.verdict.kind is ReasonKind.CONTRADICTED]
    assert (denied.subject.kind, denied.subject.row) == ("object", 1) and denied.verdict.reported
    assert "was reported, but it is contradicted by " in denied.verdict.text
    assert denied in questioner.explain(Selection(), hints=0)  # worth a word by itself
    [confirmed] = questioner.ask(Selection(object=0))
    assert confirmed.verdict.kind is ReasonKind.REPORTED and ", confirmed by car " in confirmed.verdict.text
    [numbers] = [step.numbers for step in confirmed.steps if step.stage == "cameras"]
    assert numbers["opinion"] == "confirmed" and numbers["seen"]
    assert numbers["iou"] > numbers["least"]["iou"] == 0.3 and numbers["cluster_share"] > 0.5


def test_a_click_on_either_box_asks_about_it() -> None:
    result = foreign()
    assert result.opinions is not None
    fused, place, rows = result.opinions.fused, (1.0, 2.0, 3.0), logged_rows(result)
    assert select_click(result, None, rows, entities.OUTLINES.path(entities.FUSED), 1, place) == Selection(
        object=1
    )
    for j in range(len(fused)):
        found = select_click(result, None, rows, entities.OUTLINES.path(entities.FUSION), j, place)
        assert found == Selection(detection=int(fused.detection[j]), camera=fused.camera[j])


def test_the_list_contains_doubtful_objects() -> None:
    """Without the truth, which speaks for itself; each asks about what it is."""
    result = without_truth(foreign())
    assert result.opinions is not None and result.objects is not None
    found = find_findings(FrameExplainer(result, classes=KNOWN))
    [denied] = [find for find in found if find.what == "contradicted"]
    assert (denied.name, denied.selection) == ("car", Selection(object=1)) and abs(denied.distance - 12) < 0.1
    lost = [find.selection for find in found if find.what == "lost" and find.selection is not None]
    fused, missed = result.opinions.fused, result.opinions.missed
    questioner = FrameExplainer(result, classes=KNOWN)
    rows = [(int(fused.detection[row]), fused.camera[row]) for row in np.flatnonzero(missed)]
    away = [questioner.about(Selection(detection=row, camera=camera)).distance for row, camera in rows]
    assert lost and len(lost) == sum(distance <= 40 for distance in away)
    for asked in lost:
        [answer] = questioner.ask(asked)
        assert "our fusion has it" in answer.verdict.text
    assert not [
        find for find in find_findings(FrameExplainer(ours())) if find.what in ("contradicted", "lost")
    ]


def test_effects_of_other_limits_are_counted() -> None:
    """In a sweep, and in the page's panel, where they are controls."""
    result = foreign()
    assert result.objects is not None and result.opinions is not None
    config = load(settings=["opinions.min_height=500"], base=result.config)
    _, found = held(ours(), result.objects.boxes, result.objects.names, config=config.opinions)
    lenient = replace(result, opinions=found, config=config)
    told = trial_effects(result, lenient, None)
    assert told["opinions"] == {
        "contradicted": {"before": 1, "after": 0},
        "unseen": {"before": 0, "after": 1},
    }
    assert told["changes"] == {"opinions.min_height": "25.0 -> 500.0"}
    assert trial_effects(ours(), result, None)["opinions"]["contradicted"] == {"before": None, "after": 1}
    outcome = SweepOutcome()
    for one in (result, lenient):
        outcome.add(one)
    assert (outcome.metrics["contradicted"], outcome.metrics["confirmed"]) == (0.5, 1.0)
    mine = SweepOutcome()
    mine.add(ours())
    assert "contradicted" not in mine.metrics
    [height] = [one for one in controls(config) if one["key"] == "opinions.min_height"]
    assert (height["unit"], height["low"], height["value"]) == ("pixels", 0, 500.0)


def test_a_user_stage_brings_its_own_controls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the values of the function, whatever is tried of it; they go with it."""
    model = "class Params(BaseModel):\n    cell: float = 1.0\n    axes: tuple = (1, 2)\n"
    text = f"from pydantic import BaseModel\n{model}\ndef detect(points, params):\n    return [], [], []\n"
    (tmp_path / "boxes_of.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    opened = load(settings=["clustering.eps=0.7"])
    tried = changed_config(
        opened, ["objects.method=boxes_of:detect", "objects.cell=3", "clustering.eps=0.4"], USER
    )
    found = {one["key"]: one["value"] for one in controls(tried, opened)}
    before = {one["key"]: one["value"] for one in controls(opened)}
    assert found == {**before, "objects.params.cell": 1.0, "objects.params.axes": [1, 2]}
    assert before["clustering.eps"] == 0.7
    json.dumps(found)


def test_a_network_file_counts_as_a_foreign_method() -> None:
    """Its objects are not made of our clusters, and sentences name its file."""
    config = load()
    theirs = config.objects.model_copy(update={"method": "/models/pillars.onnx"})
    config = config.model_copy(update={"objects": theirs})
    assert not owner_of(config, "objects").ours and owner_of(config, "objects").name == "pillars.onnx"
    result = replace(foreign(), config=config)
    assert result.objects is not None and result.opinions is not None
    said = [e.text for e in texts(result, result.objects, result.opinions) if e.state == "missed"]
    assert said and all("missed by pillars.onnx; " in text for text in said)
