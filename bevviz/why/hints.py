"""Find parameter changes that would change a verdict. Each is tested by running the stages again."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from pydantic import ValidationError

from bevviz.config import Config, plugin_of
from bevviz.errors import UserError
from bevviz.model.frame import Camera
from bevviz.model.reasons import Reason, ReasonKind
from bevviz.model.results import Detections, DetectionState, FrameResult
from bevviz.pipeline.perceive import perceive
from bevviz.pipeline.stage_loader import DetectFunction, StageLoader
from bevviz.pipeline.stage_log import Memo
from bevviz.why.collect import collect_evidence
from bevviz.why.evidence import Candidate, Evidence
from bevviz.why.frame_index import FrameIndex
from bevviz.why.side_effects import Effects, effects
from bevviz.why.subject import Subject
from bevviz.why.verdict import FLAWED, find_reason

TRIES = 10  # configurations to run for one subject
SURE = 0.5  # IoU from which a detection surely belongs to its object
FURTHER = 10  # more configurations, combined with the best changes so far
RESULTS = 20  # results of other configurations in the cache, for other subjects of the frame

Change = Mapping[str, Any]  # dotted key -> value

# Parameters that bevviz applies to the output of user functions, too.
_SHARED_PARAMETERS = {"min_cluster_points", "max_cluster_points", "conf_threshold"}
_SECTION = {  # kind of reason -> section whose parameters may help
    ReasonKind.GROUND: "ground",
    ReasonKind.NOISE: "clustering",
    ReasonKind.NO_CLUSTER: "clustering",
    ReasonKind.MERGED: "clustering",
    ReasonKind.SPLIT: "clustering",
    ReasonKind.NOT_DETECTED: "detector",
    ReasonKind.BELOW_THRESHOLD: "detector",
    ReasonKind.NOT_AMONG: "objects",
    ReasonKind.MISNAMED: "objects",
}
_OTHER_OWNER = {  # another subject has the detection or the cluster
    ReasonKind.SHARED_BOX,
    ReasonKind.BORROWED,
    ReasonKind.TAKEN,
    ReasonKind.OTHER_CLUSTER,
    ReasonKind.MISNAMED,
}
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
    """

    settings: tuple[str, ...]
    text: str
    effects: Effects


