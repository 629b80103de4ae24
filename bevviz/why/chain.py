"""Steps of a subject through the stages, in words and in numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bevviz.model.results import Decision, DetectionState, Opinion
from bevviz.why.evidence import Candidate, Evidence, fusion_of
from bevviz.why.frame_index import Traces
from bevviz.why.outcome import find_fused, in_box_of, opinion_on
from bevviz.why.sentences import label, not_run, state_text
from bevviz.why.subject import Subject, projected
from bevviz.why.verdict import detector_ran, name_of

_SHOWN = 5  # clusters or candidates listed in a step, at most


@dataclass(frozen=True, slots=True)
class Step:
    """The result of one stage for the subject, in words and in numbers."""

    stage: str
    text: str
    numbers: Mapping[str, Any] = field(default_factory=dict)


def chain(subject: Subject, e: Evidence, traces: Traces) -> Iterator[Step]:
    """Yield the step of each stage that was run."""
    result, config = traces.result, traces.result.config
    for failure in result.failures:
        yield Step("failure", f"{failure.stage}: {failure.reason}")
    yield from _clock(subject, traces)
    if not result.frame.lidar:
        yield from _detected(subject, e, traces)
        return
    where = {"truth": "in its box", "point": "around it", "cell": "over it and around"}
    where |= dict.fromkeys(("object", "cluster", "track"), "in it")
    yield Step("raw cloud", f"{e.raw} points {where.get(subject.kind, 'in its frustum')}", {"points": e.raw})
    if subject.box is not None and e.aimed:
        share = e.in_front / e.aimed
        text = f"{e.in_front} of {e.aimed} returns in its direction end in front of it"
        if e.front >= 0:
            text += f", most on cluster {e.front}" + _named(traces, e.front)
        yield Step("occlusion", text, {"in_front": e.in_front, "aimed": e.aimed, "share": round(share, 3)})
    if e.raw and result.voxels is not None and result.ground is not None:
        merged = max(e.raw - e.voxels, 0)
        yield Step(
            "voxel grid",
            f"{e.voxels} voxels of {config.voxel.size:g} m, {merged} points merged into them",
            {"voxels": e.voxels, "merged": merged},
        )
        yield _ground(e, traces)
        if result.clusters is not None:
            yield _clustering(e, traces)
            yield from _merged(e, traces)
    yield from _detected(subject, e, traces)
    yield from _objects(subject, e, traces)


def _clock(subject: Subject, traces: Traces) -> Iterator[Step]:
    """Yield the time and position of each camera relative to the cloud."""
    for camera in (c.camera for c in traces.result.cameras):
        if subject.camera and camera.name != subject.camera:
            continue
        said, numbers = [], {}
        if not traces.result.frame.lidar:
            yield Step(f"camera {camera.name}", ", ".join(camera.problems) or "its image makes the frame")
            continue
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


def _ground(e: Evidence, traces: Traces) -> Step:
    """Return the step of the ground removal."""
    known = e.ground[np.isfinite(e.ground)]
    text = f"{len(e.ground)} of {e.voxels} voxels removed as ground"
    numbers: dict[str, Any] = {"removed": len(e.ground)}
    if len(known):
        text += f", {float(known.min()):z.2f} to {float(known.max()):z.2f} m above the local ground"
        numbers |= {"lowest": round(float(known.min()), 3), "highest": round(float(known.max()), 3)}
    config, there = traces.result.config.ground, traces.origin("ground")
    if not there.ours:
        return Step("ground", f"{text} ({there.name})", {**numbers, "by": there.name})
    numbers["threshold"] = config.distance_threshold
    return Step(
        "ground",
        f"{text} (ground.distance_threshold {config.distance_threshold:g} m, {config.method})",
        numbers,
    )


def _clustering(e: Evidence, traces: Traces) -> Step:
    """Return the step of the clustering, with the largest clusters of the subject."""
    said, rows = [], []
    clusters, there = traces.result.clusters, traces.origin("clustering")
    assert clusters is not None
    boxes = clusters.boxes(traces.result.config.clustering)
    for part in e.parts[:_SHOWN]:
        size = " x ".join(f"{v:.1f}" for v in boxes.size[part.cluster])
        state = "" if part.kept else f", {state_text(part.state)}"
        name = _named(traces, part.cluster)
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
    if e.noise and there.ours:
        c = traces.result.config.clustering
        said.append(
            f"{e.noise} noise: at most {e.neighbours} neighbours within {c.eps:g} m, "
            f"clustering.min_points is {c.min_points}"
        )
    elif e.noise:
        said.append(f"{e.noise} in no cluster")
    if np.isfinite(e.apart):
        said.append(f"the two largest are {e.apart:.2f} m apart")
    numbers: dict[str, Any] = {"clusters": rows, "noise": e.noise}
    if there.ours:
        numbers["best_neighbours"] = e.neighbours
    else:
        numbers["by"] = there.name
        said.append(f"by {there.name}")
    return Step("clustering", "; ".join(said) or "no obstacle point", numbers)


def _merged(e: Evidence, traces: Traces) -> Iterator[Step]:
    """Yield the step about other objects in the cluster of the subject, if there are any."""
    if not np.isfinite(e.gap):
        return
    names = ", ".join(f"{name} ({points} points)" for name, points in e.others)
    part, there = e.part(e.main), traces.origin("clustering")
    names = names or f"{part.count - part.points if part is not None else 0} points that are not its own"
    text = f"the cluster also holds {names}; gap {e.gap:.2f} m"
    numbers: dict[str, Any] = {"others": [name for name, _ in e.others], "gap": round(e.gap, 3)}
    if there.ours:
        finer = f"with eps {e.finer:g} m they fall apart" if e.finer else "no smaller eps parts them"
        text += f", clustering.eps {traces.result.config.clustering.eps:g} m; {finer}"
        numbers["eps_that_parts"] = e.finer
    yield Step("merged", text, numbers)


def _named(traces: Traces, cluster: int) -> str:
    """Return the class of a cluster's object in brackets, empty for none."""
    name = name_of(traces.result, cluster)
    return f" ({name})" if name else ""


