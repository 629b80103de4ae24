"""The workbench without its page: a drive that is run and filmed, asked about and tried with other values."""

from __future__ import annotations

import bisect
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr

from bevviz.anomalies import Onsets
from bevviz.config import Config, revised
from bevviz.drive import Drive
from bevviz.errors import UserError, first_line
from bevviz.evaluate import Truth
from bevviz.model.frame import Frame
from bevviz.model.protocols import Frames, Items, Observer
from bevviz.model.results import FrameResult, Objects, Tracks
from bevviz.pipeline.notes import Note, Notes
from bevviz.pipeline.perceive import describe
from bevviz.pipeline.run import run
from bevviz.pipeline.variants import Variants, check_same_frames
from bevviz.recording import blueprints, entities
from bevviz.recording.frame_logger import Logger
from bevviz.recording.sinks import APPLICATION
from bevviz.recording.writer import WAIT
from bevviz.support.contexts import Closing
from bevviz.why import Answer, Questioner
from bevviz.why.log import mark_answers
from bevviz.why.pick import Pick, pick
from bevviz.why.pick_answers import selection, surroundings
from bevviz.workbench.finding_list import Entries
from bevviz.workbench.findings import Find, finds, with_reasons
from bevviz.workbench.findings_layer import Layer, log_layer
from bevviz.workbench.recording_buffer import Film
from bevviz.workbench.reports import Reports, folder_of
from bevviz.workbench.trials import Trials, attempt, tried_logger
from bevviz.workbench.truth_frames import TruthOf

if TYPE_CHECKING:
    from bevviz.workbench.native_viewer import NativeViewer

KEPT = 6  # results of frames that were looked at
PATIENCE = 10.0  # seconds that the run may take to end
FIRST = 6.0  # seconds that the run waits for a page to have drawn the first frame
ASKED = 8  # answers that are kept for reports
BOTH = (entities.STAMP, entities.TRIED)

Settings = tuple[str, ...]


