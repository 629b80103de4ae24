"""Worker processes that run networks ahead of a run: same results, and a failing worker costs only time."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from bevviz.bags.source import BagSource, FrameSelection
from bevviz.cli import main
from bevviz.config import Config, load
from bevviz.errors import UserError
from bevviz.fleet import bag_job
from bevviz.fleet.jobs import make_jobs
from bevviz.model.frame import Frame
from bevviz.model.results import Detections, FrameResult
from bevviz.pipeline import frame_workers, result_store
from bevviz.pipeline.dask_frames import ClusterFrames
from bevviz.pipeline.frame_workers import FrameParts, FrameWorkers
from bevviz.pipeline.network_prefetch import working_ahead
from bevviz.pipeline.result_store import open_store
from bevviz.pipeline.session import Session
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.stages.detector import Detector
from bevviz.support import progress
from bevviz.synthetic import SyntheticSource, write_bag
from tests.support.waiting import until

FRAMES = 5
CONFIG = load(None, ["detector.model=demo"])


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("workers") / "drive.mcap"
    write_bag(SyntheticSource(FRAMES), path)
    return path


@pytest.fixture(autouse=True)
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Give the process a store of its own, and workers parts of two frames."""
    monkeypatch.setattr(frame_workers, "CHUNK", 2)
    monkeypatch.setenv("BEVVIZ_STORE", str(tmp_path / "store"))
    result_store._opened.cache_clear()
    yield
    result_store._opened.cache_clear()


@pytest.fixture
def lines() -> Iterator[list[str]]:
    """Return what is said to the user."""
    said: list[str] = []
    progress.set_receiver(said.append)
    yield said
    progress.set_receiver(None)


def detections(results: list[FrameResult]) -> list[Any]:
    """Return all arrays of the detections."""
    found = [camera.detections for result in results for camera in result.cameras]
    return [getattr(d, field.name) for d in found for field in fields(Detections) if d is not None]


def listen_until_all_ended(workers: FrameWorkers) -> None:
    """Listen as a run does, until every worker has ended."""

    def have_ended() -> bool:
        workers.wait_for(0)
        return not workers._workers

    until(have_ended)


