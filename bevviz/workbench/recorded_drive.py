"""A recorded drive as the source of a page: run it, record it, run single frames with other values."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import replace

import numpy as np

from bevviz.bags.source import BagSource
from bevviz.drive import Drive
from bevviz.errors import UserError
from bevviz.findings.frame_findings import Finding, find_findings, findings_of
from bevviz.findings.marks import log_findings
from bevviz.findings.run_table import RunTable, StoredRun
from bevviz.model.frame import F32, Frame
from bevviz.model.protocols import FrameSource, Observer
from bevviz.model.results import FrameResult, Tracks
from bevviz.pipeline.run import run
from bevviz.recording import entities
from bevviz.recording.addresses import EntityRows
from bevviz.recording.frame_logger import logged_rows
from bevviz.why import Answer, FrameExplainer
from bevviz.why.robot_questions import RobotQuestions, object_topics, robot_questions
from bevviz.workbench.buffers import AHEAD, BufferReader, PageState, Reader, RecordingBuffer
from bevviz.workbench.drive_recording import DriveRecording, end_unused_streams
from bevviz.workbench.growing_drive import GrowingDrive, RunProgress, Settings
from bevviz.workbench.jobs import Job, Jobs
from bevviz.workbench.overview import LEAST, NumberedFrames, SingleFrames, overview_order
from bevviz.workbench.page_overlay import Attempt, PageOverlay
from bevviz.workbench.run_results import RunResults
from bevviz.workbench.thumbnails import Thumbnails

PATIENCE = 10.0  # seconds that close() waits for the run to end
NEIGHBOURS = (1, -1)  # frames that are made after the one that a page requests
FIRST = 6.0  # seconds that the run waits until a page has drawn the first frame


class RecordedDrive(GrowingDrive, Observer[FrameResult]):
    """Recorded drive as the source of a page. A run over all frames is recorded in the background.

    An overview of single frames comes before the run of a long drive. The run replaces its findings.

    Of a long drive the run records numbers only. A frame is recorded when a page looks at it.

    Args:
        drive: the drive that questions are about.
        again: the same frames a second time. The run reads them.
        first: number of the scan that is shown first.
        table: place of the list of a whole run. None: it is not kept.
        opened: called once a page shows the first frame, before the run.

    Attributes:
        recording: recording of the drive.
        lanes: buffers by name: ``recording``, the overlay of each page, and the runs with other values.
        results: results of the run, for the frames that it has reached.
        robot_bag: the bag a third time, for the robot's own chain. None: nobody has asked.
    """

    def __init__(
        self,
        drive: Drive,
        again: FrameSource,
        first: int = 0,
        table: RunTable | None = None,
        opened: Callable[[FrameExplainer], None] = lambda explainer: None,
    ) -> None:
        super().__init__(drive.scene.name, drive.session)
        self.has_truth = drive.scene.truth
        self.drive, self.again, self.scans = drive, again, len(drive)
        recording = getattr(drive.frames, "recording", None)
        self.single_frames = bool(getattr(recording, "single_frames", False))
        self._first, self._table, self._opened = first, table, opened
        self._is_listed = False  # whether the list is the complete one of an earlier run
        self.recording = DriveRecording(drive.scene, drive.config, self.again.total)
        self._thumbnails = Thumbnails(len(self.again.scans))
        self.lanes: dict[str, RecordingBuffer] = {"recording": self.recording.rows}
        self._overlays = 0  # number of overlays until now
        self._open_overlays: list[PageOverlay] = []
        self.results = RunResults()
        self._overview: NumberedFrames | None = None  # while it is made
        self._runs: Jobs[Job] = Jobs("run", self.news.tell)
        self._job = Job(0)  # the run, or its overview
        self._reached = 0  # newest stamp that the run has reached
        self.robot_bag: BagSource | None = None
        self._robot: RobotQuestions | None = None
        self._asking, self._counting = 0, threading.Lock()  # number of questions that are being answered
        self._quiet, self._go = threading.Event(), threading.Event()
        self._quiet.set()

    def start(self) -> None:
        """Start the run: record the frame that is shown first, then all frames in order."""
        is_known = self._load_list()
        self._runs.start(self._job, lambda job: self._run(job, is_known))

    def close(self) -> None:
        """Stop the run, then close the buffers and both sources."""
        self._runs.cancel()
        self._quiet.set()
        self._go.set()
        self._runs.end(PATIENCE)
        for buffer in self.lanes.values():
            buffer.close()
        self.recording.close()
        self.results.close()
        self.drive.close()
        self.again.close()
        with self.following:
            if self.robot_bag is not None:
                self.robot_bag.close()

    @property
    def on_demand(self) -> bool:
        """Whether a page gets a frame of the recording only when it looks at it."""
        return self.recording.on_demand

    def tracks(self, number: int) -> Tracks | None:
        """Return the tracks of the run in a frame, without their trails. None: the run has not reached it."""
        results = self.results.get(number)
        return None if results is None else results.tracks

    # --- run -----------------------------------------------------------------------------------

    @property
    def over(self) -> bool:
        """Whether the run over the drive has ended."""
        return not self._job.going

    def progress(self) -> RunProgress:
        """Return the progress of the run for the page."""
        overview = self._overview
        return {
            "phase": "overview" if overview is not None else "again" if self._is_listed else "run",
            "done": self._job.done,
            "total": self.again.total if overview is None else overview.total,
            "over": self.over,
            "error": self._job.error,
            "warnings": list(self.again.warnings) if self.over else [],
        }

    def _run(self, job: Job, is_known: bool) -> None:
        first = self.look(self._first)
        self.first = self._stamp_of(0)
        explainer = self.explainer(first)
        self.show(first, find_findings(explainer))
        self._go.wait(FIRST)
        self._opened(explainer)
        if self.again.total >= LEAST and not is_known:
            self._make_overview()
        with self.drive.new_session() as session:
            run(self.again, session, [self], stop=job.stop)
        if not (job.stop.is_set() or self._is_listed):
            self.findings.end_overview(self.scans)
            self._save_list()

    def _load_list(self) -> bool:
        """List the findings of an earlier run. Return whether they are kept.

        The run is still needed for the rest. It replaces a list without the reasons of missed objects.
        """
        stored = None if self._table is None else self._table.load()
        if stored is None:
            return False
        self.findings.restore(stored.groups, stay=stored.explained)
        with self._lock:
            self._stamps = {number: stamp for stamp, number in stored.frames}
            self._times = sorted((stamp, number) for stamp, number in stored.frames)
        if stored.explained:
            self._reached = max(self._stamps.values(), default=0)
            self._is_listed = True
        self.news.tell()
        return True

    def _save_list(self) -> None:
        """Keep the findings of the whole run."""
        if self._table is not None:
            self._table.save(StoredRun(self.findings.content(), self.frame_times()))

    def _make_overview(self) -> None:
        """List the findings of single frames all over the drive."""
        self._overview = NumberedFrames(self.again, overview_order(len(self.again.scans)))
        processor = SingleFrames(self.drive.session)
        run(self._overview, processor, [self], stop=self._job.stop)
        self._overview, self._job.done = None, 0

    def _observe_single(self, result: FrameResult) -> None:
        """List the findings of a frame of the overview. Then wait while a question is being answered.

        Missed objects get no reason yet: it would take several times as long as the frame itself. The remark
        on a row has it, and the run in order.
        """
        frame = result.frame
        self.findings.add_overview(frame.index, find_findings(self.explainer(result), restore=False))
        self._picture(frame)
        self._job.done += 1
        self.news.tell()
        self.wait_for_quiet()

    def go_on(self) -> None:
        """Let the run continue: a page shows the first frame."""
        self._go.set()

    def observe(self, result: FrameResult) -> None:
        """Record the next frame of the run. Then wait while a question is being answered."""
        if self._overview is not None:
            self._observe_single(result)
            return
        frame = result.frame
        findings = find_findings(self.explainer(result))
        if self.recording.on_demand:
            self.recording.add_numbers(result)
            self._picture(frame)
        else:
            self.show(result, findings)
        self.results.add(result)
        self._forget_unplaced(frame)
        self._reached = max(self._reached, frame.stamp)
        if not self._is_listed:
            self.findings.end_overview(frame.index)
            self.findings.add(findings)
        self._job.done += 1
        self.news.tell()
        self.wait_for_quiet()

    def _forget_unplaced(self, frame: Frame) -> None:
        """Forget what was computed of a frame before the run knew its pose."""
        number, with_pose = frame.index, frame.world_frame
        with self._lock:
            if (read := self._frames.get(number)) is not None and read.world_frame != with_pose:
                del self._frames[number]
            for key, known in list(self._results.items()):
                if key[0] == number and known.frame.world_frame != with_pose:
                    del self._results[key]

    def end(self) -> None:
        """Record the last scalars of the run."""
        self.recording.flush()

    def wait_for_quiet(self) -> None:
        """Wait until no question is being answered."""
        self._quiet.wait()

    @contextmanager
    def quiet(self) -> Iterator[None]:
        """Return a context in which the run pauses after its current frame."""
        with self._counting:
            self._asking += 1
            self._quiet.clear()
        try:
            yield
        finally:
            with self._counting:
                self._asking -= 1
                if not self._asking:
                    self._quiet.set()

    # --- recording -----------------------------------------------------------------------------

    def open_overlay(self) -> PageOverlay:
        """Return a new overlay. A page shows what is on its own overlay alone."""
        with self._lock:
            self._overlays += 1
            overlay = PageOverlay(f"overlay-{self._overlays}", self.recording, self.drive.config)
            self.lanes[overlay.lane] = overlay.buffer
            self._open_overlays.append(overlay)
        return overlay

    def close_overlay(self, overlay: PageOverlay) -> None:
        """Remove an overlay whose page is closed."""
        with self._lock:
            self.lanes.pop(overlay.lane, None)
            self._open_overlays.remove(overlay)
        overlay.close()
        end_unused_streams()

    def show(self, result: FrameResult, findings: Sequence[Finding]) -> None:
        """Record a frame of the run, which may come before frames that were recorded already."""
        self.recording.show(result, findings, self.first or result.frame.stamp)
        self._dim_again(result.frame.index)
        self._picture(result.frame)
        if self.opening is None:
            self.opening = result.frame.stamp
            self.news.tell()

    def _picture(self, frame: Frame) -> None:
        """Keep the stamp and the thumbnail of a frame."""
        self._thumbnails.add(frame)
        self.know(frame)

    def thumbnail(self, number: int) -> bytes | None:
        """Return a small image of the camera near a frame as JPEG. None: there is none yet."""
        return self._thumbnails.near(number)

    def reader(self, lane: str, first: int, state: PageState) -> AbstractContextManager[Reader]:
        """Return a context in which a page reads the recording, its overlay, or a run with other values.

        Raises:
            UserError: there is no such buffer.
        """
        buffer = self.lanes.get(lane)
        if buffer is None:
            raise UserError(f"there is no recording '{lane}'")
        if lane == "recording":
            return nullcontext(DriveReader(self, first, state))
        row_of = None if lane.startswith("overlay") else lambda _: None
        return nullcontext(BufferReader(buffer, first, state, row_of))

    def version(self, number: int) -> int:
        """Return 1 once the run has reached a frame, so that it has tracks and its pose."""
        return int(number in self.results)

    def piece(self, number: int, *, wanted: bool) -> bytes | None:
        """Return the recording of a frame on demand.

        Args:
            number: number of the frame.
            wanted: whether a page waits for it. The run pauses then.
        """
        try:
            with self.quiet() if wanted else nullcontext():
                result = self.look(number) if wanted else self.look_aside(number)
                findings = find_findings(self.explainer(result))
                piece = self.recording.draw(self._with_tracks(result), findings)
        except UserError:  # There is no such frame, or it cannot be read.
            return None
        self._picture(result.frame)
        self.news.tell()
        return piece

    def _with_tracks(self, result: FrameResult) -> FrameResult:
        """Return the result of a frame as opened, with its tracks if the run has reached it."""
        number = result.frame.index
        if (tracks := self.tracks(number)) is None:
            return result
        return replace(result, tracks=replace(tracks, trail=self._trail(number, tracks)))

    def _trail(self, number: int, tracks: Tracks) -> F32:
        """Return the trails of the tracks of a frame, from the tracks of the frames before."""
        span, stamp = self.drive.config.tracking.trail * 1e9, self._stamps[number]
        columns = [tracks.boxes.center]
        earlier = number - 1
        while (before := self.tracks(earlier)) and stamp - self._stamps[earlier] <= span:
            places = np.full((len(tracks), 3), np.nan, np.float32)
            _, rows, rows_before = np.intersect1d(tracks.id, before.id, return_indices=True)
            places[rows] = before.boxes.center[rows_before]
            columns.insert(0, places)
            earlier -= 1
        return np.stack(columns, axis=1).astype(np.float32)

    # --- single frames -------------------------------------------------------------------------

    def number_at(self, stamp: int) -> int:
        """Return the number of the frame that a viewer shows at a stamp. The run may not have reached it yet.

        Raises:
            UserError: no frame has been run yet.
        """
        times = self.frame_times()
        if not times:
            raise UserError("no frame has been run yet")
        at, number = self.shown_at(stamp) or times[0]
        if self.over or stamp <= self._reached or abs(stamp - at) <= entities.TIME_TOLERANCE:
            return number
        return self._find_frame(stamp, number)

    def _find_frame(self, stamp: int, start: int) -> int:
        """Return the last frame that is not later. The search starts at the estimate from the log times."""
        scans = self.drive.frames.scans
        number = int(np.abs(scans - (stamp + int(scans[start]) - self._stamp_of(start))).argmin())
        while number > 0 and self._stamp_of(number) > stamp + entities.TIME_TOLERANCE:
            number -= 1
        while number + 1 < len(scans) and self._stamp_of(number + 1) <= stamp + entities.TIME_TOLERANCE:
            number += 1
        return number

    def _stamp_of(self, number: int) -> int:
        """Return the stamp of a frame, or its log time if the frame cannot be read."""
        if number in self._stamps:
            return self._stamps[number]
        with suppress(UserError):
            return self._frame(number).stamp
        return int(self.drive.frames.scans[number])

    def read(self, number: int) -> Frame:
        """Read a frame from the bag.

        Raises:
            UserError: there is no such frame, or it cannot be read.
        """
        return self.drive.raw(number)

    def robot_questions(self, number: int) -> RobotQuestions | None:
        """Return the questions about the robot's chain around a frame, see ``GrowingDrive``."""
        frames = self.drive.frames
        if not isinstance(frames, BagSource) or len(object_topics(frames)) < 2:
            return None
        if self.robot_bag is None:  # A bag of its own: other questions need not wait for it.
            self.robot_bag = BagSource(frames.recording.paths, frames.config)
        frame = self.robot_bag.frame(number)
        if frame is None:
            raise UserError(f"frame {number} cannot be read")
        self._robot = robot_questions(self.robot_bag, frame, self._robot)
        return self._robot

    def entity_rows(self, number: int, settings: Settings) -> EntityRows:
        """Return the rows behind the entities of a frame as it was drawn."""
        rows = self.recording.entity_rows(number, settings)
        if rows is None:
            result = self.look(number, settings)
            findings = findings_of(self.explainer(result).traces)
            drawn = result if settings else self._with_tracks(result)
            rows = logged_rows(drawn, lambda writer: log_findings(writer, result, findings, dashed=False))
        return rows

    def mark(self, result: FrameResult, answer: Answer, overlay: PageOverlay | None) -> None:
        """Mark the object of an answer in every view of a page."""
        if overlay is not None:
            overlay.mark(result, answer)

    def _dim_again(self, number: int) -> None:
        """Dim a frame that was drawn again in the pages that have marked an object of it."""
        with self._lock:
            overlays = [*self._open_overlays]
        for overlay in overlays:
            if overlay.marked is not None and overlay.marked[0].frame.index == number:
                overlay.mark(*overlay.marked)

    def try_values(
        self, number: int, settings: Settings, attempt: Attempt | None = None
    ) -> tuple[FrameResult, FrameResult]:
        """Log a frame with other values for a page. Return its result before and after.

        Raises:
            UserError: as ``look``, or the attempt was stopped.
        """
        if attempt is not None:
            attempt.check()
        before, after = self.look(number), self.look(number, settings)
        if attempt is not None:
            attempt.check()
            self.recording.draw_tried(attempt.logger, self.explainer(after), settings, attempt.overlay.known)
            attempt.logger.flush()
            attempt.overlay.add_tried(attempt)
        return before, after


