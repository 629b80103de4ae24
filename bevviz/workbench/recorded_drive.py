"""A recorded drive as the source of a page: run it, record it, run single frames with other values."""

from __future__ import annotations

import bisect
import threading
import time
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from bevviz.anomalies import Onsets
from bevviz.config import Config, changed_config
from bevviz.drive import Drive
from bevviz.errors import UserError, first_line
from bevviz.evaluate.ground_truth import TruthLookup
from bevviz.model.protocols import FrameSource, Observer
from bevviz.model.results import FrameResult, Objects, Tracks
from bevviz.pipeline.notes import Notes
from bevviz.pipeline.perceive import add_explanations
from bevviz.pipeline.run import run
from bevviz.pipeline.session import Variants, check_same_frames
from bevviz.recording import blueprints, entities
from bevviz.recording.frame_logger import FrameLogger
from bevviz.recording.sinks import APPLICATION
from bevviz.recording.writer import SCALAR_WAIT
from bevviz.why import Answer, FrameExplainer, Selection
from bevviz.why.click import select_click
from bevviz.why.log import mark_answers
from bevviz.workbench.buffers import BufferReader, PageState, Reader, RecordingBuffer
from bevviz.workbench.findings import Finding, find_findings
from bevviz.workbench.findings_layer import FindingRows, log_layer
from bevviz.workbench.reports import ReportMaker
from bevviz.workbench.session import DriveTools, WorkbenchSession
from bevviz.workbench.source import Settings, Source
from bevviz.workbench.trials import TrialRunner

KEPT = 6  # results of recently viewed frames that are kept
PATIENCE = 10.0  # seconds that close() waits for the run to end
FIRST = 6.0  # seconds that the run waits until a page has drawn the first frame
BOTH = (entities.STAMP, entities.TRIED)


def recorded_session(
    drive: Drive,
    again: FrameSource,
    paths: Sequence[Path],
    truth_of: TruthLookup | None = None,
    first: int = 0,
) -> WorkbenchSession:
    """Return the workbench session of a recorded drive.

    Args:
        drive: the drive that questions are about.
        again: the same frames a second time. The run reads them while questions read those of ``drive``.
        paths: paths of the bag.
        truth_of: returns the ground truth of a frame. The frames of both sources carry it as well.
        first: number of the scan that is shown first.
    """
    source = RecordedDrive(drive, again, truth_of, first)
    session = WorkbenchSession(source)
    session.equip(DriveTools(TrialRunner(source), ReportMaker(session, drive, paths), Notes(paths)))
    return session


