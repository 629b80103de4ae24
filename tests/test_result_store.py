"""The store of results: what it answers is what a network would, and nothing in it is trusted blindly."""

from __future__ import annotations

import io
import os
import pickle
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bevviz.cli import live, main
from bevviz.config import load
from bevviz.config.reloading import ReloadableConfig
from bevviz.model.frame import Frame
from bevviz.model.results import Detections
from bevviz.pipeline import result_store
from bevviz.pipeline.perceive import perceive
from bevviz.pipeline.result_store import ResultStore, StoredDetector, open_store
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.stages.detector import Detector
from bevviz.stages.detector.session import NetworkSession
from bevviz.support import progress
from tests.support import kept_drives
from tests.support.onnx_networks import answer, image_input
from tests.support.small_disk import small_disk

MB = 1_000_000
H, W = 64, 96
KEYS = [f"key {number}".encode() for number in range(2000)]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Give the process a store of its own."""
    result_store._opened.cache_clear()
    monkeypatch.setenv("BEVVIZ_STORE", str(tmp_path / "store"))
    yield tmp_path / "store"
    result_store._opened.cache_clear()


@pytest.fixture
def lines() -> Iterator[list[str]]:
    """Return what is said to the user."""
    said: list[str] = []
    progress.set_receiver(said.append)
    yield said
    progress.set_receiver(None)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return list(kept_drives.frames()[:2])


def detections(frame: Frame, *settings: str, model: str = "demo", stored: bool = True) -> Detections:
    """Return the detections of a frame's camera, by networks that were loaded anew."""
    texts = [
        f"detector.model={model}",
        "detector.threads=1",
        *([] if stored else ["store.size=0"]),
        *settings,
    ]
    found = perceive(frame, config := load(settings=texts), StageLoader().load(config)).cameras[0].detections
    assert found is not None
    return found


