"""Reports: what is written, that a run again proves it, and what is said where it does not."""

from __future__ import annotations

import json
import os
import re
import signal
import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import rerun as rr
from hypothesis import given
from hypothesis import strategies as st

import bevviz
from bevviz.bags.bag import Recording as Bag
from bevviz.bags.mcap_writer import McapWriter
from bevviz.bags.message import RawMessage
from bevviz.cli import main
from bevviz.config import DetectorConfig
from bevviz.model import geometry
from bevviz.model.frame import Frame
from bevviz.model.results import Detections, FrameResult
from bevviz.pipeline.session import Session
from bevviz.recording.provenance import Dependency, Provenance
from bevviz.report.check import CheckResult
from bevviz.report.fingerprints import StageDigest, compare, detections_of, pack, unpack
from bevviz.report.make import ReportRequest, make
from bevviz.report.page import spans
from bevviz.report.pictures import marked_pictures, ticks
from bevviz.report.report_subject import cause_of, explain_subject
from bevviz.stages.detector import Detector
from bevviz.support.onnx_files import network_hash
from bevviz.why import FrameExplainer, Selection
from bevviz.why.false_objects import false_reasons
from bevviz.why.subject import projected_box
from tests.support import bags, planted_faults
from tests.support.commands import Capture, error_of
from tests.support.recordings import Recording, verify

NOTE = 'lost <script>alert("x")</script> & found\nsecond line'
WHOLE = "the recording is, byte for byte, the file that the page beside it tells of"


