"""A short part of the torture, with a fixed seed; ``python -m benchmarks.torture`` is the whole of it."""

from __future__ import annotations

import argparse
import signal
import subprocess
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest

from benchmarks.torture import damage, folders, fuzz, kill, messages, models
from benchmarks.torture.__main__ import SHARE
from benchmarks.torture.damage import DAMAGES, Tally, judged
from benchmarks.torture.worker import Outcome, Worker
from tests.support.bag_formats import FORMATS, items
from tests.support.foreign_readers import judges, taken

pytestmark = pytest.mark.long

SHORT = ("mcap, no checksums", "mcap, zstd", "mcap, flat", "mcap.zstd", "sqlite3, with a log", "ros1, lz4")


def test_damaged_bags_are_read_as_well_as_by_others() -> None:
    total = Tally()
    for _, tally in damage.run(seed=1, bags=len(SHORT) * len(DAMAGES), names=SHORT):
        total += tally
    assert total.bags == 60
    assert total.best > 6000
    assert total.share >= SHARE, total.examples
    assert not (total.tracebacks or total.hangs or total.silent), total.examples
    assert total.wrong <= total.their_wrong * 1.2


def test_fuzzed_messages_are_refused_in_one_line() -> None:
    (total,) = fuzz.run(seed=1, messages=120)
    assert total.messages >= 120 and total.refused > 40
    assert not (total.tracebacks or total.broken or total.hangs), total.examples
    assert total.slowest < 5
    assert total.memory < 400


def test_signals_at_any_time_leave_readable_files() -> None:
    for _, tally in kill.run(seed=1, count=2, names=("bag", "batch")):
        assert tally.signals == 1
        assert tally.well, tally.examples


def test_false_and_unreadable_messages_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag, check = kill.COMMANDS["bag"], kill.COMMANDS["report --check"]
    assert kill._falsehood(tmp_path, bag, 0, "") == "and not all that it should be"
    assert kill._falsehood(tmp_path, check, 0, f"{kill.SCANS} frames: the same in every bit") == ""
    assert kill._falsehood(tmp_path, check, 0, "1 of 40 frames differ")
    assert kill._falsehood(tmp_path, check, 130, "1 of 40 frames differ, first frame 3")
    assert kill._falsehood(tmp_path, bag, 3, "") and not kill._falsehood(tmp_path, bag, 130, "")
    assert not kill._falsehood(tmp_path, bag, -signal.SIGINT, "")
    monkeypatch.setattr(kill, "PATIENCE", 0.2)
    (tmp_path / "half.txt").write_text("of something")
    (tmp_path / "out.partial-0123abcd.rrd").write_text("half")
    assert kill._left(tmp_path, 2**31 - 1, set(), ["out.rrd"], killed=False) == "left: half.txt"
    assert kill._left(tmp_path, 2**31 - 1, {"half.txt"}, ["out.rrd"], killed=False) == ""
    with subprocess.Popen(["sleep", "60"], start_new_session=True) as left:
        assert "sleep 60" in kill._left(tmp_path, left.pid, {"half.txt"}, ["out.rrd"], killed=True)
    (tmp_path / "cut.rrd").write_bytes(b"RRF2\0\0")
    assert kill._unreadable(tmp_path / "cut.rrd")


@pytest.mark.parametrize("name", FORMATS)
def test_the_other_readers_read_a_sound_bag(tmp_path: Path, name: str) -> None:
    """Else what they get out of a damaged one would be worth nothing."""
    path = FORMATS[name](tmp_path)
    written = Counter((topic, time, data) for topic, _, time, data in items(name.startswith("ros1")))
    best = {judge: (Counter(taken(read, path)) & written).total() for judge, read in judges(name).items()}
    assert max(best.values()) == 161
    assert sum(count == 161 for count in best.values()) >= 2 or "with a log" in name, best


def test_failures_are_counted(tmp_path: Path) -> None:
    path = FORMATS["ros1"](tmp_path)
    written = [(topic, time, data) for topic, _, time, data in items(ros1=True)]
    whole = Counter(written)
    tally = judged(path, "ros1", whole, Outcome(found=[*written[5:], ("/other", 5, b"")]))
    assert (tally.ours, tally.best, tally.wrong, tally.silent) == (156, 161, 1, 1)
    assert judged(path, "ros1", whole, Outcome(found=written[5:], said=["5 lost"])).silent == 0
    assert judged(path, "ros1", whole, Outcome(traceback="Traceback ...")).tracebacks == 1


