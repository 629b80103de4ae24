"""Trials of other parameter values: on one frame at once, and on the whole drive in the background."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, NotRequired

import numpy as np
from typing_extensions import TypedDict  # pydantic needs this one before Python 3.12

from bevviz.config import Config, changed_config, changes
from bevviz.errors import UserError
from bevviz.evaluate import Matches, Truth, differences, rates
from bevviz.findings.finding_list import DIFFERENCES
from bevviz.findings.frame_findings import Finding, finding_of
from bevviz.model import geometry
from bevviz.model.counts import OPINIONS, count_opinions
from bevviz.model.frame import Frame
from bevviz.model.protocols import Items, Observer
from bevviz.model.reasons import ReasonKind
from bevviz.model.results import FrameResult, Objects
from bevviz.pipeline.run import run
from bevviz.pipeline.session import Session, check_same_frames
from bevviz.support.json_form import LEFT_OUT, message_form
from bevviz.why import FrameExplainer, Selection
from bevviz.workbench.buffers import RecordingBuffer
from bevviz.workbench.growing_drive import Settings, Span
from bevviz.workbench.jobs import Job, Jobs
from bevviz.workbench.overview import NumberedFrames
from bevviz.workbench.recorded_drive import RecordedDrive

RUNS = 6  # trials that are kept


class BeforeAfter(TypedDict):
    """A number before and after a change. None: it is unknown."""

    before: float | None
    after: float | None


class TriedEffects(TypedDict):
    """Effects of other values on a frame."""

    changes: dict[str, str]
    effects: differences.ChangedObjects
    opinions: dict[str, BeforeAfter]
    failures: list[str]
    f1: NotRequired[BeforeAfter]


@message_form
@dataclass(slots=True)
class Trial(Job):
    """A run over the drive with other values, and its effect on each frame.

    Attributes:
        counts: number of changes by kind.
        f1: F1 before and after. None: there is no ground truth, or no frame yet.
        lane: name by which a page requests its recording.
        span: first and last stamp of the frames that it runs over. None: the whole drive.
        scores: numbers of true, missed and false objects before and after.
        buffer: recording of its results, for the pages that show its settings.
    """

    state: str = "waiting"
    counts: Counter[str] = field(default_factory=Counter)
    f1: BeforeAfter | None = None
    lane: str = ""
    span: Span | None = None
    scores: Annotated[tuple[Counter[str], Counter[str]], LEFT_OUT] = field(
        default_factory=lambda: (Counter(), Counter())
    )
    buffer: Annotated[RecordingBuffer, LEFT_OUT] = field(default_factory=RecordingBuffer)

    @property
    def text(self) -> str:
        """Its changes in a sentence. Empty: it has not run to its end."""
        counts = ", ".join(f"{self.counts[kind]} {kind}" for kind in DIFFERENCES if self.counts[kind])
        frames = f"the whole drive of {self.done}" if self.span is None else f"{self.done}"
        return f"In {frames} frames: {counts or 'no change'}." if self.state == "over" else ""


class TrialRunner(Jobs[Trial]):
    """Trials over a drive. The newest ``RUNS`` are kept."""

    def __init__(self, drive: RecordedDrive) -> None:
        super().__init__("trial", drive.news.tell)
        self._drive = drive
        self._begun = 0  # number of trials until now

    def begin(self, settings: Settings, span: Span | None = None) -> None:
        """Run the drive, or a span of it, with these settings. A trial that is running is cancelled.

        Args:
            settings: the settings.
            span: first and last stamp of the frames. None: the whole drive.

        Raises:
            UserError: nothing is changed, a parameter is unknown, or a value is wrong.
        """
        drive, opened = self._drive, self._drive.pipeline.config
        config = changed_config(opened, settings)
        check_same_frames({"the drive": opened, "what is tried": config})
        if not changes(opened, config):
            raise UserError("nothing is changed: press a hint, or change a parameter first")
        session = Session(config, loader=drive.pipeline.loader)
        self.end()
        frames: Items[Frame] = drive.again
        if span is not None:
            frames = NumberedFrames(drive.again, _numbers(drive, span))
        lane = f"run-{self._begun}"
        trial = Trial(self._begun, settings, frames.total or 0, lane=lane, span=span)
        self._begun += 1
        drive.lanes[trial.lane] = trial.buffer
        drive.findings.replace(tuple(DIFFERENCES))
        self.start(trial, partial(self._run_drive, session, frames))
        for old in self.jobs[:-RUNS]:
            self.jobs.remove(old)
            drive.lanes.pop(old.lane).close()

    def _run_drive(self, session: Session, frames: Items[Frame], trial: Trial) -> None:
        drive = self._drive
        while not drive.over and not trial.stop.wait(0.1):
            pass  # The results of the first run are needed for comparison.
        trial.state = "running"
        with session:
            run(frames, session, [_TrialObserver(drive, trial, session.config)], stop=trial.stop)


def _numbers(drive: RecordedDrive, span: Span) -> range:
    """Return the numbers of the frames of a span."""
    return range(drive.number_at(int(span["first"])), drive.number_at(int(span["last"])) + 1)


class _TrialObserver(Observer[FrameResult]):
    """Observer of a trial. It logs each frame with the other values and counts the changes."""

    def __init__(self, drive: RecordedDrive, trial: Trial, config: Config) -> None:
        self._drive, self._trial = drive, trial
        self._logger = drive.recording.tried_logger(config)
        self._reasons = drive.findings.reasons()

    def observe(self, result: FrameResult) -> None:
        """Log a frame, list its differences and count them."""
        drive, trial, frame = self._drive, self._trial, result.frame
        opened = drive.results.get(frame.index)
        before, after = None if opened is None else opened.objects, result.objects
        cameras = () if opened is None else opened.cameras
        explainer = drive.explainer(result)
        if not drive.recording.on_demand:  # Else a page tries the values on the frames that it shows.
            drive.recording.draw_tried(self._logger, explainer, trial.settings)
        truth = drive.truth(frame)
        change = differences.before_after(before, after, truth, cameras=(cameras, result.cameras))
        findings = list(difference_findings(explainer, change, before, self._reasons))
        trial.counts.update(finding.what for finding, _ in findings)
        if change.changed:
            trial.counts["changed"] += change.changed
        for tried in (False, True):
            drive.findings.add((finding for finding, side in findings if side == tried), tried=tried)
        sides = (before, change.before), (after, change.after)
        for score, (objects, matches) in zip(trial.scores, sides, strict=True):
            if objects is not None and matches is not None:
                score.update(matches.counts)
        if change.truth is not None:
            f1_before, f1_after = (rounded(rates(score)["f1"]) for score in trial.scores)
            trial.f1 = {"before": f1_before, "after": f1_after}
        trial.done += 1
        self._show()
        drive.wait_for_quiet()

    def end(self) -> None:
        """Log the last scalars."""
        self._logger.flush()
        self._show()

    def _show(self) -> None:
        """Pass what was logged to the pages."""
        self._trial.buffer.add(self._logger.piece())
        self._drive.news.tell()


def difference_findings(
    explainer: FrameExplainer,
    change: differences.BeforeAfter,
    before: Objects | None,
    reasons: Mapping[tuple[int, str], str],
) -> Iterator[tuple[Finding, bool]]:
    """Yield the findings that other values cause in a frame, and whether the tried side shows them.

    Args:
        explainer: explainer of the result with the other values.
        change: their effects.
        before: objects of the drive as opened.
        reasons: reasons of the findings of the drive as opened, by frame and text of the selection.
    """
    frame, known = explainer.traces.result.frame, change.truth is not None
    selections = [("fixed", Selection(truth=row)) for row in change.fixed]
    selections += [("new false" if known else "new", Selection(object=row)) for row in change.new_false]
    selections += [("broken", Selection(truth=row)) for row in change.broken]
    for kind, selection in selections:
        yield finding_of(frame, kind, explainer.about(selection)), True
    for row in change.false_gone:
        assert before is not None
        kind, selection = "false gone" if known else "gone", Selection(object=row)
        name, distance = before.names[row], float(before.boxes.distance[row])
        x, y, z = geometry.apply(frame.pose, before.boxes.center[[row]])[0].tolist()
        reason = reasons.get((frame.index, str(selection)), ReasonKind.REPORTED.value)
        yield Finding(frame.index, frame.stamp, kind, name, distance, selection, reason, (x, y, z)), False


def frame_effects(
    before: FrameResult, after: FrameResult, truth: Truth | None, truth_row: int
) -> differences.BeforeAfter:
    """Return the effects of other values on one frame; for the arguments see ``trial_effects``."""
    cameras = before.cameras, after.cameras
    return differences.before_after(before.objects, after.objects, truth, cameras=cameras, asked=truth_row)


def trial_effects(
    before: FrameResult, after: FrameResult, truth: Truth | None, truth_row: int = -1
) -> TriedEffects:
    """Return the effects of other values on one frame, for the page.

    Args:
        before: result as opened.
        after: result with the other values.
        truth: ground truth of the frame.
        truth_row: row of the ground truth object that was asked about. Its effect comes first. -1: none.
    """
    effects = frame_effects(before, after, truth, truth_row)
    message: TriedEffects = {
        "changes": {key: str(change) for key, change in changes(before.config, after.config).items()},
        "effects": effects.names,
        "opinions": _opinions(before, after),
        "failures": [f"{failure.stage}: {failure.reason}" for failure in after.failures],
    }
    if truth is not None:
        message["f1"] = {"before": _f1(before, effects.before), "after": _f1(after, effects.after)}
    return message


def _opinions(before: FrameResult, after: FrameResult) -> dict[str, BeforeAfter]:
    """Return the counts of opinions that changed, before and after. None: the objects are our own."""
    counts_before, counts_after = count_opinions(before), count_opinions(after)
    return {
        opinion.replace("_", " "): {"before": counts_before.get(opinion), "after": counts_after.get(opinion)}
        for opinion in OPINIONS
        if counts_before.get(opinion, 0) != counts_after.get(opinion, 0)
    }


def _f1(result: FrameResult, matches: Matches | None) -> float | None:
    if result.objects is None or matches is None:
        return None
    return rounded(rates(matches.counts)["f1"])


def rounded(value: float) -> float | None:
    """Return a number rounded to three digits for the page, or None for NaN."""
    return None if np.isnan(value) else round(value, 3)
