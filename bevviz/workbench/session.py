"""The workbench session of one drive: run and record it, answer questions, try other parameter values."""

from __future__ import annotations

import bisect
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
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
from bevviz.evaluate import Truth
from bevviz.model.frame import Frame
from bevviz.model.protocols import FrameSource, Items, Observer
from bevviz.model.results import FrameResult, Objects, Tracks
from bevviz.pipeline.notes import Note, Notes
from bevviz.pipeline.perceive import add_explanations
from bevviz.pipeline.run import run
from bevviz.pipeline.session import Variants, check_same_frames
from bevviz.recording import blueprints, entities
from bevviz.recording.frame_logger import FrameLogger
from bevviz.recording.sinks import APPLICATION
from bevviz.recording.writer import SCALAR_WAIT
from bevviz.support.contexts import Closable
from bevviz.why import Answer, FrameExplainer
from bevviz.why.log import mark_answers
from bevviz.why.pick import Pick, pick
from bevviz.why.pick_answers import selection_of, surroundings_of
from bevviz.workbench.finding_list import FindingList
from bevviz.workbench.findings import Finding, find_findings, with_reasons
from bevviz.workbench.findings_layer import FindingRows, log_layer
from bevviz.workbench.recording_buffer import RecordingBuffer
from bevviz.workbench.reports import ReportMaker, folder_of
from bevviz.workbench.trials import TrialRunner, trial_effects, tried_logger
from bevviz.workbench.truth_frames import TruthOf

KEPT = 6  # results of recently viewed frames that are kept
PATIENCE = 10.0  # seconds that close() waits for the run to end
FIRST = 6.0  # seconds that the run waits until a page has drawn the first frame
ASKED = 8  # answers that are kept for reports
BOTH = (entities.STAMP, entities.TRIED)

Settings = tuple[str, ...]