def test_a_worker_that_hangs_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = FORMATS["ros1"](tmp_path)
    monkeypatch.setattr("benchmarks.torture.worker.LIMIT", 0.01)
    with Worker() as worker:
        assert worker.read(path).hung
        monkeypatch.setattr("benchmarks.torture.worker.LIMIT", 60.0)
        assert len(worker.read(path).found) == 161
        assert worker.read(tmp_path / "nothing.bag").said


def test_the_command_knows_its_parts_and_prints_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    from benchmarks.torture.__main__ import PARTS, damaged_bags

    options = argparse.Namespace(seed=2, bags=10, format="ros1, bz2", messages=1, signals=1)
    assert set(PARTS) == {"damage", "fuzz", "messages", "models", "folders", "kill"}
    assert damaged_bags(options)
    lines = capsys.readouterr().out.splitlines()
    assert "Damaged bags, seed 2" in lines
    assert any(line.startswith("| all | 10 | 1610 |") for line in lines)


def test_strange_folders_end_well_or_in_one_line() -> None:
    total = folders.Tally()
    for _, tally in folders.run(seed=1, cases=14):
        total += tally
    assert total.cases == 28
    assert total.read > 10 and total.refused > 10
    assert total.well, total.examples


def test_failures_of_commands_are_counted() -> None:
    assert folders._wrong(0, "bevviz: warning: a scan is cut") == ""
    assert folders._wrong(2, "bevviz: error: no such file") == ""
    assert folders._wrong(3, "bevviz: error of bevviz itself: KeyError")
    assert folders._wrong(2, "no line of an error")
    assert folders._wrong(0, "Traceback (most recent call last):")


def test_changed_onnx_files_are_read_or_refused_in_a_line() -> None:
    (total,) = models.run(seed=1, files=40)
    assert total.files == 40 and total.refused > 20
    assert total.well, total.examples


SHORT_KINDS = ("Livox CustomMsg", "CompressedPointCloud2, zstd", "RadarTracks", "foxglove.SceneUpdate, json")


def test_messages_of_other_kinds_are_refused_in_one_line() -> None:
    total = messages.Tally()
    for _, tally in messages.run(seed=1, each=60, names=SHORT_KINDS):
        total += tally
    assert total.cases == 241  # and a bomb
    assert total.well, total.examples


@pytest.mark.parametrize("name", ["MarkerArray", "foxglove.SceneUpdate, json"])
def test_a_case_is_known_by_its_seed_and_number(name: str) -> None:
    rows = messages.KINDS[name].rows()
    first = [messages.case(name, rows, number, 0) for number in range(60)]
    assert first == [messages.case(name, rows, number, 0) for number in range(60)]
    changed = {messages.case(name, rows, 7, seed)[1] for seed in range(5)}
    assert len(changed) > 3


def test_a_case_that_goes_wrong_is_named(tmp_path: Path) -> None:
    class Broken:
        def do(self, task: str, argument: tuple[Path, Sequence[str]]) -> Outcome:
            wrong = b"wrong" in argument[0].read_bytes()
            return Outcome(said=["0.1", "5", ""], traceback="Traceback\nValueError: bad" if wrong else "")

    trial = messages.Trial("PoseStamped", cast(Worker, Broken()), tmp_path)
    places = [place for place, row in enumerate(trial.rows) if row.topic == messages.TOPIC][:8]
    cases = {place: trial.rows[place] for place in places}
    cases[places[5]] = replace(cases[places[5]], data=b"wrong")
    tally = messages.Tally()
    trial.judge(cases, dict(zip(places, range(8), strict=True)), tally)
    assert (tally.cases, tally.tracebacks, tally.well) == (8, 1, False)
    assert tally.examples == ["PoseStamped, case 5: tracebacks; ; ValueError: bad"]


@pytest.mark.parametrize(
    ("outcome", "expected"),
    [
        (Outcome(said=["0.1", "5", ""]), ""),
        (Outcome(said=["0.1", "5", ""], memory=2 * messages.MEMORY), "large"),
        (Outcome(said=["99", "5", ""]), "slow"),
        (Outcome(said=["0.1", "0", "no LiDAR"]), "ended"),
        (Outcome(hung=True), "hangs"),
        (Outcome(traceback="the process ended (-9)"), "tracebacks"),
    ],
)
def test_failures_of_reading_a_drive_are_counted(outcome: Outcome, expected: str) -> None:
    assert messages.fault(outcome) == expected
