"""A long bag among others, in windows: what is made of it is what one process makes of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from bevviz.bags.source import FrameSelection
from bevviz.batch.batch import long_ones
from bevviz.batch.jobs import PARTIAL, Job, make_jobs
from bevviz.batch.table import read_info
from bevviz.batch.windows import run_jobs
from bevviz.batch.work import run
from bevviz.config import load
from bevviz.engine.task import JobResult
from tests import bags
from tests.test_parallel import SETTINGS, Serial, check_same_recording

SCANS = 52


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bags.write(tmp_path_factory.mktemp("long") / "drive", bags.small_items(scans=SCANS, points=200))


def job(bag: Path, folder: Path) -> Job:
    (found,) = make_jobs([bag], folder, load(None, list(SETTINGS), None), FrameSelection(), "debug")
    (folder / PARTIAL).mkdir(parents=True)
    return found


def rows(job: Job) -> list[dict[str, Any]]:
    found = pq.read_table(job.table).drop_columns("stamp").to_pylist()
    return [{k: v for k, v in row.items() if not k.startswith("time_ms_")} for row in found]


def ends(job: Job) -> list[JobResult]:
    return list(run_jobs([job], [job], Serial(), 0, lambda: None))


def test_what_windows_make_is_what_one_process_makes(tmp_path: Path, bag: Path) -> None:
    whole, cut = job(bag, tmp_path / "whole"), job(bag, tmp_path / "cut")
    run(whole, 1)
    (end,) = ends(cut)
    assert (end.name, end.frames, end.error) == ("drive", SCANS, "")
    check_same_recording(whole.recording, cut.recording)
    assert rows(whole) == rows(cut)
    assert sum(row["above"] is not None for row in rows(cut)) == 12
    one, other = read_info(whole.table), read_info(cut.table)
    assert one is not None and other is not None
    assert (one.key, one.recording_id, one.scene) == (other.key, other.recording_id, other.scene)
    assert sorted(one.warnings) == sorted(other.warnings)
    assert list((tmp_path / "cut" / PARTIAL).iterdir()) == []


def test_a_window_that_cannot_be_made_fails_its_bag_alone(tmp_path: Path, bag: Path) -> None:
    bad = job(bag, tmp_path / "bad")
    other = bags.write(tmp_path / "short", bags.small_items(scans=2))
    short = make_jobs([other], bad.folder, bad.config, bad.selection, bad.blueprint)[0]

    class Fails(Serial):
        def run(self, jobs: Any, *more: Any) -> Any:
            for end in super().run(jobs, *more):
                yield JobResult(end.name, error="no") if end.name == "drive, window 1" else end

    found = {end.name: end.error for end in run_jobs([bad, short], [bad], Fails(), 0, lambda: None)}
    assert found == {"drive": "drive, window 1: no", "short": ""}
    assert bad.complete() is None
    assert short.complete() is not None
    assert list((bad.folder / PARTIAL).iterdir()) == []


def test_what_is_cut_is_what_would_hold_up_all(tmp_path: Path) -> None:
    def jobs(*sizes: int) -> list[Job]:
        folder = tmp_path / "-".join(map(str, sizes))
        folder.mkdir(exist_ok=True)
        for number, size in enumerate(sizes):
            (folder / f"{number}.mcap").write_bytes(bytes(size))
        return make_jobs([folder], tmp_path / "runs", load(), FrameSelection(), "debug")

    def cut(workers: int, *sizes: int) -> list[str]:
        return [job.name for job in long_ones(jobs(*sizes), workers)]

    assert cut(1, 9000) == []
    assert cut(2, 9000) == ["0"]
    assert cut(4, 9000, 100, 100) == ["0"]
    assert cut(4, *[1000] * 8) == []
    assert cut(4, *[1000] * 7) == [str(n) for n in range(7)]
