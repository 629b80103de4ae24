"""A drive with other values: one frame of it at once, all of them behind it, and where that is better."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from bevviz.config import changes, revised
from bevviz.errors import UserError, first_line
from bevviz.evaluate import Score, Truth
from bevviz.model.counts import OPINIONS, opinions_in
from bevviz.model.protocols import Items, Observer
from bevviz.model.results import FrameResult, Objects
from bevviz.pipeline.run import run
from bevviz.pipeline.session import Session
from bevviz.pipeline.variants import check_same_frames
from bevviz.recording import entities
from bevviz.recording.frame_logger import Logger
from bevviz.recording.writer import WAIT
from bevviz.why.frame_index import truth_subjects
from bevviz.why.pick import Pick
from bevviz.why.side_effects import Effects, effects
from bevviz.why.subject import Subject
from bevviz.workbench.findings import Find, finds, fixed_place

if TYPE_CHECKING:
    from bevviz.workbench.session import Bench, Settings

DIFFERENCES = ("fixed", "broken", "new false", "false gone", "new", "gone")  # kinds of entries


@dataclass(slots=True)
class Trial:
    """A run over the drive with other values, and what it does to each frame.

    Attributes:
        settings: that differ from those the drive was opened with.
        state: waiting, running, over, cancelled or failed.
        strip: stamp of each frame, how many objects it makes better and how many worse; without a ground
            truth, how many come and how many go.
    """

    settings: Settings
    total: int
    state: str = "waiting"
    error: str = ""
    done: int = 0
    strip: list[tuple[int, int, int]] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    scores: tuple[Score, Score] = field(default_factory=lambda: (Score(), Score()))
    known: bool = False
    stop: threading.Event = field(default_factory=threading.Event)

    @property
    def going(self) -> bool:
        return self.state in ("waiting", "running")

    def as_dict(self) -> dict[str, Any]:
        """For the page."""
        return {
            "settings": list(self.settings),
            "state": self.state,
            "error": self.error,
            "done": self.done,
            "total": self.total,
            "counts": {key: number for key, number in self.counts.items() if number},
            "better": sum(good > bad for _, good, bad in self.strip),
            "worse": sum(bad > good for _, good, bad in self.strip),
            "f1": [rounded(score.f1) for score in self.scores] if self.known else None,
            "strip": [] if self.going else [[str(stamp), good, bad] for stamp, good, bad in self.strip],
        }


class Trials:
    """Runs one trial at a time over a bench's drive.

    Args:
        bench: whose drive it is.
        news: called when there is something to tell.
    """

    def __init__(self, bench: Bench, news: Callable[[], None]) -> None:
        self._bench, self._news = bench, news
        self._recording, self.film = bench.stream()
        self._thread: threading.Thread | None = None
        self.trial: Trial | None = None

    def begin(self, settings: Settings) -> None:
        """Run the drive with these, in place of what is being run.

        Raises:
            UserError: nothing is changed, an unknown parameter, or a wrong value.
        """
        bench = self._bench
        config = revised(bench.drive.config, settings)
        check_same_frames({"the drive": bench.drive.config, "what is tried": config})
        if not changes(bench.drive.config, config):
            raise UserError("nothing is changed: press a hint, or change a parameter first")
        session = Session(config, loader=bench.drive.session.loader)
        self.end()
        trial = self.trial = Trial(settings, bench.again.total, known=bench.truth_of is not None)
        bench.entries.replace(DIFFERENCES)
        self._thread = threading.Thread(target=self._run, args=(trial, session), name="trial", daemon=True)
        self._thread.start()
        self._news()

    def end(self) -> None:
        """Cancel what is being run; what was made until then stays."""
        if self.trial is not None:
            self.trial.stop.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self, trial: Trial, session: Session) -> None:
        bench = self._bench
        try:
            while not bench.over and not trial.stop.wait(0.1):
                pass  # the first run has what this one is compared with
            trial.state = "running"
            logger = tried_logger(self._recording, session, bench)
            run(bench.again, session, [_Trying(bench, trial, logger, self._show)], stop=trial.stop)
            trial.state = "cancelled" if trial.stop.is_set() else "over"
        except Exception as error:
            trial.state = "failed"
            trial.error = str(error) if isinstance(error, UserError) else first_line(error)
        self._news()

    def _show(self) -> None:
        self._bench.film.add(self.film.read())
        self._news()


class _Trying(Observer[FrameResult]):
    """Shows each frame as it is with other values, and counts what that changes."""

    def __init__(self, bench: Bench, trial: Trial, logger: Logger, show: Callable[[], None]) -> None:
        self._bench, self._trial, self._logger, self._show = bench, trial, logger, show

    def begin(self, items: Items[object]) -> None:
        pass

    def see(self, result: FrameResult) -> None:
        bench, trial, frame = self._bench, self._trial, result.frame
        before, truth = bench.objects(frame.index), bench.truth(frame)
        bench.draw_tried(self._logger, result, finds(result, truth))
        subjects = truth_subjects(frame, bench.drive.session.stages.class_names)
        found = effects(before, result.objects, subjects)
        entries = list(difference_entries(result, found, subjects, before))
        trial.counts.update(find.what for find, _ in entries)
        trial.counts["changed"] += found.changed
        for tried in (False, True):
            bench.entries.add((find for find, side in entries if side == tried), tried=tried)
        good, bad = (found.good, found.harm) if found.known else (len(found.more), len(found.gone))
        trial.strip.append((frame.stamp, good, bad))
        if truth is not None:
            for score, objects in zip(trial.scores, (before, result.objects), strict=True):
                if objects is not None:
                    score.add(objects, truth)
        trial.done += 1
        self._show()
        bench.wait_for_quiet()

    def end(self) -> None:
        self._logger.flush()
        self._show()


def tried_logger(recording: Any, session: Session, bench: Bench) -> Logger:
    """Writes results beside those of the run, on a timeline of their own."""
    return Logger(
        recording, session.config, bench.drive.scene, wait=WAIT, stamps=(entities.TRIED,), inputs=False
    )


def difference_entries(
    result: FrameResult, found: Effects, truth: Sequence[Subject], before: Objects | None
) -> Iterator[tuple[Find, bool]]:
    """What other values change in a frame, and whether it is to be seen with them."""
    when, pose = (result.frame.index, result.frame.stamp), result.frame.pose

    def find(what: str, name: str, center: Any, pick: Pick) -> Find:
        away = float(np.hypot(*center[:2]))
        return Find(*when, what, name.rsplit(" at ", 1)[0], away, pick, place=fixed_place(pose, center))

    after = result.objects
    for effect in found.made:
        if effect.truth >= 0 and (box := truth[effect.truth].box) is not None:
            yield find("fixed", effect.name, box.center[0], Pick("truth", effect.truth)), True
    for effect in found.more:
        assert after is not None
        if not found.known or effect.truth < 0:
            what = "new false" if found.known else "new"
            yield (
                find(what, effect.name, after.boxes.center[effect.after], Pick("object", effect.after)),
                True,
            )
    for effect in found.gone:
        assert before is not None
        center = before.boxes.center[effect.before]
        if effect.missed:
            yield find("broken", effect.name, center, Pick("truth", effect.truth)), True
        elif not found.known or effect.truth < 0:
            what = "false gone" if found.known else "gone"
            yield find(what, effect.name, center, Pick("object", effect.before)), False


def attempt(before: FrameResult, after: FrameResult, truth: Truth | None, asked: int = -1) -> dict[str, Any]:
    """What other values do to one frame, for the page; what was asked about, a row of the truth, first."""
    subjects = truth_subjects(after.frame, _names(before))
    found = effects(before.objects, after.objects, subjects, asked)
    told: dict[str, Any] = {
        "changes": {k: str(c) for k, c in changes(before.config, after.config).items()},
        "effects": effects_dict(found),
        "opinions": _opinions(before, after),
        "failures": [f"{failure.stage}: {failure.reason}" for failure in after.failures],
    }
    if truth is not None:
        told["f1"] = [_f1(result, truth) for result in (before, after)]
    return told


def _opinions(before: FrameResult, after: FrameResult) -> dict[str, list[int | None]]:
    """Of which there are more or fewer, how many there were and are; None: the objects are ours."""
    was, now = opinions_in(before), opinions_in(after)
    counts = {what: [was.get(what), now.get(what)] for what in OPINIONS}
    return {what.replace("_", " "): [a, b] for what, (a, b) in counts.items() if (a or 0) != (b or 0)}


def effects_dict(found: Effects) -> dict[str, Any]:
    """In words, as those of a hint."""
    return {
        "fixed": list(found.fixed),
        "added": list(found.added),
        "false": list(found.false),
        "lost": list(found.lost),
        "right": list(found.right),
        "changed": found.changed,
    }


def _names(result: FrameResult) -> list[str]:
    return [name for c in result.cameras if c.detections is not None for name in c.detections.names]


def _f1(result: FrameResult, truth: Truth) -> float | None:
    score = Score()
    if result.objects is None:
        return None
    score.add(result.objects, truth)
    return rounded(score.f1)


def rounded(value: float) -> float | None:
    """For the page; None where there is nothing to tell."""
    return None if np.isnan(value) else round(value, 3)
