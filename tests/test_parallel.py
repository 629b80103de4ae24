"""A drive in windows: its frames, and its recording, are those of one process, whatever dies meanwhile."""

from __future__ import annotations

import dataclasses
import math
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest

import bevviz
from bevviz.bags.source import BagSource, FrameSelection
from bevviz.cli import main
from bevviz.config import load
from bevviz.engine.task import JobResults, Task
from bevviz.errors import UserError
from bevviz.logging import entities
from bevviz.logging.parts import PartsWriter
from bevviz.logging.recorder import OrderedRecorder
from bevviz.logging.sinks import open_recording
from bevviz.parallel.run import run_windows
from bevviz.protocols import Observer
from bevviz.results import FrameResult
from tests import bags
from tests.recordings import Recording, verify
from tests.waiting import meanwhile


def check_same(a: Any, b: Any, path: str = "") -> None:
    """Bit for bit."""
    assert type(a) is type(b), path
    if isinstance(a, np.ndarray):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), path
    elif dataclasses.is_dataclass(a):
        for field in dataclasses.fields(a):
            check_same(getattr(a, field.name), getattr(b, field.name), f"{path}.{field.name}")
    elif isinstance(a, tuple | list):
        assert len(a) == len(b), path
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            check_same(x, y, f"{path}[{i}]")
    elif isinstance(a, Mapping):
        assert list(a) == list(b), path
        for key in a:
            check_same(a[key], b[key], f"{path}[{key}]")
    else:
        assert a == b or (a != a and b != b), path


def troubled(seed: int) -> list[bags.Item]:
    """A drive whose messages come late, in another order, twice, or not at all; some have one log time."""
    rng = np.random.default_rng(seed)
    found = []
    for item in bags.small_items(scans=40):
        if item.topic == "/tf_static":
            found.append(item)
            continue
        if rng.random() < 0.1:
            continue
        late = int(rng.integers(0, 4)) * bags.PERIOD
        found += [item._replace(received=item.received + late)] * (2 if rng.random() < 0.1 else 1)
    return found


def check_windows(bag: Path, selection: FrameSelection, length: int) -> int:
    """Returns how many windows there are."""
    config = load(None, [], None)
    with selection.source([bag], config) as whole, selection.source([bag], config) as cutter:
        count = 0

        def in_windows() -> Iterator[Any]:
            nonlocal count
            for window in cutter.windows(lambda left: length):
                count += 1
                with selection.source([bag], config) as other:
                    yield from (frame for frame, mine in other.window(window) if mine)
                    cutter.add_losses(other.losses)

        for frame, same in zip(whole, in_windows(), strict=True):
            check_same(frame, same, f"frame {frame.index}")
        assert sorted(cutter.warnings) == sorted(whole.warnings)
    return count


@pytest.mark.parametrize(
    ("seed", "selection", "length"),
    [
        (0, FrameSelection(), 7),
        (1, FrameSelection(every=2), 2),
        (2, FrameSelection(start="0.7", end="3.1"), 5),
        (3, FrameSelection(frames=(3, 30)), 9),
    ],
)
def test_frames_of_the_windows_are_those_of_the_drive(
    tmp_path: Path, seed: int, selection: FrameSelection, length: int
) -> None:
    bag = bags.write(tmp_path / "bag", troubled(seed))
    assert check_windows(bag, selection, length) >= 3


@pytest.mark.parametrize(
    ("form", "compression"), [("mcap", "storage"), ("sqlite3", "message"), ("ros1", "lz4")]
)
def test_frames_of_real_scans_in_windows(tmp_path: Path, shared: Path, form: str, compression: str) -> None:
    messages = bags.Messages(form == "ros1")
    items = bags.kitti_items(shared, messages, scans=9, step=16, compressed=form != "sqlite3")
    bag = bags.write(tmp_path / "bag", items, form=form, compression=compression)
    assert check_windows(bag, FrameSelection(), 4) == 3


def check_same_recording(one: Path, other: Path) -> None:
    """Every column of every entity, as Rerun's own reader has them; but for how long things took."""
    verify(other)
    a, b = Recording(one), Recording(other)
    timed = {entities.stage_time(""), entities.rate("pipeline")}
    assert a.times == b.times
    assert set(a.static) == set(b.static)
    for entity in a.static.keys() - {"/__properties"}:
        assert plain(a.static[entity]) == plain(b.static[entity]), entity
    assert {e: set(c) for e, c in a.at.items()} == {e: set(c) for e, c in b.at.items()}
    for entity, columns in a.at.items():
        if not entity.startswith(tuple(timed)):
            for name in columns:
                assert plain(columns[name]) == plain(b.at[entity][name]), (entity, name)
    assert b.blueprints == a.blueprints == 1


