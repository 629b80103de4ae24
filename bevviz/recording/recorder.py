"""Logs every result of a run, and sees to it that it is written."""

from __future__ import annotations

from typing import Any

import rerun as rr

from bevviz.config import Config
from bevviz.model.protocols import Items, Observer
from bevviz.model.results import FrameResult
from bevviz.recording.frame_logger import Logger
from bevviz.recording.sinks import Sinks
from bevviz.recording.writer import WAIT


class Recorder(Observer[FrameResult]):
    """Writes a run to a recording.

    Args:
        recording: where to.
        config: that is stored as that of the run.
        network: what the detector's runs on; stored, too.
    """

    def __init__(self, recording: rr.RecordingStream, config: Config, network: str = "") -> None:
        self.recording, self._config, self._network = recording, config, network

    def begin(self, items: Items[object]) -> None:
        self.logger = Logger(self.recording, self._config, items.scene, wait=WAIT, network=self._network)
        self.logger.log_static()

    def see(self, result: FrameResult) -> None:
        self.logger.log(result)

    def end(self) -> None:
        self.logger.flush()

    @property
    def warnings(self) -> list[str]:
        """What the recording lacks that it was to have, one sentence each."""
        if not (times := self.logger.clouds_left_out):
            return []
        share = f"logging.raw_share={self._config.logging.raw_share:g}"
        return [f"raw clouds around what begins were left out {times} times: there are {share} of all frames"]


class DiskWatch(Observer[Any]):
    """Ends a run whose recording cannot be written any more: the rest would be for nothing."""

    def __init__(self, sinks: Sinks) -> None:
        self._sinks = sinks

    def see(self, result: object) -> None:
        self._sinks.check()
