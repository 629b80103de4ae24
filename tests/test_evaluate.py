"""Whether results are right: metrics held to other implementations, the command, its gate, its pictures."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

import bevviz
from bevviz.cli import main
from bevviz.evaluate import Truth, judge, truth_in, truth_of
from bevviz.evaluate.average_precision import DIFFICULTIES, AveragePrecision, ScoredObjects
from bevviz.evaluate.evaluation import Evaluation
from bevviz.evaluate.ground_truth import must_be_found
from bevviz.evaluate.matching import ObjectScore
from bevviz.evaluate.tracking_score import ClassTracks
from bevviz.extras.demo.bag import write_bag
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.model import box_overlap
from bevviz.model.class_names import accepted_names
from bevviz.model.frame import Boxes3D, Frame, ImageLabels
from bevviz.model.results import Objects
from bevviz.stages.robot_results import in_points_frame
from tests.support import bags, documented_json
from tests.support.recordings import Recording, verify

REFERENCES = Path(__file__).parent / "references" / "metrics"


# --- average precision -------------------------------------------------------------------------


def kitti_boxes(case: dict[str, Any], rows: Any, what: str) -> Boxes3D:
    """KITTI's boxes (x right, y down, z forward, bottom centre; length, height, width) as ours."""
    x, y, z = case[f"{what}_location"][rows].T
    length, height, width = case[f"{what}_dimensions"][rows].T
    yaw = -case[f"{what}_rotation_y"][rows] - np.pi / 2
    center = np.column_stack([z, -x, -y + height / 2])
    return Boxes3D(center, np.column_stack([length, width, height]), yaw)


@pytest.fixture(scope="module")
def kitti_case() -> dict[str, Any]:
    """60 made-up frames, and what a public port of KITTI's development kit says of them."""
    with np.load(REFERENCES / "kitti_ap.npz") as file:
        return {name: file[name] for name in file.files}


@pytest.fixture(scope="module")
def average_precision(kitti_case: dict[str, Any]) -> dict[tuple[str, float, str, str], float]:
    case = kitti_case
    precision = AveragePrecision()
    for index in range(60):
        rows = np.flatnonzero((case["label_frame"] == index) & (case["label_name"] != "DontCare"))
        free = np.flatnonzero((case["label_frame"] == index) & (case["label_name"] == "DontCare"))
        mine = np.flatnonzero(case["found_frame"] == index)
        labels = kitti_boxes(case, rows, "label")
        image = ImageLabels(
            case["label_bbox"][rows],
            case["label_truncated"][rows],
            case["label_occluded"][rows].astype(np.int32),
            case["label_bbox"][free],
        )
        names = tuple(map(str, case["label_name"][rows]))
        none = frozenset[str]()
        truth = Truth(labels, names, (none,) * len(rows), np.ones(len(rows), bool), image=image)
        above, volume = box_overlap.box_iou(kitti_boxes(case, mine, "found"), labels)
        xyxy = case["found_bbox"][mine]
        found = ScoredObjects(
            tuple(str(name).lower() for name in case["found_name"][mine]),
            case["found_score"][mine],
            xyxy[:, 3] - xyxy[:, 1],
            {"bev": above, "3d": volume},
        )
        precision.add(found, truth)
    return precision.results()


@pytest.mark.parametrize(("ours", "theirs"), [("bev", "ap_bev"), ("3d", "ap_3d")])
def test_average_precision_equals_kittis_development_kit(
    kitti_case: dict[str, Any],
    average_precision: dict[tuple[str, float, str, str], float],
    ours: str,
    theirs: str,
) -> None:
    for c, name in enumerate(("car", "pedestrian", "cyclist")):
        for d, difficulty in enumerate(DIFFICULTIES):
            for o, overlap in enumerate((0.5, 0.7)):
                expected = kitti_case[theirs][c, d, o]
                assert average_precision[ours, overlap, name, difficulty] == pytest.approx(expected, abs=1e-4)
                assert 0 < expected < 1


# --- tracks ------------------------------------------------------------------------------------


