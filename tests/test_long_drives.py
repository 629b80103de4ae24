"""Long drives in the workbench: the overview before the run in order, and frames on demand."""

from __future__ import annotations

import math
import os
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

import bevviz
from bevviz.anomalies.detector import AnomalyDetector
from bevviz.cli import main
from bevviz.config import Config, load
from bevviz.drive import Drive
from bevviz.findings.finding_list import CELL, FindingFrame, FindingList, StoredGroup
from bevviz.findings.frame_findings import Finding, findings_of
from bevviz.findings.run_table import RunTable, StoredRun, run_table
from bevviz.model.results import FrameResult
from bevviz.pipeline import result_store
from bevviz.pipeline.run import run
from bevviz.recording import entities
from bevviz.why import Selection
from bevviz.why.frame_index import FrameIndex
from bevviz.workbench import drive_recording, recorded_drive
from bevviz.workbench.buffers import PageState
from bevviz.workbench.overview import STEP, overview_order
from bevviz.workbench.recorded_drive import RecordedDrive
from tests.support.logged_frames import frame_with_image
from tests.support.waiting import until
from tests.support.workbench_pages import FRAMES, demo_bag


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return demo_bag(tmp_path_factory.mktemp("long"))


@pytest.fixture
def drives(bag: Path) -> Iterator[tuple[Drive, Drive]]:
    with bevviz.open(bag, model="demo") as drive, bevviz.open(bag, model="demo") as again:
        yield drive, again


def finding(frame: int, row: int, x: float) -> Finding:
    """Return a missed person."""
    return Finding(frame, frame * 10**8, "missed", "person", 5.0, Selection(truth=row), position=(x, 0, 0))