@dataclass(frozen=True, slots=True)
class HintSearch:
    """Result of the search for hints on one subject.

    Attributes:
        hints: the best change that changes the verdict; empty: no tried change does.
        tried: number of configurations that were run.
        furthest: settings that bring the subject to a later stage, if no hint helps; empty: none does.
        then: kind of the reason of the subject with these settings.
        reported: whether the subject is reported with these settings.
    """

    hints: tuple[Hint, ...]
    tried: int
    furthest: tuple[str, ...] = ()
    then: ReasonKind | None = None
    reported: bool = False


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

        If each helpful change makes another object worse, return the one that does the least harm. If none
        helps, combine the changes that bring the subject to a later stage with the changes for the reason
        there.
        """
        hints: list[Hint] = []
        start = _ReachedStage(reported, reason.kind)
        reached: dict[_ReachedStage, _Step] = {}  # by the mildest change
        tried = 0

        def ways() -> Iterator[Change]:
            """Yield the changes to try."""
            yield from islice(_changes_for(evidence, reason, self._traces), TRIES)
            if not hints:
                yield from islice(_combined_changes(reached), FURTHER)

        for change in ways():
            after = self._run(change)
            if after is None:
                continue
            tried += 1
            then = collect_evidence(subject, after)
            new, now_reported = find_reason(subject, then, after)
            old_kind, new_kind = (reason.kind, reported), (new.kind, now_reported)
            text, object_row = _new_outcome(subject, old_kind, new_kind, then, after)
            if text and _is_sure(subject, change, then):
                row = subject.row if subject.kind == "truth" else -1
                objects, then_objects = self._result.objects, after.result.objects
                harm = effects(objects, then_objects, self._traces.truth, row, object_row)
                hints.append(Hint(_settings(change), text, harm))
                if not hints[-1].effects.harm:
                    break
            elif not text and (stage := _ReachedStage(now_reported, new.kind)) > start:
                reached.setdefault(stage, _Step(change, new, then, after))
        if hints or not reached:
            return HintSearch(tuple(sorted(hints, key=lambda hint: hint.effects.harm)[:1]), tried)
        last = max(reached)
        return HintSearch((), tried, _settings(reached[last].change), last.kind, last.reported)

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
    """Return whether a detection that passes only with other limits surely belongs to the subject."""
    if subject.kind != "truth" or evidence.named is None or evidence.named.detection < 0:
        return True
    if not any(key.startswith(("detector.", "fusion.min", "fusion.split")) for key in change):
        return True
    camera, row = evidence.named.camera, evidence.named.detection
    return any(
        (candidate.camera, candidate.row) == (camera, row) and candidate.overlap >= SURE
        for candidate in evidence.candidates
    )


def _settings(change: Change) -> tuple[str, ...]:
    """Return a change as settings ``key=value``."""
    return tuple(f"{key}={_setting_text(value)}" for key, value in change.items())


def _combined_changes(
    reached: Mapping[_ReachedStage, _Step],
) -> Iterator[Change]:
    """Yield combined changes, from the latest stage back. ``reached`` may grow meanwhile."""
    done: set[_ReachedStage] = set()
    while left := reached.keys() - done:
        stage = max(left)
        done.add(stage)
        step = reached[stage]
        for more in _changes_for(step.evidence, step.reason, step.traces):
            yield {**step.change, **more}


# --- changes to try ----------------------------------------------------------------------------


def _changes_for(evidence: Evidence, reason: Reason, traces: FrameIndex) -> Iterator[Change]:
    """Yield changes that may help: parameters of our stages, or of the user's function."""
    result = traces.result
    section = _SECTION.get(reason.kind, "")
    if section and not traces.origin(section).ours:
        yield from _function_changes(result, section)
    if not traces.origin("objects").ours:
        return
    config = result.config
    for change in _our_changes(evidence, reason, config):
        if all(_has_effect(key, traces) for key in change):
            yield change


def _has_effect(key: str, traces: FrameIndex) -> bool:
    """Return whether a parameter has an effect. Ours have none on a stage that is not ours."""
    section, _, name = key.partition(".")
    if section not in ("ground", "clustering", "detector"):
        return True
    owner = traces.origin(section)
    return owner.ours or (bool(owner.function) and name in _SHARED_PARAMETERS)


def _function_changes(result: FrameResult, section: str) -> Iterator[Change]:
    """Yield halves and doubles of the numeric parameters of a user's function, within their bounds."""
    try:
        plugin = plugin_of(result.config, section)
    except UserError:
        return
    if plugin is None or plugin.params is None:
        return
    params = dict(getattr(result.config, section).params)
    for factor in (0.5, 2.0):
        for name, value in params.items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not value:
                continue
            other = type(value)(round(value * factor)) if isinstance(value, int) else round(value * factor, 6)
            try:
                plugin.params.model_validate({**params, name: other})
            except ValidationError:
                continue
            if other != value:
                yield {f"{section}.params.{name}": other}