class DriveReader(BufferReader):
    """Reader of a drive. Of one with frames on demand: the rows, then the frames that this page looks at.

    Args:
        drive: the drive.
        first: row of the first piece.
        state: state of the page.
    """

    def __init__(self, drive: RecordedDrive, first: int, state: PageState) -> None:
        super().__init__(drive.recording.rows, first, state, self._row_at)
        self._drive = drive
        self._requested = -1  # number of the frame that the page waits for
        self._queue: list[int] = []  # numbers of the frames to make
        self._versions: dict[int, int] = {}  # of the frames that the page has

    def take(self) -> Sequence[bytes | str]:
        """Return the next row, or the frame to send now."""
        if not self._drive.on_demand:
            return super().take()
        pieces: tuple[bytes | str, ...] = ()
        if self._next < len(self._buffer):
            pieces = (self._buffer[self._next],)
            self._next += 1
        elif (frame := self._frame()) is not None:
            pieces = str(frame[0]), frame[1]
        self._sent += bool(pieces)
        return pieces

    def _row_at(self, stamp: int) -> int | None:
        """Return the row of the frame that a viewer shows at a stamp. None: it is not recorded."""
        recorded = self._drive.shown_at(stamp)
        return None if recorded is None else self._drive.recording.row(recorded[0])

    def _pieces(self, row: int) -> Sequence[bytes | str]:
        """Return the piece of a row, after the number of its frame. The page tells what it lacks."""
        number = self._drive.recording.number_in(row)
        return super()._pieces(row) if number is None else (str(number), self._buffer[row])

    def _frame(self) -> tuple[int, bytes] | None:
        """Return the next frame and its number. None: the page waits for nothing, or can take no more."""
        while not self._state.gone:
            stamp = None
            while self._state.requested:  # The newest one counts: the user has moved on from the others.
                stamp = self._state.requested.pop(0)
            if stamp is not None:
                self._requested = number = self._drive.number_at(stamp)
                self._queue = [number, *(number + by for by in NEIGHBOURS)]
            if not self._queue:
                return None
            wanted = self._queue[0] == self._requested
            if not wanted and self._sent >= self._state.count + AHEAD:
                return None
            number = self._queue.pop(0)
            version = self._drive.version(number)
            if self._versions.get(number) != version:
                piece = self._drive.piece(number, wanted=wanted)
                if piece is not None:
                    self._versions[number] = version
                    return number, piece
        return None
