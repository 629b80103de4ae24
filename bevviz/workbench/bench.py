"""The workbench without its page: a drive that is run and filmed, asked about and tried with other values."""

from __future__ import annotations

import bisect
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import rerun as rr

from bevviz.closing import Closing
from bevviz.compare.differences import Change, differences, seen
from bevviz.compare.truth import judge
from bevviz.config import changes, revised
from bevviz.drive import Drive, Frames
from bevviz.errors import UserError, first_line
from bevviz.evaluate import Score, Truth
from bevviz.frame import Frame, FrameResult, Tracks
from bevviz.logging import blueprints, entities
from bevviz.logging.logger import Logger
from bevviz.logging.sinks import APPLICATION
from bevviz.logging.writer import WAIT
from bevviz.perceive import describe
from bevviz.run import Items, Observer, run
from bevviz.variants import Variants, check_same_frames
from bevviz.why import Answer, Questioner
from bevviz.why.log import log_answers
from bevviz.workbench.answers import selection
from bevviz.workbench.film import Film
from bevviz.workbench.missed import Find, finds
from bevviz.workbench.pick import Pick, pick

KEPT = 6  # results of frames that were looked at
PATIENCE = 10.0  # seconds that the run may take to end

Settings = tuple[str, ...]
TruthOf = Callable[[Frame], Truth | None]


