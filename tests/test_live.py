"""The live runtime: what it keeps up with, what it drops, what it leaves behind, and how it ends."""

from __future__ import annotations

import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rerun.chunk import RrdReader

from bevviz.anomalies import AnomalyDetector
from bevviz.config import load
from bevviz.config.reloading import ReloadableConfig
from bevviz.errors import UserError
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.extras.demo.sensors import Lidar, PinholeCamera
from bevviz.live.encoder import WHOLE, Encoder, Packet
from bevviz.live.files import RecordingSaver, unused_names
from bevviz.live.flight_recorder import FlightRecorder, Triggers
from bevviz.live.indexing import INDEX, Indexer, add_index, remove_leftovers
from bevviz.live.outputs import RETRY, Program, Viewer
from bevviz.live.run_outputs import Outputs
from bevviz.live.runtime import Live
from bevviz.live.source_wrappers import thin, thinned
from bevviz.live.status import Notes
from bevviz.model.frame import Frame, Scene, UserMark
from bevviz.model.results import (
    CameraResult,
    Decision,
    Detections,
    FrameResult,
    Fusion,
    Pairs,
)
from bevviz.pipeline.session import Session
from bevviz.recording import blueprints
from bevviz.support.files import lock_file
from bevviz.support.queues import NewestQueue
from tests.support.live_sessions import CalledReceiver, run_beside
from tests.support.recordings import Recording, verify
from tests.support.replay import Replay
from tests.support.waiting import until

Run = Callable[..., "Outcome"]


@pytest.fixture(scope="module")
def drive() -> SyntheticSource:
    """Small sensors: the tests are about the runtime."""
    return SyntheticSource(
        frames=8, lidar=Lidar(beams=16, azimuths=360), camera=PinholeCamera(width=64, height=36, focal=44.0)
    )


@pytest.fixture(scope="module")
def frames(drive: SyntheticSource) -> list[Frame]:
    return list(drive)


class Paced(Replay):
    """Plays each frame when the one before it is through: nothing is left out on a slow machine, too."""

    def __init__(self, frames: Sequence[Frame], scene: Scene, total: int | None = None) -> None:
        super().__init__(frames, scene, rate=1000.0, total=total)
        self.through: Callable[[], int] = lambda: 0  # frames

    def __iter__(self) -> Iterator[Frame]:
        for frame in super().__iter__():
            while self.through() < frame.index and not self._stopped.wait(0.002):
                pass
            yield frame


class NoIndexer(Indexer):
    """Files stay as they are written: the index is made with what time others leave."""

    def add(self, path: Path) -> None:
        pass


class Outcome:
    """What a run said, counted and logged."""

    def __init__(self, live: Live, said: list[str]) -> None:
        self.live, self.said = live, said

    def told(self, text: str) -> list[str]:
        return [line for line in self.said if text in line]


@pytest.fixture
def run(frames: list[Frame], drive: SyntheticSource, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Plays the drive into a live run, with ``during(live)`` in a thread beside it.

    At a rate, which a slow machine does not keep up with, or else as fast as it can.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))

    def play(
        settings: Sequence[str] = (),
        *,
        total: int | None = 30,
        rate: float | None = None,
        during: Callable[[Live], None] | None = None,
        config: Path | None = None,
        source: Any = None,
        observe: bool = False,
        on_result: Callable[[FrameResult], None] | None = None,
        said: list[str] | None = None,
        **outputs: Any,
    ) -> Outcome:
        monkeypatch.setattr("bevviz.live.run_outputs.Indexer", NoIndexer)
        said = [] if said is None else said
        if source is None and rate is not None:
            source = Replay(frames, drive.scene, rate=rate, total=total)
        source = source or Paced(frames, drive.scene, total)
        source.problems.tell = (notes := Notes(said.append)).warn
        live = Live(
            source,
            ReloadableConfig(config, settings),
            Outputs(**outputs),
            notes,
            observe=observe,
        )
        if on_result is not None:
            live.receivers.append(CalledReceiver(on_result))
        paced = source.replay if isinstance(source, Stalled) else source
        if isinstance(paced, Paced):
            paced.through = lambda: live.frames

        def beside() -> None:
            until(lambda: live.frames > 0)
            assert during is not None
            during(live)

        if during is None:
            live.run()
        else:
            run_beside(live, beside)
        return Outcome(live, said)

    return play


def numbers(path: Path) -> list[int]:
    """Of the frames in a recording."""
    return shown(Recording(path))


def shown(recording: Recording) -> list[int]:
    return sorted(row["frame"] for row in recording.rows["/explain"])


# --- never behind ------------------------------------------------------------------------------


@given(st.lists(st.booleans()), st.integers(1, 4))
def test_a_queue_returns_the_newest_items_and_counts_drops(moves: list[bool], size: int) -> None:
    queue: NewestQueue[int] = NewestQueue(size)
    items = iter(queue)
    waiting: list[int] = []
    taken = 0
    for number, put in enumerate(moves):
        if put:
            queue.put(number)
            waiting = [*waiting, number][-size:]
        elif waiting:
            assert next(items) == waiting.pop(0)
            taken += 1
        assert len(queue) == len(waiting)
    queue.close()
    assert list(items) == waiting
    assert queue.dropped == sum(moves) - taken - len(waiting)


