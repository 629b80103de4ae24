"""A recording leads back to the bag that it was made from, and to how it was made."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

import bevviz
from bevviz.bags.bag import Recording
from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import load, stage_files
from bevviz.errors import UserError
from bevviz.messages.roles import find_roles
from bevviz.recording.frame_logger import FrameLogger
from bevviz.recording.sinks import open_recording
from bevviz.recording.source_lookup import find_source, fingerprint, read_origin
from bevviz.support.onnx_files import DEMO_MODEL

EPS = 0.437


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder with a bag, a detector and the recording of a run with them."""
    folder = tmp_path_factory.mktemp("made")
    bag, model, rrd = folder / "demo.mcap", folder / "net.onnx", folder / "run.rrd"
    shutil.copyfile(DEMO_MODEL, model)
    assert main(["demo", "--frames", "3", "-o", str(bag)]) == 0
    settings = ["--model", str(model), "--set", f"clustering.eps={EPS}"]
    assert main(["bag", str(bag), *settings, "--save", str(rrd)]) == 0
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Copy that folder as a whole to a place that contains nothing else."""
    place = tmp_path / "elsewhere"
    shutil.copytree(made, place)
    monkeypatch.chdir(tmp_path)
    return place


@pytest.fixture
def gone(made: Path) -> Iterator[Callable[[str], None]]:
    """Hides a file at the place where the recording was made, too; it is back afterwards."""
    hidden: list[Path] = []

    def hide(name: str) -> None:
        (made / name).rename(made / f"{name}.hidden")
        hidden.append(made / name)

    yield hide
    for path in hidden:
        path.with_name(f"{path.name}.hidden").rename(path)


def test_a_recording_names_its_bag(made: Path) -> None:
    how, origin = read_origin(made / "run.rrd")
    assert f"eps: {EPS}" in how
    assert origin is not None
    (bag,) = origin.bag
    assert (bag.name, bag.beside, bag.path) == ("demo.mcap", "demo.mcap", str(made / "demo.mcap"))
    assert bag.size == (made / "demo.mcap").stat().st_size
    assert origin.files["detector.model"].name == "net.onnx"
    assert not origin.redacted


def test_the_bag_is_sought_beside_it_then_at_its_path(folder: Path, made: Path) -> None:
    assert find_source(folder / "run.rrd").paths == (folder / "demo.mcap",)
    (folder / "demo.mcap").unlink()
    assert find_source(folder / "run.rrd").paths == (made / "demo.mcap",)


def test_roles_and_configuration_are_those_of_the_recording(folder: Path) -> None:
    """The topics are stated one by one, and give the same roles again."""
    recorded = find_source(folder / "run.rrd")
    config = recorded.load()
    assert config.clustering.eps == EPS
    assert config.detector.model == str(folder / "net.onnx")
    with Recording(recorded.paths) as bag:
        found, stated = find_roles(bag.topics, load().source), find_roles(bag.topics, config.source)
    assert config.source.lidar_topics == found.lidars
    assert replace(found, notes={}) == replace(stated, notes={})


def test_options_override_the_recorded_settings(folder: Path) -> None:
    recorded = find_source(folder / "run.rrd")
    assert recorded.load(settings=["clustering.eps=0.9"]).clustering.eps == 0.9
    assert recorded.load(preset="reference").clustering.eps == load(preset="reference").clustering.eps
    assert recorded.load(preset="reference").detector.model == str(folder / "net.onnx")
    file = folder / "own.yaml"
    file.write_text("clustering: {min_points: 7}\n")
    own = recorded.load(file)
    assert (own.clustering.min_points, own.clustering.eps) == (7, load().clustering.eps)
    assert own.source == recorded.load().source


def test_a_missing_bag_names_every_searched_place(
    folder: Path, gone: Callable[[str], None], made: Path
) -> None:
    gone("demo.mcap")
    (folder / "demo.mcap").unlink()
    with pytest.raises(UserError) as error:
        find_source(folder / "run.rrd")
    for part in ("the bag demo.mcap", str(folder / "demo.mcap"), str(made / "demo.mcap"), "--bag PATH"):
        assert part in str(error.value)
    (folder / "demo.mcap").write_bytes(b"something else")
    with pytest.raises(UserError, match=r"demo\.mcap is another one \(size or content\)"):
        find_source(folder / "run.rrd")


def test_a_stated_bag_is_used(folder: Path) -> None:
    moved = (folder / "demo.mcap").rename(folder / "moved.mcap")
    recorded = find_source(folder / "run.rrd", [moved])
    assert (recorded.paths, recorded.warnings) == ((moved,), ())
    shutil.copyfile(moved, folder / "other.mcap")
    with (folder / "other.mcap").open("r+b") as file:
        file.write(b"changed")
    assert (
        "is not what run.rrd was made from, demo.mcap"
        in find_source(folder / "run.rrd", [folder / "other.mcap"]).warnings[0]
    )
    with pytest.raises(UserError, match=r"--bag .*nowhere"):
        find_source(folder / "run.rrd", [folder / "nowhere.mcap"])


def test_a_missing_detector_is_asked_for(folder: Path, gone: Callable[[str], None]) -> None:
    gone("net.onnx")
    (folder / "net.onnx").unlink()
    with pytest.raises(UserError, match=r"net\.onnx; there is none at .*: give --model FILE"):
        find_source(folder / "run.rrd")
    assert find_source(folder / "run.rrd", settings=["detector.model=demo"]).load().clustering.eps == EPS


@pytest.mark.long
def test_a_recording_without_a_bag_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    demo, other = tmp_path / "demo.rrd", tmp_path / "other.rrd"
    assert main(["demo", "--frames", "1", "--save", str(demo)]) == 0
    assert main(["why", str(demo), "--at", "0"]) == 2
    assert "does not say which bag it was made from" in capsys.readouterr().err
    other.write_bytes(b"RRF2" + bytes(100))
    assert main(["why", str(other), "--at", "0"]) == 2
    assert "cannot be read as a recording" in capsys.readouterr().err
    assert main(["why", str(tmp_path / "none.rrd"), "--at", "0"]) == 2
    assert "none.rrd: no such file" in capsys.readouterr().err
    assert main(["why", "a.mcap", "--bag", "b.mcap", "--at", "0"]) == 2
    assert "PATH has to be one .rrd file" in capsys.readouterr().err


@pytest.mark.long
def test_commands_take_a_recording_for_its_bag(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Why answers the same as about the bag with the same options; the others run with what it says."""
    rrd, bag, model = str(folder / "run.rrd"), str(folder / "demo.mcap"), str(folder / "net.onnx")

    def answers(*arguments: str) -> object:
        assert main(["why", *arguments, "--at-frame", "2", "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    capsys.readouterr()
    assert answers(rrd) == answers(bag, "--model", model, "--set", f"clustering.eps={EPS}")
    assert main(["compare", rrd, "--set-b", "clustering.eps=0.9", "--frames", "0:1", "--save", "c.rrd"]) == 0
    assert f"clustering.eps  {EPS} -> 0.9" in capsys.readouterr().out
    assert main(["compare", rrd, "--frames", "0:1", "--save", "d.rrd"]) == 0
    assert f"-> {EPS}" in capsys.readouterr().out
    assert main(["bag", rrd, "--frames", "0:1", "--save", rrd]) == 2
    assert "is what is read" in capsys.readouterr().err
    with bevviz.open(rrd) as drive:
        assert drive.config.clustering.eps == EPS
        assert len(drive) == 3


@pytest.mark.long
def test_reduced_recordings_can_be_asked_and_checked(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, model, bug = str(folder / "demo.mcap"), str(folder / "net.onnx"), folder / "bug.rrd"

    def answers(path: str | Path, *arguments: str) -> object:
        capsys.readouterr()
        assert main(["why", str(path), "--at-frame", "1", "--json", *arguments]) == 0
        return json.loads(capsys.readouterr().out)

    wanted = answers(bag, "--model", model)
    for keep in ("inspect", "report"):
        less = folder / f"{keep}.rrd"
        run = ["bag", bag, "--model", model, "--frames", ":2", "--keep", keep, "--save", str(less)]
        assert main(run) == 0
        assert answers(less) == wanted
    report = ["report", bag, "--at", "0.1", "--model", model, "--keep", "report", "-o", str(bug)]
    assert main(report) == 0
    assert answers(bug) == wanted
    assert main(["report", "--check", str(bug)]) == 0
    assert "3 frames: the same in every bit" in capsys.readouterr().out
    with bevviz.open(bug) as drive:
        assert drive.config.logging.keep == "report"


def test_a_report_stands_for_the_bag_that_comes_with_it(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its recording names nothing but what lies beside it, and no folder of this machine."""
    away = folder.parent / "received"
    away.mkdir()
    report = away / "bug.rrd"
    given = ["--at", "0.1", "--before", "0", "--after", "0", "--include-model"]
    assert main(["report", str(folder / "run.rrd"), *given, "-o", str(report)]) == 0
    _, origin = read_origin(report)
    assert origin is not None
    for place in (*origin.bag, *origin.files.values()):
        assert (place.beside, place.path) == (place.name, "")
    assert str(folder).encode() not in report.read_bytes()
    recorded = find_source(report)
    assert recorded.paths == (away / "bug.mcap",)
    assert recorded.load().detector.model == str(away / "net.onnx")
    capsys.readouterr()
    assert main(["why", str(report), "--at-frame", "0"]) == 0
    assert "The " in capsys.readouterr().out


@pytest.mark.long
def test_a_redacted_report_tells_no_more_and_says_what_it_is(folder: Path) -> None:
    report = folder / "bug.rrd"
    given = ["--at", "0.1", "--before", "0", "--after", "0", "--redact"]
    assert main(["report", str(folder / "run.rrd"), *given, "-o", str(report)]) == 0
    content = report.read_bytes()
    assert str(folder).encode() not in content
    _, mark = fingerprint(folder / "demo.mcap")
    assert mark.encode() not in content, "the whole images' bag is not to be known again"
    assert "are redacted" in find_source(report).warnings[0]


@pytest.mark.long
def test_code_that_a_recording_names_is_not_run_unasked(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module, rrd = folder / "sly.py", folder / "sly.rrd"
    module.write_text("def cells(points):\n    import numpy as np\n    return np.zeros(len(points), int)\n")
    monkeypatch.chdir(folder)
    given = ["--set", "clustering.method=sly:cells"]
    assert main(["bag", "demo.mcap", *given, "--frames", "0:1", "--save", str(rrd)]) == 0
    for command in (["why", str(rrd), "--at", "0"], ["bag", str(rrd), "--save", "x.rrd"]):
        capsys.readouterr()
        assert main(command) == 2
        assert "if you trust it, add --set clustering.method=sly:cells" in capsys.readouterr().err
    assert main(["why", str(rrd), "--at", "0", "--point", "5,0,0", *given]) == 0


def test_fingerprints_tell_content_apart(tmp_path: Path) -> None:
    """Of files at the beginning, the middle and the end; of folders by the bag's files in them alone."""
    folder = tmp_path / "bag"
    folder.mkdir()
    file = folder / "one.mcap"
    content = bytearray(1_000_000)
    marks = set()
    for changed in (0, 500_000, 999_999, None):
        content[:] = bytes(len(content))
        if changed is not None:
            content[changed] = 1
        file.write_bytes(content)
        size, mark = fingerprint(file)
        assert size == len(content)
        marks.add(mark)
    assert len(marks) == 4
    before = fingerprint(folder)
    (folder / "notes.txt").write_text("mine")
    (folder / "run.rrd").write_text("made")
    assert fingerprint(folder) == before
    (folder / "two.mcap").write_bytes(b"more")
    assert fingerprint(folder) != before


@pytest.mark.long
def test_the_files_of_a_3d_detector_are_found_again(folder: Path, made: Path) -> None:
    """Beside the recording, moved with it; where they are gone they are asked for, but for others' sake."""
    names = {"objects.method": "head.onnx", "objects.params.encoder": "encoder.onnx"}
    for name in names.values():
        (folder / name).write_bytes(name.encode())
    stated = [f"{key}={folder / name}" for key, name in names.items()]
    stated += ["objects.point_range=[0, -8, -3, 24, 8, 1]", "objects.voxel_size=[1, 1, 4]"]
    stated += ["objects.features=[x, y, z, intensity]", "objects.classes=[Car]", "detector.model=demo"]
    config = load(settings=stated)
    with BagSource([folder / "demo.mcap"], config) as source:
        rrd = folder / "objects.rrd"
        with open_recording(source.scene, config, save=rrd) as sinks:
            FrameLogger(sinks.recording, config, source.scene).log_static()
    away = folder.with_name("moved")
    folder.rename(away)

    recorded = find_source(away / "objects.rrd")
    found = recorded.load()
    assert stage_files(found) == {key: str(away / name) for key, name in names.items()}
    assert found.objects.params["classes"] == ["Car"]
    assert recorded.load(preset="reference").objects.method == "frustum"
    assert recorded.load(settings=["objects.score_threshold=0.5"]).objects.params["score_threshold"] == 0.5
    (away / "head.onnx").unlink()
    lost = r"made with objects\.method head\.onnx; there is none at .*: give --set objects\.method=FILE"
    with pytest.raises(UserError, match=lost):
        find_source(away / "objects.rrd")
    for other, files in (("frustum", {}), (str(away / "demo.onnx"), {"encoder": str(away / "encoder.onnx")})):
        settings = [f"objects.method={other}"]
        there = find_source(away / "objects.rrd", settings=settings).load(settings=settings)
        assert there.objects.method == other
        assert {k: v for k, v in there.objects.params.items() if k == "encoder"} == files