def groups(listed: FindingList) -> list[list[int]]:
    """Return the frames of each group."""
    entries, _ = listed.news({})
    return [[sight.frame for sight in entry["sights"]] for entry in entries]


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Give the process a store of its own."""
    result_store._opened.cache_clear()
    monkeypatch.setenv("BEVVIZ_STORE", str(tmp_path / "store"))
    yield
    result_store._opened.cache_clear()


def whole_list(drive: RecordedDrive, passes: set[str]) -> list[list[int]]:
    """Run a drive and return the groups of its list. Collect the names of its passes."""
    drive.news.listen(lambda: passes.add(str(drive.progress()["phase"])))
    drive.start()
    until(lambda: drive.over)
    assert drive.progress()["done"] == FRAMES and not drive.progress()["error"]
    drive.recording.close()
    return groups(drive.findings)


@pytest.mark.parametrize("total", [0, 1, 128, 1000, 18000])
def test_any_beginning_of_an_overview_covers_the_drive(total: int) -> None:
    order = overview_order(total)
    assert sorted(order) == list(range(0, total, STEP))
    for count in (5, 40, 300):
        begun = [*sorted(order[:count]), total]
        gaps = [later - earlier for earlier, later in pairwise(begun)]
        assert max(gaps, default=0) <= max(STEP, 4 * total / min(count, len(order) or 1))


def test_findings_of_single_frames_end_where_the_run_comes() -> None:
    """Near ones are grouped within their part of the drive, in any order of the frames."""
    listed = FindingList()
    for frame in (0, 2 * CELL, CELL, CELL + 8, 8):
        listed.add_overview(frame, [finding(frame, 1, 3.0), finding(frame, 2, 30.0)])
    assert groups(listed) == [[0, 8], [0, 8], [2 * CELL], [2 * CELL], [CELL, CELL + 8], [CELL, CELL + 8]]
    listed.end_overview(3)
    listed.add([finding(3, 1, 3.0)])
    assert groups(listed)[-1] == [3]
    assert [0, 8] not in groups(listed) and [CELL, CELL + 8] in groups(listed)


def test_a_page_gets_each_frame_of_a_finding_once() -> None:
    """Also of a group that goes on after others have begun. Groups that are removed are told once."""
    listed, sent, received = FindingList(), dict[int, int](), dict[int, list[int]]()
    for frame in range(12):
        listed.add([finding(frame, 1, 3.0), *([finding(frame, 2, 30.0)] if frame % 3 == 0 else [])])
        if frame % 2:
            entries, gone = listed.news(sent)
            assert not gone
            for entry in entries:
                received.setdefault(entry["number"], []).extend(one.frame for one in entry["sights"])
    assert received == {1: [*range(12)], 2: [0, 3, 6, 9]}
    assert listed.news(sent) == ([], [])
    listed.replace(["missed"])
    assert listed.news(sent) == ([], [1, 2]) and listed.news(sent) == ([], [])


def test_an_overview_lists_images_that_show_nothing() -> None:
    """A covered camera is listed once within each part of the drive, from frames far apart."""
    image = np.random.default_rng(1).integers(0, 255, (90, 160, 3), np.uint8)
    detector, listed, config = AnomalyDetector(), FindingList(), Config()
    for number in overview_order(8 * CELL):
        covered = 2 * CELL <= number < 4 * CELL
        frame = frame_with_image(number, np.zeros_like(image) if covered else image)
        result = FrameResult.unprocessed(frame, config)
        anomalies = detector.update_alone(result, config.anomalies)
        assert [(a.kind, a.subject) for a in anomalies] == (
            [("sensor", "camera front: black image")] if covered else []
        )
        listed.add_overview(number, findings_of(FrameIndex(replace(result, anomalies=anomalies))))
    found = [(kind, name, [one.text for one in frames]) for kind, name, frames in listed.content()]
    text = "camera front: black image, mean grey value 0"
    assert [(kind, name) for kind, name, _ in found] == 2 * [("anomaly", "sensor")]
    assert all(texts[0].startswith(text) for _, _, texts in found)
    listed.end_overview(8 * CELL)
    assert not listed.content()


@pytest.mark.long
def test_the_run_replaces_the_overview(drives: tuple[Drive, Drive], monkeypatch: pytest.MonkeyPatch) -> None:
    """The list is that of a run without an overview."""
    monkeypatch.setattr(recorded_drive, "FIRST", 0.0)
    lists, passes = [], set[str]()
    for least in (FRAMES, FRAMES + 1):
        monkeypatch.setattr(recorded_drive, "LEAST", least)
        lists.append(whole_list(RecordedDrive(drives[0], drives[1].frames), passes))
    assert lists[0] == lists[1] and lists[0]
    assert passes == {"overview", "run"}


# --- frames on demand ---------------------------------------------------------------------------


@pytest.fixture
def long_drive(drives: tuple[Drive, Drive], monkeypatch: pytest.MonkeyPatch) -> Iterator[RecordedDrive]:
    """Yield a drive whose recording is too large for a browser, before its run."""
    monkeypatch.setattr(recorded_drive, "FIRST", 0.0)
    monkeypatch.setattr(drive_recording, "WHOLE", 0)
    drive = RecordedDrive(drives[0], drives[1].frames)
    drive.show(drive.look(0), ())
    yield drive
    drive.recording.close()


@pytest.mark.long
def test_a_page_gets_the_frames_that_it_looks_at(long_drive: RecordedDrive) -> None:
    """First the requested one, then its neighbours. Tracks come with the run."""
    state = PageState()
    stamps = [long_drive.drive.raw(number).stamp for number in range(FRAMES)]
    with long_drive.reader("recording", 0, state) as reader:
        assert len(reader.take()) == 1 and reader.take() == ()  # the layout with the first frame
        state.requested += [stamps[1], stamps[4]]
        numbers = []
        while sent := reader.take():
            numbers.append(int(sent[0]))
            state.take("")
        assert numbers == [4, 5, 3]
        run(long_drive.again, long_drive.drive.new_session(), [long_drive])
        while len(reader.take()) == 1:  # the numbers of the run
            state.take("")
        state.requested.append(stamps[4])
        number, _ = reader.take()
        assert number == "4"
    assert [number for _, number in long_drive.frame_times()] == list(range(FRAMES))


@pytest.mark.long
def test_frames_on_demand_are_complete_in_any_order(long_drive: RecordedDrive, tmp_path: Path) -> None:
    """A viewer that has some of them shows nothing of the others, and the numbers of all."""
    run(long_drive.again, long_drive.drive.new_session(), [long_drive])
    pieces = {number: long_drive.piece(number, wanted=True) for number in (5, 2, 3)}
    tracks = long_drive.tracks(3)
    assert tracks is not None
    shown = entities_at(tmp_path, pieces)
    assert {entities.TRAILS, entities.IMAGE.path("zed"), entities.POINTS.path("rslidar")} <= shown[2] & shown[
        3
    ] & shown[5]
    numbers = [long_drive.recording.rows[row] for row in range(1, len(long_drive.recording.rows))]
    totals = entities_at(tmp_path, dict(enumerate(numbers)))
    assert {entities.COUNT.path("clusters"), entities.STAGE_TIME.path("total")} <= set.union(*totals.values())
    assert not any(path.startswith(entities.WORLD) for paths in totals.values() for path in paths)


def entities_at(folder: Path, pieces: dict[int, bytes | None]) -> dict[int, set[str]]:
    """Return the entities with data other than a clear in each piece."""
    found: dict[int, set[str]] = {}
    for number, piece in pieces.items():
        assert piece is not None
        (path := folder / "piece.rrd").write_bytes(piece)
        found[number] = {
            chunk.entity_path
            for chunk in RrdReader(path).stream()
            if not any("Clear" in name for name in chunk.to_record_batch().schema.names)
        }
    return found


# --- lists of earlier runs ----------------------------------------------------------------------


@pytest.mark.long
def test_a_drive_that_was_run_before_shows_its_list_at_once(
    drives: tuple[Drive, Drive], bag: Path, store: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run goes on behind it and adds nothing twice."""
    monkeypatch.setattr(recorded_drive, "FIRST", 0.0)
    table = run_table([bag], drives[0].config, "", [None])
    assert table is not None and table.load() is None
    first = whole_list(RecordedDrive(drives[0], drives[1].frames, table=table), set())
    again, passes = RecordedDrive(drives[0], drives[1].frames, table=table), set[str]()
    again._load_list()
    assert groups(again.findings) == first != []
    assert len(again.frame_times()) == FRAMES
    again.recording.close()
    assert whole_list(RecordedDrive(drives[0], drives[1].frames, table=table), passes) == first
    assert passes == {"again"}


