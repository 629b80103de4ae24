"""One frame, run anew whenever the configuration's file is saved."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import rerun as rr

from bevviz.compare.differences import DIFFERENT, Change, FrameDifferences, differences, seen
from bevviz.compare.log import DifferenceLogger
from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.frame import Frame, FrameResult, Scene
from bevviz.live.settings import Settings
from bevviz.live.settings import differences as config_differences
from bevviz.logging import entities
from bevviz.logging.logger import Logger
from bevviz.logging.pieces import document
from bevviz.text import markdown, printable
from bevviz.variants import Variants, check_same_frames

ABOUT = "A is the version before, B the one that is shown."


@dataclass(frozen=True, slots=True)
class Version:
    """What one state of the file has made of the frame."""

    number: int
    config: Config
    changes: Mapping[str, str]  # dotted key -> old -> new, since the version before
    result: FrameResult
    found: FrameDifferences  # from the version before
    seconds: float  # from the save until everything is logged; of the first version from its start

    @property
    def text(self) -> str:
        """In one line."""
        counts = self.found.counts
        words = {Change.ONLY_A: "gone", Change.ONLY_B: "new"}
        said = [f"{counts[change]} {words.get(change, change)}" for change in DIFFERENT if counts[change]]
        changes = "; ".join(f"{key} {change}" for key, change in self.changes.items())
        failed = [f"{failure.stage} failed: {failure.reason}" for failure in self.result.failures]
        objects = f"{len(self.found.b.names)} objects" + (f" ({', '.join(said)})" if said else "")
        return printable("; ".join([f"version {self.number}: {changes or 'as it is'}: {objects}", *failed]))


class Tuner:
    """Watches a configuration and logs each version of it on the timeline ``version``.

    Args:
        frame: that is looked at; it was decoded once.
        settings: the configuration and its file.
        recording: where to.
        scene: names of the sensors.

    Raises:
        UserError: the detector's model cannot be used.
    """

    def __init__(self, frame: Frame, settings: Settings, recording: rr.RecordingStream, scene: Scene) -> None:
        self._frame, self._settings, self._scene = frame, settings, scene
        self._recording = recording
        self._variants = Variants()
        self._first = settings.config
        self._pending = False
        self._logger = Logger(recording, settings.config, scene)
        self._differences = DifferenceLogger(recording, ("version before", "this version"), ABOUT)
        self._logger.log_static()
        self.last = self._run(settings.config, time.time(), {})

    def poll(self) -> Version | None:
        """To be called every few milliseconds: the new version, once the file was saved and rests.

        Raises:
            UserError: the file as it was saved is no configuration, or none for this frame; the last
                version goes on.
        """
        if self._settings.changed():  # editors may write in several steps
            self._pending = True
            return None
        file = self._settings.file
        if not self._pending or file is None:
            return None
        try:
            stat = file.stat()
        except OSError:
            return None  # between two steps of an editor
        if stat.st_size == 0:
            return None  # being written
        self._pending = False
        config = self._settings.read()
        check_same_frames({"the first version": self._first, str(file): config})
        changes = config_differences(self.last.config, config)
        if not changes:
            return None
        self._variants.prepare(config)
        self._logger.reconfigure(config, self._scene)
        self.last = self._run(config, stat.st_mtime, changes)
        return self.last

    def _run(self, config: Config, since: float, changes: Mapping[str, str]) -> Version:
        number = self.last.number + 1 if changes else 0
        result = self._variants.run(self._frame, config)
        now = seen(result)
        before = self.last.found.b if changes else now
        found = differences(self._frame.index, self._frame.stamp, before, now)
        for writer in (self._logger, self._differences):
            writer.sequences = {entities.VERSION: number}
        self._logger.log(result)
        self._differences.log(found, self._frame.received, self._frame.pose)
        lines = [f"- {key}: {markdown(change)}" for key, change in changes.items()] or ["- the first one"]
        page = "\n".join([f"# Version {number}", "", *lines])
        self._recording.log(entities.TUNE, document(page))
        self._recording.flush()
        return Version(number, config, changes, result, found, time.time() - since)


def create(file: Path, text: str) -> bool:
    """Write the configuration's file where there is none. Returns whether there was none.

    Raises:
        UserError: it cannot be written.
    """
    try:
        with file.open("x") as new:
            new.write(text)
    except FileExistsError:
        return False
    except OSError as error:
        raise UserError(f"--config {file}: cannot be written: {error.strerror}") from None
    return True