class WorkbenchSession(Closable):
    """Workbench session of one drive.

    Ask questions from one thread only. Listeners are called from any thread. A result of the run is logged
    on the timeline ``stamp``. It is logged on ``tried`` as well, unless other values were tried on that
    frame. A result with other values is logged on ``tried`` alone. A viewer shows one or the other by its
    choice of timeline.

    Args:
        drive: the drive that questions are about.
        again: the same frames a second time. The run reads them while questions read those of ``drive``.
        paths: paths of the bag.
        truth_of: returns the ground truth of a frame. The frames of both sources carry it as well.
        first: number of the scan that is shown first.

    Attributes:
        film: buffer with the recording of the whole drive.
        desk: buffer with answers and tried results, shown together with ``film``.
        recording_id: recording id of both buffers.
        entries: the findings, grouped over frames.
        trials: runs over the drive with other values.
        reports: bug reports, saved beside the bag.
        notes: notes of the user, saved beside the bag.
        opening: stamp of the frame that a page opens at. None before the first frame is shown.
        over: whether the run over the drive has ended.
    """

    def __init__(
        self,
        drive: Drive,
        again: FrameSource,
        paths: Sequence[Path],
        truth_of: TruthOf | None = None,
        first: int = 0,
    ) -> None:
        self.drive, self.again, self.paths, self.truth_of = drive, again, paths, truth_of
        self._first = first
        self.film, self.desk = RecordingBuffer(), RecordingBuffer()
        self.entries = FindingList()
        self.opening: int | None = None
        self.done, self.over, self.error = 0, False, ""
        self._listeners: list[Callable[[], None]] = []
        self._stamps: list[tuple[int, int]] = []  # (stamp, number) of each frame in ``film``, sorted
        self._reached = 0  # newest stamp that the run has reached
        self._first_times = (0, 0, 0)  # index, stamp and receive time of the frame that was drawn first
        self._first_entities: frozenset[str] = frozenset()  # entities that have data or a clear at that frame
        self._rows: dict[int, int] = {}  # row in ``film`` by stamp
        self._tracks: dict[int, Tracks] = {}
        self._objects: dict[int, Objects | None] = {}
        self._layers: dict[tuple[int, bool], FindingRows] = {}  # by frame number and side (tried or not)
        self._recoloured: set[int] = set()  # numbers of frames whose raw cloud was drawn with other values
        self._onsets = Onsets()
        self._results: OrderedDict[tuple[int, Settings], FrameResult] = OrderedDict()
        self._variants, self._looking = Variants(drive.session.loader), threading.RLock()
        self._last_questioner: FrameExplainer | None = None
        self._stop, self._quiet, self._go = threading.Event(), threading.Event(), threading.Event()
        self._quiet.set()
        self.recording_id = f"bench-{time.time_ns()}"
        self._main, self._main_stream = self.stream()
        self._desk, self._desk_stream = self.stream()
        layout = blueprints.load("workbench", drive.scene, drive.config)
        self._main.send_blueprint(layout, make_active=True)
        self._logger = FrameLogger(self._main, drive.config, drive.scene, wait=SCALAR_WAIT, stamps=BOTH)
        self._logger.apart = True  # Pages receive frames in any order, so each is complete.
        self._logger.log_static()
        self._desk_logger = FrameLogger(self._desk, drive.config, drive.scene, stamps=BOTH)
        self._tried_logger = tried_logger(self._desk, drive.session, self)
        self.trials, self.reports = (
            TrialRunner(self, self.tell),
            ReportMaker(self, self.tell, folder_of(paths)),
        )
        self.notes = Notes(paths)
        self.notes_changed = 0
        self._answers: OrderedDict[tuple[int, Settings, str], tuple[int, Answer]] = OrderedDict()
        self._thread = threading.Thread(target=self._run, name="drive", daemon=True)

    def stream(self) -> tuple[rr.RecordingStream, rr.BinaryStream]:
        """Return a new stream into the recording, for a further thread that writes to it."""
        recording = rr.RecordingStream(APPLICATION, recording_id=self.recording_id)
        recording.set_log_time_enabled(False)
        return recording, rr.binary_stream(recording)

    def start(self) -> None:
        """Start the run: record the frame that is shown first, then all frames in order."""
        self._thread.start()

    def close(self) -> None:
        """Stop the run, the trials and the reports, then close the buffers and both sources."""
        self._stop.set()
        self._quiet.set()
        self._go.set()
        self.trials.end()
        self.reports.end()
        if self._thread.is_alive():
            self._thread.join(PATIENCE)
        for stream in (self._main_stream, self._desk_stream, self.trials.film):
            stream.read()  # Rerun warns about a binary stream with unread data.
        self.film.close()
        self.desk.close()
        self.drive.close()
        self.again.close()

    # --- background run ------------------------------------------------------------------------

    def listen(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call the listener, from any thread, after each step of the run. Return a function that ends it."""
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def progress(self) -> dict[str, Any]:
        """Return the progress message for the page."""
        return {
            "type": "progress",
            "done": self.done,
            "total": self.again.total,
            "over": self.over,
            "error": self.error,
            "reports": [report.as_dict() for report in self.reports.made],
            "trial": None if self.trials.trial is None else self.trials.trial.as_dict(),
            "warnings": list(self.again.warnings) if self.over else [],
        }

    def _run(self) -> None:
        try:
            first = self.look(self._first)
            self._show(first, find_findings(first, self.truth(first.frame)))
            self._go.wait(FIRST)
            session = self.drive.new_session()
            run(self.again, session, [_RunObserver(self)], stop=self._stop)
        except Exception as error:
            self.error = (
                str(error) if isinstance(error, UserError) else f"the run failed: {first_line(error)}"
            )
        self.over = True
        self.tell()

    def go_on(self) -> None:
        """Let the run continue: a page shows the first frame."""
        self._go.set()

    def observe(self, result: FrameResult) -> None:
        """Record the next frame of the run. Then wait while a question is being answered."""
        frame = result.frame
        findings = find_findings(result, self.truth(frame))
        if any(finding.what == "missed" for finding in findings):
            names = self.drive.session.stages.class_names
            findings = with_reasons(
                findings, result, FrameExplainer(result, self.drive.session.loader, names)
            )
        self._show(result, findings)
        self._reached = max(self._reached, frame.stamp)
        if result.tracks is not None:
            bare = np.zeros((len(result.tracks), 0, 3), np.float32)
            self._tracks[frame.index] = replace(result.tracks, trail=bare)
        self._objects[frame.index] = result.objects
        self.entries.add(findings)
        self.entries.add_anomalies(frame.index, frame.stamp, self._onsets.of(result.anomalies))
        self.done += 1
        self.tell()
        self.wait_for_quiet()

    def wait_for_quiet(self) -> None:
        """Wait until no question is being answered."""
        self._quiet.wait()

    def _show(self, result: FrameResult, findings: Sequence[Finding]) -> None:
        frame = result.frame
        self._draw(self._logger, result, findings, tried=False)
        if self.opening is None:
            self._first_times = (frame.index, frame.stamp, frame.received)
            self._first_entities = self._logger.known
        elif frame.stamp < self._first_times[1]:
            self._logger.clear_at(*self._first_times, self._logger.known - self._first_entities)
            self._first_entities = self._logger.known
        key = (frame.stamp, frame.index)
        index = bisect.bisect_left(self._stamps, key)
        if self._stamps[index : index + 1] != [key]:
            self._stamps.insert(index, key)
        self._rows[frame.stamp] = len(self.film)
        self.film.add(self._main_stream.read())
        if self.opening is None:
            self.opening = frame.stamp
            self.tell()

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

    def draw_tried(self, logger: FrameLogger, result: FrameResult, findings: Sequence[Finding]) -> None:
        """Log a frame with other values beside the result of the run."""
        logger.refresh(self._logger.results)
        # The colours of the cloud show ground and obstacles. A frame that was recoloured once is
        # always drawn again, so that its colours change back, too.
        config, opened, number = result.config, self.drive.config, result.frame.index
        if (config.voxel, config.ground) != (opened.voxel, opened.ground):
            self._recoloured.add(number)
        self._draw(logger, result, findings, tried=True, cloud=number in self._recoloured)

    def end(self) -> None:
        """Record the last scalars of the run."""
        self._logger.flush()
        self.film.add(self._main_stream.read())

    def tell(self) -> None:
        """Notify all listeners."""
        for listener in tuple(self._listeners):
            listener()

    @contextmanager
    def quiet(self) -> Iterator[None]:
        """Return a context in which the run pauses after its current frame."""
        self._quiet.clear()
        try:
            yield
        finally:
            self._quiet.set()

    # --- questions -----------------------------------------------------------------------------

    def number_at(self, stamp: int) -> int:
        """Return the number of the frame that a viewer shows at a stamp. The run may not have reached it yet.

        Raises:
            UserError: no frame has been run yet.
        """
        stamps = list(self._stamps)
        if not stamps:
            raise UserError("no frame has been run yet")
        index = bisect.bisect_right(stamps, (stamp + entities.TIME_TOLERANCE, 2**62)) - 1
        at, number = stamps[max(index, 0)]
        if self.over or stamp <= self._reached or abs(stamp - at) <= entities.TIME_TOLERANCE:
            return number
        return self._find_frame(stamp, number)

    def _find_frame(self, stamp: int, start: int) -> int:
        """Return the last frame that is not later. The search starts at the estimate from the log times."""
        with self._looking:
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

    def film_row(self, stamp: int) -> int | None:
        """Return the row in ``film`` of the frame that a viewer shows at a stamp."""
        index = bisect.bisect_right(self._stamps, (stamp + entities.TIME_TOLERANCE, 2**62)) - 1
        return self._rows.get(self._stamps[index][0]) if index >= 0 else None

    def truth(self, frame: Frame) -> Truth | None:
        """Return the ground truth of a frame, if there is any."""
        return None if self.truth_of is None else self.truth_of(frame)

    def objects(self, number: int) -> Objects | None:
        """Return the objects that the run found in a frame."""
        return self._objects.get(number)

    def look(self, number: int, settings: Settings = ()) -> FrameResult:
        """Return the result of a frame, with other values if ``settings`` names some.

        Raises:
            UserError: there is no such frame, a parameter is unknown, or a value is wrong.
        """
        with self._looking:
            return self._look(number, settings)

    def _look(self, number: int, settings: Settings) -> FrameResult:
        key = number, settings
        if key not in self._results:
            config = changed_config(self.drive.config, settings) if settings else self.drive.config
            check_same_frames({"the drive": self.drive.config, "what is tried": config})
            known_frames = [result.frame for (n, _), result in self._results.items() if n == number]
            frame = known_frames[0] if known_frames else self.drive.raw(number)
            self._results[key] = add_explanations(self._variants.perceive(frame, config))
            while len(self._results) > KEPT:
                self._results.popitem(last=False)
        self._results.move_to_end(key)
        return self._results[key]

    def picked(
        self, number: int, settings: Settings, path: str, instance: int | None, position: Sequence[float]
    ) -> Pick | None:
        """Return the pick of a click in a frame, see ``pick``."""
        layer = self._layers.get((number, bool(settings)), {})
        if instance is not None and 0 <= instance < len(rows := layer.get(path, ())):
            return rows[instance].pick
        return pick(self.look(number, settings), self._tracks.get(number), path, instance, position)

    def ask(self, number: int, settings: Settings, target: Pick) -> tuple[Answer, list[Answer]]:
        """Explain an object: why was it reported or not? The answer is marked in every view.

        Returns:
            The answer, and the answers about other subjects at the same place.

        Raises:
            UserError: there is no such object in the frame.
        """
        questioner = self._questioner(self.look(number, settings))
        selected = selection_of(target)
        candidates = questioner.candidates(selected) if target.is_place else []
        answers = candidates or questioner.ask(selected)
        if not answers:
            raise UserError(f"there is nothing to say about {target}")
        answer = answers[0]
        if not candidates and (nearby := surroundings_of(target, answer)) is not None:
            candidates = questioner.candidates(nearby)
        others = [other for other in candidates if other.subject.key != answer.subject.key]
        self._mark(questioner.traces.result, answer)
        self._keep(number, settings, target, answer)
        return answer, others

    def hints(self, number: int, settings: Settings, target: Pick) -> Answer:
        """Answer with hints: parameter changes that would change the verdict. This takes longer than ``ask``.

        Raises:
            UserError: as ``ask``.
        """
        questioner = self._questioner(self.look(number, settings))
        selected = selection_of(target)
        candidates = questioner.candidates(selected) if target.is_place else []
        answer = questioner.with_hints((candidates or questioner.ask(selected))[0])
        self._keep(number, settings, target, answer)
        return answer

    def _keep(self, number: int, settings: Settings, target: Pick, answer: Answer) -> None:
        """Keep an answer for reports. One with hints replaces one without."""
        key = number, settings, str(target)
        if answer.hints or key not in self._answers:
            self._answers[key] = self.look(number).frame.received, answer
        self._answers.move_to_end(key)
        while len(self._answers) > ASKED:
            self._answers.popitem(last=False)

    def asked_within(self, low: int, high: int, settings: Settings = ()) -> list[Answer]:
        """Return the answers about frames in a range of log times, with these settings, newest first."""
        newest_first = reversed(self._answers.items())
        return [
            answer
            for (_, asked_settings, _), (received, answer) in newest_first
            if asked_settings == settings and low <= received <= high
        ]

    # --- notes ---------------------------------------------------------------------------------

    def note(self, number: int, text: str, target: Pick | None) -> None:
        """Save a note about a frame, or about an object in it.

        Raises:
            UserError: the note cannot be written, or there is no such object.
        """
        frame = self.look(number).frame
        about = "" if target is None else self.ask(number, (), target)[0].subject.name
        pick = "" if target is None else str(target)
        self.notes.add(Note(frame.stamp, frame.received, text.strip(), about.removeprefix("the "), pick))
        self.notes_changed += 1
        self.tell()

    def remove_note(self, stamp: int, text: str) -> None:
        """Remove a note.

        Raises:
            UserError: the file cannot be written.
        """
        for note in list(self.notes):
            if (note.stamp, note.text) == (stamp, text):
                self.notes.remove(note)
        self.notes_changed += 1
        self.tell()

    def _questioner(self, result: FrameResult) -> FrameExplainer:
        """Return the questioner of a result. Further questions about it reuse the same one."""
        if self._last_questioner is None or self._last_questioner.traces.result is not result:
            session = self.drive.session
            self._last_questioner = FrameExplainer(result, session.loader, session.stages.class_names)
        return self._last_questioner

    def _mark(self, result: FrameResult, answer: Answer) -> None:
        mark_answers(self._desk_logger, result.frame, [answer], result.config.bev)
        self.desk.add(self._desk_stream.read())

    # --- other values --------------------------------------------------------------------------

    def configured(self, settings: Settings) -> Config:
        """Return the configuration with other values.

        Raises:
            UserError: a parameter is unknown, or a value is wrong.
        """
        return changed_config(self.drive.config, settings)

    def attempt(self, number: int, settings: Settings, target: Pick | None = None) -> dict[str, Any]:
        """Log a frame with other values, and return their effects.

        Args:
            number: number of the frame.
            settings: the other values.
            target: the object that the values are tried for. Its effect comes first.

        Raises:
            UserError: as ``look``.
        """
        before, after = self.look(number), self.look(number, settings)
        truth = self.truth(after.frame)
        self.draw_tried(self._tried_logger, after, find_findings(after, truth))
        self._tried_logger.flush()
        self.desk.add(self._desk_stream.read())
        truth_row = target.row if target is not None and target.kind == "truth" else -1
        return trial_effects(before, after, truth, truth_row)


class _RunObserver(Observer[FrameResult]):
    """Observer of the background run. It passes each frame to the workbench session."""

    def __init__(self, workbench: WorkbenchSession) -> None:
        self._workbench = workbench

    def begin(self, items: Items[object]) -> None:
        pass

    def observe(self, result: FrameResult) -> None:
        self._workbench.observe(result)

    def end(self) -> None:
        self._workbench.end()
