"""Find parameter changes that would change a verdict. Each is tested by running the stages again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import islice, product
from typing import Any

import numpy as np

from bevviz.evaluate import MAX_DISTANCE
from bevviz.evaluate.differences import before_after
from bevviz.model.reasons import Reason, ReasonKind
from bevviz.why.answer import Answer, Hint, TriedChange
from bevviz.why.changes import (
    FAR_STEPS,
    STEPS,
    Change,
    changes_for,
    restored_values,
    stage_changes,
    stepped_numbers,
)
from bevviz.why.collect import collect_evidence
from bevviz.why.evidence import Evidence
from bevviz.why.false_objects import false_reasons
from bevviz.why.frame_index import FrameIndex
from bevviz.why.ideal import STAGES, StageSet
from bevviz.why.neighbours import NeighbourRuns
from bevviz.why.reruns import FrameRuns
from bevviz.why.subject import Subject
from bevviz.why.verdict import FLAWED, HOPELESS, find_reason, stage_of

TRIES = 10  # changes for the reason
LATER = 12  # changes that are tried after one that helps the frame in question alone
HELPFUL = 3  # changes of each stage that are combined with those of others
OFFERED = 3  # hints of one answer
MISSED = "it stays missed"


class HintFinder:
    """Finder of changes that help one subject.

    Args:
        traces: index of the frame's result.
        runs: runs of the frame with other parameters.
        neighbours: runs of the frames before and after.
        answer: the answer about the subject.
    """

    def __init__(
        self, traces: FrameIndex, runs: FrameRuns, neighbours: NeighbourRuns, answer: Answer
    ) -> None:
        self._traces, self._runs, self._neighbours, self._answer = traces, runs, neighbours, answer
        self._subject, self._verdict = answer.subject, answer.verdict
        self._change_of: dict[tuple[str, ...], Change] = {}  # by settings, of the hints
        self._hints: list[Hint] = []
        self._tried: list[TriedChange] = []
        self._faulty: dict[TriedChange, Hint] = {}  # the object is found then, but it has a fault

    def search(self) -> Answer:
        """Search the mildest change that changes the verdict and makes no other object worse.

        If each helpful change makes another object worse, the hints are those that fix more objects than they
        break, the best first. The others count as tried in vain. If none does, a missed object that is found
        with a fault is better than none.
        """
        hints, tried, faulty = self._hints, self._tried, self._faulty
        left = 0  # changes that are still tried after one that helps this frame alone
        for number, change in enumerate(self._changes()):
            if number >= TRIES and self._stays_missed(change):
                tried.append(TriedChange(_settings(change), MISSED))
                continue
            after = self._runs.with_change(change)
            if after is None:
                continue
            if self._answer.false:
                self._try_on_false(change, after)
            else:
                self._try_on_missed(change, after)
            if hints and not hints[-1].effects.harm and hints[-1].balance > 0:
                hints[-1] = self._with_beside(hints[-1])
                if hints[-1].beside is None or hints[-1].beside > 0:
                    break
                left = left or LATER
            left -= left > 0
            if left == 1:
                break
        if not any(hint.balance > 0 for hint in hints):
            hints += [hint for hint in faulty.values() if hint.balance > 0][:1]
            tried[:] = [
                replace(change, text=f"{change.text}, and it breaks as much") if change in faulty else change
                for change in tried
                if faulty.get(change) not in hints
            ]
        likely_hints = sorted(hints, key=lambda hint: -hint.balance)
        best = [*map(self._with_beside, likely_hints[: 2 * OFFERED]), *likely_hints[2 * OFFERED :]]
        best.sort(key=lambda hint: (-(hint.beside or 0), -hint.balance))
        tried += [TriedChange(hint.settings, hint.objection) for hint in best if not hint.is_good]
        good = tuple(hint for hint in best if hint.is_good)
        return replace(self._answer, hints=good[:OFFERED], tried=tuple(tried))

    def _with_beside(self, hint: Hint) -> Hint:
        """Return a good hint with its effect on the frames before and after."""
        if hint.beside is not None or hint.balance <= 0:
            return hint
        return replace(hint, beside=self._neighbours.balance(self._change_of[hint.settings]))

    def _changes(self) -> Iterator[Change]:
        """Yield the changes to try, each once: those for the reason, for the stages, then combined ones."""
        traces, evidence, kind = self._traces, self._answer.evidence, self._verdict.kind
        restored_by, is_false = self._verdict.restored_by, self._answer.false
        stages = tuple(dict.fromkeys(stage for stages in restored_by for stage in stages))
        alone = tuple(stage for (stage,) in (one for one in restored_by if len(one) == 1))
        tried: set[tuple[tuple[str, Any], ...]] = set()

        def new(changes: Iterable[Change]) -> Iterator[Change]:
            for change in changes:
                key = tuple(sorted(change.items()))
                if key not in tried:
                    tried.add(key)
                    yield change

        for cause in (kind, *self._answer.likely[1:]):
            yield from new(islice(changes_for(evidence, cause, traces, is_false=is_false), TRIES))
        if is_false or not traces.origin("objects").ours:
            return
        blamed = stage_of(kind, evidence)
        nearest = alone or stages or tuple(stage for stage in STAGES if stage == blamed)
        if kind in (*HOPELESS, ReasonKind.NOT_RUN) or not nearest:
            return
        yield from new(restored_values(traces.result.config))
        config = traces.result.config
        for stage in nearest:
            yield from new(stage_changes(stage, config))
        for needed in restored_by:
            if len(needed) > 1:
                yield from new(self._combined(needed))
        if "detector" in nearest:  # Lower limits of the fusion let weaker detections pass.
            yield from new(stepped_numbers("fusion", config, STEPS[:1]))
        others = [stage for stage in STAGES if stage not in nearest]
        yield from new(change for stage in others for change in stage_changes(stage, config, ()))
        yield from new(change for stage in nearest for change in stepped_numbers(stage, config, FAR_STEPS))

    def _combined(self, needed: StageSet) -> Iterator[Change]:
        """Yield combined changes of several stages.

        Each one alone brings the object back if the other stages have their ideal results.
        """
        helpful: list[list[Change]] = []
        for stage in needed:
            others = tuple(other for other in needed if other != stage)
            changes = (
                change
                for change in stage_changes(stage, self._traces.result.config)
                if self._runs.is_found(self._subject, change, others)
            )
            helpful.append([*islice(changes, HELPFUL)])
        for changes_of_stages in product(*helpful):
            combined: dict[str, Any] = {}
            for change in changes_of_stages:
                combined |= change
            yield combined

    def _stays_missed(self, change: Change) -> bool:
        """Return whether a missed object of the ground truth is missed with a change, too."""
        subject = self._subject
        return self._runs.wanted(subject) is not None and not self._runs.is_found(subject, change, ())

    def _try_on_missed(self, change: Change, after: FrameIndex) -> None:
        """Try a change on a missed object, or on one with a fault."""
        subject, reason, reported = self._subject, self._verdict.reason, self._verdict.reported
        then = collect_evidence(subject, after)
        new, now_reported = find_reason(subject, then, after)
        text, object_row = _new_outcome(
            subject, (reason.kind, reported), (new.kind, now_reported), then, after
        )
        if text and _is_sure(subject, change, then):
            row = subject.row if subject.kind == "truth" else -1
            self._hints.append(self._hint(change, text, after, row, object_row))
            return
        result = _result_text(subject, reason, new, now_reported, then)
        self._tried.append(TriedChange(_settings(change), result))
        if now_reported and not reported and subject.kind == "truth" and then.named is not None:
            self._faulty[self._tried[-1]] = self._hint(change, result, after, subject.row, then.named.row)

    def _hint(self, change: Change, text: str, after: FrameIndex, asked: int = -1, own: int = -1) -> Hint:
        """Return a hint with its effects on all objects of the frame, as ``evaluate`` counts them."""
        before = self._traces
        self._change_of[_settings(change)] = change
        more = 0 if before.is_labelled else len(false_reasons(after)) - len(false_reasons(before))
        changed = before_after(
            before.result.objects,
            after.result.objects,
            before.labels_in_evaluate if before.is_labelled else None,
            cameras=(before.result.cameras, after.result.cameras),
            asked=asked,
            own=own,
            doubtful=more,
        )
        if before.matches is None or after.matches is None or not before.is_labelled:
            return Hint(_settings(change), text, changed, max(changed.good, 1) - changed.harm)
        right = int((after.matches.partner >= 0).sum()) - int((before.matches.partner >= 0).sum())
        false = int(after.matches.false.sum()) - int(before.matches.false.sum())
        flawed = 1 if right == false == 0 and not changed.harm else 0  # The subject loses a flaw alone.
        return Hint(_settings(change), text, changed, right - false + flawed)

    def _try_on_false(self, change: Change, after: FrameIndex) -> None:
        """Try a change on a false object."""
        subject = self._subject
        objects = after.result.objects
        if objects is None or subject.box is None:
            return
        away = np.linalg.norm(objects.boxes.center[:, :2] - subject.box.center[0, :2], axis=1)
        away[[name != subject.label for name in objects.names]] = np.inf
        text = "it is not reported any more"
        if away.min(initial=np.inf) <= MAX_DISTANCE:
            text = "it is right then" if self._traces.truth else "nothing about it is doubtful then"
            if int(away.argmin()) in false_reasons(after):
                self._tried.append(TriedChange(_settings(change), "it stays false"))
                return
        self._hints.append(self._hint(change, text, after))


def _new_outcome(
    subject: Subject,
    old_verdict: tuple[ReasonKind, bool],
    new_verdict: tuple[ReasonKind, bool],
    evidence: Evidence,
    after: FrameIndex,
) -> tuple[str, int]:
    """Return the new result of the subject, empty if it is no better, and the row of its object."""
    (old, reported), (new, now_reported), named = old_verdict, new_verdict, evidence.named
    if old is ReasonKind.BORROWED and subject.kind != "truth":
        return ("" if named is not None else "it is not named any more"), -1
    better = now_reported and (not reported or old in FLAWED | {ReasonKind.BORROWED})
    if not better or named is None or new is not ReasonKind.REPORTED:
        return "", -1
    if named.cluster < 0 or not after.origin("objects").ours:
        return f"{after.origin('objects').name} has {named.name} there then", named.row
    return f"it is cluster {named.cluster} then, named {named.name}", named.row


def _is_sure(subject: Subject, change: Change, evidence: Evidence) -> bool:
    """Return whether a detection that passes only with other limits belongs to the subject.

    It does if the verdict calls it the subject's own, and evaluate counts its object for the subject.
    """
    named = evidence.named
    if subject.kind != "truth" or named is None or named.detection < 0:
        return True
    if not any(key.startswith(("detector.", "fusion.min", "fusion.split")) for key in change):
        return True
    detection = (named.camera, named.detection)
    return named.right and any((c.camera, c.row) == detection for c in evidence.own_candidates)


def _result_text(subject: Subject, before: Reason, after: Reason, reported: bool, evidence: Evidence) -> str:
    """Say what a change does to a subject that it does not help."""
    named = evidence.named
    if reported and after.kind is ReasonKind.REPORTED and subject.kind == "truth" and named is not None:
        return "it is reported by a detection that may not be its own"
    if reported:
        return f"it is reported then, but '{after.kind.value}'"
    stays = "stays" if after.kind is before.kind else "is lost as"
    return f"it {stays} '{after.kind.value}'"


def _settings(change: Change) -> tuple[str, ...]:
    """Return a change as settings ``key=value``."""
    return tuple(f"{key}={_setting_text(value)}" for key, value in change.items())


def _setting_text(value: Any) -> str:
    """Return a value as ``--set`` takes it."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)
