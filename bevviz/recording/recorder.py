"""Observers that record a run: the recorder, and a watch on the disk."""

from __future__ import annotations

from typing import Any

import rerun as rr

from bevviz.config import Config
from bevviz.model.protocols import Items, Observer
from bevviz.model.results import FrameResult
from bevviz.recording.frame_logger import FrameLogger
from bevviz.recording.sinks import OpenRecording
from bevviz.recording.writer import SCALAR_WAIT


class Recorder(Observer[FrameResult]):
    """Observer that writes a run to a recording.

    Args:
        recording: recording stream.
        config: configuration of the run; it is stored in the recording.
        network: device of the detector's network; it is stored in the recording.
    """

    def __init__(self, recording: rr.RecordingStream, config: Config, network: str = "") -> None:
        self.recording, self._config, self._network = recording, config, network

    def begin(self, items: Items[object]) -> None:
        """Log the static data."""
        self.logger = FrameLogger(
            self.recording, self._config, items.scene, wait=SCALAR_WAIT, network=self._network
        )
        self.logger.log_static()

    def observe(self, result: FrameResult) -> None:
        """Log a frame."""
        self.logger.log(result)

    def end(self) -> None:
        """Send data that waits."""
        self.logger.flush()

    @property
    def warnings(self) -> list[str]:
        """One sentence for each thing that the recording should have and lacks."""
        if not (times := self.logger.clouds_left_out):
            return []
        share = f"logging.raw_share={self._config.logging.raw_share:g}"
        return [f"raw clouds around what begins were left out {times} times: there are {share} of all frames"]


class DiskWatch(Observer[Any]):
    """Observer that ends a run if its recording can no longer be written."""

    def __init__(self, sinks: OpenRecording) -> None:
        self._sinks = sinks

    def observe(self, result: object) -> None:
        """Raise UserError if the recording can no longer be written."""
        self._sinks.check()