class Page(HTMLParser):
    """Tags must be closed in order; ``links`` are the places that anything is loaded from."""

    VOID = ("meta", "img", "input", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.links: list[str] = []
        self.tags: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder with the report of a bag without a detector. The bag is in another folder."""
    folder = tmp_path_factory.mktemp("secret_name")
    bag = bags.write(folder / "drive", bags.small_items(scans=40))
    (folder / "note.txt").write_text(NOTE)
    out = tmp_path_factory.mktemp("report") / "bug.rrd"
    call = ["report", bag, "--at", "2", "--before", "0.5", "--after", "0.5", "-o", out]
    assert main([*map(str, call), "--note-file", str(folder / "note.txt"), "--set", "voxel.size=0.2"]) == 0
    return out


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def copied(report: Path, folder: Path) -> Path:
    for file in report.parent.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    return folder / report.name


def changed_bag(path: Path, change: Callable[[Bag, RawMessage], Any]) -> None:
    """Write a bag anew with other messages; None leaves one out."""
    with Bag([path]) as old, McapWriter(path.with_name("new.mcap"), old.types.definition) as new:
        for message in old.messages([t.name for t in old.topics]):
            if (data := change(old, message)) is not None:
                new.write(message.connection, message.received, data)
    path.with_name("new.mcap").replace(path)


# --- what is written ---------------------------------------------------------------------------


def test_the_report_contains_a_recording(small: Path) -> None:
    verify(small)
    found = Recording(small)
    assert found.blueprints == 1
    assert len(found.rows["/report/digest"]) == 11
    about = json.loads(found.static["/__properties/report"]["about"][0])
    assert about["note"] == NOTE
    assert about["at"] == bags.START + 2 * 10**9 + (about["at"] - bags.START) % bags.PERIOD
    document = found.static["/report"]["TextDocument:text"][0]
    assert "bevviz report --check bug.rrd" in document
    assert "--set voxel.size=0.2" in document
    assert f"note: {NOTE}" in [row["TextLog:text"][0] for row in found.rows["/explain/log"]]


def test_the_page_needs_no_other_files(small: Path) -> None:
    text = small.with_suffix(".html").read_text()
    page = Page(text)
    assert all(link.startswith("data:image/jpeg;base64,") for link in page.links)
    assert page.tags.count("script") == 1  # the note's is text
    assert page.tags.count("img") > 10
    assert page.tags.count("svg") >= 4
    assert not re.search(r"(https?:)?//[a-z]", re.sub(r"base64,[^\"]*", "", text))
    assert "url(" not in text and "@import" not in text
    words = "".join(page.words)
    for part in (NOTE, "voxel.size", "bevviz report --check bug.rrd", "GiB", "detector.model is not set"):
        assert part in words, part
    assert len(text) < 5e6


def test_no_path_of_the_machine_is_in_a_report(small: Path) -> None:
    found = Recording(small)
    text = small.with_suffix(".html").read_text() + str(found.static) + str(found.rows["/explain/log"])
    assert "secret_name" not in text
    assert str(Path.home()) + "/" not in text


@pytest.mark.long
def test_the_model_is_named_without_its_folder(tmp_path: Path, small: Path, capsys: Capture) -> None:
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=12))
    model = tmp_path / "secret" / "net.onnx"
    model.parent.mkdir()
    model.write_bytes((Path(bevviz.__file__).parent / "data" / "demo_detector.onnx").read_bytes())
    call = ["report", str(bag), "--at", "0.5", "--before", "0", "--after", "0", "--model", str(model)]
    assert main(call) == 0
    found = Recording(Path("bug.rrd"))
    about = json.loads(found.static["/__properties/report"]["about"][0])
    assert about["provenance"]["dependencies"]["detector.model"]["file"] == "net.onnx"
    assert about["provenance"]["machine"]["network"] == "CPU"
    assert "secret" not in Path("bug.html").read_text() + str(found.static)
    capsys.readouterr()
    assert "--model FILE" in error_of(capsys, "report", "--check", "bug.rrd")
    assert main(["report", "--check", "bug.rrd", "--model", str(model)]) == 0
    assert main([*call, "--force", "--include-model"]) == 0
    assert main(["report", "--check", "bug.rrd"]) == 0
    assert Path("net.onnx").read_bytes() == model.read_bytes()
    capsys.readouterr()
    assert main(["report", "--check", "bug.rrd", "--model", "demo"]) == 0  # the same network elsewhere
    same, covered, whole = capsys.readouterr().out.splitlines()
    assert whole == WHOLE
    assert same == "1 frames: the same in every bit" and covered.startswith("compared: what the stages make")
    assert "not compared: " in covered
    other = onnx.load(model)
    other.doc_string = "another file"
    onnx.save(other, "net.onnx")
    assert main(["report", "--check", "bug.rrd"]) == 0
    said = capsys.readouterr().out
    assert re.search(
        r"not as it was: detector\.model was net\.onnx \(SHA-256 \w+\), is net\.onnx \(SHA", said
    )


def test_pictures_mark_the_subject_of_a_report() -> None:
    """In the image and from above, at its place."""
    result = planted_faults.run("flat_car", "reference")
    (row,) = planted_faults.planted("flat_car", "car", 10.0)
    answer = FrameExplainer(result).about(Selection(truth=row))
    image, above = (picture for picture, _ in marked_pictures(result, answer, 640))
    assert answer.subject.box is not None
    wanted = projected_box(answer.subject.box, result.cameras[0].camera)
    assert wanted is not None
    inside = image[int(wanted[1]) : int(wanted[3]), int(wanted[0]) - 4 : int(wanted[2]) + 4]
    edge = np.asarray((inside[:, :6] >= 250).all(axis=2))  # the left one
    assert edge.any(axis=1).mean() > 0.9
    outline = (15.0 - geometry.corners(answer.subject.box)[0, :4, 1::-1]) / 30.0 * len(above)
    for u, v in np.round(outline).astype(int).tolist():
        assert (above[v - 1 : v + 2, u - 1 : u + 2] >= 250).all(axis=2).any()


def test_a_report_opens_on_a_false_object_and_on_nothing() -> None:
    """What is false is called false with ground truth and doubtful without; good frames have no cause."""
    result = planted_faults.run("shared_box", "reference")
    explainer = FrameExplainer(result)
    (answer, *_) = explain_subject(explainer, Selection(object=next(iter(false_reasons(explainer.traces)))))
    cause = cause_of(result, 7.0, answer)
    assert cause.what.startswith("False: the ")
    assert cause.why == explainer.about(answer.selection or Selection()).verdict.text
    blind = replace(result, frame=replace(result.frame, truth=None))
    assert cause_of(blind, 7.0, answer).what.startswith("Doubtful: the ")


# --- the check ---------------------------------------------------------------------------------


def test_a_run_again_is_the_same(small: Path, capsys: Capture) -> None:
    assert main(["report", "--check", str(small)]) == 0
    same, covered, whole = capsys.readouterr().out.splitlines()
    assert whole == WHOLE
    assert same == "11 frames: the same in every bit"
    assert covered.startswith("compared: what the stages make") and "; not compared: " in covered


def test_another_configuration_is_found(small: Path, capsys: Capture) -> None:
    assert main(["report", "--check", str(small), "--set", "voxel.size=9"]) == 1
    said = capsys.readouterr().out
    assert "11 of 11 frames differ, first frame 0 in 'voxels': " in said
    assert "not as it was: voxel.size was 0.2, is 9.0" in said


def test_another_message_is_found(small: Path, tmp_path: Path, capsys: Capture) -> None:
    report = copied(small, tmp_path)
    clouds = 0

    def change(bag: Bag, message: RawMessage) -> Any:
        nonlocal clouds
        if message.topic == bags.CLOUD:
            clouds += 1
            if message.received == bags.START + 2 * 10**9 + bags.PERIOD // 10:
                content = bag.decode(message)
                content.data = content.data.copy()
                content.data[:4] = np.array([99], np.float32).view(np.uint8)  # x of the first point
                return bag.encode(message, content)
        return message.data

    changed_bag(report.with_suffix(".mcap"), change)
    assert clouds > 11
    assert main(["report", "--check", str(report)]) == 1
    said = capsys.readouterr().out
    assert "1 of 11 frames differ, first frame 5 in 'cloud': xyz: 1 of 600 values differ, by up to" in said
    assert "bug.mcap is not the file that the report was made with" in said


def test_a_missing_scan_is_found(small: Path, tmp_path: Path, capsys: Capture) -> None:
    report = copied(small, tmp_path)
    last = bags.START + 25 * bags.PERIOD + bags.PERIOD // 10

    def change(bag: Bag, message: RawMessage) -> Any:
        return None if (message.topic, message.received) == (bags.CLOUD, last) else message.data

    changed_bag(report.with_suffix(".mcap"), change)
    assert main(["report", "--check", str(report)]) == 1
    assert "first frame 10 in 'cloud': this run makes no such frame" in capsys.readouterr().out


def test_other_versions_and_machines_are_named(
    small: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    from bevviz.report import check

    here = Provenance({"numpy": Dependency("9.9"), "abacist": Dependency("2")}, {"processor": "abacus"})
    monkeypatch.setattr(check, "provenance", lambda *_: here)
    assert main(["report", "--check", str(small)]) == 0
    said = capsys.readouterr().out
    assert re.search(r"not as it was: numpy was \d.*, is 9\.9", said)
    assert re.search(r"not as it was: numba was \d.*, is absent", said)
    assert "not as it was: abacist was absent, is 2" in said
    assert re.search(r"not as it was: processor was .*, is abacus", said)
    assert re.search(r"not as it was: memory was .*, is absent", said)


@pytest.mark.long
def test_whatever_may_be_the_reason_is_named(tmp_path: Path, capsys: Capture) -> None:
    """What only one of the two runs has, too: a detector, its file of class names, what it runs on."""
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=12))
    names = tmp_path / "names.txt"
    names.write_bytes(b"a\r\nb\n\nc")
    call = ["report", str(bag), "--at", "0.5", "--before", "0", "--after", "0"]
    assert main(call) == 0
    capsys.readouterr()
    assert main(["report", "--check", "bug.rrd", "--model", "demo"]) == 1
    said = capsys.readouterr().out
    assert re.search(r"was: detector\.model was absent, is demo_detector\.onnx \(SHA-256 \w{64}\)", said)
    assert "not as it was: network was absent, is CPU" in said

    count = len(Detector(DetectorConfig(model="demo")).names)
    names.write_bytes(b"\r\n".join(b"class %d" % i for i in range(count)))
    assert main([*call, "--force", "--model", "demo", "--set", f"detector.names={names}"]) == 0
    names.unlink()
    capsys.readouterr()
    assert main(["report", "--check", "bug.rrd"]) == 0
    same, covered, whole = capsys.readouterr().out.splitlines()
    assert whole == WHOLE
    assert same == "1 frames: the same in every bit" and covered.startswith("compared: what the stages make")
    assert "not compared: " in covered
    names.write_text("\n".join(f"other {i}" for i in range(count)))
    main(["report", "--check", "bug.rrd", "--set", f"detector.names={names}"])
    assert "not as it was: detector.names was names.txt (SHA-256" in capsys.readouterr().out


def test_a_difference_without_a_cause_is_stated(
    small: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    perceive = Session.perceive

    def shifted(self: Session, frame: Frame, network: Executor | None = None) -> FrameResult:
        return perceive(self, replace(frame, points=frame.points + np.float32(0.5)), network)

    monkeypatch.setattr(Session, "perceive", shifted)
    assert main(["report", "--check", str(small)]) == 1
    *_, last = capsys.readouterr().out.splitlines()
    assert last == "bag, model, configuration, versions and machine are as they were"


def test_a_check_without_frames_proves_nothing() -> None:
    nothing = CheckResult()
    assert not nothing.same
    assert list(nothing.lines()) == ["no frame, then or now: there is nothing to compare"]


@pytest.mark.long
def test_a_folder_without_a_report_is_one_line(small: Path, tmp_path: Path, capsys: Capture) -> None:
    assert "no such file" in error_of(capsys, "report", "--check", "absent.rrd")
    Path("text.rrd").write_text("no recording")
    assert "cannot be read as a report" in error_of(capsys, "report", "--check", "text.rrd")
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=3))
    assert main(["bag", str(bag), "--save", "run.rrd"]) == 0
    capsys.readouterr()
    assert "not one of 'bevviz report'" in error_of(capsys, "report", "--check", "run.rrd")
    Path("alone.rrd").write_bytes(small.read_bytes())
    assert "alone.mcap" in error_of(capsys, "report", "--check", "alone.rrd")
    with rr.RecordingStream("bevviz") as recording:
        recording.save("older.rrd")
        recording.send_property("bevviz", rr.AnyValues(config="preset: default"))
        recording.send_property("report", rr.AnyValues(about='{"low": 1}'))
    Path("older.mcap").touch()
    assert "a report of another version" in error_of(capsys, "report", "--check", "older.rrd")
    assert "takes one report" in error_of(capsys, "report", "--check", "a.rrd", "b.rrd")


# --- wrong calls and interruptions -------------------------------------------------------------


def test_wrong_calls_are_one_line(tmp_path: Path, capsys: Capture) -> None:
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=12))
    assert "--at TIME is missing" in error_of(capsys, "report", bag)
    assert "outside the recording" in error_of(capsys, "report", bag, "--at", "99")
    assert "ends in .rrd" in error_of(capsys, "report", bag, "--at", "1", "-o", "bug.html")
    assert "there is no folder" in error_of(capsys, "report", bag, "--at", "1", "-o", "no/bug.rrd")
    assert "--include-model" in error_of(capsys, "report", bag, "--at", "1", "--include-model")
    assert "--note-file" in error_of(capsys, "report", bag, "--at", "1", "--note-file", "absent.txt")
    assert "no topic fits" in error_of(capsys, "report", bag, "--at", "1", "--topics", "/absent")
    Path("bug.mcap").touch()
    assert "--force" in error_of(capsys, "report", bag, "--at", "1")
    own = "drive/drive.rrd"
    assert "what is read" in error_of(capsys, "report", "drive/drive.mcap", "--at", "1", "-o", own, "--force")
    assert not Path("bug.rrd").exists()
    with pytest.raises(SystemExit):
        main(["report", str(bag), "--before", "-1"])


@pytest.mark.long
def test_an_interrupted_run_is_a_shorter_report(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=30))
    done: list[FrameResult] = []
    finish = Session.finish

    def interrupted(self: Session, result: FrameResult) -> FrameResult:
        done.append(result)
        if len(done) == 4:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1)  # it is the main thread's to see it
        return finish(self, result)

    with monkeypatch.context() as patch:
        patch.setattr(Session, "finish", interrupted)
        assert main(["report", str(bag), "--at", "1", "--note", "x"]) == 130
    assert "interrupted after 3 frames" in capsys.readouterr().err  # the fourth was not finished
    verify(Path("bug.rrd"))
    assert "interrupted after 3 frames" in "".join(Page(Path("bug.html").read_text()).words)
    assert main(["report", "--check", "bug.rrd"]) == 0


def test_a_report_has_its_names_when_it_is_complete(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An error leaves neither half a report nor an older one that could be taken for it."""
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=2))
    folder = tmp_path / "reports"
    folder.mkdir()
    for name in ("bug.rrd", "bug.html", "bug.mcap"):
        (folder / name).write_text("older")
    seen: list[str] = []

    def full(*_: object) -> str:
        seen.extend(sorted(path.name for path in folder.iterdir()))
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("bevviz.report.make.page", full)
    assert main(["report", str(bag), "--at", "0", "-o", str(folder / "bug.rrd"), "--force"]) == 2
    assert "bug.rrd: cannot write the report: No space left on device" in capsys.readouterr().err
    (unfinished,) = seen
    assert unfinished.startswith("bug.partial-")
    assert not list(folder.iterdir())


