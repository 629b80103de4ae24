"""Trials of other parameter values: on one frame at once, and on the whole drive in the background."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from bevviz.config import changed_config, changes
from bevviz.errors import UserError, first_line
from bevviz.evaluate import ObjectScore, Truth
from bevviz.model.counts import OPINIONS, count_opinions
from bevviz.model.protocols import Items, Observer
from bevviz.model.results import FrameResult, Objects
from bevviz.pipeline.run import run
from bevviz.pipeline.session import Session, check_same_frames
from bevviz.recording import entities
from bevviz.recording.frame_logger import FrameLogger
from bevviz.recording.writer import SCALAR_WAIT
from bevviz.why.frame_index import truth_subjects
from bevviz.why.pick import Pick
from bevviz.why.side_effects import Effects, effects
from bevviz.why.subject import Subject
from bevviz.workbench.findings import Finding, find_findings, fixed_position

if TYPE_CHECKING:
    from bevviz.workbench.session import Settings, WorkbenchSession

DIFFERENCES = ("fixed", "broken", "new false", "false gone", "new", "gone")  # kinds of findings


@dataclass(slots=True)
class Trial:
    """A run over the drive with other values, and its effect on each frame.

    Attributes:
        settings: the settings that differ from those the drive was opened with.
        total: number of frames of the drive.
        state: waiting, running, over, cancelled or failed.
        error: reason of the failure.
        done: number of finished frames.
        strip: per frame its stamp, how many objects get better and how many get worse. Without ground truth,
            how many objects appear and how many disappear.
        counts: number of changes by kind.
        scores: score before and after.
        known: whether there is ground truth.
        stop: cancels the run when it is set.
    """

    settings: Settings
    total: int
    state: str = "waiting"
    error: str = ""
    done: int = 0
    strip: list[tuple[int, int, int]] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    scores: tuple[ObjectScore, ObjectScore] = field(default_factory=lambda: (ObjectScore(), ObjectScore()))
    known: bool = False
    stop: threading.Event = field(default_factory=threading.Event)

    @property
    def going(self) -> bool:
        """Whether the trial is waiting or running."""
        return self.state in ("waiting", "running")

    def as_dict(self) -> dict[str, Any]:
        """Return the trial as JSON for the page."""
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


class TrialRunner:
    """Runner of trials over the drive of a workbench session, one at a time.

    Args:
        workbench: the workbench session.
        on_change: called when the state of the trial has changed.
    """

    def __init__(self, workbench: WorkbenchSession, on_change: Callable[[], None]) -> None:
        self._workbench, self._on_change = workbench, on_change
        self._recording, self.film = workbench.stream()
        self._thread: threading.Thread | None = None
        self.trial: Trial | None = None

    def begin(self, settings: Settings) -> None:
        """Run the drive with these settings. A trial that is running is cancelled.

        Raises:
            UserError: nothing is changed, a parameter is unknown, or a value is wrong.
        """
        workbench = self._workbench
        config = changed_config(workbench.drive.config, settings)
        check_same_frames({"the drive": workbench.drive.config, "what is tried": config})
        if not changes(workbench.drive.config, config):
            raise UserError("nothing is changed: press a hint, or change a parameter first")
        session = Session(config, loader=workbench.drive.session.loader)
        self.end()
        trial = self.trial = Trial(settings, workbench.again.total, known=workbench.truth_of is not None)
        workbench.entries.replace(DIFFERENCES)
        self._thread = threading.Thread(target=self._run, args=(trial, session), name="trial", daemon=True)
        self._thread.start()
        self._on_change()

    def end(self) -> None:
        """Cancel the running trial. Its results until then stay."""
        if self.trial is not None:
            self.trial.stop.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self, trial: Trial, session: Session) -> None:
        workbench = self._workbench
        try:
            while not workbench.over and not trial.stop.wait(0.1):
                pass  # The results of the first run are needed for comparison.
            trial.state = "running"
            logger = tried_logger(self._recording, session, workbench)
            run(
                workbench.again,
                session,
                [_TrialObserver(workbench, trial, logger, self._show)],
                stop=trial.stop,
            )
            trial.state = "cancelled" if trial.stop.is_set() else "over"
        except Exception as error:
            trial.state = "failed"
            trial.error = str(error) if isinstance(error, UserError) else first_line(error)
        self._on_change()

    def _show(self) -> None:
        self._workbench.film.add(self.film.read())
        self._on_change()


class _TrialObserver(Observer[FrameResult]):
    """Observer of a trial. It logs each frame with the other values and counts the changes."""

    def __init__(
        self, workbench: WorkbenchSession, trial: Trial, logger: FrameLogger, show: Callable[[], None]
    ) -> None:
        self._workbench, self._trial, self._logger, self._show = workbench, trial, logger, show

    def begin(self, items: Items[object]) -> None:
        pass

    def observe(self, result: FrameResult) -> None:
        workbench, trial, frame = self._workbench, self._trial, result.frame
        before, truth = workbench.objects(frame.index), workbench.truth(frame)
        workbench.draw_tried(self._logger, result, find_findings(result, truth))
        subjects = truth_subjects(frame, workbench.drive.session.stages.class_names)
        side_effects = effects(before, result.objects, subjects)
        findings = list(difference_findings(result, side_effects, subjects, before))
        trial.counts.update(finding.what for finding, _ in findings)
        trial.counts["changed"] += side_effects.changed
        for tried in (False, True):
            workbench.entries.add((finding for finding, side in findings if side == tried), tried=tried)
        good, bad = (
            (side_effects.good, side_effects.harm)
            if side_effects.known
            else (len(side_effects.more), len(side_effects.gone))
        )
        trial.strip.append((frame.stamp, good, bad))
        if truth is not None:
            for score, objects in zip(trial.scores, (before, result.objects), strict=True):
                if objects is not None:
                    score.add(objects, truth)
        trial.done += 1
        self._show()
        workbench.wait_for_quiet()

    def end(self) -> None:
        self._logger.flush()
        self._show()


def tried_logger(recording: Any, session: Session, workbench: WorkbenchSession) -> FrameLogger:
    """Return a logger that writes tried results on a timeline of their own, beside those of the run."""
    return FrameLogger(
        recording,
        session.config,
        workbench.drive.scene,
        wait=SCALAR_WAIT,
        stamps=(entities.TRIED,),
        inputs=False,
    )


def difference_findings(
    result: FrameResult, side_effects: Effects, truth: Sequence[Subject], before: Objects | None
) -> Iterator[tuple[Finding, bool]]:
    """Yield the findings that other values cause in a frame, and whether the tried side shows them."""
    frame_ids, pose = (result.frame.index, result.frame.stamp), result.frame.pose

    def make_finding(kind: str, name: str, center: Any, pick: Pick) -> Finding:
        distance = float(np.hypot(*center[:2]))
        return Finding(
            *frame_ids, kind, name.rsplit(" at ", 1)[0], distance, pick, position=fixed_position(pose, center)
        )

    after = result.objects
    for effect in side_effects.made:
        if effect.truth >= 0 and (box := truth[effect.truth].box) is not None:
            yield make_finding("fixed", effect.name, box.center[0], Pick("truth", effect.truth)), True
    for effect in side_effects.more:
        assert after is not None
        if not side_effects.known or effect.truth < 0:
            kind = "new false" if side_effects.known else "new"
            yield (
                make_finding(
                    kind, effect.name, after.boxes.center[effect.after], Pick("object", effect.after)
                ),
                True,
            )
    for effect in side_effects.gone:
        assert before is not None
        center = before.boxes.center[effect.before]
        if effect.missed:
            yield make_finding("broken", effect.name, center, Pick("truth", effect.truth)), True
        elif not side_effects.known or effect.truth < 0:
            kind = "false gone" if side_effects.known else "gone"
            yield make_finding(kind, effect.name, center, Pick("object", effect.before)), False


def trial_effects(
    before: FrameResult, after: FrameResult, truth: Truth | None, truth_row: int = -1
) -> dict[str, Any]:
    """Return the effects of other values on one frame, for the page.

    Args:
        before: result as opened.
        after: result with the other values.
        truth: ground truth of the frame.
        truth_row: row of the ground truth object that was asked about. Its effect comes first. -1: none.
    """
    subjects = truth_subjects(after.frame, _names(before))
    side_effects = effects(before.objects, after.objects, subjects, truth_row)
    message: dict[str, Any] = {
        "changes": {key: str(change) for key, change in changes(before.config, after.config).items()},
        "effects": effects_dict(side_effects),
        "opinions": _opinions(before, after),
        "failures": [f"{failure.stage}: {failure.reason}" for failure in after.failures],
    }
    if truth is not None:
        message["f1"] = [_f1(result, truth) for result in (before, after)]
    return message


def _opinions(before: FrameResult, after: FrameResult) -> dict[str, list[int | None]]:
    """Return the counts of opinions that changed, before and after. None: the objects are our own."""
    counts_before, counts_after = count_opinions(before), count_opinions(after)
    counts = {opinion: [counts_before.get(opinion), counts_after.get(opinion)] for opinion in OPINIONS}
    return {
        opinion.replace("_", " "): [old, new]
        for opinion, (old, new) in counts.items()
        if (old or 0) != (new or 0)
    }


def effects_dict(side_effects: Effects) -> dict[str, Any]:
    """Return effects as JSON for the page, in the same form as those of a hint."""
    return {
        "fixed": list(side_effects.fixed),
        "added": list(side_effects.added),
        "false": list(side_effects.false),
        "lost": list(side_effects.lost),
        "right": list(side_effects.right),
        "changed": side_effects.changed,
    }


def _names(result: FrameResult) -> list[str]:
    return [
        name for camera in result.cameras if camera.detections is not None for name in camera.detections.names
    ]


def _f1(result: FrameResult, truth: Truth) -> float | None:
    score = ObjectScore()
    if result.objects is None:
        return None
    score.add(result.objects, truth)
    return rounded(score.f1)


def rounded(value: float) -> float | None:
    """Return a number rounded to three digits for the page, or None for NaN."""
    return None if np.isnan(value) else round(value, 3)
