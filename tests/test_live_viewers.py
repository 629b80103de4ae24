"""What viewers are given: fewer points than files, and never more than their browser has drawn."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

import bevviz
from bevviz.config.reloading import ReloadableConfig
from bevviz.live.encoder import Packet
from bevviz.live.flight_recorder import FlightRecorder
from bevviz.live.indexing import Indexer
from bevviz.live.outputs import Output
from bevviz.live.run_outputs import Outputs
from bevviz.live.runtime import Live
from bevviz.live.status import Notes
from bevviz.model.results import FrameResult
from bevviz.recording import entities
from bevviz.workbench.buffers import PageState
from bevviz.workbench.live_buffer import AHEAD, WHOLE
from bevviz.workbench.running_robot import RunningRobot
from tests.support import kept_drives
from tests.support.live_sessions import live_bench
from tests.support.recordings import Recording
from tests.support.replay import Replay
from tests.support.waiting import until

pytestmark = pytest.mark.filterwarnings("ignore:RRD file has no footer")
LIMIT = 500  # points


@pytest.fixture(scope="module")
def results() -> list[FrameResult]:
    with bevviz.simulate(frames=2, seed=1, set={"live.viewer_points": LIMIT}) as drive:
        return list(drive)


@pytest.fixture
def bench(results: list[FrameResult]) -> Iterator[RunningRobot]:
    with live_bench(results, f"live.viewer_points={LIMIT}") as bench:
        yield bench


def test_viewers_get_fewer_points_and_files_all(
    bench: RunningRobot, results: list[FrameResult], tmp_path: Path
) -> None:
    live, result = bench.live, results[0]
    frame = result.frame
    packet = live.encoder.encode(result, live.scene, {}, ())

    def recording(name: str, data: bytes) -> Recording:
        path = tmp_path / name
        path.write_bytes(live.encoder.prelude(packet.context) + data)
        return Recording(path)

    whole, thinned = recording("file.rrd", packet.data), recording("viewer.rrd", packet.shown)
    path = entities.POINTS.path(frame.lidar)
    (every,) = whole.column(path, "Points3D:positions")
    (few,) = thinned.column(path, "Points3D:positions")
    assert np.array_equal(np.array(every), frame.points) and len(few) == LIMIT
    for entity in (path, entities.GROUND.path(frame.lidar), entities.CLUSTERS.path(frame.lidar)):
        points, classes = (whole.column(entity, f"Points3D:{part}")[0] for part in ("positions", "class_ids"))
        shown, of_shown = (
            thinned.column(entity, f"Points3D:{part}")[0] for part in ("positions", "class_ids")
        )
        assert len(shown) == min(LIMIT, len(points))
        if len(classes) > 1:
            class_of = dict(zip(map(tuple, points), classes, strict=True))
            assert [class_of[tuple(point)] for point in shown] == of_shown
        else:
            assert of_shown == classes
    (boxes,) = thinned.column(entities.CLUSTERS.path(frame.lidar), "Boxes3D:centers")
    assert [boxes] == whole.column(entities.CLUSTERS.path(frame.lidar), "Boxes3D:centers") and len(boxes) > 1
    assert thinned.at.keys() == whole.at.keys()
    assert all(thinned.at[path].keys() == whole.at[path].keys() for path in whole.at), (
        "nothing else is left out"
    )

    bench.observe(result)  # a click on a point is on that one
    for row in (0, 7, LIMIT - 1):
        found = bench.select(frame.index, (), path, row, [])
        assert found is not None and found.point == pytest.approx(few[row])
    assert bench.select(frame.index, (), path, LIMIT, []) is None


def test_what_is_held_to_be_saved_has_all_points(bench: RunningRobot, results: list[FrameResult]) -> None:
    live = bench.live
    packet = live.encoder.encode(results[0], live.scene, {}, ())
    flight = FlightRecorder(ReloadableConfig(), live.encoder, Indexer(), live.notes)
    flight.put(packet)
    assert flight.packets()[0].data == packet.data and flight.packets()[0].thinned is None
    assert packet.thinned is not None and len(packet.thinned) < len(packet.data) / 2


def test_a_page_is_sent_what_it_can_draw_and_its_lag_is_known(
    bench: RunningRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr(bench.live.encoder, "clock", lambda: now)
    recording = bench.recording
    assert recording.lag is None, "nobody looks"
    heard = PageState()
    with recording.shown(heard) as page:
        assert recording.lag == 0.0
        for _ in range(AHEAD):
            assert page.ready
            page.send()
            now += 0.5
        assert not page.ready and recording.lag == 0.5 * AHEAD
        assert bench.live.numbers["lag of the page viewer, ms"] == 500.0 * AHEAD
        heard.hidden = True
        assert recording.lag == 0.0, "a page that nobody sees draws nothing"
        heard.hidden, heard.count = False, AHEAD - 1
        assert page.ready and recording.lag == 0.5
        heard.count = AHEAD
        assert recording.lag == 0.0
    assert recording.lag is None


def test_what_a_page_was_too_slow_for_is_counted(bench: RunningRobot, results: list[FrameResult]) -> None:
    recording, encoder = bench.recording, bench.live.encoder
    packet = encoder.encode(results[0], bench.live.scene, {}, ())
    recording._take(packet, True)
    _, number = recording.since(None)
    for _ in range(WHOLE + 2):
        recording._take(packet, False)
    pieces, _ = recording.since(number)
    assert len(pieces) == 2 and recording.dropped == WHOLE + 1, "the newest whole one, and what it relies on"


def test_pages_get_as_many_frames_as_viewers(results: list[FrameResult]) -> None:
    source = Replay([result.frame for result in results], kept_drives.scene())
    settings = ReloadableConfig(None, ["detector.model=demo", "live.viewer_rate=1"])
    live = Live(source, settings, Outputs(), Notes(lambda line: None))
    with RunningRobot(live) as bench:
        whole = live.encoder.encode(results[0], live.scene, {}, ())
        for packet in (whole, Packet(b"", False, whole.context, 0.0), whole):
            bench.recording.put(packet)
        until(lambda: bench.recording.since(0)[1] == 2)
        assert bench.recording.since(0)[0] == 2 * [live.encoder.header + whole.shown]
        live.encoder.close()


def test_a_viewer_is_behind_until_it_keeps_up(results: list[FrameResult]) -> None:
    with live_bench(results) as bench:
        outputs, problems = bench.live.outputs, bench.live.problems
        viewer = Mock(spec=Output, dropped=1)
        viewer.name = "web"
        outputs.attach(viewer)
        for lag, is_behind in ((2.9, False), (3.5, True), (1.5, True), (0.5, False), (2.0, False)):
            viewer.lag = lag
            outputs.check()
            assert bool(problems.of("web viewer")) == is_behind
        (problem,) = problems.all.values()
        assert problem.finding.text == "the web viewer is 1.5 s behind" and problem.times == 1
        assert bench.live.numbers["lag of the web viewer, ms"] == 2000.0