# --- fingerprints ------------------------------------------------------------------------------


def stages(**arrays: Any) -> tuple[StageDigest, ...]:
    from bevviz.report.fingerprints import _stage

    return (_stage("part", {name: np.asarray(value) for name, value in arrays.items()}),)


@pytest.mark.parametrize(
    ("then", "now", "text", "rounding"),
    [
        ({"a": [1.0, 2.0]}, {"a": [1.0, 2.000001]}, "a: 1 of 2 values differ, by up to 1e-06", True),
        ({"a": [1.0, 2.0]}, {"a": [1.0, 2.1]}, "by up to 0.1", False),
        ({"a": [1e4]}, {"a": [1e4 + 0.01]}, "by up to 0.01", True),
        ({"a": [1.0]}, {"a": [np.nan]}, "by up to", False),
        ({"a": [0.0]}, {"a": [-0.0]}, "not in every bit", True),
        ({"a": [1, 2]}, {"a": [1, 3]}, "the first: 2 became 3", False),
        ({"a": ["car"]}, {"a": ["bus"]}, "the first: car became bus", False),
        ({"a": [1, 2]}, {"a": [1]}, "a: 2 rows became 1", False),
        ({"a": [1.0]}, {"b": [1.0]}, "1 rows became 0", False),
        ({"a": np.zeros(20000)}, {"a": np.ones(20000)}, "their sum +20000", False),
        ({"a": np.zeros(20000)}, {"a": np.zeros(20001)}, "20000 rows became 20001", False),
    ],
)
def test_differences_are_described_in_words(
    then: dict[str, Any], now: dict[str, Any], text: str, rounding: bool
) -> None:
    from bevviz.report.fingerprints import ROUNDING

    found = compare(stages(**then), stages(**now))
    assert found is not None and text in found.text
    assert (found.amount <= ROUNDING) == rounding
    assert compare(stages(**then), stages(**then)) is None