def test_simultaneous_scans_wait_and_slow_runs_get_the_newest() -> None:
    queue: NewestQueue[int] = NewestQueue(3, catch_up=True)
    items = iter(queue)
    for number in range(0, 10, 2):  # pairs, for one who is quick
        queue.put(number)
        queue.put(number + 1)
        assert (next(items), next(items)) == (number, number + 1)
    for number in range(10, 40, 3):  # three, all there before the first is taken
        for i in range(3):
            queue.put(number + i)
        assert [next(items) for _ in range(3)] == [number, number + 1, number + 2]
    assert queue.dropped == 0
    taken = []
    for number in range(40, 70):  # three come while one is worked on
        queue.put(number)
        if number % 3 == 0:
            taken.append(next(items))
    assert taken[1:] == [45, 48, 51, 54, 57, 60, 63, 66, 69][-len(taken[1:]) :] and len(taken) == 10
    assert queue.dropped == 30 - len(taken) - len(queue)


@pytest.mark.long
def test_a_slow_pipeline_takes_the_newest_frame(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = Session.perceive

    def slow(self: Session, frame: Frame, network: Any = None) -> FrameResult:
        time.sleep(0.2)
        return whole(self, frame, network)

    monkeypatch.setattr(Session, "perceive", slow)
    outcome = run(total=40, rate=40, save=Path("out.rrd"))
    drops = outcome.live.drops
    logged = numbers(Path("out.rrd"))
    assert drops["incoming"] > 20
    assert len(logged) + sum(drops.values()) == 40
    assert logged[-1] == 39
    health = Recording(Path("out.rrd")).column("/health/drops/incoming", "Scalars:scalars")
    assert 0 < health[-1][0] <= drops["incoming"]


def test_a_slow_log_drops_results_and_holds_nobody_up(
    run: Run, frames: list[Frame], drive: SyntheticSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, free = Live.log, threading.Event()

    def slow(self: Live, result: FrameResult) -> None:
        assert free.wait(180)
        whole(self, result)

    class Published(Paced):
        """Comes as fast as the results are published."""

        def __iter__(self) -> Iterator[Frame]:
            self.through = lambda: len(seen)
            return super().__iter__()

    def publish(result: FrameResult) -> None:
        seen.append(result.frame.index)
        if len(seen) == 40:
            free.set()

    monkeypatch.setattr(Live, "log", slow)
    seen: list[int] = []
    source = Published(frames, drive.scene, 40)
    outcome = run(["live.log_queue=3"], source=source, on_result=publish, save=Path("out.rrd"))
    assert seen == list(range(40)), "nobody else waits for the log"
    logged, drops = numbers(Path("out.rrd")), outcome.live.drops
    assert logged[-3:] == [37, 38, 39] and 3 <= len(logged) <= 4
    assert drops["logging"] == sum(drops.values()) == 40 - len(logged)


class Unread:
    """A viewer's program that reads only while it is let."""

    def __init__(self) -> None:
        self.read, self.write = os.pipe()
        self.let = threading.Event()
        self.got = 0  # bytes
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self) -> None:
        self.let.wait()
        while data := os.read(self.read, 1 << 20):
            self.got += len(data)


def test_a_slow_viewer_gets_the_newest_and_its_lag_is_known(
    results: list[FrameResult], drive: SyntheticSource
) -> None:
    program = Unread()

    class Screen(Viewer):
        def _start(self) -> Any:
            process = subprocess.Popen(["sleep", "1000"])
            process.stdin = os.fdopen(program.write, "wb")
            return process

        def _show(self, packet: Packet, fresh: bool) -> bool:
            done = super()._show(packet, fresh)
            taken.extend([packet.context.clock[0]] * done)
            return done

    taken: list[int] = []
    clock = Clock()
    with closing(Encoder(load(), drive.scene, "live", clock=clock)) as encoder:
        screen = Screen(Program("screen", ["sleep"]), 20, encoder, Notes(lambda text: None))

        def log(*indices: int) -> None:
            for index in indices:
                result = results[index % len(results)]
                frame = replace(result.frame, index=index, stamp=100_000_000 * (index + 1))
                clock.now = 1000.0 + PERIOD * index
                screen.put(encoder.encode(replace(result, frame=frame), drive.scene, {}, ()))

        log(*range(25))
        assert screen.lag == pytest.approx(2.4)
        program.let.set()
        until(lambda: screen._sending is None and not len(screen._packets))
        assert screen.lag < PERIOD * 6
        screen.close(180.0)
    program.thread.join()
    assert taken[-5:] == [20, 21, 22, 23, 24], "from the newest whole one on"
    assert len(taken) == 25 - screen.dropped <= 6 and program.got


class Stalled(Replay):
    """Plays a replay, then only says how its topics do."""

    def __init__(self, replay: Replay) -> None:
        self.replay, self._over = replay, threading.Event()
        self.scene, self.total, self.warnings = replay.scene, None, ()
        self.problems, self.raw = replay.problems, replay.raw
        self.states = {"/points": "ok"}

    def stop(self) -> None:
        self._over.set()

    def __iter__(self) -> Iterator[Frame]:
        yield from self.replay
        self._over.wait()


@pytest.mark.long
def test_what_is_said_while_no_frame_comes_is_logged(
    run: Run, frames: list[Frame], drive: SyntheticSource
) -> None:
    source = Stalled(Paced(frames, drive.scene, 3))

    def stall(live: Live) -> None:
        until(lambda: live.frames == 3)
        source.states = {"/points": "silent"}
        live.notes.warn("no cloud for 2 s on /points")
        until(lambda: not live.notes._waiting)
        live.stop()

    run(source=source, during=stall, save=Path("out.rrd"))
    recording = Recording(Path("out.rrd"))
    lanes = recording.rows["/explain/states/topics/points"]
    assert list(dict.fromkeys(row["StateChange:state"][0] for row in lanes)) == ["ok", "silent"]
    said = ["no cloud for 2 s on /points"]
    (line,) = (row for row in recording.rows["/explain/log"] if row["TextLog:text"] == said)
    last = recording.rows["/explain"][-1]
    assert line["frame"] == last["frame"]
    assert line["stamp"] - last["stamp"] == line["received"] - last["received"] > 900_000_000


class Clock:
    """That a test turns."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


PERIOD = 0.1  # seconds between two packets


@pytest.fixture(scope="module")
def results(frames: list[Frame]) -> list[FrameResult]:
    session = Session(load())
    return [session.run(frame) for frame in frames]


@contextmanager
def packets_of(
    results: list[FrameResult], scene: Scene, count: int, whole: float = WHOLE
) -> Iterator[tuple[Encoder, list[Packet]]]:
    """Of as many frames, made every 0.1 s."""
    clock, packets = Clock(), []
    with closing(Encoder(load(), scene, "live", whole=whole, clock=clock)) as encoder:
        for index in range(count):
            result = results[index % len(results)]
            frame = replace(result.frame, index=index, stamp=round(PERIOD * 1e9) * (index + 1))
            packets.append(encoder.encode(replace(result, frame=frame), scene, {}, ()))
            clock.now += PERIOD
        yield encoder, packets


def test_viewers_can_be_given_fewer_frames_than_files(
    results: list[FrameResult], drive: SyntheticSource
) -> None:
    taken: list[int] = []

    class Screen(Viewer):
        def _start(self) -> Any:
            return subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)

        def _take(self, packet: Packet, fresh: bool) -> bool:
            taken.append(packet.context.clock[0])
            return super()._take(packet, fresh)

    with packets_of(results, drive.scene, 12, whole=0.35) as (encoder, packets):
        screen = Screen(Program("screen", ["cat"]), 20, encoder, Notes(lambda text: None), sparse=True)
        for packet in packets:
            screen.put(packet)
        screen.close(60.0)
    assert taken == [0, 4, 8]
    assert [packet.context.clock[0] for packet in packets if packet.whole] == taken
    assert screen.dropped == 0  # they were not wanted


def test_leftover_indexes_are_removed_and_those_in_work_are_not(tmp_path: Path) -> None:
    left, work = tmp_path / f"a{INDEX}0123abcd", tmp_path / f"b{INDEX}0123abcd"
    left.write_bytes(b"half")
    download = tmp_path / "a.rrd.part"  # as browsers name what is on its way
    download.write_bytes(b"half")
    with work.open("wb") as file:
        lock_file(file.fileno(), "taken")
        remove_leftovers(tmp_path)
    assert not left.exists() and work.exists() and download.exists()


def test_a_steady_run_logs_every_frame_with_its_health(run: Run) -> None:
    outcome = run(total=30, save=Path("out.rrd"))
    add_index(Path("out.rrd"))
    recording = Recording(Path("out.rrd"))
    assert numbers(Path("out.rrd")) == list(range(30)) and sum(outcome.live.drops.values()) == 0
    with pytest.raises(RuntimeError, match="after shutdown"):
        outcome.live.session._sensors.worker.submit(print)
    p50 = [v[0] for v in recording.column("/health/latency_ms/p50", "Scalars:scalars")]
    p99 = [v[0] for v in recording.column("/health/latency_ms/p99", "Scalars:scalars")]
    assert all(0 < a <= b for a, b in zip(p50, p99, strict=True))
    assert recording.column("/health/process/memory_mb", "Scalars:scalars")[-1][0] > 50
    assert recording.column("/health/process/cpu_percent", "Scalars:scalars")[-1][0] > 0
    verify(Path("out.rrd"))


def test_thinning_reduces_frames_and_data(frames: list[Frame], drive: SyntheticSource) -> None:
    clock = Clock()

    class Scans(Replay):
        """20 a second."""

        def __iter__(self) -> Iterator[Frame]:
            for frame in super().__iter__():
                clock.now = 1000.0 + 0.05 * frame.index
                yield frame

    def left(setting: str) -> list[Frame]:
        config = load(settings=[setting])
        return list(thinned(Scans(frames, drive.scene, rate=1e6, total=40), lambda: config, clock))

    assert [frame.index for frame in left("live.every=3")] == list(range(0, 40, 3))
    slower = [frame.index for frame in left("live.max_rate=5")]
    assert 8 <= len(slower) <= 12 and set(np.diff(slower[3:])) == {4}
    assert {len(frame.points) for frame in left("live.points=500")} == {500}


@given(st.integers(0, 300), st.integers(0, 300), st.integers(1, 400))
def test_thinned_frames_are_consistent(first: int, second: int, points: int) -> None:
    frame = merged(first, second)
    thinned = thin(frame, points)
    assert len(thinned.points) == min(points, first + second)
    assert len(np.unique(thinned.points[:, 0])) == len(thinned.points)
    np.testing.assert_array_equal(thinned.points, np.concatenate([cloud.xyz for cloud in thinned.clouds]))
    np.testing.assert_array_equal(thinned.fields["ring"], thinned.points[:, 0])
    for cloud in thinned.clouds:
        np.testing.assert_array_equal(cloud.fields["ring"], cloud.xyz[:, 0])


def merged(first: int, second: int) -> Frame:
    """Make a frame of two LiDARs whose points are numbered."""
    from bevviz.model.frame import Cloud

    number = np.arange(first + second, dtype=np.float32)
    points = np.repeat(number[:, None], 3, 1)
    parts = (slice(0, first), slice(first, None))
    clouds = tuple(Cloud(0, "l", points[p], {"ring": number[p]}) for p in parts)
    return Frame(0, 0, 0, "lidars", points, "base_link", {"ring": number}, clouds=clouds)


def test_observing_logs_only_what_the_robot_publishes(
    run: Run, frames: list[Frame], drive: SyntheticSource
) -> None:
    robot = [
        replace(f, robot_boxes=(replace(f.truth, topic="/detection/fused_3d"),)) for f in frames if f.truth
    ]
    run(source=Paced(robot, drive.scene, 6), observe=True, save=Path("out.rrd"))
    logged = Recording(Path("out.rrd")).at
    assert {"/world/rslidar/points", "/world/zed/image", "/robot/detection/fused_3d"} <= set(logged)
    assert not {"/bev", "/world/rslidar/clusters", "/world/fused", "/world/rslidar/points/ground"} & set(
        logged
    )


def test_a_subscriber_that_fails_is_said_once(run: Run) -> None:
    def fail(result: FrameResult) -> None:
        raise ValueError("no network")

    outcome = run(total=10, on_result=fail)
    assert len(outcome.told("results cannot be published: ValueError: no network")) == 1
    assert outcome.live.frames > 0


def test_a_mark_outlives_its_frame(run: Run, frames: list[Frame], drive: SyntheticSource) -> None:
    class Marked(Paced):
        waiting: Sequence[UserMark] = (
            UserMark("a person", 1, 0),
            UserMark("a van", 3, 0),
            UserMark("never", 9, 0),
        )

        def marks(self, index: int) -> tuple[UserMark, ...]:
            """As of a source that has left out the frames 1 to 3 in front of the fourth."""
            found = tuple(mark for mark in self.waiting if mark.index <= index and index >= 4)
            self.waiting = [mark for mark in self.waiting if mark not in found]
            return found

        def __iter__(self) -> Iterator[Frame]:
            yield from (replace(frame, stamp=10**9 * frame.index) for frame in super().__iter__())

    run(source=Marked(frames, drive.scene, 6), save=Path("out.rrd"))
    recording = Recording(Path("out.rrd"))
    rows = recording.rows["/explain/log"]
    told = [(row["frame"], text) for row in rows for text in row["TextLog:text"] or () if "mark" in text]
    assert told == [(4, f"mark: {what} (4.00 s before this frame)") for what in ("a person", "a van")]
    lane = recording.at["/explain/states/marks"]["StateChange:state"]
    marked = {number: value[0] for number, value in lane.items() if value[0]}
    assert list(marked) == [4] and "a person (4.00 s before this frame)" in marked[4]


# --- the flight recorder -----------------------------------------------------------------------


@pytest.mark.long
def test_the_flight_recorder_holds_the_last_seconds(
    results: list[FrameResult], drive: SyntheticSource, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def index(command: Sequence[str], stdin: int) -> Any:
        """Do what the process of lowest priority does, which a busy machine gives no time."""
        assert list(command[:6]) == ["nice", "-n", "19", sys.executable, "-P", "-m"] and stdin
        for name in command[7:]:
            add_index(Path(name))
        return SimpleNamespace(poll=lambda: 0)

    monkeypatch.setattr("bevviz.live.indexing.rerun_cli.spawn", index)
    settings = ReloadableConfig(None, ["live.flight_time=2 s", f"live.flight_folder={tmp_path}"])
    with packets_of(results, drive.scene, 80) as (encoder, packets):
        flight = FlightRecorder(settings, encoder, Indexer(), Notes(lambda text: None))
        for packet in packets:
            flight.put(packet)
        saved = [flight.save(), flight.save(tmp_path / "second.rrd")]
        with pytest.raises(UserError, match="already there"):
            flight.save(tmp_path / "second.rrd")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in saved)
    verify(saved[0])
    for path in saved:
        recording = Recording(path)
        assert numbers(path) == list(range(60, 80)), "from the first whole one on"
        assert recording.blueprints == 1
        assert "TextDocument:text" in recording.static["/config"]
        assert "Pinhole:image_from_camera" in recording.static["/world/zed"]
        assert min(recording.at["/explain/states/pipeline"]["StateChange:state"]) == 60


def test_a_snapshot_has_its_name_when_it_is_complete(
    results: list[FrameResult], drive: SyntheticSource, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names: list[str] = []

    def full(handle: int, data: bytes) -> None:
        names.extend(path.name for path in tmp_path.iterdir())
        raise OSError(28, "No space left on device")

    with packets_of(results, drive.scene, 4) as (encoder, packets):
        flight = FlightRecorder(ReloadableConfig(), encoder, Indexer(), Notes(lambda text: None))
        for packet in packets:
            flight.put(packet)
        monkeypatch.setattr("bevviz.live.flight_recorder.write_all", full)
        with pytest.raises(UserError, match="cannot be saved: No space left on device"):
            flight.save(tmp_path / "a.rrd")
    assert [name.startswith("a.partial-") for name in names] == [True]
    assert not list(tmp_path.iterdir())


def test_the_flight_recorder_is_bounded_in_memory(results: list[FrameResult], drive: SyntheticSource) -> None:
    sizes: list[int] = []
    settings = ReloadableConfig(None, ["live.flight_time=1000", "live.flight_size=1 MB"])
    with packets_of(results, drive.scene, 80) as (encoder, packets):
        flight = FlightRecorder(settings, encoder, NoIndexer(), Notes(lambda text: None))
        for packet in packets:
            flight.put(packet)
            sizes.append(flight.size)
            assert flight.size == sum(len(held.data) for held in flight.packets())
    assert 500_000 < max(sizes) <= 1_000_000 < sum(len(packet.data) for packet in packets)


def test_saving_without_frames_is_refused(run: Run) -> None:
    def during(live: Live) -> None:
        with pytest.raises(UserError, match="flight_time is 0"):
            live.flight.save()

    run(["live.flight_time=0"], total=10, during=during)


def test_an_empty_buffer_writes_no_bytes(frames: list[Frame], drive: SyntheticSource) -> None:
    config = load()
    with closing(Encoder(config, drive.scene, "live")) as encoder:
        first = encoder.encode(FrameResult.unprocessed(frames[0], config), drive.scene, {}, [])
        assert encoder._stream.read() == b"" == encoder._stream.read()
        second = encoder.encode(FrameResult.unprocessed(frames[1], config), drive.scene, {}, [])
        assert len(first.data) > 1000 < len(second.data) and second.data.strip(b"\0")


def test_a_recording_may_start_at_any_whole_packet(
    frames: list[Frame], drive: SyntheticSource, tmp_path: Path
) -> None:
    """What an entity had before the cut is not left standing, and states are known from the first frame."""
    config = load()
    clock = Clock()
    encoder = Encoder(config, drive.scene, "live", clock=clock)
    session = Session(config)
    full = session.run(frames[0])
    gone = replace(full, frame=replace(frames[1], index=1), clusters=None, obstacles=None)
    packets = [encoder.encode(full, drive.scene, {}, ())]
    clock.now += WHOLE
    packets += [encoder.encode(gone, drive.scene, {}, [("WARN", "something was said")])]
    path = tmp_path / "late.rrd"
    path.write_bytes(encoder.prelude(packets[1].context) + packets[1].data)
    encoder.close()
    assert [p.whole for p in packets] == [True, True]
    application = blueprints.application_id("live", drive.scene, config)
    assert {store.application_id for store in RrdReader(path).recordings()} == {application}
    styled = {chunk.entity_path for chunk in RrdReader(path).stream() if chunk.is_static}
    assert {"/world/rslidar/points/ground", "/anomalies/count"} < styled
    recording = Recording(path)
    assert recording.cleared("/world/rslidar/clusters") == {1}
    assert recording.column("/world/zed/image", "EncodedImage:blob")
    assert ["something was said"] in recording.column("/explain/log", "TextLog:text")
    assert recording.column("/explain/states/pipeline", "StateChange:state") == [["no detector"]]


# --- triggers ----------------------------------------------------------------------------------


def result_of(frame: Frame, *decisions: Decision, total: float = 0.05) -> FrameResult:
    """Make a frame with one detected pedestrian for each decision."""
    n = len(decisions)
    none = np.zeros(n, np.int32)
    found = Detections(
        np.tile(np.array([10, 10, 30, 50], np.float32), (n, 1)),
        np.ones(n, np.float32),
        none,
        ("pedestrian",) * n,
        none,
        none - 1,
        none * 1.0,
    )
    pairs = Pairs(*(np.zeros(0, np.int32),) * 3, *(np.zeros(0, np.float32),) * 4)
    nowhere = np.zeros((0, 4), np.float32)
    fusion = Fusion(np.array(decisions, np.int32), none - 1, none, none[:0], none[:0], pairs, nowhere)
    cameras = tuple(CameraResult(camera, found, fusion) for camera in frame.cameras)
    return replace(FrameResult.unprocessed(frame, load(), cameras), timings={"total": total})


def triggers(*settings: str) -> Callable[[FrameResult], str | None]:
    """Return a function that returns what the triggers report for a result."""
    config = load(settings=["live.trigger_pause=0", *settings])
    watch, detector = Triggers(), AnomalyDetector()

    def check(result: FrameResult) -> str | None:
        anomalies = detector.update(result, config.anomalies)
        return watch.check(replace(result, anomalies=anomalies, config=config))

    return check


def test_an_unmatched_detection_triggers(frames: list[Frame], monkeypatch: pytest.MonkeyPatch) -> None:
    watch = triggers("live.triggers=[one_sensor]", "anomalies.alone_frames=3")
    alone, matched = result_of(frames[0], Decision.NO_CLUSTER), result_of(frames[0], Decision.MATCHED)
    monkeypatch.setattr("bevviz.anomalies.detector._seen_through", lambda *_: True)
    said = [watch(r) for r in [alone, alone, matched, alone, alone, alone, alone]]
    assert said == [None] * 5 + ["zed: pedestrian 1.00, for 3 frames", None]


def test_a_slow_stage_triggers(frames: list[Frame]) -> None:
    watch = triggers("live.triggers=[stage]", "anomalies.stage_time=100 ms")
    assert watch(result_of(frames[0], total=0.09)) is None
    assert watch(result_of(frames[0], total=0.15)) == "total took 150 ms"


def test_a_lost_transform_triggers(frames: list[Frame]) -> None:
    watch = triggers("live.triggers=[tf]")
    (camera,) = frames[0].cameras
    lost = replace(frames[0], cameras=(replace(camera, camera_from_points=None),))
    said = [watch(result_of(f)) for f in (lost, frames[0], lost, lost, frames[0])]
    assert said == [None, None, "the transform of zed is lost", None, None]


def test_a_large_sync_error_triggers(frames: list[Frame]) -> None:
    watch = triggers("live.triggers=[sync]")
    (camera,) = frames[0].cameras
    late = replace(frames[0], cameras=(replace(camera, sync_error=-0.06),))
    assert watch(result_of(frames[0])) is None
    assert watch(result_of(late)) == "zed is -60 ms off the cloud"


def test_only_what_was_asked_for_triggers(frames: list[Frame]) -> None:
    watch = triggers("live.triggers=[sync, tf]", "anomalies.stage_time=1 ms")
    assert watch(result_of(frames[0])) is None


def test_a_trigger_pauses_after_it_fired(frames: list[Frame]) -> None:
    watch = triggers(
        "live.triggers=[stage]", "live.trigger_pause=1000", "anomalies.stage_time=1 ms", "anomalies.hold=0"
    )
    later = replace(frames[0], stamp=frames[0].stamp + 10**9)
    results = [result_of(frames[0]), result_of(frames[0], total=0.0), result_of(later)]
    assert [bool(watch(r)) for r in results] == [True, False, False]


@pytest.mark.long
def test_a_trigger_saves_the_last_seconds(run: Run) -> None:
    asked = ["live.triggers=[stage]", "anomalies.stage_time=1 us", "live.flight_folder=flights"]
    outcome = run(asked, total=20)
    assert len(outcome.told("not saved")) == 1  # no such folder: said, and everything goes on
    Path("flights").mkdir()
    outcome = run(asked, total=20)
    (saved,) = Path("flights").glob("*.rrd")
    assert len(outcome.told(f"saved in {saved} (")) == 1
    assert numbers(saved)


# --- files -------------------------------------------------------------------------------------


def save(path: Path, encoder: Encoder, packets: list[Packet], *settings: str) -> list[Path]:
    """Save the packets and return the files that they are saved in."""
    config = load(settings=[f"live.output_queue={len(packets)}", *settings]).live
    saver = RecordingSaver(path, config, encoder, NoIndexer(), Notes(lambda text: None))
    for packet in packets:
        saver.put(packet)
    saver.close()
    assert saver.paths == sorted(path.parent.glob(f"{path.stem}_*.rrd"))
    return saver.paths


def test_without_a_frame_there_is_no_file(results: list[FrameResult], drive: SyntheticSource) -> None:
    said: list[str] = []
    config = load()
    saver = RecordingSaver(
        Path("none.rrd"), config.live, Encoder(config, drive.scene, "live"), NoIndexer(), Notes(said.append)
    )
    assert Path("none.rrd").exists()
    saver.close()
    assert not Path("none.rrd").exists() and saver.paths == []
    assert said == ["none.rrd: no frame came, so there is no recording"]


@pytest.mark.long
def test_parts_open_on_their_own_and_lack_nothing_together(
    results: list[FrameResult], drive: SyntheticSource, tmp_path: Path
) -> None:
    with packets_of(results, drive.scene, 50) as (encoder, packets):
        parts = save(tmp_path / "drive.rrd", encoder, packets, "live.split_time=2 s")
        small = save(tmp_path / "small.rrd", encoder, packets, "live.split_size=6 MB")
    assert [numbers(part) for part in parts] == [[*range(20)], [*range(20, 40)], [*range(40, 50)]]
    for part in parts:
        recording = Recording(part)
        assert recording.blueprints == 1
        assert "Pinhole:image_from_camera" in recording.static["/world/zed"]
        assert "StateChange:state" in recording.at["/explain/states/pipeline"]
    assert len(small) > 1 and max(part.stat().st_size for part in small) < 6_600_000
    assert [number for part in small for number in numbers(part)] == list(range(50))


def test_a_run_is_saved_in_parts(run: Run) -> None:
    outcome = run(["live.split_time=1 s"], total=5, save=Path("drive.rrd"))
    (parts,) = outcome.live.outputs.saved
    assert parts == sorted(Path().glob("drive_*.rrd"))
    assert [number for part in parts for number in numbers(part)] == list(range(5))


@pytest.mark.long
def test_a_full_disk_is_said_once_and_nothing_else_ends(run: Run) -> None:
    Path("full.rrd").symlink_to("/dev/full")
    saved: list[Path] = []

    def during(live: Live) -> None:
        until(lambda: live.frames > 10)
        saved.append(live.flight.save())
        live.stop()

    outcome = run(total=None, save=Path("full.rrd"), during=during)
    assert len(outcome.told("saving ends here, the rest goes on: No space left on device")) == 1
    assert outcome.live.frames > 10
    assert len(numbers(saved[0])) >= 10


@contextmanager
def file_limit(size: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_what_was_written_before_the_disk_was_full_is_readable(
    frames: list[Frame], drive: SyntheticSource, tmp_path: Path
) -> None:
    config = load()
    encoder = Encoder(config, drive.scene, "live")
    session = Session(config)
    packets = [encoder.encode(session.run(frame), drive.scene, {}, ()) for frame in frames]
    size = len(encoder.prelude(packets[0].context)) + sum(len(p.data) for p in packets[:3])
    said: list[str] = []
    path = tmp_path / "out.rrd"
    saver = RecordingSaver(path, config.live, encoder, NoIndexer(), Notes(said.append))
    with file_limit(size + len(packets[3].data) // 2):
        for packet in packets:
            saver.put(packet)
        saver.close()
    encoder.close()
    assert len(said) == 1
    assert numbers(path) == [0, 1, 2]


def test_an_output_that_is_no_recording_is_refused(run: Run) -> None:
    with pytest.raises(UserError, match="expected a file name that ends in"):
        run(save=Path("drive.mcap"))


# --- changes while it runs -----------------------------------------------------------------------


@pytest.mark.long
def test_the_configuration_is_reloaded_when_it_is_saved(run: Run) -> None:
    file = Path("c.yaml")
    file.write_text("clustering: {eps: 0.5}\n")
    applied: list[float] = []
    said: list[str] = []

    def during(live: Live) -> None:
        live.followers.append(lambda config: applied.append(config.clustering.eps))
        file.write_text("clustering: {eps: 0.75}\n")
        until(lambda: live.config.clustering.eps == 0.75)
        before = live.frames
        until(lambda: live.frames > before + 2)
        file.write_text("clustering: {eps: -1}\n")
        until(lambda: any("stays as it was" in line for line in said))
        assert live.config.clustering.eps == 0.75
        live.stop()

    outcome = run(total=None, config=file, during=during, said=said, save=Path("out.rrd"))
    assert outcome.told("configuration: clustering.eps 0.5 -> 0.75")
    assert len(outcome.told("clustering.eps")) == 2
    (refused,) = outcome.told("stays as it was")
    assert "c.yaml: clustering.eps must be greater than 0" in refused
    assert applied == [0.75]
    recording = Recording(Path("out.rrd"))
    assert "eps: 0.75" in recording.static["/config"]["TextDocument:text"][0]
    log = [line for lines in recording.column("/explain/log", "TextLog:text") for line in lines]
    assert any("clustering.eps 0.5 -> 0.75" in line for line in log)


def test_parameters_can_be_set_during_a_run(run: Run) -> None:
    def during(live: Live) -> None:
        live.settings.take(["range_x=12", "voxel_size=20 cm", "live.nice=1"])
        assert (live.config.bev.range_x, live.config.voxel.size) == (12, 0.2)
        with pytest.raises(UserError, match="range_x"):
            live.settings.take(["voxel_size=30 cm", "range_x=-1"])
        assert live.config.voxel.size == 0.2
        live.settings.take(["source.base_frame=base"])
        frames = live.frames
        until(lambda: live.frames > frames + 2)
        assert os.getpriority(os.PRIO_PROCESS, 0) == 1
        live.stop()

    before = os.getpriority(os.PRIO_PROCESS, 0)
    try:
        outcome = run(total=None, during=during, save=Path("out.rrd"))
    finally:
        if os.getuid() == 0:
            os.setpriority(os.PRIO_PROCESS, 0, before)
    assert outcome.told("bev.range_x 40.0 -> 12.0")
    assert outcome.told("source.base_frame base_link -> base; takes effect at the next start")
    assert "range_x: 12.0" in Recording(Path("out.rrd")).static["/config"]["TextDocument:text"][0]


def test_a_late_sensor_is_used(run: Run, frames: list[Frame], drive: SyntheticSource) -> None:
    class Late(Paced):
        def __iter__(self) -> Iterator[Frame]:
            for frame in super().__iter__():
                if frame.index == 10:
                    self.scene = drive.scene
                yield frame if frame.index >= 10 else replace(frame, cameras=())

    lidar_only = Scene(drive.scene.name, drive.scene.lidar, drive.scene.lidars)
    run(source=Late(frames, lidar_only, 12), save=Path("out.rrd"))
    recording = Recording(Path("out.rrd"))
    assert "Pinhole:image_from_camera" in recording.static["/world/zed"]
    assert "AnnotationContext:context" in recording.static["/world/zed/image/points"]


# --- viewers -----------------------------------------------------------------------------------


def rerun(*arguments: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "rerun", *arguments]
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )


def end(process: subprocess.Popen[bytes], number: int = signal.SIGKILL) -> None:
    """And the children of ``python -m rerun``."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, number)
    if number == signal.SIGKILL:
        process.wait()


def listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), 1).close()
    except OSError:
        return False
    return True


