"""Recording of a drive in pieces for the pages: all of a short drive, frames on demand of a long one."""

from __future__ import annotations

import bisect
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import rerun as rr
import rerun_bindings

from bevviz.config import Config
from bevviz.findings.frame_findings import Finding, find_findings
from bevviz.findings.marks import log_findings
from bevviz.model.frame import Frame, Scene
from bevviz.model.results import FrameResult
from bevviz.recording import blueprints, entities
from bevviz.recording.addresses import EntityRows, RowCache
from bevviz.recording.focus import Focus, log_focus, log_robot_from_above
from bevviz.recording.writer import SCALAR_WAIT
from bevviz.support.contexts import Closable
from bevviz.why import FrameExplainer
from bevviz.workbench.buffers import RecordingBuffer
from bevviz.workbench.piece_logger import PieceLogger

WHOLE = 400_000_000  # bytes of a recording that a browser holds as a whole
TOGETHER = 50, 800  # frames whose numbers are sent together: the first ones, and most
BOTH = (entities.STAMP, entities.TRIED)


class DriveRecording(Closable):
    """Recording of a drive.

    A frame of the drive as opened is logged on the timelines ``stamp`` and ``tried``. One with other values
    is logged on ``tried`` alone. A viewer shows one or the other by its choice of timeline.

    Args:
        scene: names of the sensors.
        config: configuration of the drive.
        total: number of frames of the drive.

    Attributes:
        scene: names of the sensors, and whether the views move.
        rows: pieces that every page gets. The first has the layout, the static data and a frame.
        on_demand: whether pages get further frames only on demand, because they hold no whole recording.
        logger: makes a logger of results of a configuration, for a further thread that writes to it.
        usual_focus: where the views look without a subject. None: no frame was shown yet.
    """

    def __init__(self, scene: Scene, config: Config, total: int) -> None:
        self.scene, self._config, self._total = replace(scene, moving=bool(scene.lidar)), config, total
        self.rows, self.on_demand = RecordingBuffer(), False
        self.usual_focus: Focus | None = None
        self._rows_by_stamp: dict[int, int] = {}
        self._numbers_by_row: dict[int, int] = {}
        self._drawn: list[tuple[int, int, int]] = []  # stamp, number and receive time, sorted
        self._rows = RowCache()  # by frame number and settings
        self._recoloured: set[int] = set()  # numbers of frames whose raw cloud was drawn with other values
        self._drawing = threading.Lock()  # guards the frames on demand, and the logger that draws them
        self._waiting_numbers = 0  # frames whose numbers are logged and not sent
        self._together = TOGETHER[0]  # Few large pieces take a quarter of the bytes of many small ones.
        ids = blueprints.application_id("workbench", self.scene, config), f"bench-{time.time_ns()}"
        self.logger = partial(PieceLogger, *ids, scene=self.scene, stamps=BOTH)
        self._logger = self.logger(config, wait=SCALAR_WAIT)
        layout = blueprints.load("workbench", self.scene, config)
        self._logger.recording.send_blueprint(layout, make_active=True)
        self._logger.apart = True  # Pages receive frames in any order, so each is complete.
        self._logger.log_static()
        if self.scene.moving:
            log_robot_from_above(self._logger, scene.lidar)
        self._numbers: PieceLogger | None = None  # logger of the numbers of a long drive

    def close(self) -> None:
        """Delete all pieces."""
        self._logger.close()
        if self._numbers is not None:
            self._numbers.close()
        self.rows.close()

    def tried_logger(self, config: Config | None = None) -> PieceLogger:
        """Return a logger that writes tried results on a timeline of their own."""
        stamps = (entities.TRIED,)
        return self.logger(config or self._config, wait=SCALAR_WAIT, stamps=stamps, inputs=False)

    # --- frames as opened ----------------------------------------------------------------------

    def show(self, result: FrameResult, findings: Sequence[Finding], first: int) -> None:
        """Record a frame for all pages, which may come before frames that were recorded already.

        The first one decides whether the others come on demand.

        Args:
            result: result of the frame.
            findings: its findings.
            first: first stamp of the drive, from which on the views have poses.
        """
        with self._drawing:
            if self.scene.moving and not self._rows_by_stamp:
                self._log_usual_focus(result.frame, first)
            piece = self._drawn_piece(result, findings)
        if not self._rows_by_stamp and len(piece) * self._total > WHOLE:
            self.on_demand = True
            self._logger.streams_video = False  # A page may lack the packets that a picture depends on.
        self._rows_by_stamp[result.frame.stamp] = len(self.rows)
        self._numbers_by_row[len(self.rows)] = result.frame.index
        self.rows.add(piece)

    def _log_usual_focus(self, frame: Frame, first: int) -> None:
        """Log the poses of the views without a subject."""
        self.usual_focus = focus = Focus.usual(frame, self.scene.cameras)
        log_focus(self._logger, replace(frame, stamp=first), focus, 0)

    def row(self, stamp: int) -> int | None:
        """Return the row of the frame with this stamp."""
        return self._rows_by_stamp.get(stamp)

    def number_in(self, row: int) -> int | None:
        """Return the number of the frame that a row has. None: it has none."""
        return self._numbers_by_row.get(row)

    def draw(self, result: FrameResult, findings: Sequence[Finding]) -> bytes:
        """Return the piece of a frame on demand. It is complete in itself."""
        with self._drawing:
            self._logger.refresh()
            return self._drawn_piece(result, findings)

    def _drawn_piece(self, result: FrameResult, findings: Sequence[Finding]) -> bytes:
        """Log a frame. The next frame of those that were drawn before clears what it did not know of."""
        frame, logger = result.frame, self._logger
        known, time_of = logger.known, (frame.stamp, frame.index, frame.received)
        self._log(logger, result, findings, ())
        place = bisect.bisect_left(self._drawn, time_of)
        if self._drawn[place : place + 1] != [time_of]:
            self._drawn.insert(place, time_of)
        if new := logger.known - known if place + 1 < len(self._drawn) else ():
            stamp, number, received = self._drawn[place + 1]
            logger.clear_at(number, stamp, received, frozenset(new))
        if self.on_demand:
            logger.flush()
        return logger.piece() or b""

    def add_numbers(self, result: FrameResult) -> None:
        """Record the numbers and states of the next frame of the run, of which pages get no frame."""
        if self._numbers is None:
            never = rr.ChunkBatcherConfig.NEVER()
            self._numbers = self.logger(self._config, wait=float("inf"), inputs=False, batches=never)
        self._numbers.log_numbers(result)
        self._waiting_numbers += 1
        if self._waiting_numbers >= self._together:
            self._together = min(2 * self._together, TOGETHER[1])
            self.flush()

    def flush(self) -> None:
        """Record what waits of the run."""
        self._waiting_numbers = 0
        with self._drawing:
            self._logger.flush()
            self.rows.add(self._logger.piece())
        if self._numbers is not None:
            self._numbers.flush()
            self.rows.add(self._numbers.piece())

    # --- frames with other values --------------------------------------------------------------

    def draw_tried(
        self,
        logger: PieceLogger,
        explainer: FrameExplainer,
        settings: tuple[str, ...],
        known: frozenset[str] = frozenset(),
    ) -> None:
        """Log a frame with these settings beside the result of the run. Clear what is ``known`` of others."""
        result = explainer.traces.result
        logger.refresh(self._logger.results | known)
        # The colours of the cloud show ground and obstacles. A frame that was recoloured once is
        # always drawn again, so that its colours change back, too.
        config, opened, number = result.config, self._config, result.frame.index
        if (config.voxel, config.ground) != (opened.voxel, opened.ground):
            self._recoloured.add(number)
        self._log(logger, result, find_findings(explainer), settings, cloud=number in self._recoloured)

    def entity_rows(self, number: int, settings: tuple[str, ...]) -> EntityRows | None:
        """Return the rows behind the entities of a frame as drawn. None: they are not kept.

        Over the input of the sensors, a frame with other values shows the frame as opened.
        """
        rows = self._rows.get((number, settings))
        if rows is None or not settings:
            return rows
        opened = self._rows.get((number, ())) or {}
        return {path: opened[path] for path in opened.keys() - self._logger.results} | dict(rows)

    def _log(
        self,
        logger: PieceLogger,
        result: FrameResult,
        findings: Sequence[Finding],
        settings: tuple[str, ...],
        *,
        cloud: bool = False,
    ) -> None:
        def log_more() -> None:
            log_findings(logger, result, findings, dashed=False)

        if self.on_demand and not settings:
            logger.log_frame(result, log_more)
        else:
            logger.log(result, log_more=log_more, cloud=cloud)
        self._rows.put((result.frame.index, settings), logger.rows)


def end_unused_streams() -> None:
    """End the threads of streams that nothing refers to. Rerun itself ends them at ``rerun.init`` alone."""
    rerun_bindings.flush_and_cleanup_orphaned_recordings()