def _our_changes(evidence: Evidence, reason: Reason, config: Config) -> Iterator[Change]:
    """Yield changes of our parameters that may help against the reason."""
    kind, clustering, best = reason.kind, config.clustering, evidence.best
    if kind is ReasonKind.GROUND:
        yield from _ground_changes(config)
    elif kind is ReasonKind.NOISE:
        for points in _smaller_min_points(evidence.neighbours, clustering.min_points):
            yield {"clustering.min_points": points}
            if points < clustering.min_cluster_points:
                yield {"clustering.min_points": points, "clustering.min_cluster_points": points}
        for factor in (1.5, 2.0):
            yield {"clustering.eps": round(clustering.eps * factor, 3)}
        yield from _ground_changes(config)
    elif kind is ReasonKind.TOO_SMALL:
        yield {"clustering.min_cluster_points": max(reason["count"], 1)}
        yield {"clustering.eps": round(clustering.eps * 1.5, 3)}
    elif kind is ReasonKind.TOO_LARGE:
        yield {"clustering.max_cluster_points": reason["count"]}
    elif kind is ReasonKind.MERGED:
        if config.fusion.method == "frustum" and not config.fusion.split:
            yield {"fusion.split": True}
        if evidence.finer:
            yield from ({"clustering.eps": round(evidence.finer * factor, 3)} for factor in (1.0, 0.85, 0.7))
        elif not evidence.others:
            yield from ({"clustering.eps": round(clustering.eps * factor, 3)} for factor in (0.8, 0.6, 0.4))
    elif kind is ReasonKind.SPLIT:
        # The distance is unknown if one of the parts is not a cluster.
        yield {"clustering.eps": round(max(np.nan_to_num(evidence.apart), clustering.eps) * 1.1, 3)}
        yield {"clustering.min_points": max(1, clustering.min_points // 2)}
        yield {"clustering.eps": round(clustering.eps * 1.5, 3)}
    elif best is not None:
        yield from _detection_changes(kind, best, config)


def _detection_changes(kind: ReasonKind, best: Candidate, config: Config) -> Iterator[Change]:
    """Yield changes that may help a subject that has a detection."""
    if kind is ReasonKind.BELOW_THRESHOLD:
        # A threshold that lets noise pass is no advice.
        if best.score >= 0.05:
            passes = {"detector.conf_threshold": math.floor(100 * best.score) / 100}
            yield passes
            if config.fusion.method == "frustum" and config.fusion.split:
                # The rating of a match is proportional to the score.
                weak = config.fusion.min_rating * best.score / config.detector.conf_threshold
                yield from ({**passes, "fusion.min_rating": round(weak * factor, 4)} for factor in (1.0, 0.5))
    elif kind is ReasonKind.SUPPRESSED:
        yield from ({"detector.iou_threshold": value} for value in (0.6, 0.7, 0.8, 0.9))
    elif kind is ReasonKind.LOW_OVERLAP:
        yield from (
            {"fusion.min_iou": round(config.fusion.min_iou * factor, 3)} for factor in (0.5, 0.2, 0.0)
        )
        yield {"clustering.eps": round(config.clustering.eps * 0.6, 3)}
    elif kind is ReasonKind.MISFIT:
        yield from (
            {"fusion.min_rating": round(config.fusion.min_rating * factor, 4)} for factor in (0.5, 0.2)
        )
        yield {"fusion.split": False}
    elif kind is ReasonKind.TOO_FEW_POINTS:
        yield from ({"fusion.min_points": value} for value in range(config.fusion.min_points - 1, 0, -1))
    elif kind in _OTHER_OWNER:
        if config.fusion.method == "centroid":
            yield {"fusion.method": "frustum"}
    elif kind is ReasonKind.TOO_FAR and config.fusion.method == "centroid":
        # The subject has no cluster of its own: the fusion compared the nearest other one.
        yield from _ground_changes(config)
        yield {"fusion.method": "frustum"}
    elif kind is ReasonKind.TOO_FAR:
        yield {"fusion.max_depth": 200.0}


def _ground_changes(config: Config) -> Iterator[Change]:
    """Yield thinner ground layers, and for a plane also a ground that follows the road."""
    ground, points = config.ground, max(1, config.clustering.min_points // 3)
    for threshold in (0.3, 0.2, 0.1):
        if threshold < ground.distance_threshold:
            yield {"ground.distance_threshold": threshold}
    if ground.method == "plane":
        yield {"ground.method": "polar", "ground.distance_threshold": 0.2}
        yield {
            "ground.method": "polar",
            "ground.distance_threshold": 0.2,
            "clustering.min_points": points,
        }


def _smaller_min_points(neighbours: int, limit: int) -> list[int]:
    """Return values of min_points to try: the number that the best point reaches, and less."""
    tries = [neighbours, round(neighbours * 0.75), neighbours // 2]
    return [n for n in dict.fromkeys(tries) if 2 <= n < limit]


def _setting_text(value: Any) -> str:
    """Return a value as ``--set`` takes it."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)
