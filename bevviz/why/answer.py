"""Answers: the verdict, the chain through the stages, and what would change it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bevviz.config import Config
from bevviz.frame import U8, ClusterState, Decision, DetectionState, FrameResult
from bevviz.perceive import StageLoader
from bevviz.why.evidence import Candidate, Evidence, Traces, fusion_of, gather
from bevviz.why.subject import Selection, Subject, competing, projected, select
from bevviz.why.verdict import Reason, Verdict, judge, label, name_of
from bevviz.why.whatif import Hint, WhatIf

_SHOWN = 5  # candidates that the chain names


@dataclass(frozen=True, slots=True)
class Step:
    """What one stage made of the subject, in words and in numbers."""

    stage: str
    text: str
    numbers: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Answer:
    """Everything about one subject.

    Attributes:
        subject: what was asked about.
        verdict: the reason and its sentence.
        steps: stage by stage.
        hints: changes of the configuration that were run and do change the verdict.
        fate: (N,) what became of each raw point, see ``evidence.Fate``.
        distance: horizontal metres, NaN where unknown.
    """

    subject: Subject
    verdict: Verdict
    steps: tuple[Step, ...]
    hints: tuple[Hint, ...]
    fate: U8
    distance: float

    def as_dict(self) -> dict[str, Any]:
        """For machines: without the points."""
        s, v = self.subject, self.verdict
        return {
            "kind": s.kind,
            "name": s.name,
            "label": s.label,
            "row": s.row,
            "camera": s.camera,
            "image_box": None if s.xyxy is None else [round(float(x), 2) for x in s.xyxy],
            "position": None if s.box is None else [round(float(x), 3) for x in s.box.center[0]],
            "distance": None if np.isnan(self.distance) else round(self.distance, 2),
            "reported": v.reported,
            "reason": v.reason.value,
            "verdict": v.text,
            "chain": [{"stage": x.stage, "text": x.text, **x.numbers} for x in self.steps],
            "hints": [{"settings": list(h.settings), "text": h.text} for h in self.hints],
        }


def why(
    result: FrameResult,
    selection: Selection,
    classes: Sequence[str] = (),
    hints: int = 5,
    progress: Callable[[Sequence[Answer]], Iterable[Answer]] = iter,
    loader: StageLoader | None = None,
) -> list[Answer]:
    """Explain what is selected, worst first: what was not reported before the rest, near before far.

    Args:
        result: what was made of a frame, described.
        selection: what is asked about; nothing: all that did not become an object of its own.
        classes: names that the detector knows.
        hints: for how many of them other configurations are tried, which runs the stages again.
        progress: wraps those answers while they are being tried.
        loader: that has the networks already.

    Raises:
        UserError: see ``select``.
    """
    traces = Traces(result)
    everything = competing(result, select(result, Selection(camera=selection.camera), classes))
    answers = [_answer(s, traces, everything) for s in select(result, selection, classes)]
    if not (selection.label or selection.box or selection.point):
        answers = [a for a in answers if _notable(a)]
    answers.sort(key=_rank)
    what_if = WhatIf(result, loader)
    tried = [_with_hints(a, traces, everything, what_if) for a in progress(answers[:hints])]
    return [*tried, *answers[hints:]]


def _notable(answer: Answer) -> bool:
    """Not what went well; nor weak detections of nothing, which are what thresholds are for."""
    weak = answer.verdict.reason in (Reason.BELOW_THRESHOLD, Reason.SUPPRESSED)
    return answer.verdict.reason is not Reason.REPORTED and not (answer.subject.kind == "detection" and weak)


def _rank(answer: Answer) -> tuple[bool, bool, bool, float]:
    v = answer.verdict
    return (
        v.reported,
        v.reason is Reason.REPORTED,
        answer.subject.kind == "detection" and v.reason is Reason.BELOW_THRESHOLD,
        float("inf") if np.isnan(answer.distance) else answer.distance,
    )


def _answer(subject: Subject, traces: Traces, others: Sequence[Subject]) -> Answer:
    evidence = gather(subject, traces, others)
    verdict = judge(subject, evidence, traces.result, traces.result.config)
    steps = tuple(_steps(subject, evidence, traces.result, traces.result.config))
    return Answer(subject, verdict, steps, (), evidence.fate, evidence.distance)


def _with_hints(answer: Answer, traces: Traces, others: Sequence[Subject], what_if: WhatIf) -> Answer:
    subject, verdict = answer.subject, answer.verdict
    hints = what_if.hints(subject, gather(subject, traces, others), verdict, others)
    if not hints:
        return answer
    settings = ", ".join(hints[0].settings)
    text = f"{verdict.text.removesuffix('.')}; change {settings}: {hints[0].text}."
    return replace(answer, verdict=replace(verdict, text=text), hints=hints)


# --- the chain ---------------------------------------------------------------------------------


def _steps(subject: Subject, e: Evidence, result: FrameResult, config: Config) -> Iterator[Step]:
    for failure in result.failures:
        yield Step("failure", f"{failure.stage}: {failure.reason}")
    yield from _clock(subject, result)
    where = {"truth": "in its box", "point": "around it"}.get(subject.kind, "in its frustum")
    yield Step("raw cloud", f"{e.raw} points {where}", {"points": e.raw})
    if subject.box is not None and e.aimed:
        share = e.in_front / e.aimed
        text = f"{e.in_front} of {e.aimed} returns in its direction end in front of it"
        if e.front >= 0:
            text += f", most on cluster {e.front}" + _named(result, e.front)
        yield Step("occlusion", text, {"in_front": e.in_front, "aimed": e.aimed, "share": round(share, 3)})
    if result.voxels is None or result.ground is None:
        return
    merged = e.raw - e.voxels
    yield Step(
        "voxel grid",
        f"{e.voxels} voxels of {config.voxel.size:g} m, {max(merged, 0)} points merged into them",
        {"voxels": e.voxels, "merged": max(merged, 0)},
    )
    yield _ground(e, config)
    if result.clusters is None:
        return
    yield _clustering(e, result, config)
    if e.others:
        names = ", ".join(f"{name} ({points} points)" for name, points in e.others)
        part = f"with eps {e.finer:g} m they fall apart" if e.finer else "no smaller eps parts them"
        yield Step(
            "merged",
            f"the cluster also holds {names}; gap {e.gap:.2f} m, "
            f"clustering.eps {config.clustering.eps:g} m; {part}",
            {"others": [name for name, _ in e.others], "gap": round(e.gap, 3), "eps_that_parts": e.finer},
        )
    yield from _detected(e, result, config)
    if result.cameras and not e.candidates:
        model = "no candidate there" if config.detector.model else "no detector (detector.model is not set)"
        yield Step("detector", model, {"candidates": 0})


def _clock(subject: Subject, result: FrameResult) -> Iterator[Step]:
    for camera in (c.camera for c in result.cameras):
        if subject.camera and camera.name != subject.camera:
            continue
        said, numbers = [], {}
        if np.isfinite(camera.sync_error):
            said.append(f"image {1e3 * camera.sync_error:+.0f} ms from the cloud")
            numbers["sync_error_ms"] = round(1e3 * camera.sync_error, 1)
        if np.isfinite(camera.tf_age):
            said.append(f"transform {1e3 * camera.tf_age:.0f} ms old")
            numbers["tf_age_ms"] = round(1e3 * camera.tf_age, 1)
        said.append(
            "moved to the image's time" if camera.motion_compensated else "not moved to the image's time"
        )
        said += camera.problems
        box = projected(subject.box, camera) if subject.box is not None else None
        if box is not None:
            u, v = (box[:2] + box[2:]) / 2
            said.append(f"expected at pixel {u:.0f}, {v:.0f}")
        yield Step(f"camera {camera.name}", ", ".join(said), numbers)


def _ground(e: Evidence, config: Config) -> Step:
    known = e.ground[np.isfinite(e.ground)]
    text = f"{len(e.ground)} of {e.voxels} voxels removed as ground"
    numbers: dict[str, Any] = {"removed": len(e.ground), "threshold": config.ground.distance_threshold}
    if len(known):
        text += f", {float(known.min()):.2f} to {float(known.max()):.2f} m above the local ground"
        numbers |= {"lowest": round(float(known.min()), 3), "highest": round(float(known.max()), 3)}
    threshold = config.ground.distance_threshold
    return Step(
        "ground", f"{text} (ground.distance_threshold {threshold:g} m, {config.ground.method})", numbers
    )


def _clustering(e: Evidence, result: FrameResult, config: Config) -> Step:
    said, rows = [], []
    clusters = result.clusters
    assert clusters is not None
    for part in e.parts[:_SHOWN]:
        size = " x ".join(f"{v:.1f}" for v in clusters.obb.size[part.cluster])
        state = "" if part.state == ClusterState.KEPT else f", {part.state.name.lower().replace('_', ' ')}"
        name = _named(result, part.cluster)
        said.append(f"{part.points} in cluster {part.cluster}{name} of {part.count}, {size} m{state}")
        rows.append(
            {
                "cluster": part.cluster,
                "points": part.points,
                "count": part.count,
                "state": part.state.name.lower(),
            }
        )
    if len(e.parts) > _SHOWN:
        said.append(f"{len(e.parts) - _SHOWN} clusters more")
    if e.noise:
        c = config.clustering
        said.append(
            f"{e.noise} noise: at most {e.neighbours} neighbours within {c.eps:g} m, "
            f"clustering.min_points is {c.min_points}"
        )
    if np.isfinite(e.apart):
        said.append(f"the two largest are {e.apart:.2f} m apart")
    numbers: dict[str, Any] = {"clusters": rows, "noise": e.noise, "best_neighbours": e.neighbours}
    return Step("clustering", "; ".join(said) or "no obstacle point", numbers)


def _named(result: FrameResult, cluster: int) -> str:
    name = name_of(result, cluster)
    return f" ({name})" if name else ""


def _detected(e: Evidence, result: FrameResult, config: Config) -> Iterator[Step]:
    for c in e.candidates[:_SHOWN]:
        found, fusion = fusion_of(result, c.camera)
        detections = found.detections
        assert detections is not None
        numbers = {"name": c.name, "score": round(c.score, 3), "state": c.state.name.lower(), "row": c.row}
        text = f"{label(c)}, overlap {c.overlap:.2f}: "
        if c.state == DetectionState.BELOW_THRESHOLD:
            text += f"below detector.conf_threshold {config.detector.conf_threshold:g}"
        elif c.state == DetectionState.SUPPRESSED:
            d = int(detections.suppressed_by[c.row])
            text += (
                f"suppressed by {detections.names[d]} {detections.score[d]:.2f}, IoU "
                f"{detections.overlap[c.row]:.2f} > detector.iou_threshold {config.detector.iou_threshold:g}"
            )
            numbers["suppressed_by"] = d
        else:
            text += "kept"
        yield Step("detector", text, numbers)
        if c.state == DetectionState.KEPT and fusion is not None:
            yield from _pairs(c, e, result)
    more = len(e.candidates) - _SHOWN
    if more > 0:
        yield Step("detector", f"{more} weaker candidates more", {"more": more})


def _pairs(c: Candidate, e: Evidence, result: FrameResult) -> Iterator[Step]:
    """The evidence of the pairs of a detection: with the clusters there, and with the one it got."""
    _, fusion = fusion_of(result, c.camera)
    assert fusion is not None
    said = next(
        x for x in result.explanations if (x.subject, x.camera, x.row) == ("detection", c.camera, c.row)
    )
    yield Step("fusion", said.text, {"decision": c.decision.name.lower(), "cluster": c.cluster})
    pairs = fusion.pairs
    interesting = {part.cluster for part in e.parts[:3]} - {c.cluster}
    for row in np.flatnonzero(pairs.detection == c.row).tolist():
        k = int(pairs.cluster[row])
        if k not in interesting:
            continue
        decision = Decision(int(fusion.cluster_decision[k])).name.lower().replace("_", " ")
        cost = "refused" if np.isinf(pairs.cost[row]) else f"cost {pairs.cost[row]:.2f}"
        yield Step(
            "fusion",
            f"{label(c)} with cluster {k}: {pairs.points[row]} points, IoU {pairs.iou[row]:.2f}, "
            f"{pairs.distance[row]:.0f} px, {pairs.depth[row]:.1f} m, {cost}; that cluster ended {decision}",
            {
                "cluster": k,
                "points": int(pairs.points[row]),
                "iou": round(float(pairs.iou[row]), 3),
                "distance_px": round(float(pairs.distance[row]), 1),
            },
        )