class RecordedDrive(Source, Observer[FrameResult]):
    """Recorded drive as the source of a page. A run over all frames is recorded in the background.

    A result of the run is logged on the timeline ``stamp``. It is logged on ``tried`` as well, unless other
    values were tried on that frame. A result with other values is logged on ``tried`` alone. A viewer shows
    one or the other by its choice of timeline.

    Args:
        drive: the drive that questions are about.
        again: the same frames a second time. The run reads them.
        truth_of: returns the ground truth of a frame.
        first: number of the scan that is shown first.

    Attributes:
        film: buffer with the recording of the whole drive.
        desk: buffer with answers and tried results, shown together with ``film``.
        recording_id: recording id of both buffers.
        over: whether the run over the drive has ended.
    """

    def __init__(
        self, drive: Drive, again: FrameSource, truth_of: TruthLookup | None = None, first: int = 0
    ) -> None:
        super().__init__(drive.scene.name, drive.session, truth_of)
        self.drive, self.again, self.scans = drive, again, len(drive)
        self._first = first
        self.film, self.desk = RecordingBuffer(), RecordingBuffer()
        self.over = False
        self._done, self._error = 0, ""
        self._stamps: list[tuple[int, int]] = []  # (stamp, number) of each frame in ``film``, sorted
        self._rows: dict[int, int] = {}  # row in ``film`` by stamp
        self._reached = 0  # newest stamp that the run has reached
        self._tracks: dict[int, Tracks] = {}
        self._objects: dict[int, Objects | None] = {}
        self._onsets = Onsets()
        self._results: OrderedDict[tuple[int, Settings], FrameResult] = OrderedDict()
        self._variants, self._looking = Variants(drive.session.loader), threading.RLock()
        self._stop, self._quiet, self._go = threading.Event(), threading.Event(), threading.Event()
        self._quiet.set()
        self._thread = threading.Thread(target=self._run, name="drive", daemon=True)
        self._begin_recording()

    def start(self) -> None:
        """Start the run: record the frame that is shown first, then all frames in order."""
        self._thread.start()

    def close(self) -> None:
        """Stop the run, then close the buffers and both sources."""
        self._stop.set()
        self._quiet.set()
        self._go.set()
        if self._thread.is_alive():
            self._thread.join(PATIENCE)
        for stream in (self._run_stream, self._desk_stream):
            stream.read()  # Rerun warns about a binary stream with unread data.
        self.film.close()
        self.desk.close()
        self.drive.close()
        self.again.close()

    def objects(self, number: int) -> Objects | None:
        """Return the objects that the run found in a frame."""
        return self._objects.get(number)

    # --- run -----------------------------------------------------------------------------------

    def progress(self) -> dict[str, Any]:
        """Return the progress of the run for the page."""
        return {
            "done": self._done,
            "total": self.again.total,
            "over": self.over,
            "error": self._error,
            "warnings": list(self.again.warnings) if self.over else [],
        }

    def _run(self) -> None:
        try:
            first = self.look(self._first)
            self.first = self._stamp_of(0)
            self.show(first, find_findings(self.explainer(first)))
            self._go.wait(FIRST)
            run(self.again, self.drive.new_session(), [self], stop=self._stop)
        except Exception as error:
            self._error = (
                str(error) if isinstance(error, UserError) else f"the run failed: {first_line(error)}"
            )
        self.over = True
        self.news.tell()

    def go_on(self) -> None:
        """Let the run continue: a page shows the first frame."""
        self._go.set()

    def observe(self, result: FrameResult) -> None:
        """Record the next frame of the run. Then wait while a question is being answered."""
        frame = result.frame
        findings = find_findings(self.explainer(result))
        self.show(result, findings)
        self._reached = max(self._reached, frame.stamp)
        if result.tracks is not None:
            no_trail = np.zeros((len(result.tracks), 0, 3), np.float32)
            self._tracks[frame.index] = replace(result.tracks, trail=no_trail)
        self._objects[frame.index] = result.objects
        self.findings.add(findings)
        self.findings.add_anomalies(frame.index, frame.stamp, self._onsets.of(result.anomalies))
        self._done += 1
        self.news.tell()
        self.wait_for_quiet()

    def end(self) -> None:
        """Record the last scalars of the run."""
        self._run_logger.flush()
        self.film.add(self._run_stream.read())

    def wait_for_quiet(self) -> None:
        """Wait until no question is being answered."""
        self._quiet.wait()

    @contextmanager
    def quiet(self) -> Iterator[None]:
        """Return a context in which the run pauses after its current frame."""
        self._quiet.clear()
        try:
            yield
        finally:
            self._quiet.set()

    # --- recording -----------------------------------------------------------------------------

    def _begin_recording(self) -> None:
        """Start both streams of the recording, with the layout and the static data."""
        drive = self.drive
        self.recording_id = f"bench-{time.time_ns()}"
        self._first_times = (0, 0, 0)  # index, stamp and receive time of the frame that was drawn first
        self._first_entities: frozenset[str] = frozenset()  # entities that have data or a clear at that frame
        self._layers: dict[tuple[int, bool], FindingRows] = {}  # by frame number and side (tried or not)
        self._recoloured: set[int] = set()  # numbers of frames whose raw cloud was drawn with other values
        recording, self._run_stream = self.stream()
        recording.send_blueprint(blueprints.load("workbench", drive.scene, drive.config), make_active=True)
        self._run_logger = FrameLogger(recording, drive.config, drive.scene, wait=SCALAR_WAIT, stamps=BOTH)
        self._run_logger.apart = True  # Pages receive frames in any order, so each is complete.
        self._run_logger.log_static()
        recording, self._desk_stream = self.stream()
        self._marker = FrameLogger(recording, drive.config, drive.scene, stamps=BOTH)
        self._tried_logger = self.tried_logger(recording, drive.config)

    def stream(self) -> tuple[rr.RecordingStream, rr.BinaryStream]:
        """Return a new stream into the recording, for a further thread that writes to it."""
        recording = rr.RecordingStream(APPLICATION, recording_id=self.recording_id)
        recording.set_log_time_enabled(False)
        return recording, rr.binary_stream(recording)

    def tried_logger(self, recording: rr.RecordingStream, config: Config) -> FrameLogger:
        """Return a logger that writes tried results on a timeline of their own, beside those of the run."""
        stamps = (entities.TRIED,)
        return FrameLogger(recording, config, self.drive.scene, wait=SCALAR_WAIT, stamps=stamps, inputs=False)

    def show(self, result: FrameResult, findings: Sequence[Finding]) -> None:
        """Record a frame of the run, which may come before frames that were recorded already."""
        frame, logger = result.frame, self._run_logger
        self._draw(logger, result, findings, tried=False)
        if self.opening is None:
            self._first_times = (frame.index, frame.stamp, frame.received)
            self._first_entities = logger.known
        elif frame.stamp < self._first_times[1]:
            logger.clear_at(*self._first_times, logger.known - self._first_entities)
            self._first_entities = logger.known
        key = (frame.stamp, frame.index)
        index = bisect.bisect_left(self._stamps, key)
        if self._stamps[index : index + 1] != [key]:
            self._stamps.insert(index, key)
        self._rows[frame.stamp] = len(self.film)
        self.film.add(self._run_stream.read())
        if self.opening is None:
            self.opening = frame.stamp
            self.news.tell()

    def draw_tried(self, logger: FrameLogger, explainer: FrameExplainer) -> None:
        """Log a frame with other values beside the result of the run."""
        result = explainer.traces.result
        logger.refresh(self._run_logger.results)
        # The colours of the cloud show ground and obstacles. A frame that was recoloured once is
        # always drawn again, so that its colours change back, too.
        config, opened, number = result.config, self.drive.config, result.frame.index
        if (config.voxel, config.ground) != (opened.voxel, opened.ground):
            self._recoloured.add(number)
        findings = find_findings(explainer)
        self._draw(logger, result, findings, tried=True, cloud=number in self._recoloured)

    def _draw(
        self,
        logger: FrameLogger,
        result: FrameResult,
        findings: Sequence[Finding],
        *,
        tried: bool,
        cloud: bool = False,
    ) -> None:
        layers: list[FindingRows] = []
        logger.log(result, log_more=lambda: layers.append(log_layer(logger, result, findings)), cloud=cloud)
        self._layers[result.frame.index, tried] = layers[0]

    @contextmanager
    def reader(self, lane: str, first: int, state: PageState) -> Iterator[Reader]:
        """Return a context in which a page reads the film or the desk."""
        if lane == "desk":
            yield BufferReader(self.desk, first, state)
        else:
            yield BufferReader(self.film, first, state, self._film_row)

    def _film_row(self, stamp: int) -> int | None:
        """Return the row in ``film`` of the frame that a viewer shows at a stamp."""
        recorded = self._recorded_at(stamp)
        return None if recorded is None else self._rows.get(recorded[0])

    # --- single frames -------------------------------------------------------------------------

    def _recorded_at(self, stamp: int) -> tuple[int, int] | None:
        """Return stamp and number of the recorded frame that a viewer shows at a stamp, if there is one."""
        stamps = list(self._stamps)
        index = bisect.bisect_right(stamps, (stamp + entities.TIME_TOLERANCE, 2**62))
        return stamps[index - 1] if index else None

    def number_at(self, stamp: int) -> int:
        """Return the number of the frame that a viewer shows at a stamp. The run may not have reached it yet.

        Raises:
            UserError: no frame has been run yet.
        """
        if not self._stamps:
            raise UserError("no frame has been run yet")
        at, number = self._recorded_at(stamp) or self._stamps[0]
        if self.over or stamp <= self._reached or abs(stamp - at) <= entities.TIME_TOLERANCE:
            return number
        with self._looking:
            return self._find_frame(stamp, number)

    def _find_frame(self, stamp: int, start: int) -> int:
        """Return the last frame that is not later. The search starts at the estimate from the log times."""
        scans, frame = self.drive.frames.scans, self.look(start).frame
        number = int(np.abs(scans - (stamp + int(scans[start]) - frame.stamp)).argmin())
        while number > 0 and self._stamp_of(number) > stamp + entities.TIME_TOLERANCE:
            number -= 1
        while number + 1 < len(scans) and self._stamp_of(number + 1) <= stamp + entities.TIME_TOLERANCE:
            number += 1
        return number

    def _stamp_of(self, number: int) -> int:
        """Return the stamp of a frame, or its log time if the frame cannot be read."""
        frame = self.drive.frames.frame(number)
        return int(self.drive.frames.scans[number]) if frame is None else frame.stamp

    def tracks(self, number: int) -> Tracks | None:
        """Return the tracks that the run found in a frame. None: it has not reached the frame."""
        return self._tracks.get(number)

    @property
    def desk_pieces(self) -> int:
        """Number of pieces in ``desk``."""
        return len(self.desk)

    def frame_times(self) -> list[tuple[int, int]]:
        """Return stamp and number of each recorded frame."""
        return list(self._stamps)

    def look(self, number: int, settings: Settings = ()) -> FrameResult:
        """Return the result of a frame, with other values if ``settings`` names some.

        Raises:
            UserError: there is no such frame, a parameter is unknown, or a value is wrong.
        """
        key = number, settings
        with self._looking:
            if key not in self._results:
                config = self.configured(settings)
                check_same_frames({"the drive": self.drive.config, "what is tried": config})
                known_frames = [result.frame for (n, _), result in self._results.items() if n == number]
                frame = known_frames[0] if known_frames else self.drive.raw(number)
                self._results[key] = add_explanations(self._variants.perceive(frame, config))
                while len(self._results) > KEPT:
                    self._results.popitem(last=False)
            self._results.move_to_end(key)
            return self._results[key]

    def look_aside(self, number: int) -> FrameResult:
        """Return the result of a frame as opened. A question waits at most until the frame is read."""
        with self._looking:
            if (known := self._results.get((number, ()))) is not None:
                return known
            frame = self.drive.raw(number)
        return self.pipeline.run_single(frame)

    def configured(self, settings: Settings) -> Config:
        """Return the configuration with other values.

        Raises:
            UserError: a parameter is unknown, or a value is wrong.
        """
        return changed_config(self.drive.config, settings) if settings else self.drive.config

    def select(
        self, number: int, settings: Settings, path: str, instance: int | None, position: Sequence[float]
    ) -> Selection | None:
        """Return the selection of a click in a frame: a finding, or see ``select_click``."""
        rows = self._layers.get((number, bool(settings)), {}).get(path, ())
        if instance is not None and 0 <= instance < len(rows):
            return rows[instance].selection
        return select_click(self.look(number, settings), self._tracks.get(number), path, instance, position)

    def mark(self, result: FrameResult, answer: Answer) -> None:
        """Mark the object of an answer in every view."""
        mark_answers(self._marker, result.frame, [answer], result.config.bev)
        self.desk.add(self._desk_stream.read())

    def try_values(self, number: int, settings: Settings) -> tuple[FrameResult, FrameResult]:
        """Log a frame with other values. Return its result before and after.

        Raises:
            UserError: as ``look``.
        """
        before, after = self.look(number), self.look(number, settings)
        self.draw_tried(self._tried_logger, self.explainer(after))
        self._tried_logger.flush()
        self.desk.add(self._desk_stream.read())
        return before, after