def a_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def received(port: int, path: Path, enough: Callable[[Recording], object]) -> Recording:
    """Return the recording that a viewer gets if it connects now."""
    for seconds in (2, 4, 8, 16, 32):
        late = rerun(f"rerun+http://127.0.0.1:{port}/proxy", "--save", str(path), "--port", str(a_port()))
        time.sleep(seconds)
        end(late, signal.SIGTERM)
        late.wait(60)
        if path.exists() and path.stat().st_size:
            try:
                recording = Recording(path)
            except RuntimeError:  # ended while it wrote
                continue
            if enough(recording):
                return recording
    raise AssertionError("it was sent nothing, or not enough")


@pytest.mark.long
def test_a_late_viewer_sees_the_static_data_and_the_recent_past(
    run: Run, frames: list[Frame], drive: SyntheticSource
) -> None:
    found: list[Recording] = []
    port = a_port()

    def during(live: Live) -> None:
        (url,) = live.outputs.urls
        assert url.startswith(f"http://localhost:{port}/?url=")
        until(lambda: listens(port))
        until(lambda: live.frames == 30)
        data_port = int(url.rpartition("localhost%3A")[2].partition("%2F")[0])
        found.append(received(data_port, Path("late.rrd"), lambda r: shown(r)[-1:] == [29]))
        live.stop()

    class Later(Stalled):
        def __iter__(self) -> Iterator[Frame]:
            until(lambda: listens(port))
            yield from super().__iter__()

    run(["live.output_queue=1000"], source=Later(Paced(frames, drive.scene, 30)), during=during, serve=port)
    (recording,) = found
    assert shown(recording) == list(range(shown(recording)[0], 30)) and len(shown(recording)) > 1
    assert recording.blueprints == 1
    assert "TextDocument:text" in recording.static["/config"]
    assert not listens(port)