def test_a_stage_of_one_run_alone_is_named() -> None:
    found = compare(stages(a=[1]), ())
    assert found is not None and found.text == "only the report has results of it"


@given(
    st.lists(st.tuples(st.floats(0, 1, width=32), st.sampled_from(["car", "person", "ü/x"])), max_size=8),
    st.integers(0, 2**62),
)
def test_detections_survive_packing(rows: list[tuple[float, str]], stamp: int) -> None:
    from bevviz.report.fingerprints import _arrays, _stage

    n = len(rows)
    scores = np.array([score for score, _ in rows], np.float32)
    found = replace(
        Detections.empty(),
        xyxy=np.outer(scores, np.arange(4)).astype(np.float32),
        score=scores,
        class_id=np.arange(n, dtype=np.int32),
        names=tuple(name for _, name in rows),
        state=np.zeros(n, np.int32),
        suppressed_by=np.full(n, -1, np.int32),
        overlap=scores,
    )
    image = {"stamp": np.array([stamp]), "pixels": np.zeros((100, 100, 3), np.uint8)}
    before = (_stage("image cam", image), _stage("detector cam", dict(_arrays(found))))
    after = unpack(*pack(before))
    assert compare(before, after) is None
    (key, again), *_ = detections_of(after).items()
    assert key == ("cam", stamp)
    assert again.names == found.names
    np.testing.assert_array_equal(again.xyxy, found.xyxy)
    assert again.score.dtype == np.float32


