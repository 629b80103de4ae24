"""What if? Planted differences are found and named; sides share what they have in common."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import bevviz
from bevviz.cli import main
from bevviz.compare.sides import ComparedFrame, published_result, robot_topic
from bevviz.compare.views import side_space
from bevviz.config import load
from bevviz.errors import UserError
from bevviz.evaluate import truth_of
from bevviz.evaluate.differences import (
    Change,
    ImageBoxes,
    compare_images,
    compare_objects,
    differences,
    seen,
)
from bevviz.evaluate.matching import judge
from bevviz.extras.demo.bag import write_bag
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.model.frame import Boxes3D, Frame, LabelledBoxes3D
from bevviz.model.geometry import transform
from bevviz.model.results import FrameResult, Objects
from bevviz.pipeline.perceive import add_explanations
from bevviz.pipeline.session import Session, Variants, check_same_frames, without_motion_compensation
from bevviz.pipeline.stage_log import Memo
from bevviz.recording import entities
from bevviz.stages import detector
from bevviz.stages.user_stages import make_objects
from tests.support import bags, documented_json, kept_drives
from tests.support.recordings import Recording, verify

pytestmark = pytest.mark.usefixtures("elsewhere")

Capture = pytest.CaptureFixture[str]
DEFAULT, REFERENCE = (load(settings=["detector.model=demo"], preset=p) for p in ("default", "reference"))


@cache
def frame() -> Frame:
    return SyntheticSource(20, 3).snapshot(12).frame


@cache
def result() -> FrameResult:
    session = Session(DEFAULT)
    return session.run(frame())


def objects(*rows: tuple[str, float, float]) -> Objects:
    """Objects of 2 x 1 m: class, x, y."""
    centre = np.array([(x, y, 0) for _, x, y in rows], np.float32).reshape(-1, 3)
    size = np.tile(np.array([2, 1, 1.5], np.float32), (len(rows), 1))
    boxes = Boxes3D(centre, size, np.zeros(len(rows), np.float32))
    names = tuple(name for name, _, _ in rows)
    return make_objects(boxes, names, np.ones(len(rows), np.float32), None, None)


def changed(a: Objects, b: Objects) -> list[tuple[Change, int, int]]:
    return [(d.change, d.row_a, d.row_b) for d in compare_objects(a, b)]


# --- what differs ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ([], [], []),
        ([("car", 5, 0)], [("car", 5.1, 0)], [(Change.SAME, 0, 0)]),
        ([("car", 5, 0)], [("car", 5.5, 0)], [(Change.MOVED, 0, 0)]),
        ([("car", 5, 0)], [("car", 7.5, 0)], [(Change.ONLY_A, 0, -1), (Change.ONLY_B, -1, 0)]),
        ([("car", 5, 0)], [("truck", 5.3, 0)], [(Change.CLASS, 0, 0)]),
        # Another class beside it is another object.
        ([("car", 5, 0)], [("person", 5, 1.2)], [(Change.ONLY_A, 0, -1), (Change.ONLY_B, -1, 0)]),
        ([("car", 5, 0)], [], [(Change.ONLY_A, 0, -1)]),
        ([], [("car", 5, 0)], [(Change.ONLY_B, -1, 0)]),
        # The nearer of two would take the one that the other one needs.
        (
            [("car", 0, 0), ("car", 1.9, 0)],
            [("car", 1, 0), ("car", 3.8, 0)],
            [(Change.MOVED, 0, 0), (Change.MOVED, 1, 1)],
        ),
        # Where the rider and the bicycle are in one place, each goes to its own.
        (
            [("person", 5, 0), ("bicycle", 5.1, 0)],
            [("bicycle", 5, 0), ("person", 5.1, 0)],
            [(Change.SAME, 0, 1), (Change.SAME, 1, 0)],
        ),
    ],
)
def test_planted_differences_are_found(a: Any, b: Any, expected: list[tuple[Change, int, int]]) -> None:
    assert changed(objects(*a), objects(*b)) == expected


@given(st.integers(0, 1000), st.integers(0, 12), st.integers(0, 12))
def test_each_object_once_and_the_sides_are_alike(seed: int, count_a: int, count_b: int) -> None:
    rng = np.random.default_rng(seed)

    def random(count: int) -> Objects:
        names = rng.choice(["car", "person"], count)
        return objects(*zip(names, rng.uniform(-5, 5, count), rng.uniform(-5, 5, count), strict=True))

    a, b = random(count_a), random(count_b)
    found = compare_objects(a, b)
    assert sorted(d.row_a for d in found if d.row_a >= 0) == list(range(count_a))
    assert sorted(d.row_b for d in found if d.row_b >= 0) == list(range(count_b))
    again = compare_objects(b, a)
    assert len(again) == len(found)
    assert {d.change for d in compare_objects(a, a)} <= {Change.SAME}


def test_the_summary_states_the_numbers() -> None:
    (moved,) = compare_objects(objects(("car", 5, 0)), objects(("car", 5.5, 0)))
    assert moved.text == "car moved by 0.50 m, IoU 0.60"
    (other,) = compare_objects(objects(("car", 5, 0)), objects(("truck", 5, 0)))
    assert other.text == "car in A is truck in B"


def test_detections_are_paired_in_the_image() -> None:
    box = np.array([[0, 0, 10, 10], [20, 20, 40, 40], [60, 0, 80, 10]], np.float32)
    a = ImageBoxes(box[:2], ("person", "car"))
    b = ImageBoxes(box + np.float32(1), ("person", "truck", "car"))
    found = compare_images(a, b)
    assert [d.change for d in found] == [Change.SAME, Change.CLASS, Change.ONLY_B]
    assert found[1].name_b == "truck"


def test_a_run_does_not_differ_from_itself() -> None:
    ours = seen(result())
    assert len(ours.objects) > 3
    found = differences(ours, ours)
    assert found.number == 0
    assert len(found.objects) == len(ours.objects)
    assert len(found.images["zed"]) == len(ours.images["zed"].names) > 0


# --- several configurations on one frame -------------------------------------------------------


def same_results(a: FrameResult, b: FrameResult) -> None:
    assert a.failures == b.failures == ()
    assert a.objects is not None
    assert b.objects is not None
    assert a.objects.names == b.objects.names
    np.testing.assert_array_equal(a.objects.boxes.center, b.objects.boxes.center)
    assert a.clusters is not None
    assert b.clusters is not None
    np.testing.assert_array_equal(a.clusters.labels, b.clusters.labels)
    np.testing.assert_array_equal(a.cameras[0].uv, b.cameras[0].uv)
    assert a.explanations == b.explanations


def test_variants_equal_separate_runs() -> None:
    low = load(settings=["detector.model=demo", "detector.conf_threshold=0.1"])
    variants = Variants()
    for config in (REFERENCE, DEFAULT, low, REFERENCE):
        seen_by = without_motion_compensation(frame()) if config is REFERENCE else frame()
        session = Session(config)
        same_results(add_explanations(variants.perceive(frame(), config)), session.run(seen_by))


def test_common_stages_run_once(monkeypatch: pytest.MonkeyPatch) -> None:
    runs: list[int] = []
    infer = detector.Detector.infer

    def counted(self: detector.Detector, bgr: Any, least: float) -> Any:
        runs.append(id(bgr))
        return infer(self, bgr, least)

    monkeypatch.setattr(detector.Detector, "infer", counted)
    variants = Variants()
    configs = [
        load(settings=["detector.model=demo", f"clustering.eps={eps}", f"detector.conf_threshold={eps}"])
        for eps in (0.4, 0.5, 0.6)
    ]
    results = [variants.perceive(frame(), config) for config in configs]
    assert len(runs) == 1
    first, *others = results
    assert all(other.voxels is first.voxels and other.ground is first.ground for other in others)
    assert len({id(r.clusters) for r in results}) == 3
    # What is spared is told with the time that it took, not the microseconds of finding it again.
    assert all(r.timings["voxel"] >= first.timings["voxel"] * 0.05 for r in others)
    variants.perceive(replace(frame(), index=99), configs[0])
    assert len(runs) == 2  # another frame


def test_the_cache_drops_the_oldest_results() -> None:
    memo = Memo(size=2)
    made: list[int] = []

    def make(value: tuple[int, ...]) -> int:
        made.append(value[0])
        return value[0]

    one, two, three = (1,), (2,), (3,)
    for value in (one, two, one, three, one, two):
        assert memo.call(make, value) == value[0]
    assert made == [1, 2, 3, 2]


def test_cameras_without_motion_are_where_they_are_mounted() -> None:
    moving, still = frame().cameras[0], without_motion_compensation(frame()).cameras[0]
    assert moving.camera_from_points is not None
    assert still.camera_from_points is not None
    away = np.linalg.norm((moving.camera_from_points - still.camera_from_points)[:3, 3])
    assert 0.05 < away < 0.15  # 12 ms at 8 m/s
    assert not still.motion_compensated


def test_source_settings_must_be_equal() -> None:
    other = load(settings=["sync.tolerance=0.05"])
    with pytest.raises(UserError, match=r"A and B differ in sync.tolerance \(0.1 -> 0.05\)"):
        check_same_frames({"A": load(), "B": other})
    check_same_frames({"A": load(), "B": load(preset="reference")})


# --- the robot ---------------------------------------------------------------------------------


def test_the_robots_boxes_are_compared_in_our_frame() -> None:
    ours = result().objects
    assert ours is not None
    stated = LabelledBoxes3D(
        "/detection/fused_3d", 0, "map", ours.boxes, ours.names, ours.score, frame().world_from_points
    )
    robot = published_result(replace(frame(), robot_boxes=(stated,)), "/detection/fused_3d", DEFAULT)
    assert robot is not None
    assert {d.change for d in compare_objects(ours, seen(robot).objects)} == {Change.SAME}
    world = np.asarray(frame().world_from_points)
    shifted = replace(
        stated, world_from_boxes=world @ transform(np.array([1.0, 0, 0]), np.array([0, 0, 0, 1.0]))
    )
    robot = published_result(replace(frame(), robot_boxes=(shifted,)), "/detection/fused_3d", DEFAULT)
    assert robot is not None
    moved = [d for d in compare_objects(ours, seen(robot).objects) if d.change is Change.MOVED]
    assert len(moved) > len(ours) / 2
    np.testing.assert_allclose(np.median([d.distance for d in moved]), 1.0, atol=1e-3)
    assert published_result(frame(), "/detection/fused_3d", DEFAULT) is None


@pytest.mark.parametrize(
    ("topics", "asked", "expected"),
    [
        (("/lidar_clusters", "/fused_3d"), "", "/fused_3d"),
        (("/lidar_clusters", "/objects"), "", "/objects"),
        (("/a", "/b"), "/b", "/b"),
    ],
)
def test_a_topic_of_the_robot_can_be_a_side(topics: tuple[str, ...], asked: str, expected: str) -> None:
    assert robot_topic(topics, asked) == expected


@pytest.mark.parametrize(
    ("topics", "asked", "message"),
    [
        ((), "", "--robot: the bag has no vision_msgs/Detection3DArray"),
        (("/a", "/b"), "", "--robot: which of its topics.*: --robot TOPIC, of /a, /b"),
        (("/a",), "/c", "--robot /c: no such Detection3DArray topic; there are: /a"),
    ],
)
def test_a_missing_robot_topic_is_one_line(topics: tuple[str, ...], asked: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        robot_topic(topics, asked)


# --- as a user runs it -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def kitti(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """Return a bag and a model."""
    bag = bags.write(tmp_path_factory.mktemp("kitti") / "kitti", bags.kitti_items(shared))
    return str(bag), str(shared / "models/yolox_nano.onnx")


def test_two_configurations_are_compared_on_kitti(kitti: tuple[str, str], capsys: Capture) -> None:
    bag, model = kitti
    # The pedestrian of 000000 has some hundred points: B asks for more.
    planted = "clustering.min_cluster_points=2000"
    files = ["--save", "c.rrd", "--json", "c.json", "--csv", "c.csv"]
    assert main(["compare", bag, "--model", model, "--set-b", planted, *files]) == 0
    said = capsys.readouterr().out
    assert "clustering.min_cluster_points  10 -> 2000" in said
    tree = json.loads(Path("c.json").read_text())
    documented_json.check(tree, "bevviz.compare/1")
    first = tree["frames"][0]["objects"]
    assert {(o["change"], o["class_a"]) for o in first} >= {("only A", "person")}
    assert tree["objects"]["person"]["only A"] >= 1
    rows = list(csv.DictReader(Path("c.csv").read_text().splitlines()))
    assert [row["change"] for row in rows if row["frame"] == "0"] == [o["change"] for o in first]
    person = next(o for o in first if o["class_a"] == "person")
    assert np.hypot(person["x"], person["y"]) < 12  # where the label is

    verify(Path("c.rrd"))
    recording = Recording(Path("c.rrd"))
    boxes = recording.at["/compare/objects/only_a"]["Boxes3D:labels"][0]
    assert "person: only A" in boxes
    # Both sides, and what the sensors brought once.
    assert "/world/fused" in recording.at
    assert 0 in recording.at["/b/explain"]["TextDocument:text"]
    assert "EncodedImage:blob" in recording.at["/world/camera/image"]
    assert "EncodedImage:blob" not in recording.at["/b/world/camera/image"]
    assert "Points3D:positions" not in recording.at["/b/world/velodyne/points"]
    assert recording.at["/compare/states/person"]["StateChange:state"][0] == ["only A"]
    assert recording.at["/compare/count/only_a"]["Scalars:scalars"][0][0] == len(
        [o for o in first if o["change"] == "only A"]
    )
    assert recording.static["/compare/about"]["TextDocument:text"]


def test_our_results_are_compared_with_the_robots(capsys: Capture) -> None:
    """A bag in which the robot publishes one box; bevviz without a detector names none."""
    messages = bags.Messages()
    items = bags.small_items(messages, scans=3)
    store = messages
    for i in range(2):
        stamp = bags.START + i * bags.PERIOD
        items.append(
            bags.Item(
                "/fused_3d", "vision_msgs/msg/Detection3DArray", stamp, detection(store, stamp, "person")
            )
        )
    bags.write(Path("drive"), items, messages)
    assert main(["compare", "drive", "--robot", "--save", "c.rrd"]) == 0
    told = capsys.readouterr()
    assert "B: the robot's /fused_3d" in told.out
    line = next(line for line in told.out.splitlines() if line.startswith("person"))
    columns = ["objects A", "objects B", "same", "only A", "only B", "other class", "moved"]
    assert dict(zip(columns, line.split()[1:], strict=True))["only B"] == "2"
    recording = Recording(Path("c.rrd"))
    assert recording.at["/b/world/fused"]["class_name"][0] == ["person"]
    assert recording.at["/compare/objects/only_b"]["Boxes3D:labels"][0] == ["person: only B"]


def detection(messages: bags.Messages, stamp: int, label: str) -> Any:
    make = messages.make
    point = make("geometry_msgs/msg/Point", x=5.0, y=1.0, z=0.0)
    turn = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    pose = make("geometry_msgs/msg/Pose", position=point, orientation=turn)
    size = make("geometry_msgs/msg/Vector3", x=0.5, y=0.5, z=1.7)
    box = make("vision_msgs/msg/BoundingBox3D", center=pose, size=size)
    hypothesis = make("vision_msgs/msg/ObjectHypothesis", class_id=label, score=0.8)
    covariance = make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
    result = make("vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=covariance)
    header = messages.header(stamp, bags.LIDAR_FRAME)
    one = make("vision_msgs/msg/Detection3D", header=header, results=[result], bbox=box, id="")
    return make("vision_msgs/msg/Detection3DArray", header=header, detections=[one])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["a.rrd"], "a.rrd: no such file"),
        (["drive", "--robot", "--set-a", "voxel.size=0.2"], "leave --a and --b out"),
        (["drive", "--robot"], "the bag has no vision_msgs/Detection3DArray"),
        (["drive", "--set-b", "sync.tolerance=0.05"], "A and B differ in sync.tolerance"),
        (["drive", "--b", "none.yaml"], "none.yaml: cannot read the configuration"),
        (["drive", "--set-a", "clustering.epsilon=1"], "unknown key 'clustering.epsilon'"),
        (
            ["drive", "--json", "none/c.json", "--save", "c.rrd"],
            "--json none/c.json: there is no folder none",
        ),
    ],
)
def test_wrong_calls_are_one_line(arguments: list[str], message: str, capsys: Capture) -> None:
    if arguments[0] == "drive":
        messages = bags.Messages()
        bags.write(Path("drive"), bags.small_items(messages, scans=2), messages)
    assert main(["compare", *arguments]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("bevviz: error: ")
    assert message in said


def test_files_and_presets_can_be_sides(capsys: Capture) -> None:
    messages = bags.Messages()
    bags.write(Path("drive"), bags.small_items(messages, scans=2), messages)
    Path("b.yaml").write_text("clustering:\n  eps: 0.9\n")
    assert main(["compare", "drive", "--b", "b.yaml", "--set", "voxel.size=0.2", "--save", "c.rrd"]) == 0
    said = capsys.readouterr().out
    assert "A: default\nB: b.yaml\nparameters that differ, A -> B:\n  clustering.eps  0.5 -> 0.9\n\n" in said
    assert main(["compare", "drive", "--save", "c.rrd"]) == 0
    assert capsys.readouterr().out.startswith("A: reference\nB: default\n")


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("truth") / "demo.mcap"
    write_bag(SyntheticSource(frames=3), path)
    return str(path)


def test_the_truth_says_which_side_is_right(demo: str, capsys: Capture) -> None:
    """B sees nothing of what A sees, and the other way round."""
    blind = "detector.conf_threshold=0.999"
    tables = {}
    for side, other in (("b", "fixed"), ("a", "broke")):
        call = ["compare", demo, "--model", "demo", f"--set-{side}", blind]
        assert main([*call, "--save", "c.rrd", "--json", "c.json"]) == 0
        tables[other] = json.loads(Path("c.json").read_text())["truth"]
        said = capsys.readouterr().out
        assert "of the truth" in said and "objects that are none" in said
        assert ("fixed 0" in said) == (side == "b") and ("broke 0" in said) == (side == "a")
        assert ("broke person" in said or "broke car" in said) == (side == "b")
    there = {name: counts["there"] for name, counts in tables["broke"]["classes"].items()}
    assert sum(there.values()) > 10
    for name, counts in tables["broke"]["classes"].items():
        assert counts["B"] == counts.get("fixed", 0) == tables["fixed"]["classes"][name].get("broke", 0)
    recording = Recording(Path("c.rrd"))
    (page,) = recording.at["/compare"]["TextDocument:text"][0]
    labels = recording.at["/compare/objects/fixed"]["Boxes3D:labels"][0]
    assert f"#### Fixed by B: {len(labels)}\n" in page and "found of" in page
    assert 0 < sum(map(bool, labels)) <= 6 and "/compare/objects/broken" not in recording.at
    assert all(label.startswith("fixed: ") for label in labels if label)


def test_without_a_detector_it_is_not_said_that_nothing_differs(demo: str, capsys: Capture) -> None:
    assert main(["compare", demo, "--save", "c.rrd"]) == 0
    said = capsys.readouterr().out
    assert "no difference" not in said.replace("parameters: no difference", "")
    assert "no detector (--model FILE.onnx), so no objects; the number of clusters differs in 3 of 3" in said


def test_both_views_follow_the_robot(demo: str) -> None:
    """The eye of each is fixed to its own LiDAR, and both LiDARs go the same way."""
    scene = kept_drives.scene()
    one, other = side_space(scene, ""), side_space(scene, entities.B)
    origins = [str(view.origin) for view in (one, other)]
    assert origins == ["/world/rslidar", "/b/world/rslidar"]
    for view, origin in zip((one, other), origins, strict=True):
        (target, *_) = view.properties["SpatialInformation"].as_component_batches()
        assert target.as_arrow_array().to_pylist() == [f"tf#{origin}"]
    eyes = [
        [batch.as_arrow_array() for batch in view.properties["EyeControls3D"].as_component_batches()]
        for view in (one, other)
    ]
    assert len(eyes[0]) >= 4 and eyes[0] == eyes[1]
    assert main(["compare", demo, "--save", "c.rrd"]) == 0
    recording = Recording(Path("c.rrd"))
    ways = [recording.column(origin, "Transform3D:translation") for origin in origins]
    assert len(ways[0]) == 3 and len({tuple(np.ravel(place)) for place in ways[0]}) == 3
    assert ways[0] == ways[1]


@pytest.mark.long
def test_what_is_false_in_evaluate_is_false_in_compare(shared: Path) -> None:
    """Most of the image box of an object of this frame is in a region that nobody labelled."""
    model = shared / "models/yolox_nano.onnx"
    with bevviz.open(shared / "kitti", model=model, frames=(3, 4)) as drive:
        (result,) = drive
    assert result.objects is not None and result.frame.truth is not None
    truth = truth_of(result.frame, result.frame.truth)
    assert judge(result.objects, truth).false.any()
    assert not judge(result.objects, truth, result.cameras).false.any()
    found = ComparedFrame(result, result, truth).found
    assert found is not None and found.effects.before is not None
    assert not found.effects.before.false.any()