def test_a_viewer_that_dies_is_started_again(
    results: list[FrameResult], drive: SyntheticSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bevviz.live.outputs.RETRY", 0.01)
    said: list[str] = []
    with packets_of(results, drive.scene, 1) as (encoder, packets):
        program = Program("screen", ["sh", "-c", "exec cat > /dev/null"])
        screen = Viewer(program, 20, encoder, Notes(said.append))
        first = screen._process
        first.kill()

        def told(text: str) -> bool:
            screen.put(packets[0])
            return any(text in line for line in said)

        until(lambda: told("the screen viewer is gone"))
        until(lambda: told("the screen viewer is back"))
        assert screen._process is not first and len(said) == 2
        screen.close(60.0)


@pytest.mark.long
def test_viewers_that_hang_or_die_slow_nothing_down(run: Run) -> None:
    port = a_port()
    arguments = ("--serve-grpc", "--port", str(port), "--server-memory-limit", "1GB")
    viewers = [rerun(*arguments)]
    until(lambda: listens(port))
    found: list[Recording] = []
    said: list[str] = []

    def during(live: Live) -> None:
        until(lambda: live.frames > 5)
        end(viewers[0], signal.SIGSTOP)
        until(lambda: live.drops["remote"] > 0)  # frames come, nobody waits
        end(viewers[0])
        until(lambda: any("is gone" in line for line in said))
        time.sleep(RETRY + 1)
        viewers.append(rerun(*arguments))
        until(lambda: any("is back" in line for line in said))
        found.append(received(port, Path("late.rrd"), lambda r: len(r.rows["/explain"]) > 20))
        live.stop()

    try:
        connect = [f"rerun+http://127.0.0.1:{port}/proxy"]
        outcome = run(total=None, rate=20, during=during, said=said, connect=connect)
    finally:
        for viewer in viewers:
            end(viewer)
    assert len(outcome.told("the remote viewer is gone")) == 1
    assert len(outcome.told("the remote viewer is back")) == 1
    (recording,) = found
    assert recording.blueprints == 1


def test_an_absent_viewer_is_reported(run: Run) -> None:
    with pytest.raises(UserError, match="no viewer answers"):
        run(connect=[f"rerun+http://127.0.0.1:{a_port()}/proxy"])


# --- how it ends -------------------------------------------------------------------------------


def test_a_source_that_fails_leaves_a_readable_recording(
    run: Run, frames: list[Frame], drive: SyntheticSource
) -> None:
    class Broken(Paced):
        def __iter__(self) -> Iterator[Frame]:
            yield from super().__iter__()
            raise RuntimeError("the middleware is gone")

    with pytest.raises(UserError, match="RuntimeError: the middleware is gone"):
        run(source=Broken(frames, drive.scene, 10), save=Path("out.rrd"))
    assert numbers(Path("out.rrd")) == list(range(10))


def test_jumping_stamps_end_no_run(run: Run, frames: list[Frame], drive: SyntheticSource) -> None:
    class Jumping(Paced):
        def __iter__(self) -> Iterator[Frame]:
            for frame in super().__iter__():
                jump = -3_600_000_000_000 if frame.index >= 5 else 0
                yield replace(frame, stamp=frame.stamp + jump, received=frame.received + 2 * jump)

    outcome = run(source=Jumping(frames, drive.scene, 10), save=Path("out.rrd"))
    assert outcome.live.frames == 10
    p99 = Recording(Path("out.rrd")).column("/health/latency_ms/p99", "Scalars:scalars")
    assert all(value[0] < 60_000 for value in p99)


# --- files of earlier runs ---------------------------------------------------------------------


def test_a_run_never_writes_over_files_of_an_earlier_one(tmp_path: Path) -> None:
    asked = tmp_path / "drive.rrd", tmp_path / "drive.mcap"

    def names() -> list[str]:
        return [path.name for path in unused_names(*asked)]

    (tmp_path / "drive-20240131.rrd").touch()  # of somebody else, and not in the way
    assert names() == ["drive.rrd", "drive.mcap"]
    (tmp_path / "drive-20240131.rrd").unlink()
    for taken, free in [
        ("drive.partial-0123abcd.mcap", "drive-2"),
        ("drive-2_000.rrd", "drive-3"),
        ("drive-9.mcap", "drive-10"),
    ]:
        (tmp_path / taken).touch()
        assert names() == [f"{free}.rrd", f"{free}.mcap"]
    (tmp_path / "null.rrd").symlink_to("/dev/null")
    assert unused_names(tmp_path / "null.rrd") == [tmp_path / "null.rrd"]


def test_a_recording_is_not_written_through_a_link(drive: SyntheticSource, tmp_path: Path) -> None:
    bag, link = tmp_path / "bag.mcap", tmp_path / "drive.rrd"
    bag.write_text("the bag")
    link.symlink_to(bag)
    config = load()
    encoder = Encoder(config, drive.scene, "live")
    with pytest.raises(UserError, match="is already there"):
        RecordingSaver(link, config.live, encoder, NoIndexer(), Notes(lambda text: None))
    assert bag.read_text() == "the bag"