class Bench(Closing):
    """One drive on the bench. Questions are to be asked from one thread; whoever listens is told from any.

    Args:
        drive: that is asked about.
        again: the same frames once more, to be run through while others are asked for.
        truth_of: what is known to be there.
        first: number of the scan that is shown first.

    Attributes:
        film: what is shown: the whole drive, then what was asked and tried.
        recording_id: of the film.
        found: what is worth a look in the frames so far.
        opening: stamp of the frame that a page is to open at; None: not run yet.
    """

    def __init__(self, drive: Drive, again: Frames, truth_of: TruthOf | None = None, first: int = 0) -> None:
        self.drive, self.truth_of = drive, truth_of
        self._first = first
        self.film = Film()
        self.found: list[Find] = []
        self.opening: int | None = None
        self.done, self.over, self.error = 0, False, ""
        self._again = again
        self._listeners: list[Callable[[], None]] = []
        self._stamps: list[tuple[int, int]] = []  # stamp, number of each frame on the film, in order
        self._tracks: dict[int, Tracks] = {}
        self._results: OrderedDict[tuple[int, Settings], FrameResult] = OrderedDict()
        self._variants, self._looking = Variants(drive.session.loader), threading.RLock()
        self._asked: Questioner | None = None
        self._stop, self._quiet = threading.Event(), threading.Event()
        self._quiet.set()
        self.recording_id = recording_id = f"bench-{time.time_ns()}"
        self._main, self._film_main = self._stream(recording_id)
        self._desk, self._film_desk = self._stream(recording_id)
        self._main.send_blueprint(blueprints.load("workbench", drive.scene), make_active=True)
        self._logger = Logger(self._main, drive.config, drive.scene, wait=WAIT)
        self._logger.log_static()
        self._desk_logger = Logger(self._desk, drive.config, drive.scene)
        self._thread = threading.Thread(target=self._run, name="drive", daemon=True)

    @staticmethod
    def _stream(recording_id: str) -> tuple[rr.RecordingStream, rr.BinaryStream]:
        recording = rr.RecordingStream(APPLICATION, recording_id=recording_id)
        recording.set_log_time_enabled(False)
        return recording, rr.binary_stream(recording)

    def start(self) -> None:
        """Film the frame that is shown first, then all of them in order."""
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._quiet.set()
        if self._thread.is_alive():
            self._thread.join(PATIENCE)
        self.film.close()
        self.drive.close()
        self._again.close()

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
            "total": self._again.total,
            "over": self.over,
            "error": self.error,
            "warnings": list(self._again.warnings) if self.over else [],
        }

    def _run(self) -> None:
        try:
            if self._first:
                self._show(self.look(self._first))
            session = self.drive.new_session()
            run(self._again, session, [_Filming(self)], stop=self._stop)
        except Exception as error:
            self.error = (
                str(error) if isinstance(error, UserError) else f"the run failed: {first_line(error)}"
            )
        self.over = True
        self._news()

    def see(self, result: FrameResult) -> None:
        """The next frame of the run; while a question is being answered, it waits."""
        self._show(result)
        frame = result.frame
        if result.tracks is not None:
            bare = np.zeros((len(result.tracks), 0, 3), np.float32)
            self._tracks[frame.index] = replace(result.tracks, trail=bare)
        new = finds(result, self.truth_of(frame) if self.truth_of is not None else None)
        self.found += new
        self.done += 1
        self._news()
        self._quiet.wait()

    def _show(self, result: FrameResult) -> None:
        frame = result.frame
        self._logger.log(result)
        entry = (frame.stamp, frame.index)
        place = bisect.bisect_left(self._stamps, entry)
        if self._stamps[place : place + 1] != [entry]:
            self._stamps.insert(place, entry)
        self.film.add(self._film_main.read())
        if self.opening is None:
            self.opening = frame.stamp
            self._news()

    def end(self) -> None:
        """The run's last numbers."""
        self._logger.flush()
        self.film.add(self._film_main.read())

    def _news(self) -> None:
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
        """Number of the frame that a viewer shows at that time.

        Raises:
            UserError: no frame is there yet.
        """
        if not self._stamps:
            raise UserError("no frame has been run yet")
        place = bisect.bisect_right(self._stamps, (stamp + 1000, 2**62)) - 1  # pages count in doubles
        return self._stamps[max(place, 0)][1]

    def stamp_of(self, number: int) -> int:
        """Sensor time of a frame, in nanoseconds.

        Raises:
            UserError: it is not on the film yet.
        """
        for stamp, index in self._stamps:
            if index == number:
                return stamp
        raise UserError(f"frame {number} has not been run yet")

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
        return pick(self.look(number, settings), self._tracks.get(number), path, instance, position)

    def ask(self, number: int, settings: Settings, what: Pick, hints: bool = False) -> Answer:
        """Why it was reported, or was not; what is asked about is shown in every view.

        Raises:
            UserError: there is no such thing in the frame.
        """
        questioner = self._questioner(self.look(number, settings))
        found = questioner.ask(selection(what))
        if not found:
            raise UserError(f"there is nothing to say about {what}")
        if hints:
            return questioner.with_hints(found[0])
        self._mark(questioner.traces.result, found[:1])
        return found[0]

    def _questioner(self, result: FrameResult) -> Questioner:
        """What questions about one result have in common is worked out once."""
        if self._asked is None or self._asked.traces.result is not result:
            session = self.drive.session
            self._asked = Questioner(result, session.loader, session.stages.class_names)
        return self._asked

    def _mark(self, result: FrameResult, answers: Sequence[Answer]) -> None:
        frame = result.frame
        self._desk_logger.set_time(frame.index, frame.stamp, frame.received)
        self._desk.log(entities.WHY, rr.Clear(recursive=True))
        log_answers(self._desk, frame, answers, len(answers))
        self._desk_logger.set_time(frame.index + 1, frame.stamp + 1, frame.received and frame.received + 1)
        self._desk.log(entities.WHY, rr.Clear(recursive=True))
        self.film.add(self._film_desk.read())

    # --- other values --------------------------------------------------------------------------

    def attempt(self, number: int, settings: Settings) -> dict[str, Any]:
        """Show the frame as it is with other values, and tell what they do to it.

        Raises:
            UserError: as ``look``.
        """
        before, after = self.look(number), self.look(number, settings)
        self._redraw(before, after)
        frame = after.frame
        found = differences(frame.index, frame.stamp, seen(before), seen(after))
        counts = found.counts
        names = (before.objects.names if before.objects else (), after.objects.names if after.objects else ())
        told: dict[str, Any] = {
            "changes": {k: str(c) for k, c in changes(self.drive.config, after.config).items()},
            "before": Counter(names[0]),
            "after": Counter(names[1]),
            "gone": counts[Change.ONLY_A],
            "new": counts[Change.ONLY_B],
            "changed": counts[Change.MOVED] + counts[Change.CLASS],
            "failures": [f"{failure.stage}: {failure.reason}" for failure in after.failures],
        }
        truth = self.truth_of(frame) if self.truth_of is not None else None
        if truth is not None:
            judged = judge(before, after, truth)
            told["fixed"] = [judged.text(row) for row in judged.fixed]
            told["broken"] = [judged.text(row) for row in judged.broken]
            told["f1"] = [_f1(before, truth), _f1(after, truth)]
        return told

    def _redraw(self, before: FrameResult, after: FrameResult) -> None:
        """Over what the run has drawn, which the desk's logger has to know in order to clear it."""
        self._desk_logger.log(before)
        self._desk_logger.refresh()
        if after is not before:
            self._desk_logger.log(after)
            self._desk_logger.refresh()
        self._desk_logger.flush()
        self.film.add(self._film_desk.read())


def _f1(result: FrameResult, truth: Truth) -> float | None:
    score = Score()
    if result.objects is None:
        return None
    score.add(result.objects, truth)
    return None if np.isnan(score.f1) else round(score.f1, 3)


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
