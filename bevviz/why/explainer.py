"""Explain the subjects of one frame: one path from a selection to its answers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from bevviz.evaluate import Matches, Truth
from bevviz.model.reasons import Reason, ReasonKind
from bevviz.model.results import FrameResult
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.why.answer import Answer
from bevviz.why.collect import collect_evidence
from bevviz.why.false_objects import false_reasons
from bevviz.why.frame_index import FrameIndex
from bevviz.why.hints import HintFinder
from bevviz.why.ideal import StageSet
from bevviz.why.kept_labels import label_of
from bevviz.why.neighbours import FrameLookup, NeighbourRuns
from bevviz.why.reruns import FrameRuns
from bevviz.why.resolve import select_subjects, subjects_at_place
from bevviz.why.selection import Selection
from bevviz.why.sentences import make_verdict, untried_text
from bevviz.why.steps import Step, steps_of
from bevviz.why.subject import Subject
from bevviz.why.verdict import HOPELESS, Verdict, find_reason, likely_reasons, stage_of


class FrameExplainer:
    """Explainer of one frame. All answers share the index of its results.

    Args:
        result: result of the frame, with its explanations.
        loader: stage loader with the networks already loaded, for ``hints``.
        classes: names of the classes that the detector knows.
        truth: ground truth of the frame; None: its own.
        neighbours: returns the frames before and after, on which hints are tried, too.
        labels: labels that the user keeps. Where there is no ground truth, they make the answers about their
            objects exact, and tell nothing about others.
    """

    def __init__(
        self,
        result: FrameResult,
        loader: StageLoader | None = None,
        classes: Sequence[str] = (),
        truth: Truth | None = None,
        neighbours: FrameLookup = tuple,
        labels: Truth | None = None,
    ) -> None:
        self.traces = FrameIndex(result, classes, truth)
        self._labelled: FrameExplainer | None = None
        if labels is not None and self.traces.labels_in_evaluate is None:
            self._labelled = FrameExplainer(result, loader, classes, labels, neighbours)
        loader = loader or StageLoader()
        self._runs = FrameRuns(self.traces, loader)
        self._neighbours = NeighbourRuns(neighbours, result.config, loader)
        self._answers: dict[tuple[object, ...], Answer] = {}

    def ask(self, selection: Selection) -> list[Answer]:
        """Explain the subjects of a selection without hints, the worst first.

        A pixel or an image box selects the object that shows there, the first of ``candidates``. A point or a
        cell selects all points around it. An empty selection is the whole frame, reported objects included.

        Raises:
            UserError: unknown class, camera, row or track, or a pixel or cell outside the image.
        """
        if selection.box:
            candidates = self.candidates(selection)
            if candidates:
                return candidates[:1]
        answers = [self._answer(subject) for subject in select_subjects(self.traces, selection)]
        return _once_by_label(sorted(answers, key=_rank))

    def explain(
        self,
        selection: Selection,
        hints: int = 5,
        progress: Callable[[Sequence[Answer]], Iterable[Answer]] = iter,
        *,
        everything: bool = False,
    ) -> list[Answer]:
        """Explain the subjects of a selection that matter, with hints.

        Args:
            selection: the subjects in question.
            hints: number of answers that get hints. Each hint runs the stages again.
            progress: wraps these answers while their hints are searched.
            everything: include folded answers and, for an empty selection, reported objects.

        Raises:
            UserError: as ``ask``.
        """
        answers = self.ask(selection)
        unfolded = [answer for answer in answers if not answer.folded]
        if not everything and (selection.label or selection.one):
            answers = unfolded or answers
        elif not everything:
            answers = [answer for answer in unfolded if answer.verdict.kind is not ReasonKind.REPORTED]
        return [*map(self.with_hints, progress(answers[:hints])), *answers[hints:]]

    def candidates(self, selection: Selection) -> list[Answer]:
        """Explain each subject at a pixel, in an image box, around a point or in a cell.

        The visible ones come first, then those behind them. Within these, known objects come before unnamed
        clusters, missed before reported, near before far. Subjects that no sensor can see come last.

        Raises:
            UserError: as ``ask``.
        """
        answers = [
            (self._answer(subject), shows) for subject, shows in subjects_at_place(self.traces, selection)
        ]
        order = sorted(answers, key=lambda pair: _place_rank(*pair))
        return _once_by_label([answer for answer, _ in order])

    def about(self, selection: Selection) -> Answer:
        """Explain the one subject of a selection that selects a row."""
        return self._answer(select_subjects(self.traces, selection)[0])

    def false_verdict(self, subject: Subject) -> Verdict | None:
        """Return the verdict on a false object without an answer's evidence and steps, which take longer.

        None: the object is not false, or labels of the user decide about it.
        """
        false = false_reasons(self.traces) if self._labelled is None else {}
        return make_verdict(subject, false[subject.row], reported=True) if subject.row in false else None

    def missed(self) -> list[Answer]:
        """Explain the objects that should have been reported and were not, the nearest first."""
        answers = [a for a in self.ask(Selection()) if a.near and not a.verdict.reported]
        return sorted(answers, key=_sort_distance)

    def search(self, answer: Answer) -> Answer:
        """Search changes that would change the verdict. This runs other configurations and takes a while."""
        return HintFinder(self.traces, self._runs, self._neighbours, answer).search()

    def with_hints(self, answer: Answer) -> Answer:
        """Add hints and a remark to an answer. Its sentence then names the first hint, or what was tried."""
        if answer.empty:
            return answer
        if answer.label >= 0 and (labelled := self._labelled) is not None:
            exact = labelled.with_hints(
                replace(answer, subject=labelled.traces.truth[answer.label], label=-1)
            )
            return replace(exact, subject=answer.subject, label=answer.label)
        if answer.verdict.kind is ReasonKind.SECOND_NAME:
            remark = untried_text(answer.subject, answer.verdict)
            return replace(answer, remark=f"{remark[0].upper()}{remark[1:]}.")
        answer = self.search(self.with_restoring_stages(answer))
        verdict = answer.verdict
        if answer.hints:
            hint = answer.hints[0]
            also = f" (in this frame: {hint.effects.text})" if hint.effects.text else ""
            clause = f"change {', '.join(hint.settings)}: {hint.text}{also}"
        else:
            clause = answer.tried_text()
        advice = "" if answer.folded else clause
        brief = clause if answer.hints else answer.tried_text(named=1)
        remark = brief or untried_text(answer.subject, verdict)
        remark = f"{remark[:1].upper()}{remark[1:]}." if remark else ""
        return replace(answer, verdict=replace(verdict, advice=advice), remark=remark)

    def with_restoring_stages(self, answer: Answer) -> Answer:
        """Add all smallest sets of stages that bring a missed object back.

        Lists do without them: each set takes a run of the stages. With ground truth they have the first set,
        if it has the stage of the reason. Without it, the object is the one that an image box shows.
        """
        subject, verdict = answer.subject, answer.verdict
        if not (restored_by := self._runs.restored_by(subject)):
            return answer
        blamed = stage_of(verdict.reason.kind, answer.evidence)
        verdict = make_verdict(subject, verdict.reason, verdict.reported, restored_by, blamed)
        return replace(answer, verdict=verdict, likely=())

    def _answer(self, subject: Subject) -> Answer:
        """Return the answer about one subject, from the cache if it is known."""
        if subject.asked is None and subject.key in self._answers:
            return self._answers[subject.key]
        if (exact := self._by_label(subject)) is not None:
            return exact
        evidence = collect_evidence(subject, self.traces)
        reason, reported = find_reason(subject, evidence, self.traces)
        restored_by: tuple[StageSet, ...] = ()
        if subject.kind == "truth":
            restored_by = self._runs.restored_by(subject, stage_of(reason.kind, evidence))
            reason, reported = find_reason(subject, evidence, self.traces, restored_by)
        likely = () if reported else likely_reasons(subject, evidence, self.traces, reason.kind)
        blamed = stage_of(reason.kind, evidence)
        verdict = make_verdict(subject, reason, reported, restored_by, blamed, likely)
        steps = tuple(steps_of(subject, evidence, self.traces))
        answer = Answer(subject, verdict, steps, (), evidence.fate, evidence.distance, evidence.raw, evidence)
        answer = replace(answer, likely=likely, near=self.traces.must(subject))
        if subject.asked is None and not subject.is_place:  # The number of possible places has no limit.
            self._answers[subject.key] = answer
        return answer

    def _by_label(self, subject: Subject) -> Answer | None:
        """Return the answer about the object of the label that a subject is on. None: there is no label."""
        if (labelled := self._labelled) is None:
            return None
        row = label_of(subject, self.traces, labelled.traces)
        if row < 0:
            return None
        label = labelled.traces.truth[row]
        exact = labelled.about(Selection(truth=row))
        step = Step("label", f"{label.name} is kept as truth, so this answer is exact")
        subject = replace(subject, name=label.name, box=label.box)
        return replace(exact, subject=subject, steps=(step, *exact.steps), label=row)


class RunExplainer:
    """Explainer of the frames of a run. The observers of a frame share its ``FrameExplainer``.

    Args:
        loader: as in ``FrameExplainer``.
        classes: as in ``FrameExplainer``.
    """

    def __init__(self, loader: StageLoader | None = None, classes: Sequence[str] = ()) -> None:
        self._loader, self._classes = loader, classes
        self._last: FrameExplainer | None = None

    def of(self, result: FrameResult, truth: Truth | None = None) -> FrameExplainer:
        """Return the explainer of a frame.

        Args:
            result: result of the frame.
            truth: its ground truth; None: that of the first call for the frame, or the frame's own.
        """
        if self._last is None or self._last.traces.result is not result:
            self._last = FrameExplainer(result, self._loader, self._classes, truth)
        return self._last

    def false_causes(self, result: FrameResult, truth: Truth, matches: Matches) -> Mapping[int, Reason]:
        """Return the causes of the false objects of a frame by row, for an ``Evaluation``."""
        traces = self.of(result, truth).traces
        if result.objects is not None:
            traces.matches = matches
        return false_reasons(traces) if matches.false.any() else {}


def _once_by_label(answers: Sequence[Answer]) -> list[Answer]:
    """Return the answers without a second one about the same label."""
    labels = [answer.label for answer in answers]
    return [
        answer for row, answer in enumerate(answers) if answer.label < 0 or answer.label not in labels[:row]
    ]


def _rank(answer: Answer) -> tuple[bool, bool, bool, bool, bool, float]:
    """Return the sort key of answers in a list, the worst first."""
    verdict, best = answer.verdict, answer.evidence.best
    if answer.weak and best is not None:  # the highest score first
        return True, True, False, False, False, -best.score
    return (
        answer.folded,
        False,
        verdict.reported,
        verdict.kind is ReasonKind.REPORTED,
        not answer.near,
        _sort_distance(answer),
    )


def _place_rank(answer: Answer, shows: bool) -> tuple[bool, bool, int, bool, float]:
    """Return the sort key of the answers at one place."""
    kind = 2 if answer.weak else 1 if answer.subject.kind == "cluster" else 0
    hopeless = answer.verdict.kind in HOPELESS
    return hopeless, not shows, kind, answer.verdict.reported, _sort_distance(answer)


def _sort_distance(answer: Answer) -> float:
    """Return the distance; unknown distances sort last."""
    return float("inf") if np.isnan(answer.distance) else answer.distance
