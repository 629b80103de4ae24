"""The workbench's page beside a robot: a real graph, the real server; the tests speak the page's part."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

import bevviz
from bevviz.config.reloading import ReloadableConfig
from bevviz.errors import UserError
from bevviz.live.encoder import Encoder
from bevviz.live.run_outputs import Outputs
from bevviz.live.runtime import Live
from bevviz.live.status import Notes
from bevviz.model.results import FrameResult
from bevviz.recording import entities
from bevviz.why import Selection
from bevviz.workbench.live_buffer import WHOLE, LiveBuffer
from bevviz.workbench.running_robot import KEPT, RunningRobot, robot_session
from bevviz.workbench.server import page_server
from bevviz.workbench.session import WorkbenchSession
from tests.support import kept_drives
from tests.support.live_sessions import live_bench, run_beside
from tests.support.replay import Replay
from tests.support.ros_graphs import own_graph, playing
from tests.support.ros_player import Play
from tests.support.waiting import PATIENCE, until
from tests.support.workbench_pages import chromium, opened

pytestmark = pytest.mark.filterwarnings("ignore:RRD file has no footer")
HELD = 4


# --- on a real graph ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    """Run a robot and ``bevviz live --workbench`` beside it. Yield the workbench's address and its folder."""
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")
    folder, root = tmp_path_factory.mktemp("live"), Path(__file__).parents[1]
    with own_graph() as patch:
        patch.setenv("PYTHONPATH", str(root))
        command = [sys.executable, "-m", "bevviz.cli", "live", "--model", "demo", "--workbench"]
        said = folder / "said.txt"
        with (
            playing(Play(frames=3, points=10_000, rate=5.0)),
            said.open("w") as log,
            subprocess.Popen(command, cwd=folder, stderr=log) as live,
        ):
            try:
                yield _address(said, live), folder
            finally:
                live.send_signal(signal.SIGINT)
                live.wait(timeout=PATIENCE)


def _address(said: Path, live: subprocess.Popen[bytes]) -> str:
    """Return the address that the live run prints, as soon as it can be reached."""
    from bevviz.recording.ports import is_listening

    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and live.poll() is None:
        found = re.search(r"workbench at (http://([^:]+):(\d+)\S+)", said.read_text())
        if found and is_listening(found[2], int(found[3])):
            return found[1]
        time.sleep(0.1)
    raise AssertionError(said.read_text())


class Channel:
    """One of the page's sockets."""

    def __init__(self, address: str, path: str) -> None:
        from websockets.sync.client import connect
        from websockets.typing import Origin

        parts = urlsplit(address)
        origin = Origin(f"http://{parts.netloc}")
        url = f"ws://{parts.netloc}{path}?{parts.query}"
        self._open = ExitStack()
        self._socket = self._open.enter_context(connect(url, origin=origin, max_size=None))
        self._number = 0
        self.entries = deque[list[dict[str, Any]]]()  # those that came before another message was awaited

    def send(self, **message: Any) -> int:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, **message}))
        return self._number

    def piece(self) -> bytes:
        data = self._socket.recv(timeout=PATIENCE)
        assert isinstance(data, bytes)
        self._socket.send("")  # it is drawn
        return data

    def until(self, kind: str, number: int | None = None) -> dict[str, Any]:
        """Return the next message of a kind, or an error."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            message: dict[str, Any] = json.loads(self._socket.recv(timeout=PATIENCE))
            if message["type"] == "entries" and kind != "entries":
                self.entries.append(message["entries"])
            if message["type"] in (kind, "error") and number in (None, message.get("id")):
                return message
        raise AssertionError(f"no {kind}")

    def close(self) -> None:
        self._open.close()


class Shown:
    """What a page's viewer would show. A thread takes each piece at once: a slow page skips pieces."""

    def __init__(self, address: str, folder: Path) -> None:
        self.channel, self._file = Channel(address, "/recording"), folder / "piece.rrd"
        self.stamp, self.texts, self.marked = 0, list[str](), False
        self._pieces = deque[bytes]()
        threading.Thread(target=self._receive, daemon=True).start()

    def _receive(self) -> None:
        from websockets.exceptions import ConnectionClosed

        with suppress(ConnectionClosed, TimeoutError):
            while True:
                self._pieces.append(self.channel.piece())

    def until(self, done: Callable[[], Any]) -> None:
        end = time.monotonic() + PATIENCE
        while not done():
            assert time.monotonic() < end
            if self._pieces:
                self._take(self._pieces.popleft())
            else:
                time.sleep(0.02)

    def _take(self, piece: bytes) -> None:
        from rerun.chunk import RrdReader

        self._file.write_bytes(piece)
        reader = RrdReader(self._file)
        for store in reader.recordings():
            for chunk in reader.stream(store=store):
                batch = chunk.to_record_batch()
                if chunk.entity_path == entities.EXPLAIN:
                    self.stamp = max(self.stamp, *(t.value for t in batch.column(entities.STAMP)))
                if chunk.entity_path == entities.EXPLAIN_LOG:
                    self.texts += [text for (text,) in batch.column("TextLog:text").to_pylist()]
                self.marked |= chunk.entity_path.startswith(entities.WHY_PART.path(""))