def _detected(subject: Subject, e: Evidence, traces: Traces) -> Iterator[Step]:
    """Yield the steps of the detector and of the fusion for the best candidates."""
    result, config = traces.result, traces.result.config
    if not detector_ran(result, subject.camera):
        yield Step("detector", "never ran: " + "; ".join(not_run(result, subject.camera)), {"candidates": 0})
        return
    by = "" if traces.origin("detector").ours else f" of {traces.origin('detector').name}"
    if not e.candidates:
        yield Step("detector", f"no candidate{by} there", {"candidates": 0})
    for c in e.candidates[:_SHOWN]:
        found, fusion = fusion_of(result, c.camera)
        detections = found.detections
        assert detections is not None
        numbers = {"name": c.name, "score": round(c.score, 3), "state": c.state.name.lower(), "row": c.row}
        text = f"{label(c)}{by}, overlap {c.overlap:.2f}: "
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
        if c.kept and fusion is not None:
            yield from _pairs(c, e, traces)
    more = len(e.candidates) - _SHOWN
    if more > 0:
        yield Step("detector", f"{more} weaker candidates more", {"more": more})


def _pairs(c: Candidate, e: Evidence, traces: Traces) -> Iterator[Step]:
    """Yield the fusion's decision about a detection, and its pairs with the subject's clusters."""
    _, fusion = fusion_of(traces.result, c.camera)
    assert fusion is not None
    ours = traces.origin("objects").ours
    stage = "fusion" if ours else "our fusion"
    key = "detection", c.camera, c.row
    said = next((x for x in traces.result.explanations if (x.subject, x.camera, x.row) == key), None)
    if said is not None:
        yield Step(stage, said.text, {"decision": c.decision.name.lower(), "cluster": c.cluster})
    pairs = fusion.pairs
    interesting = {part.cluster for part in e.parts[:3]} - {c.cluster}
    for row in np.flatnonzero(pairs.detection == c.row).tolist():
        k = int(pairs.cluster[row])
        if k not in interesting:
            continue
        decision = state_text(Decision(int(fusion.cluster_decision[k])))
        cost = "refused" if np.isinf(pairs.cost[row]) else f"cost {pairs.cost[row]:.2f}"
        yield Step(
            stage,
            f"{label(c)} with cluster {k}: {pairs.points[row]} points, IoU {pairs.iou[row]:.2f}, "
            f"{pairs.distance[row]:.0f} px, {pairs.depth[row]:.1f} m, {cost}; that cluster ended {decision}",
            {
                "cluster": k,
                "points": int(pairs.points[row]),
                "iou": round(float(pairs.iou[row]), 3),
                "distance_px": round(float(pairs.distance[row]), 1),
            },
        )


def _objects(subject: Subject, e: Evidence, traces: Traces) -> Iterator[Step]:
    """Yield the steps of objects that do not come from our fusion."""
    there, objects = traces.origin("objects"), traces.result.objects
    if there.ours:
        return
    j, opinions = find_fused(subject, e, traces), traces.result.opinions
    if e.named is None or objects is None:
        number = "no" if objects is None else str(len(objects))
        yield Step("objects", f"none of the {number} objects of {there.name} is there", {"by": there.name})
        if j >= 0 and opinions is not None:
            fused, k = opinions.fused, int(opinions.partner[j])
            text = f"{fused.names[j]} {fused.score[j]:.2f} of cluster {fused.cluster[j]}, "
            text += f"which {there.name} has missed" if k < 0 or objects is None else in_box_of(objects, k)
            yield Step("our fusion", text, {"row": j, "missed": k < 0})
        return
    score = float(objects.score[e.named.row])
    text = f"{there.name} has {e.named.name} {score:.2f} there"
    yield Step("objects", text, {"by": there.name, "row": e.named.row, "score": round(score, 3)})
    if opinions is not None and (said := opinion_on(traces.result, e.named.row)):
        opinion = Opinion(int(opinions.opinion[e.named.row]))
        yield Step(
            "cameras", said, {"opinion": opinion.word, "seen": not opinion.is_unseen, **_seen(e, traces)}
        )


def _seen(e: Evidence, traces: Traces) -> Mapping[str, Any]:
    """Return the numbers behind the cameras' opinion on an object, with their limits."""
    opinions, least = traces.result.opinions, traces.result.config.opinions
    assert opinions is not None and e.named is not None
    k = e.named.row
    found = {
        "shown": round(float(opinions.shown[k]), 3),
        "visible": round(float(opinions.visible[k]), 3),
        "height_px": round(float(opinions.height[k]), 1),
    }
    if opinions.detection[k] >= 0:
        found["iou"] = round(float(opinions.iou[k]), 3)
    if not np.isnan(opinions.held[k]):
        found["cluster_share"] = round(float(opinions.held[k]), 3)
    limits = {"shown": least.min_shown, "visible": least.min_visible}
    return {**found, "least": {**limits, "height_px": least.min_height, "iou": least.min_iou}}