def test_a_robots_images_leave_nothing_in_the_store(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    networks: list[object] = []

    def run(settings: ReloadableConfig, *others: object) -> int:
        (loader,) = [other for other in others if isinstance(other, StageLoader)]
        networks.append(loader.load(settings.config).network)
        return 0

    monkeypatch.setattr(live, "_run", run)
    assert main(["live", "--model", "demo"]) == 0
    assert isinstance(networks[0], Detector)
    assert not folder.exists()


def expect_equal(one: Any, other: Any) -> None:
    """Assert that two data classes of arrays are the same in every bit."""
    for field in fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes(), field.name
        elif a is not None and not isinstance(a, tuple):
            expect_equal(a, b)
        else:
            assert a == b, field.name


@pytest.fixture
def no_network(folder: Path, frames: list[Frame], monkeypatch: pytest.MonkeyPatch) -> None:
    """Fill the store with the frames. From then on, a network that runs on an image fails the test."""
    for frame in frames:
        assert len(detections(frame))
    run, inputs = NetworkSession.run, []

    def once(self: NetworkSession, feed: Any, wanted: Any = None) -> Any:
        inputs.append(feed)
        assert len(inputs) == 1, "the probe of the outputs alone may run"
        return run(self, feed, wanted)

    monkeypatch.setattr(NetworkSession, "run", once)


@pytest.mark.usefixtures("no_network")
def test_the_same_image_is_not_detected_twice(frames: list[Frame]) -> None:
    kept = detections(frames[0])
    assert len(kept) > 3


@pytest.mark.long
@pytest.mark.parametrize(
    "setting",
    [
        "detector.conf_threshold=0.6",
        "detector.iou_threshold=0.1",
        "detector.explain_threshold=0.2",
        "detector.max_candidates=2",
        "detector.classes=[person]",
        "clustering.eps=0.9",
    ],
)
@pytest.mark.usefixtures("no_network")
def test_other_thresholds_are_answered_by_the_store(
    setting: str, frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = detections(frames[1], setting)
    monkeypatch.undo()
    expect_equal(stored, detections(frames[1], setting, stored=False))


def test_weaker_candidates_than_kept_are_made_anew(folder: Path, frames: list[Frame]) -> None:
    few = detections(frames[0])
    many = detections(frames[0], "detector.explain_threshold=0.001", "detector.max_candidates=10000")
    assert len(many) > len(few) and many.score.min() < 0.01
    expect_equal(
        many,
        detections(
            frames[0], "detector.explain_threshold=0.001", "detector.max_candidates=10000", stored=False
        ),
    )


def segmenting_network(path: Path, seed: int = 0) -> str:
    """Save a network with three objects and masks of random shape."""
    draw = np.random.default_rng(seed)
    cells = sum((H // stride) * (W // stride) for stride in (8, 16, 32))
    table = np.zeros((1, 4 + 3 + 32, cells), np.float32)
    table[0, :4] = 4
    for column, (x, y, size) in enumerate([(20, 20, 24), (60, 30, 30), (22, 21, 24)]):
        table[0, :4, column] = x, y, size, size
        table[0, 4 + column % 2, column] = 0.9 - 0.2 * column
        table[0, 7:, column] = draw.normal(size=32)
    prototypes = draw.normal(size=(1, 32, H // 4, W // 4)).astype(np.float32)
    names = {"names": "{0: 'car', 1: 'person', 2: 'cyclist'}", "task": "segment"}
    return answer(path, {"output0": table, "output1": prototypes}, [image_input(1, 3, H, W)], names)


def test_masks_are_kept_for_each_set_of_detections(
    folder: Path, frames: list[Frame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = segmenting_network(tmp_path / "seg.onnx")
    first, stricter = detections(frames[0], model=model), "detector.conf_threshold=0.8"
    assert first.masks is not None and first.masks.packed.any()
    fewer = detections(frames[0], stricter, model=model)
    assert fewer.masks is not None and len(fewer.masks.packed) < len(first.masks.packed)
    plain = detections(frames[0], stricter, model=model, stored=False)
    expect_equal(plain, fewer)
    infer = StoredDetector._infer_masks
    monkeypatch.setattr(StoredDetector, "_infer_masks", lambda *_: pytest.fail("the network ran"))
    expect_equal(plain, detections(frames[0], stricter, model=model))
    expect_equal(first, detections(frames[0], model=model))
    monkeypatch.setattr(StoredDetector, "_infer_masks", infer)


# --- keys --------------------------------------------------------------------------------------


def identity_of(model: Path) -> bytes:
    return result_store._identity([model], "facts")


def test_another_version_of_bevviz_reads_no_entry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (model := tmp_path / "m.onnx").write_bytes(b"weights")
    ours = identity_of(model)
    assert identity_of(model) == ours
    monkeypatch.setattr(result_store, "__version__", "99.0")
    assert identity_of(model) != ours


def test_weights_beside_the_model_belong_to_its_identity(tmp_path: Path) -> None:
    (tmp_path / "m.onnx.data").write_bytes(b"one")
    (model := tmp_path / "m.onnx").write_bytes(b"...\n\x08location\x12\x0bm.onnx.data...")
    before = identity_of(model)
    (tmp_path / "m.onnx.data").write_bytes(b"two")
    os.utime(tmp_path / "m.onnx.data", ns=(1, 1))
    assert identity_of(model) != before


def test_arrays_of_other_shape_or_type_have_other_keys() -> None:
    numbers = np.arange(6, dtype=np.float32)
    same = [numbers, numbers.reshape(2, 3), numbers.view(np.int32), numbers[:5], numbers[::-1]]
    assert len({result_store.store_key("x", array) for array in same}) == len(same)
    assert result_store.store_key("ab", "c") != result_store.store_key("a", "bc")
    assert result_store.store_key(numbers.reshape(2, 3).T) == result_store.store_key(
        numbers.reshape(2, 3).T.copy()
    )


# --- the file ----------------------------------------------------------------------------------


def test_the_least_recently_used_results_go_first(tmp_path: Path) -> None:
    with ResultStore(tmp_path, 2 * MB) as store:
        for number, key in enumerate(KEYS):
            store.put(key, os.urandom(5000))
            store._run("UPDATE results SET used = ? WHERE key = ?", number, key)
        count, size = store.summary()
        assert 200 < count < 450 and size < 2.5 * MB
        assert store.get(KEYS[-1]) is not None and store.get(KEYS[0]) is None
    assert store.path.stat().st_size < 2.6 * MB


def test_a_smaller_size_shrinks_the_file(tmp_path: Path) -> None:
    with ResultStore(tmp_path, 9 * MB) as store:
        for key in KEYS[:1000]:
            store.put(key, os.urandom(5000))
    assert store.path.stat().st_size > 5 * MB
    with ResultStore(tmp_path, 1 * MB) as store:
        store.put(b"one more", b"value")
    assert store.path.stat().st_size < 1.1 * MB


def damage_entry(path: Path) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE results SET value = substr(value, 1, length(value) - 1) || x'99'")


def test_a_damaged_entry_is_computed_anew(folder: Path, frames: list[Frame]) -> None:
    good = detections(frames[0])
    damage_entry(folder / "results.sqlite")
    expect_equal(good, detections(frames[0]))


def test_objects_of_pickle_are_never_loaded(tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "exploded"),)

    target = io.BytesIO()
    np.save(target, np.array([Bomb()], dtype=object), allow_pickle=True)
    for content in (target.getvalue(), pickle.dumps(Bomb())):
        assert result_store._unpack(content, ((1, "f"),)) is None
    assert not (tmp_path / "exploded").exists()


def test_a_damaged_file_begins_anew_and_says_so(tmp_path: Path, lines: list[str]) -> None:
    with ResultStore(tmp_path, 9 * MB) as store:
        for key in KEYS[:100]:
            store.put(key, os.urandom(5000))
    content = bytearray(store.path.read_bytes())
    content[4096:-4096] = os.urandom(len(content) - 8192)
    store.path.write_bytes(content)
    with ResultStore(tmp_path, 9 * MB) as store:
        for key in KEYS[:200]:
            store.put(key, b"new")
        assert all(store.get(key) in (None, b"new") for key in KEYS[:200])
        assert store.get(KEYS[199]) == b"new"
    assert [line for line in lines if "begins anew" in line] == lines and len(lines) == 1


@pytest.mark.parametrize("kind", ["text", "sqlite"])
def test_a_file_of_another_program_stays_untouched(kind: str, tmp_path: Path, lines: list[str]) -> None:
    path = tmp_path / "results.sqlite"
    if kind == "text":
        path.write_text("mine\n" * 1000)
    else:
        with sqlite3.connect(path) as connection:
            connection.execute("CREATE TABLE mine (x)")
    before = path.read_bytes()
    with ResultStore(tmp_path, MB) as store:
        store.put(b"key", b"value")
        assert store.get(b"key") is None
    assert path.read_bytes() == before
    assert len(lines) == 1 and str(path) in lines[0] and "BEVVIZ_STORE" in lines[0]


def test_a_full_disk_is_one_line_and_the_run_goes_on(tmp_path: Path, lines: list[str]) -> None:
    with small_disk(tmp_path / "disk", "200k") as disk, ResultStore(disk, 9 * MB) as store:
        for key in KEYS[:100]:
            store.put(key, os.urandom(5000))
        assert store.get(KEYS[99]) is None
    assert len(lines) == 1 and "full" in lines[0]


def test_a_folder_that_cannot_be_made_is_one_line(
    folder: Path, frames: list[Frame], lines: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder.write_text("a file")
    assert len(detections(frames[0])) > 3
    assert len([line for line in lines if "no results are kept" in line]) == 1


def test_a_user_without_a_home_runs_without_a_store(
    lines: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("BEVVIZ_STORE")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    assert open_store(1) is None
    assert lines == ["no results are kept: this user has no home; set BEVVIZ_STORE"]


WRITER = """
import sys
from pathlib import Path
from bevviz.pipeline.result_store import ResultStore
with ResultStore(Path(sys.argv[1]), 10**9) as store:
    for number in range(300):
        key = str(number).encode()
        value = store.get(key)
        assert value in (None, key * 1000), "half of a value"
        store.put(key, key * 1000)
"""


@pytest.mark.long
def test_several_processes_share_the_file(tmp_path: Path) -> None:
    writers = [subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path)]) for _ in range(3)]
    assert [writer.wait(120) for writer in writers] == [0, 0, 0]
    with ResultStore(tmp_path, 10**9) as store:
        assert store.summary()[0] == 300
        assert store.get(b"7") == b"7" * 1000


# --- commands ----------------------------------------------------------------------------------


def test_the_command_shows_and_empties_the_store(
    folder: Path, frames: list[Frame], capsys: pytest.CaptureFixture[str]
) -> None:
    detections(frames[0])
    assert main(["store"]) == 0
    assert capsys.readouterr().out.startswith(f"{folder / 'results.sqlite'}: 1 results, ")
    assert main(["store", "--clear"]) == 0
    assert capsys.readouterr().out == f"{folder / 'results.sqlite'}: 1 results deleted\n"
    assert main(["store"]) == 0
    assert ": 0 results, " in capsys.readouterr().out


@pytest.mark.long
def test_redacted_reports_leave_nothing_in_the_store(folder: Path, tmp_path: Path) -> None:
    bag = tmp_path / "drive.mcap"
    assert main(["demo", "--frames", "3", "-o", str(bag), "--set", "store.size=0"]) == 0
    report = ["report", str(bag), "--at", "0.1", "--model", "demo", "--redact", "-o", str(tmp_path / "r.rrd")]
    assert main(report) == 0
    with ResultStore(folder, MB) as store:
        assert store.summary()[0] == 0
