"""The Python interface: the same results and answers as the commands give."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import bevviz
from bevviz.cli import main
from bevviz.extras.demo.bag import BagWriter
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.model.results import FrameResult
from bevviz.support.python_words import python_words
from bevviz.why import Selection
from tests.support.recordings import Recording, verify


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    source = SyntheticSource(12, 3)
    with BagWriter(source, path) as writer:
        for frame in source:
            writer.write(frame)
    return path


@pytest.fixture
def drive(bag: Path) -> Iterator[bevviz.Drive]:
    with bevviz.open(bag, model="demo") as drive:
        yield drive


def test_a_drive_states_its_contents(drive: bevviz.Drive) -> None:
    assert len(drive) == 12
    assert drive.scene.cameras == ("zed",)
    np.testing.assert_allclose(drive.times, 0.1 * np.arange(12), atol=1e-6)
    assert repr(drive) == "<Drive drive.mcap: 12 scans, 1.1 s, preset default>"


def test_a_frame_by_time_or_number_is_that_of_the_run(drive: bevviz.Drive) -> None:
    run = {result.frame.index: result for result in drive}
    assert sorted(run) == list(range(12))
    assert all(result.tracks is not None for result in run.values())
    for result, number in ((drive.at(0.52), 5), (drive.at(frame=7), 7), (drive.at(frame=-1), 11)):
        assert result.frame.index == number
        assert result.tracks is None
        same(result, run[number])
    assert drive.at(frame=7) is drive.at(0.7), "what was made is kept"


def same(a: FrameResult, b: FrameResult) -> None:
    assert (
        a.clusters is not None and b.clusters is not None and a.objects is not None and b.objects is not None
    )
    np.testing.assert_array_equal(a.frame.points, b.frame.points)
    np.testing.assert_array_equal(a.clusters.labels, b.clusters.labels)
    assert a.objects.names == b.objects.names
    assert a.explanations == b.explanations
    assert a.bev is not None and b.bev is not None
    np.testing.assert_array_equal(a.bev.image, b.bev.image)


def test_the_answer_is_that_of_the_command(
    drive: bevviz.Drive, bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answers = drive.why(0.5, cls="car", hints=1)
    assert (
        main(["why", str(bag), "--model", "demo", "--at", "0.5", "--class", "car", "--limit", "1", "--json"])
        == 0
    )
    told = json.loads(capsys.readouterr().out)["answers"]
    assert len(answers) > 2
    assert [answer.verdict.text for answer in answers] == [answer["verdict"] for answer in told]


def test_several_questions_share_one_run_of_a_scan(drive: bevviz.Drive) -> None:
    questioner = drive.questioner(0.5)
    assert drive.questioner(0.5) is questioner
    number = len(drive.at(0.5).clusters or ())
    (answer,) = drive.why(0.5, cluster=number - 1, hints=0)
    assert answer.subject.kind == "cluster" and answer.subject.row == number - 1
    assert answer is questioner.ask(Selection(cluster=number - 1))[0]
    told, everything = (drive.why(0.5, hints=0, everything=flag) for flag in (False, True))
    assert 0 < len(told) < len(everything)
    assert drive.questioner(0.0) is not questioner


def test_a_changed_parameter_applies_to_later_questions(drive: bevviz.Drive) -> None:
    before = drive.at(0.5)
    changed = drive.configure("clustering.eps=20 cm", fusion={"min_points": 5})
    assert {key: str(change) for key, change in changed.items()} == {
        "clustering.eps": "0.5 -> 0.2",
        "fusion.min_points": "3 -> 5",
    }
    after = drive.at(0.5)
    assert before.clusters is not None and after.clusters is not None
    assert len(after.clusters) != len(before.clusters)
    assert after.config is drive.config
    with pytest.raises(bevviz.UserError, match=r"unknown key 'clustering.epsilon'"):
        drive.configure("clustering.epsilon=1")
    with pytest.raises(bevviz.UserError, match=r"detector.model none.onnx: no such file"):
        drive.configure("detector.model=none.onnx")
    assert drive.at(0.5) is after


def test_parameters_may_be_a_mapping_or_settings(bag: Path, tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("clustering: {eps: 0.9, min_points: 7}\n")
    stated = {"clustering.eps": 0.6, "detector.classes": ["person", "car"]}
    with bevviz.open(bag, model="demo", set=stated, config=file, frames=(2, 5)) as drive:
        config = drive.config
        assert (config.clustering.eps, config.clustering.min_points) == (0.6, 7)
        assert config.detector.classes == ("person", "car")
        assert [result.frame.index for result in drive] == [2, 3, 4]
    with bevviz.open([str(bag)], set=["clustering.eps=60 cm"], preset="reference", start=0.5) as drive:
        assert drive.config.voxel.size == 0.05
        assert len(list(drive)) == 7


def values_in_order(recording: Recording, entity: str) -> list[tuple[int, list[str], str]]:
    """Return frame, components and values of each row of an entity.

    Rerun decides by the clock which rows share a chunk. Rows of several kinds then come in another order,
    and with a null for each component of the other kinds.
    """
    rows = (
        {name: value for name, value in row.items() if value is not None} for row in recording.rows[entity]
    )
    return sorted((row["frame"], sorted(row), repr(sorted(row.items()))) for row in rows)


@pytest.mark.long
def test_a_saved_drive_is_that_of_the_command(drive: bevviz.Drive, bag: Path, tmp_path: Path) -> None:
    path = drive.save(tmp_path / "api.rrd")
    verify(path)
    assert main(["bag", str(bag), "--model", "demo", "--save", str(tmp_path / "cli.rrd")]) == 0
    ours, theirs = Recording(path), Recording(tmp_path / "cli.rrd")
    assert ours.at.keys() == theirs.at.keys()
    for entity in ("/explain", "/world/fused", "/tracks/speed_m_s"):
        assert values_in_order(ours, entity) == values_in_order(theirs, entity)


@pytest.mark.long
def test_results_are_exported_as_tables(drive: bevviz.Drive) -> None:
    pytest.importorskip("pandas")
    result = drive.at(0.5)
    assert result.objects is not None and result.clusters is not None
    table = result.objects.to_pandas()
    assert list(table["name"]) == list(result.objects.names)
    np.testing.assert_array_equal(table[["x", "y", "z"]], result.objects.boxes.center)
    assert (result.clusters.to_pandas()["points"] == result.clusters.count).all()
    detections = result.cameras[0].detections
    assert detections is not None
    assert set(detections.to_pandas()["state"]) <= {"kept", "below_threshold", "suppressed"}
    frames = drive.to_pandas()
    assert list(frames["frame"]) == list(range(12))
    assert (frames["points"] > 50_000).all()
    last = list(drive)[-1]
    assert last.tracks is not None
    assert len(last.tracks.to_pandas()) == len(last.tracks)
    arrow = result.objects.to_arrow()
    assert arrow.column("name").to_pylist() == list(result.objects.names)
    np.testing.assert_array_equal(arrow.column("x").to_numpy(), result.objects.boxes.center[:, 0])


def test_results_are_short_in_text_and_pictures_in_a_page(drive: bevviz.Drive) -> None:
    result = drive.at(0.5)
    assert result.objects is not None and result.clusters is not None
    parts = (result, result.frame, result.clusters, result.objects, result.cameras[0].detections)
    assert all(len(repr(part)) < 200 for part in parts)
    assert f"{len(result.frame.points):,} points" in repr(result)
    page = result._repr_html_()
    assert page.count("data:image/jpeg;base64,") == 2, "the camera and the view from above"
    assert all(f"<td>{name}</td>" in page for name in result.objects.names)


def test_frames_are_reached_by_number_and_slice(drive: bevviz.Drive) -> None:
    assert drive[3] is drive.at(frame=3) and drive[-1].frame.index == len(drive) - 1
    assert [result.frame.index for result in drive[-3:]] == [9, 10, 11]
    with pytest.raises(IndexError, match="frame 12: the drive has 12"):
        drive[12]
    assert {"open", "simulate", "Drive"} <= {*dir(bevviz)}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("--set clustering.epz=1: unknown", 'set=["clustering.epz=1"]: unknown'),
        ("2 drives; choose with --sequence NAME", '2 drives; choose with set={"source.sequence": "NAME"}'),
        ("no detector: --model FILE.onnx", 'no detector: model="FILE.onnx"'),
        ("--set sync.offsets='{/t: 0.5}' sets it", 'set=["sync.offsets={/t: 0.5}"] sets it'),
        ("a number (--frames, --at-frame)", "a number (frames=, frame=)"),
        ("--set detector.model=det:find: det", 'set=["detector.model=det:find"]: det'),
    ],
)
def test_options_become_arguments_in_python(text: str, said: str) -> None:
    assert python_words(text) == said


def test_errors_in_python_name_arguments(bag: Path) -> None:
    with pytest.raises(bevviz.UserError, match=r'^set=\["clustering\.epz=1"\]: unknown key'):
        bevviz.open(bag, set={"clustering.epz": 1})


@pytest.mark.long
def test_the_synthetic_drive_can_be_opened() -> None:
    with bevviz.simulate(frames=5, seed=2, set={"voxel.size": 0.2}) as drive:
        assert len(drive) == 5
        assert drive.at(0.3).frame.index == 3
        assert drive.at(0.3).frame.truth is not None
        assert len(list(drive)) == 5
        with pytest.raises(bevviz.UserError, match=r"9 is outside the drive, which has 0.4 s"):
            drive.at(9)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({}, "which scan"),
        ({"time": 1, "frame": 1}, "which scan"),
        ({"time": 100}, "100 is outside the recording"),
        ({"time": "soon"}, "'soon' is no time"),
        ({"frame": 12}, "frame 12: drive.mcap has 12 scans, counted from 0"),
        ({"frame": -13}, "frame -1: drive.mcap has 12 scans"),
    ],
)
def test_wrong_questions_raise_an_error(drive: bevviz.Drive, asked: dict[str, object], message: str) -> None:
    with pytest.raises(bevviz.UserError, match=message):
        drive.at(**asked)  # type: ignore[call-overload]


def test_importing_the_package_is_fast() -> None:
    """What is heavy comes with the first drive."""
    code = "import bevviz, sys; print(sorted({'numpy', 'rerun', 'numba', 'cv2'} & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    with pytest.raises(AttributeError, match="module 'bevviz' has no attribute 'opne'"):
        bevviz.opne  # noqa: B018
