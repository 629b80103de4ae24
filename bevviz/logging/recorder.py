"""Logs every result of a run."""

from __future__ import annotations

import rerun as rr

from bevviz.config import Config
from bevviz.frame import FrameResult
from bevviz.logging.logger import Logger
from bevviz.logging.writer import WAIT
from bevviz.run import Items, Observer


class Recorder(Observer[FrameResult]):
    """Writes a run to a recording.

    Args:
        recording: where to.
        config: that is stored as that of the run.
    """

    def __init__(self, recording: rr.RecordingStream, config: Config) -> None:
        self.recording, self._config = recording, config

    def begin(self, items: Items[object]) -> None:
        self.logger = Logger(self.recording, self._config, items.scene, wait=WAIT)
        self.logger.log_static()

    def see(self, result: FrameResult) -> None:
        self.logger.log(result)

    def end(self) -> None:
        self.logger.flush()