class Bench(Closing):
    """One drive on the bench. Questions are to be asked from one thread; whoever listens is told from any.

    What the run makes of a frame is on the timeline ``stamp`` and, where nothing else was tried on it, on
    ``tried``; what other values make of it is on ``tried`` alone. To see either is to choose the timeline.

    Args:
        drive: that is asked about.
        again: the same frames once more, to be run through while others are asked for.
        paths: of the bag.
        truth_of: what is known to be there, which the frames of both have, too.
        first: number of the scan that is shown first.

    Attributes:
        film: what is shown: the whole drive.
        desk: what was asked and tried, which is shown with it.
        recording_id: of both.
        native: the viewer beside the page, where there is one.
        entries: what is worth a look.
        trials: runs over the drive with other values.
        reports: of what was found, beside the bag.
        notes: of the user, beside the bag.
        opening: stamp of the frame that a page is to open at; None: not run yet.
        over: whether the run over the drive has ended.
    """

    def __init__(
        self,
        drive: Drive,
        again: Frames,
        paths: Sequence[Path],
        truth_of: TruthOf | None = None,
        first: int = 0,
    ) -> None:
        self.drive, self.again, self.paths, self.truth_of = drive, again, paths, truth_of
        self._first = first
        self.film, self.desk = Film(), Film()
        self.entries = Entries()
        self.opening: int | None = None
        self.done, self.over, self.error = 0, False, ""
        self._listeners: list[Callable[[], None]] = []
        self._stamps: list[tuple[int, int]] = []  # stamp, number of each frame on the film, in order
        self._reached = 0  # stamp that the run is at
        self._ahead = (0, 0, 0)  # index and times of the frame that was drawn first
        self._ahead_knows: frozenset[str] = frozenset()  # entities that are cleared there, or its own
        self._rows: dict[int, int] = {}  # on the film, of each stamp
        self._tracks: dict[int, Tracks] = {}
        self._objects: dict[int, Objects | None] = {}
        self._layers: dict[tuple[int, bool], Layer] = {}  # by frame, and whether other values made it
        self._recoloured: set[int] = set()  # frames whose raw cloud was drawn as other values have it
        self._onsets = Onsets()
        self._results: OrderedDict[tuple[int, Settings], FrameResult] = OrderedDict()
        self._variants, self._looking = Variants(drive.session.loader), threading.RLock()
        self._asked: Questioner | None = None
        self._stop, self._quiet, self._go = threading.Event(), threading.Event(), threading.Event()
        self._quiet.set()
        self.native: NativeViewer | None = None
        self.recording_id = f"bench-{time.time_ns()}"
        self._main, self._film_main = self.stream()
        self._desk, self._film_desk = self.stream()
        layout = blueprints.load("workbench", drive.scene, drive.config)
        self._main.send_blueprint(layout, make_active=True)
        self._logger = Logger(self._main, drive.config, drive.scene, wait=WAIT, stamps=BOTH)
        self._logger.apart = True  # pages get them in whatever order they are looked at
        self._logger.log_static()
        self._desk_logger = Logger(self._desk, drive.config, drive.scene, stamps=BOTH)
        self._tried_logger = tried_logger(self._desk, drive.session, self)
        self.trials, self.reports = Trials(self, self.tell), Reports(self, self.tell, folder_of(paths))
        self.notes = Notes(paths)
        self.notes_changed = 0
        self._answers: OrderedDict[tuple[int, Settings, str], tuple[int, Answer]] = OrderedDict()
        self._thread = threading.Thread(target=self._run, name="drive", daemon=True)

    def stream(self) -> tuple[rr.RecordingStream, rr.BinaryStream]:
        """The recording, for a further thread that writes to it."""
        recording = rr.RecordingStream(APPLICATION, recording_id=self.recording_id)
        recording.set_log_time_enabled(False)
        return recording, rr.binary_stream(recording)

    def start(self) -> None:
        """Film the frame that is shown first, then all of them in order."""
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._quiet.set()
        self._go.set()
        self.trials.end()
        self.reports.end()
        if self._thread.is_alive():
            self._thread.join(PATIENCE)
        if self.native is not None:
            self.native.close()
        for stream in (self._film_main, self._film_desk, self.trials.film):
            stream.read()  # it would complain of what nobody has read
        self.film.close()
        self.desk.close()
        self.drive.close()
        self.again.close()

    # --- the run behind it ---------------------------------------------------------------------

    def listen(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call it, from any thread, whenever the run is further. Returns what ends that."""
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def progress(self) -> dict[str, Any]:
        """How far the run is."""
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
            self._show(first, finds(first, self.truth(first.frame)))
            self._go.wait(FIRST)
            session = self.drive.new_session()
            run(self.again, session, [_Filming(self)], stop=self._stop)
        except Exception as error:
            self.error = (
                str(error) if isinstance(error, UserError) else f"the run failed: {first_line(error)}"
            )
        self.over = True
        self.tell()

    def go_on(self) -> None:
        """A page shows the first frame: run the others."""
        self._go.set()

    def see(self, result: FrameResult) -> None:
        """The next frame of the run; while a question is being answered, it waits."""
        frame = result.frame
        found = finds(result, self.truth(frame))
        if any(find.what == "missed" for find in found):
            names = self.drive.session.stages.class_names
            found = with_reasons(found, result, Questioner(result, self.drive.session.loader, names))
        self._show(result, found)
        self._reached = max(self._reached, frame.stamp)
        if result.tracks is not None:
            bare = np.zeros((len(result.tracks), 0, 3), np.float32)
            self._tracks[frame.index] = replace(result.tracks, trail=bare)
        self._objects[frame.index] = result.objects
        self.entries.add(found)
        self.entries.add_anomalies(frame.index, frame.stamp, self._onsets.of(result.anomalies))
        self.done += 1
        self.tell()
        self.wait_for_quiet()

    def wait_for_quiet(self) -> None:
        """Until no question is being answered."""
        self._quiet.wait()

    def _show(self, result: FrameResult, found: Sequence[Find]) -> None:
        frame = result.frame
        self._draw(self._logger, result, found, tried=False)
        if self.opening is None:
            self._ahead, self._ahead_knows = (frame.index, frame.stamp, frame.received), self._logger.known
        elif frame.stamp < self._ahead[1]:
            self._logger.clear_at(*self._ahead, self._logger.known - self._ahead_knows)
            self._ahead_knows = self._logger.known
        entry = (frame.stamp, frame.index)
        place = bisect.bisect_left(self._stamps, entry)
        if self._stamps[place : place + 1] != [entry]:
            self._stamps.insert(place, entry)
        self._rows[frame.stamp] = len(self.film)
        self.film.add(self._film_main.read())
        if self.opening is None:
            self.opening = frame.stamp
            self.tell()

    def _draw(
        self, logger: Logger, result: FrameResult, found: Sequence[Find], *, tried: bool, cloud: bool = False
    ) -> None:
        layers: list[Layer] = []
        logger.log(result, beside=lambda: layers.append(log_layer(logger, result, found)), cloud=cloud)
        self._layers[result.frame.index, tried] = layers[0]

    def draw_tried(self, logger: Logger, result: FrameResult, found: Sequence[Find]) -> None:
        """A frame as other values make it, beside what the run has made of it."""
        logger.refresh(self._logger.results)
        # Its colours tell ground from obstacles; once they are others, they have to be put back, too.
        config, opened, number = result.config, self.drive.config, result.frame.index
        if (config.voxel, config.ground) != (opened.voxel, opened.ground):
            self._recoloured.add(number)
        self._draw(logger, result, found, tried=True, cloud=number in self._recoloured)

    def end(self) -> None:
        """The run's last numbers."""
        self._logger.flush()
        self.film.add(self._film_main.read())

    def tell(self) -> None:
        """There is something new."""
        for listener in tuple(self._listeners):
            listener()

    @contextmanager
    def quiet(self) -> Iterator[None]:
        """Within, the run waits after the frame that it is at."""
        self._quiet.clear()
        try:
            yield
        finally:
            self._quiet.set()

    # --- questions -----------------------------------------------------------------------------

    def number_at(self, stamp: int) -> int:
        """Number of the frame that a viewer shows at that time, whether it has been run yet or not.

        Raises:
            UserError: no frame is there yet.
        """
        stamps = list(self._stamps)
        if not stamps:
            raise UserError("no frame has been run yet")
        place = bisect.bisect_right(stamps, (stamp + entities.SLACK, 2**62)) - 1
        at, number = stamps[max(place, 0)]
        if self.over or stamp <= self._reached or abs(stamp - at) <= entities.SLACK:
            return number
        return self._sought(stamp, number)

    def _sought(self, stamp: int, near: int) -> int:
        """The last frame whose stamp is not behind that time, from where the log times say that it is."""
        with self._looking:
            scans, frame = self.drive.frames.scans, self.look(near).frame
            number = int(np.abs(scans - (stamp + int(scans[near]) - frame.stamp)).argmin())
            while number > 0 and self._stamp_of(number) > stamp + entities.SLACK:
                number -= 1
            while number + 1 < len(scans) and self._stamp_of(number + 1) <= stamp + entities.SLACK:
                number += 1
            return number

    def _stamp_of(self, number: int) -> int:
        """Its log time, where it cannot be read."""
        frame = self.drive.frames.frame(number)
        return int(self.drive.frames.scans[number]) if frame is None else frame.stamp

    def film_row(self, stamp: int) -> int | None:
        """Piece of the film that has the frame which a viewer shows at that time."""
        place = bisect.bisect_right(self._stamps, (stamp + entities.SLACK, 2**62)) - 1
        return self._rows.get(self._stamps[place][0]) if place >= 0 else None

    def truth(self, frame: Frame) -> Truth | None:
        """What has to be found in a frame, where that is known."""
        return None if self.truth_of is None else self.truth_of(frame)

    def objects(self, number: int) -> Objects | None:
        """That the run has found in a frame."""
        return self._objects.get(number)

    def look(self, number: int, settings: Settings = ()) -> FrameResult:
        """What the stages make of a frame, with other values; with those in force the tracks of the run.

        Raises:
            UserError: no such frame, an unknown parameter, or a wrong value.
        """
        with self._looking:
            return self._look(number, settings)

    def _look(self, number: int, settings: Settings) -> FrameResult:
        key = number, settings
        if key not in self._results:
            config = revised(self.drive.config, settings) if settings else self.drive.config
            check_same_frames({"the drive": self.drive.config, "what is tried": config})
            known = next((r.frame for (n, _), r in self._results.items() if n == number), None)
            frame = known if known is not None else self.drive.raw(number)
            self._results[key] = describe(self._variants.perceive(frame, config))
            while len(self._results) > KEPT:
                self._results.popitem(last=False)
        self._results.move_to_end(key)
        return self._results[key]

    def picked(
        self, number: int, settings: Settings, path: str, instance: int | None, position: Sequence[float]
    ) -> Pick | None:
        """What a click in the frame is on, see ``pick``."""
        layer = self._layers.get((number, bool(settings)), {})
        if instance is not None and 0 <= instance < len(rows := layer.get(path, ())):
            return rows[instance].pick
        return pick(self.look(number, settings), self._tracks.get(number), path, instance, position)

    def ask(self, number: int, settings: Settings, what: Pick) -> tuple[Answer, list[Answer]]:
        """Why it was reported, or was not, and what else is there; it is shown in every view.

        Raises:
            UserError: there is no such thing in the frame.
        """
        questioner = self._questioner(self.look(number, settings))
        wanted = selection(what)
        there = questioner.candidates(wanted) if what.is_place else []
        found = there or questioner.ask(wanted)
        if not found:
            raise UserError(f"there is nothing to say about {what}")
        answer = found[0]
        if not there and (around := surroundings(what, answer)) is not None:
            there = questioner.candidates(around)
        beside = [other for other in there if other.subject.key != answer.subject.key]
        self._mark(questioner.traces.result, answer)
        self._keep(number, settings, what, answer)
        return answer, beside

    def hints(self, number: int, settings: Settings, what: Pick) -> Answer:
        """The same with what would change it, which takes longer.

        Raises:
            UserError: as ``ask``.
        """
        questioner = self._questioner(self.look(number, settings))
        wanted = selection(what)
        there = questioner.candidates(wanted) if what.is_place else []
        answer = questioner.with_hints((there or questioner.ask(wanted))[0])
        self._keep(number, settings, what, answer)
        return answer

    def _keep(self, number: int, settings: Settings, what: Pick, answer: Answer) -> None:
        """For reports, with its hints once they are known."""
        key = number, settings, str(what)
        if answer.hints or key not in self._answers:
            self._answers[key] = self.look(number).frame.received, answer
        self._answers.move_to_end(key)
        while len(self._answers) > ASKED:
            self._answers.popitem(last=False)

    def asked_within(self, low: int, high: int, settings: Settings = ()) -> list[Answer]:
        """What was asked about frames of these log times, with these values, the newest first."""
        kept = reversed(self._answers.items())
        return [answer for (_, own, _), (at, answer) in kept if own == settings and low <= at <= high]

    # --- notes ---------------------------------------------------------------------------------

    def note(self, number: int, text: str, what: Pick | None) -> None:
        """Keep a note of a frame, or of a thing in it.

        Raises:
            UserError: it cannot be written, or there is no such thing.
        """
        frame = self.look(number).frame
        about = "" if what is None else self.ask(number, (), what)[0].subject.name
        pick = "" if what is None else str(what)
        self.notes.add(Note(frame.stamp, frame.received, text.strip(), about.removeprefix("the "), pick))
        self.notes_changed += 1
        self.tell()

    def remove_note(self, stamp: int, text: str) -> None:
        """Raises UserError where the file cannot be written."""
        for note in list(self.notes):
            if (note.stamp, note.text) == (stamp, text):
                self.notes.remove(note)
        self.notes_changed += 1
        self.tell()

    def _questioner(self, result: FrameResult) -> Questioner:
        """What questions about one result have in common is worked out once."""
        if self._asked is None or self._asked.traces.result is not result:
            session = self.drive.session
            self._asked = Questioner(result, session.loader, session.stages.class_names)
        return self._asked

    def _mark(self, result: FrameResult, answer: Answer) -> None:
        mark_answers(self._desk_logger, result.frame, [answer], result.config.bev)
        self.desk.add(self._film_desk.read())

    # --- other values --------------------------------------------------------------------------

    def configured(self, settings: Settings) -> Config:
        """How frames are made with other values.

        Raises:
            UserError: an unknown parameter, or a wrong value.
        """
        return revised(self.drive.config, settings)

    def attempt(self, number: int, settings: Settings, what: Pick | None = None) -> dict[str, Any]:
        """Show the frame as it is with other values, and tell what they do to it.

        Args:
            number: of the frame.
            settings: the values.
            what: they are tried for, which is told first.

        Raises:
            UserError: as ``look``.
        """
        before, after = self.look(number), self.look(number, settings)
        truth = self.truth(after.frame)
        self.draw_tried(self._tried_logger, after, finds(after, truth))
        self._tried_logger.flush()
        self.desk.add(self._film_desk.read())
        asked = what.row if what is not None and what.kind == "truth" else -1
        return attempt(before, after, truth, asked)


class _Filming(Observer[FrameResult]):
    """The run's way onto the bench."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    def begin(self, items: Items[object]) -> None:
        pass

    def see(self, result: FrameResult) -> None:
        self._bench.see(result)

    def end(self) -> None:
        self._bench.end()
