"""Parameters over a range: what is parsed, counted, judged and plotted."""

from __future__ import annotations

import csv
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bevviz.cli import main
from bevviz.config import load
from bevviz.datasets.kitti_labels import label_files, read_labels
from bevviz.errors import UserError
from bevviz.evaluate import ObjectScore, Truth, pair_in_order, rates, truth_of
from bevviz.extras.demo.bag import write_bag
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.extras.sweep.log import HEIGHT, WIDTH, axis_scale
from bevviz.extras.sweep.run import Parameter, Sweep, combine, parse
from bevviz.model.frame import Boxes3D, Frame, LabelledBoxes3D
from bevviz.model.geometry import apply as move
from bevviz.model.geometry import corners, project
from bevviz.model.results import FrameResult, Objects
from tests.support import bags
from tests.support.kitti_labels import labels
from tests.support.recordings import Recording, verify

pytestmark = pytest.mark.usefixtures("elsewhere")

Capture = pytest.CaptureFixture[str]
SEED = 5


@cache
def source() -> SyntheticSource:
    return SyntheticSource(20, SEED)


@cache
def frame() -> Frame:
    return source().snapshot(10).frame


# --- ranges and lists --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("clustering.eps=0.3:0.9:0.1", ("0.3", "0.4", "0.5", "0.6", "0.7", "0.8", "0.9")),
        ("clustering.min_points=5:14:4", ("5", "9", "13")),
        ("voxel.size=0.1:0.1:1", ("0.1",)),
        ("voxel.size=5 cm, 10 cm", ("5 cm", "10 cm")),
        ("ground.method=polar,plane", ("polar", "plane")),
    ],
)
def test_ranges_of_values_are_parsed(text: str, values: tuple[str, ...]) -> None:
    ((parameter,), constant) = parse([text, "detector.classes=[person, car]"])
    assert parameter == Parameter(text.split("=")[0], values)
    assert constant == ["detector.classes=[person, car]"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["clustering.eps=0.5"], "sweep: over what"),
        (["clustering.eps=0.9:0.3:0.1"], "expected first:last:step"),
        (["clustering.eps=0.1:0.3:0"], "expected first:last:step"),
        (["clustering.eps=0:1:0.0001"], "10001 values are more than 500"),
        (["clustering.eps=1,2", "voxel.size=1,2", "fusion.min_iou=0,1"], "two parameters at most, not 3"),
        (["clustering.eps=1:30:1", "voxel.size=1:30:1"], "900 combinations are more than 500"),
    ],
)
def test_an_invalid_range_is_one_line(settings: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        parse(settings)


def test_two_parameters_make_a_grid() -> None:
    parameters, constant = parse(["clustering.eps=0.4,0.5", "clustering.min_points=5,9,13", "voxel.size=0.2"])
    configs = combine(parameters, lambda more: load(settings=[*constant, *more]))
    assert list(configs)[:2] == [("0.4", "5"), ("0.4", "9")]
    assert len(configs) == 6
    assert configs["0.5", "13"].clustering.min_points == 13
    assert {config.voxel.size for config in configs.values()} == {0.2}


def test_source_parameters_cannot_be_swept() -> None:
    with pytest.raises(UserError, match=r"differ in sync\.tolerance"):
        combine([Parameter("sync.tolerance", ("0.1", "0.2"))], lambda more: load(settings=more))


# --- right and wrong ---------------------------------------------------------------------------


def boxes(*places: tuple[float, float]) -> Boxes3D:
    center = np.array([(x, y, 0) for x, y in places], np.float32).reshape(-1, 3)
    return Boxes3D(center, np.ones_like(center), np.zeros(len(center), np.float32))


def objects(*rows: tuple[str, float, float, float]) -> Objects:
    names, score = tuple(r[0] for r in rows), np.array([r[3] for r in rows], np.float32)
    none = np.zeros(len(rows), np.int32)
    return Objects(boxes(*((r[1], r[2]) for r in rows)), names, score, none, ("zed",) * len(rows), none)


def truth(*rows: tuple[str, float, float, bool]) -> Truth:
    names = tuple(r[0] for r in rows)
    accepted = tuple(frozenset((name.lower(),)) for name in names)
    return Truth(boxes(*((r[1], r[2]) for r in rows)), names, accepted, np.array([r[3] for r in rows], bool))


def test_planted_errors_are_counted() -> None:
    score = ObjectScore()
    there = truth(
        ("car", 10, 0, True), ("Person", 5, 5, True), ("person", 30, 0, False), ("car", 20, 0, True)
    )
    score.add(
        objects(
            ("car", 10.5, 0, 0.9),  # right
            ("car", 10.2, 0, 0.8),  # the same once more: false
            ("person", 5, 5.1, 0.7),  # right, whatever the case of the letters
            ("person", 30, 0, 0.6),  # need not be found: counts for nothing
            ("person", 20, 0, 0.5),  # the wrong class: false, and the car is missed
            ("bench", 1, 1, 0.9),  # nothing that the truth knows of
        ),
        there,
    )
    assert dict(score.classes["car"]) == {"true": 1, "false": 1, "missed": 1}
    assert dict(score.classes["person"]) == {"true": 1, "false": 1}
    expected = {"precision": 2 / 4, "recall": 2 / 3, "f1": 2 * 2 / (2 * 2 + 2 + 1)}
    assert rates(score.total) == pytest.approx(expected)
    assert score.errors() == pytest.approx([0.5, 0.1])


def test_empty_results_and_empty_truth_are_counted() -> None:
    score = ObjectScore()
    score.add(objects(), truth())
    assert np.isnan([*rates(score.total).values()]).all()
    score.add(objects(), truth(("car", 5, 0, True)))
    assert rates(score.total)["recall"] == 0


def test_the_nearest_unmatched_object_is_matched() -> None:
    distance = np.array([[1.0, 0.2], [0.3, 0.1], [0.5, 9]], np.float32)
    partner, free = pair_in_order(distance, 2.0)
    assert partner.tolist() == [1, 0, -1]
    assert not free.any()


@pytest.mark.long
def test_required_objects_of_the_synthetic_drive_are_known() -> None:
    """In range, in the image, and hit: as the simulator knows it itself."""
    shot = source().snapshot(10)
    stated = shot.frame.truth
    assert stated is not None
    found = truth_of(shot.frame, stated)
    np.testing.assert_allclose(found.boxes.center, stated.boxes.center, atol=1e-3)
    assert 2 < found.must.sum() < len(found.must)
    assert (shot.truth_hits[found.must] >= 8).all()  # points of the ground may be in a box as well
    assert (np.hypot(*found.boxes.center[found.must, :2].T) <= 40).all()
    camera = shot.frame.cameras[0]
    assert camera.intrinsics is not None
    assert camera.camera_from_points is not None
    uv, _ = project(move(camera.camera_from_points, found.boxes.center[found.must]), camera.intrinsics)
    assert (np.abs(uv - [319.5, 179.5]) <= [320, 180]).all()


# --- KITTI -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["000000", "000001"])
def test_kitti_labels_are_where_the_points_are(shared: Path, name: str) -> None:
    stated = read_labels(shared / "kitti/label_2" / f"{name}.txt")
    expected = labels(shared, name)  # through the camera's pose instead
    assert list(stated.labels) == [kind for kind, _ in expected]
    np.testing.assert_allclose(stated.boxes.center, [place for _, place in expected], atol=0.02)
    points = bags.kitti(shared, name).points[:, :3]
    for k in range(len(stated.boxes)):
        eight = corners(stated.boxes)[k]
        near = (np.abs(points - stated.boxes.center[k]) <= np.ptp(eight, axis=0) / 2).all(axis=1)
        assert near.sum() > 2
    length, width, height = stated.boxes.size.T
    assert (height > 1.4).all()
    assert (length > width).all()


def test_headings_of_kitti_labels_are_right(shared: Path) -> None:
    """The car and the truck of 000001 stand along the road, the pedestrian of 000000 across."""
    along = read_labels(shared / "kitti/label_2/000001.txt")
    assert np.abs(np.sin(along.boxes.yaw)).max() < 0.05
    across = read_labels(shared / "kitti/label_2/000000.txt")
    assert abs(np.sin(across.boxes.yaw[0])) > 0.99


def test_unusable_labels_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no label file there"):
        label_files(tmp_path)
    (tmp_path / "label_2").mkdir()
    (tmp_path / "calib").mkdir()
    file = tmp_path / "label_2" / "000000.txt"
    file.write_text("Car 1 2 3\n")
    with pytest.raises(UserError, match=r"calib/000000.txt: cannot be read: No such file"):
        read_labels(file)
    (tmp_path / "calib" / "000000.txt").write_text("P2: 1 2 3\n")
    with pytest.raises(UserError, match=r"calib/000000.txt: no Tr_velo_to_cam or"):
        read_labels(file)
    rows = "P2: 700 0 600 0 0 700 180 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\n"
    rows += "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
    (tmp_path / "calib" / "000000.txt").write_text(rows)
    with pytest.raises(UserError, match="line 1 has 3 numbers, a KITTI label has 14"):
        read_labels(file)


# --- as a user runs it -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("sweep") / "drive.mcap"
    write_bag(SyntheticSource(3, SEED), path)
    return str(path)


@pytest.mark.long
def test_a_sweep_of_the_synthetic_drive(drive: str, capsys: Capture) -> None:
    swept = ["--set", "clustering.min_points=5,5000", "--set", "clustering.min_cluster_points=1"]
    swept += ["--set", "fusion.split=false"]  # else the camera makes objects of noise
    files = ["--csv", "s.csv", "--save", "s.rrd"]
    assert main(["sweep", drive, "--model", "demo", "--frames", ":2", *swept, *files]) == 0
    said = capsys.readouterr().out
    assert "best F1: " in said
    assert "at clustering.min_points = 5\n" in said
    few, many = csv.DictReader(Path("s.csv").read_text().splitlines())
    assert float(few["recall"]) > 0.4
    assert float(many["recall"]) == float(many["objects"]) == 0  # nothing is that dense
    assert few["detections"] == many["detections"]
    assert int(few["frames"]) == 2
    assert sum(int(few[f"{name} tp"]) for name in ("car", "person") if f"{name} tp" in few) > 0
    verify(Path("s.rrd"))
    recording = Recording(Path("s.rrd"))
    chart = "/sweep/Precision\\,_recall\\,_F1"
    assert recording.static[f"{chart}/values"]["Points2D:labels"] == ["5", "5000"]
    told = recording.static[f"{chart}/recall/points"]
    assert told["says"] == [f"recall {float(few['recall']):.4g} at 5", "recall 0 at 5000"]
    (left, above), (right, below) = told["Points2D:positions"]
    assert (left, right, below) == (0, WIDTH, HEIGHT) and 0 <= above < below
    marks = [recording.static[f"{chart}/mark_{n}/word"] for n in (0, 1)]
    assert [mark["Points2D:labels"] for mark in marks] == [["best: 5"], ["now: 10"]]
    assert marks[0]["Points2D:positions"][0][0] == 0 < marks[1]["Points2D:positions"][0][0] < 0.01 * WIDTH
    assert "| clustering.min_points |" in recording.static["/sweep"]["TextDocument:text"][0]
    assert recording.blueprints == 1


@pytest.mark.long
def test_a_flat_sweep_over_two_parameters_has_no_best_value(drive: str, capsys: Capture) -> None:
    swept = ["--set", "clustering.eps=0.55,0.6", "--set", "fusion.min_points=1,2", "--save", "s.rrd"]
    assert main(["sweep", drive, "--model", "demo", *swept, "--json"]) == 0
    tree = json.loads(capsys.readouterr().out)
    assert [run["values"] for run in tree["runs"]] == [[e, n] for e in ("0.55", "0.6") for n in ("1", "2")]
    assert min(run["metrics"]["F1"] for run in tree["runs"]) > 0.5 and tree["best"] is None
    page = Recording(Path("s.rrd")).static["/sweep"]["TextDocument:text"][0]
    assert "no value is best within the noise: F1 0." in page
    assert "| clustering.eps | fusion.min_points |" in page


def test_kitti_labels_serve_as_truth(shared: Path, capsys: Capture) -> None:
    bag = bags.write(Path("kitti"), bags.kitti_items(shared))
    arguments = ["--model", str(shared / "models/yolox_nano.onnx"), "--frames", ":1"]
    for name in ("label_2/000000.txt", "label_2/000001.txt", "calib/000000.txt", "calib/000001.txt"):
        (Path("labels") / name).parent.mkdir(parents=True, exist_ok=True)
        (Path("labels") / name).write_bytes((shared / "kitti" / name).read_bytes())
    where = ["--kitti-labels", "labels/label_2"]
    swept = ["--set", "detector.conf_threshold=0.3,0.99", "--csv", "s.csv"]
    assert main(["sweep", str(bag), *arguments, *where, *swept]) == 0
    low, high = csv.DictReader(Path("s.csv").read_text().splitlines())
    assert (low["pedestrian tp"], low["pedestrian fn"]) == ("1", "0")  # the one of 000000
    assert (high["pedestrian tp"], high["pedestrian fn"]) == ("0", "1")
    capsys.readouterr()
    assert main(["sweep", str(bag), *where[:1], "labels/label_2/000000.txt", *swept]) == 2
    said = "1 label file and 2 scans: one for each scan, in order, is needed"
    assert said in capsys.readouterr().err


@pytest.mark.long
def test_another_topic_serves_as_truth() -> None:
    """The frame's own truth under a topic of the robot is the same truth."""
    own = frame().truth
    assert own is not None
    sweep = run_with(lambda f: truth_of(f, own))
    other = run_with(
        lambda f: truth_of(f, LabelledBoxes3D("/x", 0, "map", own.boxes, own.labels, own.scores))
    )
    assert sweep.outcomes["0.5",].score.classes == other.outcomes["0.5",].score.classes


def run_with(judge: Any) -> Sweep:
    parameters, _ = parse(["clustering.eps=0.5,0.6"])
    configs = combine(parameters, lambda more: load(settings=["detector.model=demo", *more]))
    sweep = Sweep(parameters, configs, judge)
    sweep.perceive(frame())
    return sweep


def test_an_interrupted_sweep_tells_what_it_has(
    drive: str, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    perceive = Sweep.perceive

    def interrupted(self: Sweep, frame: Frame, network: Any = None) -> FrameResult:
        if self.outcomes["0.5",].frames:
            raise KeyboardInterrupt
        return perceive(self, frame, network)

    monkeypatch.setattr(Sweep, "perceive", interrupted)
    assert main(["sweep", drive, "--set", "clustering.eps=0.5,0.6"]) == 130
    told = capsys.readouterr()
    assert told.out.startswith("1 frames; means")
    assert "interrupted after 1 frames; the table is of these" in told.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "sweep: over what?"),
        (["--set", "clustering.epsilon=1,2"], "unknown key 'clustering.epsilon'"),
        (
            ["--set", "clustering.eps=-1:1:1"],
            "--set clustering.eps=-1: clustering.eps must be greater than 0",
        ),
        (
            ["--set", "clustering.eps=1,2", "--truth", "/none"],
            "--truth /none: no such Detection3DArray topic",
        ),
        (["--set", "clustering.eps=1,2", "--kitti-labels", "none"], "--kitti-labels none: no label file"),
        (["--set", "clustering.eps=1,2", "--csv", "none/s.csv"], "--csv none/s.csv: there is no folder none"),
    ],
)
def test_wrong_calls_are_one_line(arguments: list[str], message: str, drive: str, capsys: Capture) -> None:
    assert main(["sweep", drive, "--frames", ":1", *arguments]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("bevviz: error: ")
    assert message in said


@given(st.floats(-1e6, 1e6), st.floats(0, 1e6))
def test_axes_hold_every_number_with_few_ticks(low: float, span: float) -> None:
    begin, end, step = axis_scale(low, low + span)
    assert begin <= low + 1e-6 * step and low + span <= end + 1e-6 * step
    assert 1 <= round((end - begin) / step) <= 8
