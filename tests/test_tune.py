"""A configuration that is watched: each save is run on the one frame, and what is wrong with it is told."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from functools import cache
from pathlib import Path
from queue import Empty, Queue
from typing import Any, Self

import pytest

from bevviz.cli import main
from bevviz.compare.differences import Change
from bevviz.config import config_yaml, load
from bevviz.config.reloading import ReloadableConfig
from bevviz.errors import UserError
from bevviz.model.frame import Frame
from bevviz.pipeline.run import DropPolicy, run
from bevviz.recording.sinks import open_recording
from bevviz.stages import detector
from bevviz.sweep.tune import ConfigSaves, FrameTuner, Version, VersionRecorder, create_config_file
from bevviz.synthetic import SyntheticSource
from tests.support import bags
from tests.support.recordings import Recording, verify
from tests.support.waiting import PATIENCE

MODEL = "detector.model=demo"


@cache
def source() -> SyntheticSource:
    return SyntheticSource(20, 3)


@cache
def frame() -> Frame:
    return source().snapshot(12).frame


class Tuned:
    """``bevviz tune`` on ``my.yaml``, logging to ``t.rrd``, beside the test."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "my.yaml"
        self.file.write_text("")
        self.versions: Queue[Version | UserError] = Queue()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(folder / "t.rrd",))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self, path: Path) -> None:
        settings, one = ReloadableConfig(self.file, [MODEL]), FrameTuner(frame())
        saves = ConfigSaves(settings, source().scene, one.check, self.versions.put)
        with open_recording(source().scene, settings.config, save=path, blueprint="tune") as sinks:
            recorder = VersionRecorder(
                sinks.recording, settings.config, lambda version, seconds: self.versions.put(version)
            )
            run(saves, one, [recorder], dropping=DropPolicy(), stop=self._stop)

    def save(self, text: str) -> None:
        time.sleep(0.05)  # the file system's clock may be coarse
        self.file.write_text(text)

    def version(self) -> Version:
        found = self.versions.get(timeout=PATIENCE)
        assert isinstance(found, Version), found
        return found

    def refusal(self) -> str:
        found = self.versions.get(timeout=PATIENCE)
        assert isinstance(found, UserError), found
        return str(found)

    def silence(self) -> None:
        with pytest.raises(Empty):
            self.versions.get(timeout=0.5)


def test_each_save_is_a_new_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inferred: list[int] = []
    infer = detector.Detector.infer

    def counted(self: detector.Detector, bgr: Any, least: float) -> Any:
        inferred.append(1)
        return infer(self, bgr, least)

    monkeypatch.setattr(detector.Detector, "infer", counted)
    with Tuned(tmp_path) as tuned:
        first = tuned.version()
        assert first.number == 0
        assert first.text.startswith(f"version 0: as it is: {len(first.found.b.names)} objects")
        tuned.silence()
        tuned.save("clustering:\n  min_cluster_points: 100000\n")
        one = tuned.version()
        assert {key: str(change) for key, change in one.save.changes.items()} == {
            "clustering.min_cluster_points": "10 -> 100000"
        }
        assert one.found.counts == {Change.ONLY_A: len(first.found.b.names)}
        assert one.text.endswith(f": 0 objects ({len(first.found.b.names)} gone)")
        tuned.save("")  # an editor has only begun to write
        tuned.silence()
        tuned.save("detector:\n  conf_threshold: 0.9\n")
        two = tuned.version()
        assert two.number == 2
        assert set(two.save.changes) == {"clustering.min_cluster_points", "detector.conf_threshold"}
        tuned.save("detector:\n  conf_threshold: 0.9\n")  # saved, but as it was
        tuned.silence()
    assert len(inferred) == 1
    verify(tmp_path / "t.rrd")
    recording = Recording(tmp_path / "t.rrd")
    assert [row["version"] for row in recording.rows["/tune"]] == [0, 1, 2]
    assert [row["version"] for row in recording.rows["/bev"]] == [0, 1, 2]
    pages = [row["TextDocument:text"][0] for row in recording.rows["/tune"]]
    assert "- clustering.min_cluster_points: 10 -> 100000" in pages[1]
    gone = recording.rows["/compare/objects/only_a"][0]
    assert gone["version"] == 1
    assert len(gone["Boxes3D:centers"]) == len(first.found.b.names)
    assert {row["version"] for row in recording.rows["/explain/log"]} <= {0, 1, 2}


def test_an_invalid_configuration_is_refused(tmp_path: Path) -> None:
    with Tuned(tmp_path) as tuned:
        assert tuned.version().number == 0
        for text, message in (
            ("clustering:\n  eps: -1\n", "clustering.eps must be greater than 0"),
            ("clustering:\n  epsilon: 1\n", "unknown key"),
            ("clustering: [", "not valid YAML"),
            ("sync:\n  tolerance: 0.05\n", "differ in sync.tolerance"),
            ("detector:\n  classes: [dragon]\n", "the model has no class 'dragon'"),
        ):
            tuned.save(text)
            refusal = tuned.refusal()
            assert message in refusal
            assert "\n" not in refusal
        tuned.save("clustering:\n  eps: 0.8\n")
        assert tuned.version().number == 1
        (tmp_path / "my.yaml").unlink()
        tuned.silence()


def test_a_missing_file_is_created_once(tmp_path: Path) -> None:
    file = tmp_path / "my.yaml"
    config = load(settings=["clustering.eps=0.7"], preset="reference")
    assert create_config_file(file, config_yaml(config))
    assert load(file) == config
    assert not create_config_file(file, "")
    assert load(file) == config
    with pytest.raises(UserError, match="cannot write the file"):
        create_config_file(tmp_path / "none" / "my.yaml", "")


def test_the_command_shows_each_saved_version(tmp_path: Path) -> None:
    messages = bags.Messages()
    bags.write(tmp_path / "drive", bags.small_items(messages, scans=3), messages)
    command = [sys.executable, "-m", "bevviz.cli", "tune", "drive", "--at", "0.1", "--save", "t.rrd"]
    process = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout is not None
    said: list[str] = []

    def until(words: str) -> str:
        assert process.stdout is not None
        for line in process.stdout:
            said.append(line)
            if words in line:
                return line
        raise AssertionError("".join(said))

    try:
        until("save bevviz.yaml to run it again")
        file = tmp_path / "bevviz.yaml"
        text = file.read_text()
        file.write_text(text.replace("  eps: 0.5 ", "  eps: 0.75 "))
        assert "clustering.eps 0.5 -> 0.75" in until("version 1")
        time.sleep(0.05)
        file.write_text(text.replace("  eps: 0.5 ", "  eps: -1 "))
        assert "clustering.eps must be greater than 0" in until("not taken")
    finally:
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, rest
    assert "ended at version 1" in rest
    assert len(Recording(tmp_path / "t.rrd").rows["/tune"]) == 2


def test_wrong_calls_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.chdir(tmp_path)
    messages = bags.Messages()
    bags.write(tmp_path / "drive", bags.small_items(messages, scans=2), messages)
    for arguments, message in (
        (["drive", "--at", "100"], "100 is outside the recording"),
        (["drive", "--config", "none/my.yaml"], "my.yaml: cannot write the file: No such file"),
        (["drive", "--model", "none.onnx"], "detector.model none.onnx: no such file"),
    ):
        assert main(["tune", *arguments]) == 2
        assert message in capsys.readouterr().err.splitlines()[-1]
        Path("bevviz.yaml").unlink(missing_ok=True)
