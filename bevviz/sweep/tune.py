"""Tuning on one frame: run it again whenever the configuration file is saved."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path

import rerun as rr

from bevviz.compare.differences import DIFFERENT, Change, FrameDifferences, differences, seen
from bevviz.compare.log import DifferenceLogger
from bevviz.config import Config, ParameterChange, changes
from bevviz.config.reloading import ReloadableConfig
from bevviz.errors import UserError
from bevviz.model.frame import Frame, Scene
from bevviz.model.protocols import Items, Observer
from bevviz.model.results import FrameResult
from bevviz.pipeline.perceive import add_explanations
from bevviz.pipeline.session import Variants, check_same_frames
from bevviz.recording import entities
from bevviz.recording.frame_logger import FrameLogger
from bevviz.recording.primitives import document
from bevviz.support.files import save_text
from bevviz.support.text import markdown, printable

ABOUT = "A is the version before, B the one that is shown."
LOOK = 0.01  # seconds between two looks at the file


@dataclass(frozen=True, slots=True)
class ConfigSave:
    """One saved state of the configuration file."""

    config: Config
    changes: Mapping[str, ParameterChange]  # since the state before
    time: float  # of the save; for the first state, of the start


@dataclass(frozen=True, slots=True)
class Version:
    """The result of one saved state for the frame."""

    number: int
    save: ConfigSave
    result: FrameResult
    found: FrameDifferences  # from the version before

    @property
    def text(self) -> str:
        """Changes, objects and failures in one line."""
        counts = self.found.counts
        words = {Change.ONLY_A: "gone", Change.ONLY_B: "new"}
        different = [
            f"{counts[change]} {words.get(change, change)}" for change in DIFFERENT if counts[change]
        ]
        changed = "; ".join(f"{key} {change}" for key, change in self.save.changes.items())
        failed = [f"{failure.stage} failed: {failure.reason}" for failure in self.result.failures]
        objects = f"{len(self.found.b.names)} objects" + (f" ({', '.join(different)})" if different else "")
        return printable("; ".join([f"version {self.number}: {changed or 'as it is'}: {objects}", *failed]))


class ConfigSaves:
    """Iterable over the states of a configuration file: the present one, then each saved one, until ``stop``.

    Args:
        settings: the configuration and its file.
        scene: scene of the frame.
        check: raises UserError where a configuration cannot be run.
        tell: called with the error of a state that is skipped.
    """

    total = None
    warnings = ()

    def __init__(
        self,
        settings: ReloadableConfig,
        scene: Scene,
        check: Callable[[Config], None],
        tell: Callable[[UserError], None],
    ) -> None:
        self.scene = scene
        self._settings, self._check, self._tell = settings, check, tell
        self._first = self._last = settings.config
        self._pending = False
        self._stopped = threading.Event()

    def stop(self) -> None:
        """End the iteration, from any thread."""
        self._stopped.set()

    def __iter__(self) -> Iterator[ConfigSave]:
        yield ConfigSave(self._first, {}, time.time())
        while not self._stopped.wait(LOOK):
            try:
                save = self._look()
            except UserError as error:
                self._tell(error)
                continue
            if save is not None:
                yield save

    def _look(self) -> ConfigSave | None:
        """Return the new state once the file was saved and no longer changes, else None."""
        if self._settings.changed():  # Editors may write in several steps.
            self._pending = True
            return None
        file = self._settings.file
        if not self._pending or file is None:
            return None
        try:
            stat = file.stat()
        except OSError:
            return None  # The editor is between two steps.
        if stat.st_size == 0:
            return None  # The editor is still writing.
        self._pending = False
        config = self._settings.read()
        check_same_frames({"the first version": self._first, str(file): config})
        changed = changes(self._last, config)
        if not changed:
            return None
        self._check(config)
        self._last = config
        return ConfigSave(config, changed, stat.st_mtime)


class FrameTuner:
    """A frame that was decoded once, and its version for each state of the file."""

    def __init__(self, frame: Frame) -> None:
        self._frame = frame
        self._variants = Variants()
        self._last: Version | None = None

    def check(self, config: Config) -> None:
        """Raise a UserError if the configuration cannot be run."""
        self._variants.check(config)

    def perceive(self, save: ConfigSave, network: Executor | None = None) -> Version:
        """Run the frame with a saved state. Compare it with the version before."""
        result = self._variants.perceive(self._frame, save.config, network)
        current, last = seen(result), self._last
        before = last.found.b if last is not None else current
        diff = differences(self._frame.index, self._frame.stamp, before, current)
        self._last = Version(0 if last is None else last.number + 1, save, result, diff)
        return self._last

    def finish(self, version: Version) -> Version:
        """Add the explanations to the result of a version."""
        return replace(version, result=add_explanations(version.result))


class VersionRecorder(Observer[Version]):
    """Observer that logs each version on the timeline ``version``.

    Args:
        recording: recording to log to.
        config: configuration of the first version.
        tell: called after logging with each version and the seconds since it was saved.
    """

    def __init__(
        self, recording: rr.RecordingStream, config: Config, tell: Callable[[Version, float], None]
    ) -> None:
        self._recording, self._config, self._tell = recording, config, tell

    def begin(self, items: Items[object]) -> None:
        """Log the static entities."""
        self._scene = items.scene
        self._logger = FrameLogger(self._recording, self._config, items.scene)
        self._differences = DifferenceLogger(self._recording, ("version before", "this version"), ABOUT)
        self._logger.log_static()

    def observe(self, version: Version) -> None:
        """Log one version and its differences from the version before."""
        result, frame, save = version.result, version.result.frame, version.save
        if save.changes:
            self._logger.reconfigure(save.config, self._scene)
        for writer in (self._logger, self._differences):
            writer.sequences = {entities.VERSION: version.number}
        self._logger.log(result)
        self._differences.log(version.found, frame.received, frame.pose)
        lines = [f"- {key}: {markdown(str(change))}" for key, change in save.changes.items()] or [
            "- the first one"
        ]
        page = "\n".join([f"# Version {version.number}", "", *lines])
        self._recording.log(entities.TUNE, document(page))
        self._recording.flush()
        self._tell(version, time.time() - save.time)


def create_config_file(file: Path, text: str) -> bool:
    """Write the configuration file if it does not exist. Return whether it was written.

    Raises:
        UserError: the file cannot be written.
    """
    if file.exists():
        return False
    save_text(file, text, "--config")
    return True