def nearest_missed(talk: Channel, frame: int) -> str:
    """Return the pick of the nearest missed object in the next list, which is of one frame only."""
    entries: list[dict[str, Any]] = []
    # Lists of the frame that was held before may come first.
    while {sight["frame"] for entry in entries for sight in entry["sights"]} != {frame}:
        entries = talk.entries.popleft() if talk.entries else talk.until("entries")["entries"]
    missed = [entry["sights"][0] for entry in entries if entry["what"] == "missed"]
    return str(min(missed, key=lambda sight: sight["distance"])["pick"])


@pytest.mark.long
def test_a_running_robot_is_asked_and_changed(robot: tuple[str, Path]) -> None:
    """From the newest frame to a held one, its answer, a parameter for all to come, a mark, a snapshot."""
    address, folder = robot
    talk, shown = Channel(address, "/talk"), Shown(address, folder)
    welcome = talk.until("welcome")
    assert welcome["detector"]
    assert any(control["key"] == "clustering.eps" for control in welcome["controls"])
    shown.until(lambda: shown.stamp)

    talk.send(type="hold", time=shown.stamp)
    held = talk.until("held")
    stamp = int(held["stamp"])
    near = nearest_missed(talk, held["frame"])
    number = talk.send(type="ask", time=stamp, pick=near, set=[])
    answer = talk.until("answer", number)
    assert answer["frame"] == held["frame"]
    assert not answer["reported"]
    shown.until(lambda: shown.marked)

    number = talk.send(type="try", time=stamp, set=["clustering.min_cluster_points=100000"])
    tried = talk.until("tried", number)
    assert tried["changes"] == {"clustering.min_cluster_points": "10 -> 100000"}
    lost = tried["effects"]["lost"]
    assert lost and not tried["effects"]["added"]
    shown.until(lambda: any("clustering.min_cluster_points 10 -> 100000" in t for t in shown.texts))
    told = shown.stamp  # of a frame that may have been made before
    shown.until(lambda: shown.stamp > told + 10**9)
    talk.send(type="hold", time=shown.stamp)
    later = talk.until("held")
    assert later["frame"] > held["frame"]
    near = nearest_missed(talk, later["frame"])
    number = talk.send(type="ask", time=int(later["stamp"]), pick=near, set=[])
    assert "min_cluster_points" in json.dumps(talk.until("answer", number))
    number = talk.send(type="try", time=int(later["stamp"]), set=[])  # undone
    assert talk.until("tried", number)["effects"]["fixed"]
    number = talk.send(type="try", time=stamp, set=["clustering.eps=-1"])
    assert "must be greater than 0" in talk.until("tried", number)["text"]
    number = talk.send(type="note", time=stamp, text="", pick="")
    assert "a drive that is over" in talk.until("noted", number)["text"]
    talk.send(type="report", time=int(later["stamp"]), set=[], text="odd", before=0.5, after=0.5)
    report: dict[str, Any] = {"state": "running"}
    while report["state"] == "running":
        report = (talk.until("progress").get("reports") or [report])[-1]
    assert report["state"] == "over", report["error"]
    assert {Path(file["name"]).suffix for file in report["files"]} == {".rrd", ".html", ".mcap"}

    talk.send(type="mark", time=stamp, text="odd")
    said = talk.until("said")["text"]
    assert said == f"mark at frame {held['frame']}: odd"
    shown.until(lambda: said in shown.texts)
    talk.send(type="snap")
    saved = talk.until("said")["text"].removeprefix("saved in ")
    assert (folder / saved).stat().st_size > 100_000
    talk.send(type="dance")
    assert "cannot be understood" in talk.until("said")["text"]
    for channel in (talk, shown.channel):
        channel.close()