@pytest.mark.long
@pytest.mark.parametrize("command", ["evaluate", "batch"])
def test_a_drive_run_by_another_command_shows_its_list(
    drives: tuple[Drive, Drive],
    bag: Path,
    store: None,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    command: str,
) -> None:
    """The list is that of the workbench's own run, which adds the reasons. A part of the drive keeps none."""
    monkeypatch.setattr(recorded_drive, "FIRST", 0.0)
    monkeypatch.setattr(recorded_drive, "LEAST", FRAMES + 1)
    provider = drives[0].session.stages.provider
    table = run_table([bag], drives[0].config, provider, (None, None))
    assert table is not None
    words = [command, str(bag), "--model", "demo"]
    words += ["--out", str(tmp_path), "--keep", "inspect"] if command == "batch" else []
    assert main([*words, "--every", "2"]) == 0 and table.load() is None
    assert main(words) == 0
    evaluated = RecordedDrive(drives[0], drives[1].frames, table=table)
    evaluated._load_list()
    assert len(evaluated.frame_times()) == FRAMES
    evaluated.recording.close()
    stored, passes = table.load(), set[str]()
    assert stored is not None and stored.explained == (command == "batch")
    own = RecordedDrive(drives[0], drives[1].frames, table=None if stored.explained else table)
    assert groups(evaluated.findings) == whole_list(own, passes) != []
    replaced = table.load()
    assert passes == {"run"} and replaced is not None and replaced.explained
    reasons = [frame.text for group in replaced.groups for frame in group.frames if group.what == "missed"]
    assert reasons and all(reasons)


def test_a_list_belongs_to_one_drive_and_configuration(bag: Path, store: None, tmp_path: Path) -> None:
    """A bag that changed, other values and a damaged entry have none."""
    (copy := tmp_path / "copy.mcap").write_bytes(b"content")
    frame = FindingFrame(3, 5, math.nan, "truth=1")
    stored = StoredRun([StoredGroup("missed", "person", [frame])], [(5, 3)])

    def table(*settings: str, labels: Sequence[str | Path | None] = ()) -> RunTable:
        made = run_table([copy], load(None, ["detector.model=demo", *settings]), "", labels)
        assert made is not None
        return made

    table().save(stored)
    found = table().load()
    assert found is not None and repr(found) == repr(stored)
    assert table("clustering.eps=0.7").load() is None
    assert table(labels=["/truth"]).load() is None
    os.utime(copy, ns=(1, 1))
    assert table().load() is None
    table()._store.put(table()._key, zlib.compress(b'{"groups": 3}'))
    assert table().load() is None


def test_findings_are_ranked_by_reasons_kind_and_distance() -> None:
    def frame(**more: Any) -> FindingFrame:
        return replace(FindingFrame(0, 10**9, 30.0, "truth//0", text="merged"), **more)

    findings = FindingList()
    lasting = [frame(distance=10.0, in_way=True), frame(stamp=15 * 10**8, distance=9.0)]
    groups = [
        StoredGroup("missed", "second name", [frame(distance=2.0, text="second name")]),
        StoredGroup("anomaly", "sync", [frame(distance=float("nan"))]),
        StoredGroup("missed", "unknown distance", [frame(distance=float("nan"))]),
        StoredGroup("doubtful", "near", [frame(distance=5.0)]),
        StoredGroup("fixed", "near", [frame(distance=5.0)]),
        StoredGroup("false", "nearer", [frame(distance=4.0)]),
        StoredGroup("missed", "lasting", lasting),
    ]
    findings.restore(groups)
    entries, _ = findings.news({})
    order = [(one["what"], one["name"]) for one in sorted(entries, key=lambda one: one["rank"])]
    assert order == [
        ("missed", "lasting"),
        ("anomaly", "sync"),
        ("false", "nearer"),
        ("doubtful", "near"),
        ("fixed", "near"),
        ("missed", "second name"),
        ("missed", "unknown distance"),
    ]
    reasons = next(one["reasons"] for one in entries if one["name"] == "lasting")
    assert reasons == ["in the way of the robot", "nearer than 10 m", "lasts 0.5 s"]