def test_hota_mota_and_idf1_equal_trackeval() -> None:
    with np.load(REFERENCES / "trackeval.npz") as file:
        case = {name: file[name] for name in file.files}
    identities = ClassTracks()
    for index in range(80):
        rows, mine = (case[what][case[what][:, 0] == index] for what in ("truth", "tracks"))
        distance = np.linalg.norm(rows[:, None, 2:] - mine[None, :, 2:], axis=2)
        identities.add([str(int(n)) for n in rows[:, 1]], mine[:, 1].astype(int).tolist(), distance)
    hota, clear = identities.hota(), identities.clear()
    for name in ("hota", "deta", "assa"):
        assert hota[name] == pytest.approx(float(case[name]), abs=1e-6)
    assert clear["mota"] == pytest.approx(float(case["mota"]), abs=1e-6)
    assert clear["idf1"] == pytest.approx(float(case["idf1"]), abs=1e-6)
    assert clear["id_switches"] == case["switches"]
    # Theirs is a similarity, ours a distance.
    assert 1 - clear["motp_m"] / 2 == pytest.approx(float(case["motp"]), abs=1e-3)


# --- the command -------------------------------------------------------------------------------

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drives") / "drive.mcap"
    write_bag(SyntheticSource(4, 5), path)
    return path


@pytest.fixture(scope="module")
def evaluated(drive: Path) -> Evaluation:
    """Of the bag, from Python."""
    with bevviz.open(drive, model="demo") as opened:
        return opened.evaluate()


def test_counts_classes_and_ranges_are_those_of_the_frames(drive: Path, evaluated: Evaluation) -> None:
    """Counted anew, object by object, from the simulator's truth."""
    there: Counter[str] = Counter()
    found: Counter[str] = Counter()
    with bevviz.open(drive, model="demo") as opened:
        for result in opened:
            assert result.objects is not None
            assert result.frame.truth is not None
            truth = truth_of(result.frame, result.frame.truth)
            matches = judge(result.objects, truth)
            partners = set(matches.partner.tolist())
            for k in np.flatnonzero(truth.must).tolist():
                label = truth.labels[k]
                there[label] += 1
                found[label] += k in partners
    assert there.total() > 10
    for label, number in there.items():
        assert evaluated.metrics[f"recall.{label}"] == pytest.approx(found[label] / number)
    ranged = sum(evaluated.score.counts("", low, low + 10)["true"] for low in (0, 10, 20, 30))
    assert ranged == found.total()
    assert evaluated.metrics["missed"] == there.total() - found.total()
    assert 0.9 < evaluated.metrics["ground_iou"] < 1
    assert evaluated.metrics["object_points_kept"] > 0.9
    assert 0 < evaluated.metrics["hota"] < 1
    assert evaluated.metrics["detection_recall.car"] > 0.5
    assert 0 < evaluated.metrics["ap_3d_0.5.car"] <= evaluated.metrics["ap_bev_0.5.car"] < 1


def test_a_perfect_result_is_perfect(drive: Path) -> None:
    """The truth itself as objects: everything that must be found is, exactly where it is."""
    with bevviz.open(drive, model="demo") as opened:
        evaluation = Evaluation(truth_in(opened.frames))
        for result in opened:
            truth = result.frame.truth
            assert truth is not None
            boxes = in_points_frame(result.frame.pose, truth)
            none = np.full(len(boxes), -1, np.int32)
            objects = Objects(boxes, truth.labels, truth.scores, none, ("",) * len(boxes), none)
            evaluation.observe(replace(result, objects=objects))
    assert evaluation.metrics["recall"] == evaluation.metrics["precision"] == 1
    assert evaluation.metrics["error_90_m"] == pytest.approx(0, abs=1e-4)
    assert evaluation.worst == []
    assert "nothing missed, nothing false" in evaluation.table()
    few = evaluation.labels["car"] - 1  # one point of recall for each label after the first
    assert evaluation.metrics["ap_3d_0.7.car"] == pytest.approx(min(few, 40) / 40)