# --- without one --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def results() -> list[FrameResult]:
    with bevviz.simulate(frames=HELD + KEPT + 3, seed=1, set={"live.held": HELD}) as drive:
        return list(drive)


@pytest.fixture
def bench(results: list[FrameResult]) -> Iterator[RunningRobot]:
    with live_bench(results, f"live.held={HELD}") as bench:
        yield bench


@pytest.mark.long
def test_only_the_newest_frames_and_those_held_are_there(
    bench: RunningRobot, results: list[FrameResult]
) -> None:
    with pytest.raises(UserError, match="no frame has come yet"):
        bench.number_at(0)
    for result in results[:HELD]:
        bench.observe(result)
    first = bench.hold(results[1].frame.stamp)
    assert first is results[1]
    for result in results[HELD:]:
        bench.observe(result)
    assert bench.look(1) is first
    assert bench.number_at(results[-1].frame.stamp + 10**7) == results[-1].frame.index
    assert bench.number_at(first.frame.stamp) == 1
    for gone in (0, 3):  # before the kept frame, and between it and the held seconds
        with pytest.raises(UserError, match=r"that frame is gone: the last \d s can be asked about"):
            bench.number_at(results[gone].frame.stamp)
    held = [str(results[number].frame.stamp) for number in (1, -HELD)]
    assert bench.progress()["held"] == held
    with pytest.raises(UserError, match="frame 0 is gone"):
        bench.look(0)
    assert bench.hold(0) is results[-HELD], "of a viewer that lags behind the first of the held seconds"
    for result in results[-KEPT:]:
        bench.hold(result.frame.stamp)
    with pytest.raises(UserError, match="frame 1 is gone"):
        bench.look(1)
    assert len(bench._held) == KEPT and len(bench._newest) == HELD