def plain(value: Any) -> Any:
    """With NaN that equals itself."""
    if isinstance(value, dict):
        return {key: plain(v) for key, v in value.items()}
    if isinstance(value, list):
        return [plain(v) for v in value]
    return "nan" if isinstance(value, float) and math.isnan(value) else value


class Serial:
    """An engine without processes, for what does not depend on them."""

    count = 2

    def close(self) -> None: ...

    def run(
        self,
        jobs: Iterable[Task],
        retries: int,
        on_frame: Callable[[], None],
        tick: Callable[[], None] = lambda: None,
    ) -> JobResults:
        for job in jobs:
            yield job.run(1, on_frame)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    items = bags.small_items(scans=36, points=400)
    return bags.write(tmp_path_factory.mktemp("drive") / "bag", items)


SETTINGS = ("clustering.eps=2 m", "clustering.min_points=2", "tracking.min_hits=1")


def test_a_recording_in_windows_is_that_of_one_process_though_a_worker_dies(
    tmp_path: Path, bag: Path
) -> None:
    one, two = tmp_path / "one.rrd", tmp_path / "two.rrd"
    with bevviz.open(bag, set=SETTINGS) as drive:
        drive.save(one)
    killed = Event()

    def kill() -> None:
        """The first worker that is at work."""
        if not killed.is_set() and any(tmp_path.glob(".bevviz-windows-*/*.results")):
            os.kill(multiprocessing.active_children()[0].pid or 0, signal.SIGKILL)
            killed.set()

    settings = [argument for text in SETTINGS for argument in ("--set", text)]
    with meanwhile(kill):
        assert main(["bag", str(bag), "--jobs", "2", "--save", str(two), *settings]) == 0
    assert killed.is_set()
    check_same_recording(one, two)
    assert [path.name for path in tmp_path.iterdir() if path.suffix != ".rrd"] == []


def test_an_interrupted_run_leaves_a_recording_of_whole_windows(tmp_path: Path, bag: Path) -> None:
    saved, stop = tmp_path / "cut.rrd", Event()

    class Until(Observer[FrameResult]):
        def see(self, result: FrameResult) -> None:
            if result.frame.index == 10:
                stop.set()

    with bevviz.open(bag, set=SETTINGS) as drive:
        assert isinstance(drive.frames, BagSource)
        with open_recording(drive.scene, drive.config, save=saved, in_parts=True) as sinks:
            seen = [OrderedRecorder(sinks.recording, drive.config), Until()]
            end = run_windows(drive, drive.new_session(), sinks, seen, Serial(), stop)
    assert end.frames == 9 + 8
    recording = Recording(saved)
    assert sorted(recording.times["stamp"]) == list(range(end.frames))
    assert not any(tmp_path.glob(".bevviz-windows-*"))


def test_what_may_remember_is_run_in_one_process(
    tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.py").write_text(
        "import numpy as np\n\ndef flat(points):\n    return points[:, 2] < 0\n", encoding="utf-8"
    )
    monkeypatch.syspath_prepend(tmp_path)
    saved = tmp_path / "saved.rrd"
    command = ["bag", str(bag), "--frames", ":2", "--jobs", "2", "--save", str(saved)]
    assert main([*command, "--set", "ground.method=mine:flat"]) == 0
    said = capsys.readouterr().err
    assert "in one process: mine:flat may remember what it saw" in said
    assert len(Recording(saved).times["stamp"]) == 2


def test_the_address_of_a_cluster_reaches_it(
    tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved = tmp_path / "saved.rrd"
    assert main(["bag", str(bag), "--dask", "tcp://127.0.0.1:9", "--save", str(saved)]) == 2
    assert "--dask tcp://127.0.0.1:9: nobody answers there" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir() if path.suffix != ".rrd"] == []


def test_a_part_that_cannot_be_written_any_more_is_said(tmp_path: Path, bag: Path) -> None:
    writer = PartsWriter(tmp_path / "no" / "such.rrd")
    (tmp_path / "part.rrd").write_bytes(bytes(1 << 22))
    writer.add(tmp_path / "part.rrd")
    writer.close()
    with pytest.raises(UserError, match="the recording ends early: rerun rrd route"):
        writer.check()
