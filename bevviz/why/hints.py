"""Find parameter changes that would change a verdict. Each is tested by running the stages again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from pydantic import ValidationError

from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.evaluate import MAX_DISTANCE
from bevviz.model.frame import Camera
from bevviz.model.reasons import Reason, ReasonKind
from bevviz.model.results import Detections, DetectionState
from bevviz.pipeline.perceive import perceive
from bevviz.pipeline.stage_loader import DetectFunction, StageLoader
from bevviz.pipeline.stage_log import Memo
from bevviz.why.changes import Change, changes_for
from bevviz.why.collect import collect_evidence
from bevviz.why.evidence import Evidence
from bevviz.why.false_objects import false_reasons
from bevviz.why.frame_index import FrameIndex
from bevviz.why.side_effects import Effects, effects
from bevviz.why.subject import Subject
from bevviz.why.verdict import FALSE, FLAWED, find_reason

TRIES = 10  # configurations to run for one subject
OFFERED = 3  # hints of one answer
FURTHER = 10  # more configurations, combined with the best changes so far
RESULTS = 20  # results of other configurations in the cache, for other subjects of the frame

_ORDER = {kind: place for place, kind in enumerate(ReasonKind)}  # in the order of the stages


@dataclass(frozen=True, slots=True)
class _ReachedStage:
    """The stage that a subject reached. A later stage is greater."""

    reported: bool
    kind: ReasonKind

    def __gt__(self, other: _ReachedStage) -> bool:
        return (self.reported, _ORDER[self.kind]) > (other.reported, _ORDER[other.kind])


@dataclass(frozen=True, slots=True)
class _Step:
    """The mildest change that brings a subject to a stage, and the result there."""

    change: Change
    reason: Reason
    evidence: Evidence
    traces: FrameIndex


@dataclass(frozen=True, slots=True)
class Hint:
    """Settings that change the verdict, and their effects, found by running the stages again.

    Attributes:
        settings: settings as ``--set`` takes them.
        text: the result for the subject.
        effects: other objects of the frame that change.
        balance: number of objects that it fixes, the subject included, minus those that it breaks.
    """

    settings: tuple[str, ...]
    text: str
    effects: Effects
    balance: int = 1

    @property
    def objection(self) -> str:
        """The result, and what speaks against it."""
        return f"{self.text}, but it breaks as much as it fixes: it {self.effects.text}"


@dataclass(frozen=True, slots=True)
class TriedChange:
    """Change of parameters that was run and does not help."""

    settings: tuple[str, ...]
    """key=value each"""
    text: str
    """its result"""


@dataclass(frozen=True, slots=True)
class HintSearch:
    """Result of the search for hints on one subject.

    Attributes:
        hints: the best change that changes the verdict; empty: no tried change does.
        tried: the changes that were run and did not help.
    """

    hints: tuple[Hint, ...]
    tried: tuple[TriedChange, ...]


class HintFinder:
    """Finder of changes that help. It runs one frame with other configurations, each once.

    Args:
        traces: index of the frame's result.
        loader: stage loader with the networks already loaded.
    """

    def __init__(self, traces: FrameIndex, loader: StageLoader | None = None) -> None:
        self._traces, self._result = traces, traces.result
        self._loader, self._memo = loader or StageLoader(), Memo()
        self._runs: dict[tuple[tuple[str, Any], ...], FrameIndex | None] = {}

    def search(self, subject: Subject, evidence: Evidence, reason: Reason, reported: bool) -> HintSearch:
        """Search the mildest change that changes the verdict and makes no other object worse.

        If each helpful change makes another object worse, return those that fix more objects than they break,
        the best first. The others count as tried in vain. If none helps, combine the changes that bring the
        subject to a later stage with the changes for the reason there. If these do not help either, a missed
        object that is found with a fault is better than none.
        """
        is_false = reason.kind in FALSE and subject.kind == "object"
        hints: list[Hint] = []
        start = _ReachedStage(reported, reason.kind)
        reached: dict[_ReachedStage, _Step] = {}  # by the mildest change
        tried: list[TriedChange] = []
        faulty: dict[TriedChange, Hint] = {}  # the object is found then, but it has a fault

        def ways() -> Iterator[Change]:
            """Yield the changes to try."""
            changes = changes_for(evidence, reason, self._traces, is_false=is_false)
            yield from islice(changes, TRIES)
            if not hints:
                yield from islice(_combined_changes(reached), FURTHER)

        for change in ways():
            after = self._run(change)
            if after is None:
                continue
            if is_false:
                self._try_on_false(subject, change, after, hints, tried)
                if hints and not hints[-1].effects.harm and hints[-1].balance > 0:
                    break
                continue
            then = collect_evidence(subject, after)
            new, now_reported, _ = find_reason(subject, then, after)
            old_kind, new_kind = (reason.kind, reported), (new.kind, now_reported)
            text, object_row = _new_outcome(subject, old_kind, new_kind, then, after)
            if text and _is_sure(subject, change, then):
                row = subject.row if subject.kind == "truth" else -1
                hints.append(self._hint(change, text, after, row, object_row))
                if not hints[-1].effects.harm and hints[-1].balance > 0:
                    break
                continue
            result = _result_text(subject, reason, new, now_reported, then)
            tried.append(TriedChange(_settings(change), result))
            if now_reported and not reported and subject.kind == "truth" and then.named is not None:
                faulty[tried[-1]] = self._hint(change, result, after, subject.row, then.named.row)
            if not text and (stage := _ReachedStage(now_reported, new.kind)) > start:
                reached.setdefault(stage, _Step(change, new, then, after))
        if not any(hint.balance > 0 for hint in hints):
            hints += [hint for hint in faulty.values() if hint.balance > 0][:1]
            tried = [
                replace(change, text=f"{change.text}, and it breaks as much") if change in faulty else change
                for change in tried
                if faulty.get(change) not in hints
            ]
        best = sorted(hints, key=lambda hint: -hint.balance)
        tried += [TriedChange(hint.settings, hint.objection) for hint in best if hint.balance <= 0]
        return HintSearch(tuple(hint for hint in best if hint.balance > 0)[:OFFERED], tuple(tried))

    def _hint(self, change: Change, text: str, after: FrameIndex, asked: int = -1, own: int = -1) -> Hint:
        """Return a hint with its effects on all objects of the frame, as ``evaluate`` counts them."""
        before = self._traces
        more = 0 if before.truth else len(false_reasons(after)) - len(false_reasons(before))
        objects, then_objects = before.result.objects, after.result.objects
        changed = effects(objects, then_objects, before.truth, asked, own, more)
        if before.matches is None or after.matches is None:
            return Hint(_settings(change), text, changed, max(changed.good, 1) - changed.harm)
        right = int((after.matches.partner >= 0).sum()) - int((before.matches.partner >= 0).sum())
        false = int(after.matches.false.sum()) - int(before.matches.false.sum())
        flawed = 1 if right == false == 0 and not changed.harm else 0  # The subject loses a flaw alone.
        return Hint(_settings(change), text, changed, right - false + flawed)

    def _try_on_false(
        self, subject: Subject, change: Change, after: FrameIndex, hints: list[Hint], tried: list[TriedChange]
    ) -> None:
        """Add the result of a change on a false object to the hints or to the tried changes."""
        objects = after.result.objects
        if objects is None or subject.box is None:
            return
        away = np.linalg.norm(objects.boxes.center[:, :2] - subject.box.center[0, :2], axis=1)
        away[[name != subject.label for name in objects.names]] = np.inf
        text = "it is not reported any more"
        if away.min(initial=np.inf) <= MAX_DISTANCE:
            text = "it is right then" if self._traces.truth else "nothing about it is doubtful then"
            if int(away.argmin()) in false_reasons(after):
                tried.append(TriedChange(_settings(change), "it stays false"))
                return
        hints.append(self._hint(change, text, after))

    def _run(self, change: Change) -> FrameIndex | None:
        """Run the frame with a change, once. None: the configuration cannot be run."""
        key = tuple(change.items())
        if key not in self._runs:
            try:
                config = with_changes(self._result.config, change)
                stages = self._loader.load(config, self._known_detections(config, change))
            except (UserError, ValidationError):  # the model file has gone, or the value is out of bounds
                self._runs[key] = None
            else:
                result = perceive(self._result.frame, config, stages, self._memo)
                self._runs[key] = self._traces.for_result(result)
            while len(self._runs) > RESULTS:
                del self._runs[next(iter(self._runs))]
        return self._runs[key]

    def _known_detections(self, config: Config, change: Change) -> DetectFunction | None:
        """Return a detector that applies another threshold to the known detections. None: run the network.

        The candidates kept for explanations do not tell the result of another NMS, nor that of other
        parameters of a user's detector. Detections of the robot never change.
        """
        touched = {key for key in change if key.startswith("detector.")} - {"detector.conf_threshold"}
        if touched or self._traces.origin("detector").topic:
            return None
        known = {c.camera.name: c.detections for c in self._result.cameras}

        def detect(camera: Camera) -> Detections | None:
            """Return the detections of a camera with the states of the new threshold."""
            detections = known[camera.name]
            if detections is None:
                return None
            kept = detections.score >= config.detector.conf_threshold
            state = np.where(kept, DetectionState.KEPT, DetectionState.BELOW_THRESHOLD).astype(np.int32)
            state[detections.state == DetectionState.SUPPRESSED] = DetectionState.SUPPRESSED
            return replace(detections, state=state)

        return detect


def with_changes(config: Config, change: Change) -> Config:
    """Return the configuration with other values."""
    tree = config.model_dump()
    for key, value in change.items():
        *path, name = key.split(".")
        section = tree
        for part in path:
            section = section[part]
        section[name] = value
    return config.restated(tree)


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


def _combined_changes(reached: Mapping[_ReachedStage, _Step]) -> Iterator[Change]:
    """Yield combined changes, from the latest stage back. ``reached`` may grow meanwhile."""
    done: set[_ReachedStage] = set()
    while left := reached.keys() - done:
        stage = max(left)
        done.add(stage)
        step = reached[stage]
        for more in changes_for(step.evidence, step.reason, step.traces):
            yield {**step.change, **more}


def _setting_text(value: Any) -> str:
    """Return a value as ``--set`` takes it."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)