@pytest.mark.long
def test_the_gate_passes_and_fails_by_its_limits(drive: Path, tmp_path: Path, capsys: Capture) -> None:
    files = ["--json", str(tmp_path / "e.json"), "--junit", str(tmp_path / "e.xml")]
    saved = tmp_path / "e.rrd"
    command = ["evaluate", str(drive), "--model", "demo", *files]
    assert main([*command, "--min", "recall=0.1", "--max", "false=100", "--save", str(saved)]) == 0
    assert "all 2 limits are kept" in capsys.readouterr().err
    suite = ElementTree.parse(tmp_path / "e.xml").getroot()[0]
    assert (suite.get("name"), suite.get("tests"), suite.get("failures")) == ("drive", "2", "0")
    tree = json.loads((tmp_path / "e.json").read_text())
    documented_json.check(tree, "bevviz.evaluate/1")
    assert tree["frames"] == 4
    counts = [len(frame["missed"]) + len(frame["false"]) for frame in tree["worst"]]
    assert counts == sorted(counts, reverse=True)

    verify(saved)
    recording = Recording(saved)
    assert recording.blueprints == 1
    wrong = {frame["frame"]: frame for frame in tree["worst"]}
    missed = recording.at["/evaluate/objects/missed"]["Boxes3D:centers"]
    assert {f for f, centers in missed.items() if centers} == {f for f, w in wrong.items() if w["missed"]}
    for index, frame in wrong.items():
        assert recording.at["/evaluate/count/missed"]["Scalars:scalars"][index] == [len(frame["missed"])]
    assert "| all |" in recording.static["/evaluate/about"]["TextDocument:text"][0]

    assert main([*command, "--min", "recall=0.999", "--min", "recall.tram=0.5"]) == 1
    said = capsys.readouterr().err
    assert "not kept: recall is 0." in said
    assert "recall.tram could not be measured: measured were recall, recall.car" in said
    suite = ElementTree.parse(tmp_path / "e.xml").getroot()[0]
    assert suite.get("failures") == "2"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--min", "recal=0.8"],
            "--min recal=0.8: no metric 'recal'; did you mean 'recall'? There are recall, ",
        ),
        (["--max", "false"], "--max false: expected METRIC=NUMBER"),
        (["--max", "false=few"], "--max false=few: expected METRIC=NUMBER"),
        (["--truth", "/none"], "--truth /none: no such Detection3DArray topic"),
        (["--min", "recall=0", "--junit", "none/j.xml"], "--junit none/j.xml: cannot be written"),
    ],
)
def test_wrong_calls_are_one_line(drive: Path, arguments: list[str], message: str, capsys: Capture) -> None:
    assert main(["evaluate", str(drive), "--model", "demo", "--frames", ":1", *arguments]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("bevviz: error: ")
    assert message in said


def test_a_bag_without_truth_is_one_line(tmp_path: Path, capsys: Capture) -> None:
    bag = bags.write(tmp_path / "small", bags.small_items())
    assert main(["evaluate", str(bag), "--model", "demo"]) == 2
    assert "no .../ground_truth in it; give --truth TOPIC" in capsys.readouterr().err


def test_without_a_detector_nothing_is_evaluated(drive: Path, capsys: Capture) -> None:
    """A table of zeros would look like a result."""
    assert main(["evaluate", str(drive), "--frames", ":1"]) == 2
    said = capsys.readouterr()
    assert "without a detector" in said.err and "--model FILE.onnx" in said.err
    assert not said.out
    assert main(["evaluate", str(drive), "--frames", ":1", "--min", "ground_iou=0.9"]) == 0
    assert "kept: ground_iou >= 0.9" in capsys.readouterr().err


# --- KITTI's folders ---------------------------------------------------------------------------


@pytest.fixture
def made_up(tmp_path: Path) -> Path:
    """One frame as KITTI's object benchmark has it: a car 10 m ahead, and a region that nobody labelled."""
    for name in ("velodyne", "image_2", "calib", "label_2"):
        (tmp_path / name).mkdir()
    rng = np.random.default_rng(0)
    car = np.column_stack([rng.uniform(8, 12, 200), rng.uniform(-0.8, 0.8, 200), rng.uniform(-1.5, 0, 200)])
    np.column_stack([car, np.ones(200)]).astype(np.float32).tofile(tmp_path / "velodyne/000000.bin")
    cv2.imwrite(str(tmp_path / "image_2/000000.png"), np.zeros((100, 300, 3), np.uint8))
    (tmp_path / "calib/000000.txt").write_text(
        "P2: 100 0 150 0 0 100 50 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\n"
        "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
    )
    (tmp_path / "label_2/000000.txt").write_text(
        "Car 0.00 0 -1.57 120 40 180 80 1.5 1.6 4.0 0.0 1.5 10.0 -1.57\n"
        "DontCare -1 -1 -10 200 0 299 99 -1 -1 -1 -1000 -1000 -1000 -10\n"
    )
    return tmp_path


def test_a_folder_of_kitti_is_read_as_it_is_labelled(made_up: Path) -> None:
    with bevviz.open(made_up) as drive:
        frame = drive.raw(0)
        truth = truth_in(drive.frames)(frame)
    assert truth is not None
    assert truth.labels == ("Car",)
    np.testing.assert_allclose(truth.boxes.center, [[10, 0, -0.75]], atol=1e-6)
    assert truth.must.all()
    # In front of the car's place on the right, in the region that nobody labelled, nothing is false.
    beside = Boxes3D(
        np.array([[10, -10, 0], [10, 3, 0]], np.float32), np.ones((2, 3), np.float32), np.zeros(2, np.float32)
    )
    assert truth.unlabelled(beside).tolist() == [True, False]


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("label_2/000000.txt", "Car 0 0 a\n", "line 1 has 3 numbers, a KITTI label has 14"),
        ("label_2/000000.txt", "Car" + " x" * 14, "line 1 has something that is no number"),
        ("calib/000000.txt", "P2: 1\n", "000000.txt: no Tr_velo_to_cam"),
        ("velodyne/000000.bin", "abcdefg", "no point in it"),
    ],
)
def test_damaged_kitti_folders_are_one_line(
    made_up: Path, file: str, content: str, message: str, capsys: Capture
) -> None:
    (made_up / file).write_text(content)
    assert main(["evaluate", str(made_up), "--model", "demo"]) in (0, 2)
    assert message in capsys.readouterr().err