def test_networks_find_what_workers_did(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with BagSource([bag], CONFIG) as source:
        session = Session(CONFIG, loader=StageLoader(store=False))
        alone = [session.perceive(frame) for frame in source]
        store = open_store(CONFIG.store.size)
        assert store is not None
        with FrameWorkers(source, [CONFIG], 2) as workers:
            until(lambda: store.summary()[0] == FRAMES)
            for frame in source:
                workers.wait_for(frame.index)
        monkeypatch.setattr(Detector, "infer", lambda *_: pytest.fail("the network ran again"))
        session = Session(CONFIG)
        after = [session.perceive(frame) for frame in source]
    assert len(alone) == len(after) == FRAMES
    assert any(len(array) for array in detections(alone))
    for ours, theirs in zip(detections(after), detections(alone), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_parts_have_the_frames_of_the_selection(bag: Path) -> None:
    with BagSource([bag], CONFIG, frames=(1, None), every=2) as source, source.opener() as again:
        whole = list(source)
        parts = [*again.part(0, 1), *again.part(1, 2)]
    assert [frame.index for frame in whole] == [frame.index for frame in parts] == list(source.numbers)
    for frame, same in zip(whole, parts, strict=True):
        assert frame.stamp == same.stamp
        image, same_image = frame.cameras[0].image, same.cameras[0].image
        assert image is not None
        assert same_image is not None
        np.testing.assert_array_equal(image.bgr, same_image.bgr)


def test_killed_workers_cost_only_time(bag: Path, lines: list[str]) -> None:
    with BagSource([bag], CONFIG) as source, FrameWorkers(source, [CONFIG], 2) as workers:
        for worker in list(workers._workers.values()):
            assert worker.process.pid is not None
            os.kill(worker.process.pid, signal.SIGKILL)
        listen_until_all_ended(workers)
        for number in source.numbers:
            workers.wait_for(number)
    assert len(lines) == 2
    assert all("ended (by SIGKILL" in line and "goes on" in line for line in lines)


def fail() -> FrameParts:
    """Stand in for a source that cannot be opened."""
    raise UserError("no bag here")


@dataclass
class LostSource:
    """Source that a worker cannot open."""

    numbers: range
    opener: Any

    def part(self, first: int, stop: int) -> Iterator[Frame]:
        raise AssertionError

    def close(self) -> None:
        pass


def test_a_worker_that_raises_costs_only_time(lines: list[str]) -> None:
    with FrameWorkers(LostSource(range(8), partial(fail)), [CONFIG], 1) as workers:
        listen_until_all_ended(workers)
    assert lines == ["--jobs: a worker process ended (no bag here); the run goes on without it"]


@pytest.mark.parametrize("config", [load(), load(None, ["detector.model=demo", "store.size=0"])])
def test_without_network_or_store_one_process_runs(bag: Path, config: Config, lines: list[str]) -> None:
    session = Session(config)
    with BagSource([bag], config) as source, working_ahead(session, source, [config], 4) as processor:
        assert processor is session
    assert [line.partition(":")[0] for line in lines] == ["--jobs"]


def test_a_batch_gives_the_same_with_helpers(bag: Path, tmp_path: Path) -> None:
    tables = []
    for helpers in (1, 2):
        (job,) = make_jobs([bag], tmp_path / str(helpers), CONFIG, FrameSelection(), "debug")
        result = bag_job.run(job, 1, helpers=helpers)
        assert (result.frames, result.error) == (FRAMES, "")
        columns = pq.read_table(job.table).to_pydict()
        tables.append({name: values for name, values in columns.items() if not name.startswith("time_ms")})
        store = open_store(CONFIG.store.size)
        assert store is not None
        store.clear()
    # As texts, because an unknown number is no number, and equals nothing.
    assert json.dumps(tables[0], default=str) == json.dumps(tables[1], default=str)
    assert sum(tables[0]["detections"]) > 0


def test_evaluate_gives_the_same_with_jobs(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = []
    for more in (["--set", "store.size=0"], ["--jobs", "2"]):
        assert main(["evaluate", str(bag), "--model", "demo", "--json", *more]) == 0
        results.append(json.loads(capsys.readouterr().out))
    assert results[0] == results[1]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    distributed = pytest.importorskip("distributed", reason="needs Dask: pip install 'bevviz[dask]'")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as started:
        yield started


def test_a_dask_cluster_runs_the_networks(
    cluster: Any, bag: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The drive and the model are named by relative paths, and the workers have another folder."""
    monkeypatch.chdir(bag.parent)
    arguments = ["evaluate", bag.name, "--model", "demo", "--json"]
    monkeypatch.setenv("BEVVIZ_STORE", "")
    assert main(arguments) == 0
    alone = json.loads(capsys.readouterr().out)
    monkeypatch.setenv("BEVVIZ_STORE", str(bag.parent / "shared store"))
    result_store._opened.cache_clear()
    monkeypatch.setattr(Detector, "infer", lambda *_: pytest.fail("the network ran on this machine"))
    assert main([*arguments, "--dask", cluster.scheduler_address]) == 0
    assert json.loads(capsys.readouterr().out) == alone


def test_a_cluster_that_fails_costs_only_time(cluster: Any, bag: Path, lines: list[str]) -> None:
    store = open_store(CONFIG.store.size)
    assert store is not None
    lost = LostSource(range(3), fail)
    with ClusterFrames(lost, [CONFIG], store, cluster.scheduler_address) as ahead:
        for number in lost.numbers:
            ahead.wait_for(number)
    assert lines == ["--dask: the cluster failed (no bag here); the run goes on without it"]


def test_a_scheduler_that_is_not_there_is_one_line(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("distributed", reason="needs Dask: pip install 'bevviz[dask]'")
    assert main(["evaluate", str(bag), "--model", "demo", "--dask", "tcp://127.0.0.1:9"]) == 2
    assert "--dask tcp://127.0.0.1:9: nobody answers there" in capsys.readouterr().err