def test_a_page_says_that_no_frame_comes(
    bench: RunningRobot, results: list[FrameResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The only LiDAR is silent: its state is a piece of the recording, at which the page learns of it."""
    news: list[str] = []
    live = bench.live
    live.log(results[0])
    assert bench.progress()["error"] == ""
    bench.news.listen(lambda: news.append(bench.progress()["error"]))
    states = {"/points": "silent", "/camera": "ok"}
    monkeypatch.setattr(live.source, "states", states, raising=False)
    monkeypatch.setattr(live, "_logged", time.monotonic() - 2)
    live._log_meanwhile()
    until(lambda: "no frame comes: /points (silent)" in news)
    live.log(results[1])
    assert bench.progress()["error"] == ""


def test_a_page_lists_the_current_problems(bench: RunningRobot) -> None:
    problems = bench.live.problems
    problems.set("silent", "/camera", "no message on /camera for 1.5 s", "/camera is back")
    problems.set("clock", "/lidar", "its clock is ahead", remedy="--set sync.by=received")
    texts = [(row["text"], row["seconds"]) for row in bench.progress()["problems"]]
    assert texts == [
        ("no message on /camera for 1.5 s", 0),
        ("its clock is ahead: --set sync.by=received", 0),
    ]
    problems.set("silent", "/camera", "")
    assert [row["text"] for row in bench.progress()["problems"]] == [texts[1][0]]
    (silent, clock) = bench.live.summary[:2]
    assert re.fullmatch(r"no message on /camera .* \(\d\d:\d\d:\d\d to \d\d:\d\d:\d\d\)", silent)
    assert re.fullmatch(r"its clock is ahead.* \(since \d\d:\d\d:\d\d\)", clock)


@pytest.mark.long
def test_a_browser_shows_begin_and_end_of_a_problem(
    results: list[FrameResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    source = Replay([result.frame for result in results], kept_drives.scene())
    live = Live(source, ReloadableConfig(None, ["detector.model=demo"]), Outputs(), Notes(lambda line: None))
    session, addresses = robot_session(live), list[str]()

    def look() -> None:
        with chromium() as browser, opened(browser, addresses[0]) as page:
            rows = page.locator("#problems li", has_text="/camera")  # replayed frames may have others
            assert not rows.count()
            live.problems.set("silent", "/camera", "no message on /camera for 1.5 s", "/camera is back")
            until(rows.count, "the problem")
            text = rows.inner_text()
            assert re.fullmatch(r"no message on /camera for 1\.5 s \(for \d+ s\)", text)
            live.problems.set("silent", "/camera", "")
            until(lambda: not rows.count(), "its end")

    with page_server(lambda: session, "live", None, addresses.append):
        run_beside(live, look)


def test_a_held_frame_can_be_asked_with_other_values(bench: RunningRobot, results: list[FrameResult]) -> None:
    for result in results[:2]:
        bench.observe(result)
    assert results[1].objects is not None and len(results[1].objects)
    assert "was reported" in WorkbenchSession(bench).ask(1, (), Selection(object=0))[0].verdict.text
    tried = bench.look(1, ("clustering.min_cluster_points=100000",))
    assert tried.objects is not None and not len(tried.objects)
    assert bench.live.config == results[1].config.model_copy(update={"live": bench.live.config.live})


NETWORK = """
from pydantic import BaseModel, Field

class Params(BaseModel):
    ahead: float = Field(12.0, description="metres")

def detect(points, params):
    return [[params.ahead, 0, 0, 4, 1.8, 1.5, 0]], [0.9], ["car"]
"""


@pytest.fixture
def bench_with_network(
    results: list[FrameResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[RunningRobot]:
    """Yield a run whose user has named a function and then our own method. A page may switch between them."""
    (tmp_path / "network.py").write_text(NETWORK)
    monkeypatch.syspath_prepend(tmp_path)
    named = ("objects.method=network:detect", "objects.method=frustum")
    with live_bench(results, f"live.held={HELD}", *named) as bench:
        yield bench


def test_the_objects_method_is_changed_there_and_back(
    bench_with_network: RunningRobot, results: list[FrameResult]
) -> None:
    """Ours, a function with parameters of its own, the robot's topic, and ours again."""
    bench = bench_with_network
    session = WorkbenchSession(bench)
    bench.observe(results[0])
    theirs = ("objects.method=network:detect", "objects.params.ahead=14", "opinions.min_height=400")
    told = session.try_values(0, theirs)
    assert told["changes"]["objects.params.ahead"] == "absent -> 14.0"
    assert told["opinions"]["unseen"] == {"before": None, "after": 1}
    assert (told["opinions"]["missed"]["after"] or 0) > 0
    assert bench.live.session.stages.objects is not None
    said = [text for _, text in bench.live.notes.take()]
    assert not [text for text in said if "absent" in text], "what comes with a method is not told one by one"
    assert "configuration: objects.method frustum -> network:detect" in said
    told = session.try_values(0, ("objects.method=topic:/nobody",))
    assert told["failures"] == ["objects: the robot published no boxes on /nobody at the time of this scan"]
    assert bench.live.config.opinions.min_height == 25 and not bench.live.config.objects.params
    with pytest.raises(UserError, match=r"start bevviz with --set objects\.method=nowhere:detect"):
        session.try_values(0, ("objects.method=nowhere:detect",))
    assert bench.live.config.objects.method == "topic:/nobody"
    told = session.try_values(0, ())
    assert not told["changes"] and not told["opinions"] and not any(asdict(told["effects"]).values())
    again = bench.live.session.run_single(results[0].frame)
    assert again.opinions is None and again.objects is not None and results[0].objects is not None
    assert again.objects.names == results[0].objects.names


def test_pages_begin_at_a_whole_frame_and_miss_none(bench: RunningRobot, results: list[FrameResult]) -> None:
    encoder: Encoder = bench.live.encoder
    recording: LiveBuffer = bench.recording
    assert recording.since(None) == ([], -1)
    packets = deque(encoder.encode(result, bench.live.scene, {}, ()) for result in results[:3])
    recording._take(packets[0], True)
    begin, number = recording.since(None)
    assert len(begin) == 3, "layout, what the frame relies on, the frame"
    assert all(piece[:4] == begin[0][:4] for piece in begin)
    recording._take(packets[1], False)
    recording.add(b"marks")
    assert recording.since(number) == ([encoder.header + packets[1].data, b"marks"], number + 2)
    for _ in range(WHOLE + 1):
        recording._take(packets[0], False)
    again, following = recording.since(0)
    assert len(again) == 2, "what was missed is not made up for: a whole frame, and what it relies on"
    assert recording.since(following) == ([], following)
