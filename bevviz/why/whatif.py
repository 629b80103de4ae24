"""What would change a verdict: said only where running the stages again proves it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.frame import Camera, Detections, DetectionState, FrameResult
from bevviz.perceive import Detect, Memo, StageLoader, perceive
from bevviz.why.evidence import Candidate, Evidence, Traces, gather
from bevviz.why.subject import Subject
from bevviz.why.verdict import Reason, Verdict, judge, name_of

TRIES = 10  # configurations that are run for one subject
FLAWED = {Reason.SHARED_BOX, Reason.MERGED, Reason.SPLIT}

Change = Mapping[str, Any]  # dotted key -> value


@dataclass(frozen=True, slots=True)
class Hint:
    """Settings that change the verdict when the stages are run again, and what happens then."""

    settings: tuple[str, ...]  # as --set takes them
    text: str


class WhatIf:
    """Runs a frame with other configurations, each once.

    Args:
        result: what was made of the frame.
        loader: that has the networks already.
    """

    def __init__(self, result: FrameResult, loader: StageLoader | None = None) -> None:
        self._result = result
        self._loader, self._memo = loader or StageLoader(), Memo()
        self._runs: dict[tuple[tuple[str, Any], ...], Traces | None] = {}

    def hints(
        self, subject: Subject, evidence: Evidence, verdict: Verdict, others: Sequence[Subject]
    ) -> tuple[Hint, ...]:
        """The first change that helps of those that the reason suggests, mildest first."""
        for count, change in enumerate(_changes(evidence, verdict.reason, self._result.config)):
            if count == TRIES:
                break
            run = self._run(change)
            if run is None:
                continue
            text = _outcome(subject, verdict, run, others)
            if text:
                return (Hint(tuple(f"{key}={_written(value)}" for key, value in change.items()), text),)
        return ()

    def _run(self, change: Change) -> Traces | None:
        key = tuple(change.items())
        if key not in self._runs:
            config = changed(self._result.config, change)
            try:
                stages = self._loader.load(config, self._known_detections(config))
            except UserError:  # the model file has gone meanwhile: nothing can be proved
                self._runs[key] = None
            else:
                self._runs[key] = Traces(perceive(self._result.frame, config, stages, self._memo))
        return self._runs[key]

    def _known_detections(self, config: Config) -> Detect | None:
        """Detections for other thresholds: the network need not be run. None: it has to be.

        What NMS leaves cannot be told from the candidates that were kept to be explained.
        """
        if config.detector.iou_threshold != self._result.config.detector.iou_threshold:
            return None
        known = {c.camera.name: c.detections for c in self._result.cameras}

        def detect(camera: Camera) -> Detections | None:
            found = known[camera.name]
            if found is None:
                return None
            kept = found.score >= config.detector.conf_threshold
            state = np.where(kept, DetectionState.KEPT, DetectionState.BELOW_THRESHOLD).astype(np.int32)
            state[found.state == DetectionState.SUPPRESSED] = DetectionState.SUPPRESSED
            return replace(found, state=state)

        return detect


def changed(config: Config, change: Change) -> Config:
    """The configuration with other values."""
    tree = config.model_dump()
    for key, value in change.items():
        section, name = key.split(".")
        tree[section][name] = value
    return Config.model_validate(tree)


def _outcome(subject: Subject, verdict: Verdict, traces: Traces, others: Sequence[Subject]) -> str:
    """What has become of the subject, empty where it is no better off."""
    evidence, result = gather(subject, traces, others), traces.result
    after = judge(subject, evidence, result, result.config)
    if verdict.reason is Reason.BORROWED:
        named = evidence.parts and name_of(result, evidence.parts[0].cluster)
        return "" if named else "it is not named any more"
    better = after.reported and (not verdict.reported or verdict.reason in FLAWED)
    if not better or after.reason in FLAWED | {Reason.BORROWED}:
        return ""
    best = evidence.candidates[0] if evidence.candidates else None
    matched = best is not None and best.cluster >= 0 and subject.kind == "detection"
    cluster = best.cluster if best is not None and matched else evidence.parts[0].cluster
    return f"it is cluster {cluster} then, named {name_of(result, cluster)}"


def _changes(e: Evidence, reason: Reason, config: Config) -> Iterator[Change]:
    """What might help, by the reason."""
    c, best = config.clustering, e.candidates[0] if e.candidates else None
    if reason is Reason.GROUND:
        yield from _lower_ground(config)
    elif reason is Reason.NOISE:
        for points in _below(e.neighbours, c.min_points):
            yield {"clustering.min_points": points}
            if points < c.min_cluster_points:
                yield {"clustering.min_points": points, "clustering.min_cluster_points": points}
        for factor in (1.5, 2.0):
            yield {"clustering.eps": round(c.eps * factor, 3)}
        yield from _lower_ground(config)
    elif reason is Reason.TOO_SMALL:
        yield {"clustering.min_cluster_points": max(e.parts[0].count, 1)}
        yield {"clustering.eps": round(c.eps * 1.5, 3)}
    elif reason is Reason.TOO_LARGE:
        yield {"clustering.max_cluster_points": e.parts[0].count}
    elif reason is Reason.MERGED:
        if config.fusion.method == "frustum" and not config.fusion.split:
            yield {"fusion.split": True}
        if e.finer:
            yield {"clustering.eps": e.finer}
            yield from ({"clustering.eps": round(e.finer * f, 3)} for f in (0.85, 0.7))
    elif reason is Reason.SPLIT:
        yield {"clustering.eps": round(max(e.apart * 1.1, c.eps * 1.1), 3)}
        yield {"clustering.min_points": max(1, c.min_points // 2)}
        yield {"clustering.eps": round(c.eps * 1.5, 3)}
    elif best is not None:
        yield from _for_detection(reason, best, config)


def _for_detection(reason: Reason, best: Candidate, config: Config) -> Iterator[Change]:
    if reason is Reason.BELOW_THRESHOLD:
        # A threshold that lets any noise pass is no advice.
        if best.score >= 0.05:
            yield {"detector.conf_threshold": math.floor(100 * best.score) / 100}
    elif reason is Reason.SUPPRESSED:
        yield from ({"detector.iou_threshold": value} for value in (0.6, 0.7, 0.8, 0.9))
    elif reason is Reason.LOW_OVERLAP:
        yield from ({"fusion.min_iou": round(config.fusion.min_iou * f, 3)} for f in (0.5, 0.2, 0.0))
        yield {"clustering.eps": round(config.clustering.eps * 0.6, 3)}
    elif reason is Reason.MISFIT:
        yield from ({"fusion.min_rating": round(config.fusion.min_rating * f, 4)} for f in (0.5, 0.2))
        yield {"fusion.split": False}
    elif reason is Reason.TOO_FEW_POINTS:
        yield from ({"fusion.min_points": value} for value in range(config.fusion.min_points - 1, 0, -1))
    elif reason in (Reason.SHARED_BOX, Reason.BORROWED, Reason.TAKEN, Reason.OTHER_CLUSTER, Reason.MISNAMED):
        if config.fusion.method == "centroid":
            yield {"fusion.method": "frustum"}
    elif reason is Reason.TOO_FAR and config.fusion.method == "centroid":
        # Its own cluster is missing: something else was merely the nearest.
        yield from _lower_ground(config)
        yield {"fusion.method": "frustum"}
    elif reason is Reason.TOO_FAR:
        yield {"fusion.max_depth": 200.0}


def _lower_ground(config: Config) -> Iterator[Change]:
    """A thinner ground; where one plane is all there is, one that follows the road, too."""
    g, points = config.ground, max(1, config.clustering.min_points // 3)
    for threshold in (0.3, 0.2, 0.1):
        if threshold < g.distance_threshold:
            yield {"ground.distance_threshold": threshold}
    if g.method == "plane":
        yield {"ground.method": "polar", "ground.distance_threshold": 0.2}
        yield {
            "ground.method": "polar",
            "ground.distance_threshold": 0.2,
            "clustering.min_points": points,
        }


def _below(neighbours: int, limit: int) -> list[int]:
    """Values of min_points to try: what the best point just reaches, and less."""
    tries = [neighbours, round(neighbours * 0.75), neighbours // 2]
    return [n for n in dict.fromkeys(tries) if 2 <= n < limit]


def _written(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)