# --- pieces of the page ------------------------------------------------------------------------


@given(st.floats(-1e6, 1e6), st.floats(0, 1e6), st.integers(2, 8))
def test_ticks_enclose_what_they_measure(low: float, span: float, count: int) -> None:
    found = ticks(low, low + span, count)
    assert 2 <= len(found) <= count + 2
    step = found[1] - found[0]
    assert found[0] <= low + 1e-6 * step + 1e-9
    assert found[-1] >= low + span - 1e-6 * step - 1e-9


def test_report_windows_are_parsed() -> None:
    assert spans([1, 2, 3, 7, 9, 10]) == "1-3, 7, 9-10"


@pytest.mark.long
def test_weights_beside_the_model_are_in_the_report(tmp_path: Path, small: Path) -> None:
    """A newer exporter of torch writes model.onnx and model.onnx.data."""
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=12))
    model = tmp_path / "models" / "net.onnx"
    model.parent.mkdir()
    network = onnx.load(Path(bevviz.__file__).parent / "data" / "demo_detector.onnx")
    onnx.save(network, model, save_as_external_data=True, location="net.onnx.data", size_threshold=100)
    weights = model.with_name("net.onnx.data")
    content = weights.read_bytes()
    call = ["report", str(bag), "--at", "0.5", "--before", "0", "--after", "0", "--model", str(model)]
    assert main([*call, "--include-model"]) == 0
    assert Path("net.onnx.data").read_bytes() == content
    before = network_hash(model)
    weights.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    assert network_hash(model) != before, "the weights count"
    weights.unlink()
    model.unlink()
    assert main(["report", "--check", "bug.rrd"]) == 0


def test_a_report_tells_scans_of_equal_log_time_apart(tmp_path: Path) -> None:
    """The page hands over the result that its user saw."""
    clouds = [item for item in bags.small_items(scans=4) if item.topic == bags.CLOUD]
    bag = bags.write(tmp_path / "drive", [item._replace(received=bags.START) for item in clouds])
    out = tmp_path / "bug.rrd"
    with bevviz.open(bag) as drive:
        seen = list(drive)[2]
        request = ReportRequest(
            paths=[bag], config=drive.config, at="0", output=out, note="lost here", result=seen
        )
    assert make(request).frames == 4
    log = Recording(out).at["/explain/log"]["TextLog:text"]
    assert [frame for frame, text in log.items() if "note: lost here" in str(text)] == [2]