def test_real_frames_are_evaluated(shared: Path, capsys: Capture) -> None:
    model = str(shared / "models/yolox_nano.onnx")
    assert main(["evaluate", str(shared / "kitti"), "--model", model, "--min", "recall.car=0.8"]) == 0
    said = capsys.readouterr()
    assert "12 frames; 28 objects had to be found" in said.out
    assert "car, moderate" in said.out
    assert "\nperson" not in said.out, "what is called so counts for the labels that it may be"
    assert "(of 40 labels or fewer an average precision is (labels - 1) / 40 at best" in said.out


# --- detectors' names and labels ----------------------------------------------------------------

ACCEPTED = {name: accepted_names(name, ()) for name in ("Pedestrian", "Cyclist", "Car")}


def labelled(*rows: tuple[str, float, float]) -> Truth:
    """Labels at places on the ground, all of which must be found."""
    center = np.array([[x, y, 0.0] for _, x, y in rows]).reshape(-1, 3)
    there = Boxes3D(center, np.ones((len(rows), 3), np.float32), np.zeros(len(rows), np.float32))
    names = tuple(name for name, *_ in rows)
    accepted = tuple(ACCEPTED.get(name, frozenset({name})) for name in names)
    return Truth(there, names, accepted, np.ones(len(rows), bool))


def named(*rows: tuple[str, float, float]) -> Objects:
    """Make the objects that a detector with COCO's classes finds in a frame."""
    count = len(rows)
    numbers = np.arange(count, dtype=np.int32)
    score = np.linspace(0.9, 0.5, count, dtype=np.float32)
    names = tuple(name for name, *_ in rows)
    return Objects(
        labelled(*(("Car", x, y) for _, x, y in rows)).boxes, names, score, numbers, ("",) * count, numbers
    )


@pytest.mark.parametrize(
    ("labels", "false"),
    [
        ((), {"car", "person", "truck"}),  # a frame in which nothing was there to label
        (("Car",), {"car", "person", "truck"}),  # KITTI labels persons, too, in other frames
        (("crate",), set()),  # nobody knows whether cars were labelled
        (("crate", "car"), {"car"}),
        (("pedestrian",), {"car", "person", "truck"}),  # nuScenes
    ],
)
def test_an_object_is_false_where_such_objects_are_labelled(labels: tuple[str, ...], false: set[str]) -> None:
    objects = named(("car", 5, 5), ("person", 7, 7), ("truck", 9, 9), ("bench", 11, 11))
    matches = judge(objects, labelled(*((label, 30.0, 0.0) for label in labels)))
    assert {objects.names[row] for row in np.flatnonzero(matches.false)} == false


