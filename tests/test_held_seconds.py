"""Questions about a frame that was shown seconds ago: it is made again from the messages in memory."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from bevviz.bags.message import RawMessage
from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import load
from bevviz.errors import UserError
from bevviz.model.frame import Frame
from bevviz.model.results import FrameResult
from bevviz.pipeline.session import Session
from bevviz.recording import entities
from bevviz.why import Selection
from bevviz.workbench.growing_drive import RESULTS
from bevviz.workbench.reports import ReportMaker
from bevviz.workbench.running_robot import RunningRobot
from bevviz.workbench.session import WorkbenchSession
from tests.support.live_sessions import live_bench
from tests.support.recordings import Recording
from tests.support.waiting import until

FRAMES, FIRST, HELD = 8, 4000, 2  # the live run has dropped or shown frames before


@dataclass(frozen=True)
class Drive:
    results: Sequence[FrameResult]
    messages: Sequence[RawMessage]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    """Return the results of a bag, numbered as of a live run, and its messages."""
    path = tmp_path_factory.mktemp("held") / "demo.mcap"
    assert main(["demo", "--frames", str(FRAMES), "-o", str(path)]) == 0
    config = load(None, ["detector.model=demo"])
    session = Session(config)
    with BagSource([path], config) as source:
        results = [session.run_single(numbered) for numbered in _numbered(source)]
        topics = [topic.name for topic in source.recording.topics]
        messages = sorted(source.recording.messages(topics), key=lambda message: message.received)
    return Drive(results, messages)


def _numbered(source: BagSource) -> Iterator[Frame]:
    for frame in source:
        yield replace(frame, index=frame.index + FIRST)


@pytest.fixture
def robot(drive: Drive) -> Iterator[RunningRobot]:
    with live_bench(drive.results, f"live.held={HELD}", messages=drive.messages) as robot:
        for result in drive.results:
            robot.observe(result)
        yield robot


def test_an_old_frame_is_made_again_as_it_was(robot: RunningRobot, drive: Drive) -> None:
    shown = drive.results[2]
    number = robot.number_at(shown.frame.stamp)
    assert number == FIRST + 2
    again = robot.look(number)
    assert again is not shown and again is robot.look(number)
    assert (again.frame.index, again.frame.stamp) == (number, shown.frame.stamp)
    np.testing.assert_array_equal(again.frame.points, shown.frame.points)
    np.testing.assert_allclose(again.frame.pose, shown.frame.pose)
    assert again.frame.cameras[0].image is not None and not again.frame.problems
    assert again.objects is not None and shown.objects is not None
    assert again.objects.names == shown.objects.names
    session = WorkbenchSession(robot)
    (old, *_), (new, *_) = (_answers(session, result) for result in (shown, again))
    assert old == new and "reported" in new


def _answers(session: WorkbenchSession, result: FrameResult) -> list[str]:
    explainer = session.source.explainer(result)
    return [answer.verdict.text for answer in explainer.ask(Selection(object=0))]


def test_an_image_that_came_too_late_stays_away(drive: Drive) -> None:
    """A verdict about a frame that the live run saw without an image must not come from a better frame."""
    frame = drive.results[1].frame
    blind = replace(frame, cameras=tuple(replace(camera, image=None) for camera in frame.cameras))
    with live_bench(drive.results, "live.held=1", messages=drive.messages) as robot:
        robot.observe(replace(drive.results[1], frame=blind))
        robot.observe(drive.results[2])
        camera = robot.look(FIRST + 1).frame.cameras[0]
        assert camera.image is None
        assert camera.problems[-1] == "its image came too late for the live run"


def test_what_is_made_again_is_bounded_and_ends(robot: RunningRobot, drive: Drive) -> None:
    numbers = [result.frame.index for result in drive.results[:-HELD]]
    for number in numbers:
        robot.look(number)
    assert len(robot._results) == min(RESULTS, len(numbers)) and len(robot._bags) == 1
    folder = robot._bags[0].path.parent
    assert [path.name for path in folder.iterdir()] == [robot._bags[0].path.name]
    with pytest.raises(UserError, match="frame 17 is gone"):
        robot.look(17)
    with pytest.raises(UserError, match="that frame is gone: the last 1 s can be asked about"):
        robot.number_at(drive.results[0].frame.stamp - 10**9)
    robot.close()
    assert not folder.exists()


def test_frames_without_messages_are_forgotten(robot: RunningRobot, drive: Drive) -> None:
    """The buffer of messages is the limit: what it has dropped cannot be asked about."""
    raw = robot.live.source.raw
    assert raw is not None
    robot.live.settings.take(["live.raw_size=0.000001"])
    raw.put(raw.messages()[-1])
    robot.observe(drive.results[-1])
    assert [number for _, number in robot.frame_times()] == [FIRST + FRAMES - 1]


@pytest.mark.long
def test_the_held_seconds_are_listed(robot: RunningRobot) -> None:
    said = robot.commands["list"]({})
    assert said["type"] == "said"
    assert said["text"] == "Listing the held seconds, each frame ..."
    until(lambda: not robot._listing.jobs[-1].going)
    groups = robot.findings.content()
    assert {frame.frame for _, _, frames in groups for frame in frames} >= {FIRST, FIRST + FRAMES - 1}


@pytest.mark.long
def test_a_report_is_cut_from_the_held_seconds(robot: RunningRobot, drive: Drive, tmp_path: Path) -> None:
    session = WorkbenchSession(robot, ReportMaker(robot.news.tell, robot.bag_of, tmp_path))
    number, stamp = FIRST + 2, drive.results[2].frame.stamp
    (answer, *_) = session.ask(number, (), Selection(object=0))
    identity = session.identity(number, (), Selection(object=0), answer, None)
    report = session.begin_report(robot.number_at(stamp), (), 0.2, 0.2, "odd", identity)
    until(lambda: report.state != "running")
    assert report.state == "over", report.error
    page = next(tmp_path.glob("*.html")).read_text()
    assert f"frame {number}" in page and answer.verdict.text[:40] in page
    assert {Path(file.name).suffix for file in report.files} == {".rrd", ".html", ".mcap"}
    started = time.monotonic()
    session.close()
    assert time.monotonic() - started < 5


def test_the_rest_of_a_frame_is_dim_beside_a_robot(
    robot: RunningRobot, drive: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result, pieces = drive.results[-1], list[bytes]()
    monkeypatch.setattr(robot.recording, "add", pieces.append)
    robot.mark(result, robot.explainer(result).about(Selection(object=0)))
    (path := tmp_path / "marks.rrd").write_bytes(b"".join(pieces))
    camera, recording = result.frame.cameras[0].name, Recording(path)
    for entity in (entities.FUSED, entities.WHY_PART.path(f"{camera}/veil")):
        assert recording.rows[entity][0]["stamp"] == result.frame.stamp
