"""Logger of frames whose data is taken in pieces, for the pages of the workbench."""

from __future__ import annotations

from collections.abc import Sequence

import rerun as rr

from bevviz.config import Config
from bevviz.model.frame import Scene
from bevviz.recording import entities
from bevviz.recording.frame_logger import FrameLogger
from bevviz.recording.stream import RecordingStream


class PieceLogger(FrameLogger):
    """Logger into a stream of its own, whose data is taken in pieces. Each piece is a whole ``.rrd``.

    Args:
        application: application id of the recording.
        recording_id: id of the recording, which all loggers of a page share.
        config, scene, wait, stamps, inputs: see ``FrameLogger``.
        batches: how Rerun batches the data.
    """

    def __init__(
        self,
        application: str,
        recording_id: str,
        config: Config,
        scene: Scene,
        *,
        wait: float = 0.0,
        stamps: Sequence[str] = (entities.STAMP,),
        inputs: bool | None = None,
        batches: rr.ChunkBatcherConfig | None = None,
    ) -> None:
        recording = RecordingStream(application, recording_id=recording_id, batcher_config=batches)
        recording.set_log_time_enabled(False)
        super().__init__(recording, config, scene, wait=wait, stamps=stamps, inputs=inputs)
        self._stream = rr.binary_stream(recording)

    def piece(self) -> bytes | None:
        """Return what was logged since the last piece. None: nothing was."""
        return self._stream.read()

    def close(self) -> None:
        """Drop what was not taken. Rerun warns about a stream with unread data."""
        super().close()
        self.piece()