def test_false_boxes_count_for_each_class_they_may_be() -> None:
    """Also in frames before the first label of that class."""
    score = ObjectScore()
    score.add(named(("person", 5, 5), ("bench", 7, 7)), labelled(("Cyclist", 30, 0)))
    score.add(
        named(("person", 10, 0), ("person", 20, 0), ("person", 15, 9), ("bicycle", 25, 9)),
        labelled(("Pedestrian", 10, 0), ("Cyclist", 20, 0), ("Car", 40, 0)),
    )
    assert {name: dict(found) for name, found in score.classes.items()} == {
        "pedestrian": {"true": 1, "false": 2},
        "cyclist": {"true": 1, "false": 1, "missed": 1},
        "car": {"missed": 1},
    }
    assert dict(score.total) == {"true": 2, "false": 3, "missed": 2}


def test_false_boxes_in_any_frame_lower_the_precision() -> None:
    """A detector's persons, where people have labelled pedestrians and cyclists."""

    def averages(*more: Objects) -> dict[str, float]:
        precision = AveragePrecision()
        places = [(float(x), 0.0) for x in range(0, 150, 3)]
        frames = [(objects, labelled()) for objects in more]
        frames += [
            (
                named(("person", x, y), ("person", x, y + 9)),
                labelled(("Pedestrian", x, y), ("Cyclist", x, y + 9)),
            )
            for x, y in places
        ]
        for objects, truth in frames:
            above, volume = box_overlap.box_iou(objects.boxes, truth.boxes)
            height = np.full(len(objects), np.inf, np.float32)
            overlaps = {"bev": above, "3d": volume}
            precision.add(ScoredObjects(objects.names, objects.score, height, overlaps), truth)
        return {key[2]: value for key, value in precision.results().items() if key[:2] == ("bev", 0.5)}

    assert averages() == {"pedestrian": 1.0, "cyclist": 1.0}
    assert averages(*[named(("person", 0, 0))] * 50) == {"pedestrian": 0.5, "cyclist": 1.0}
    assert averages(named(("bench", 0, 0))) == {"pedestrian": 1.0, "cyclist": 1.0}


# --- many bags ---------------------------------------------------------------------------------


@pytest.mark.long
def test_a_batch_is_evaluated_against_the_truth(
    drive: Path, evaluated: Evaluation, tmp_path: Path, capsys: Capture
) -> None:
    runs, junit = tmp_path / "runs", tmp_path / "ci.xml"
    command = ["batch", str(drive), "-o", str(runs), "--model", "demo", "--junit", str(junit)]
    assert main([*command, "--min", "recall=0.1"]) == 0, "truth in the bag is used"
    rows = pq.read_table(runs / "summary.parquet").to_pylist()
    assert sum(row["missed"] for row in rows) == evaluated.metrics["missed"]
    missed = [text for row in rows for text in row["remarks"] if text.startswith("missed ")]
    assert len(missed) == evaluated.metrics["missed"]
    assert f"{evaluated.metrics['recall']:.3f}</td>" in (runs / "summary.html").read_text()
    assert ElementTree.parse(junit).getroot()[0].get("failures") == "0"
    # The same results, another limit: nothing is run again.
    assert main([*command, "--min", "recall=0.999"]) == 1
    said = capsys.readouterr().err
    assert "1 of 1 bags are complete and up to date" in said
    assert "drive: not kept: recall is 0." in said
    assert ElementTree.parse(junit).getroot()[0].get("failures") == "1"


def test_two_labels_of_one_cyclist_are_one() -> None:
    """View of Delft labels the rider in the box of the cyclist, and racks that no detector knows."""
    labels = ("Cyclist", "rider", "rider", "bicycle_rack")
    center = np.array([[10, 0, 0], [10.2, 0, 0.2], [15, 3, 0], [12, -4, 0]], np.float32)
    boxes = Boxes3D(center, np.full((4, 3), 1.5, np.float32), np.zeros(4, np.float32))
    points = np.repeat(center, 20, axis=0)
    frame = Frame(0, 1, 1, "lidar", points, "lidar")
    assert must_be_found(frame, boxes, labels).tolist() == [True, False, True, False]
    assert "cyclist" in accepted_names("rider", ()) and "rider" in accepted_names("Rider", ())
