"""Steps of a subject through the stages, in words and in numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bevviz.model.decisions import detection_reason
from bevviz.model.reasons import ReasonKind, kind_of, limit, limit_of, scored
from bevviz.model.results import Decision, DetectionState, Fusion, Opinion, texts_by_row
from bevviz.why.evidence import Candidate, Evidence
from bevviz.why.frame_index import FrameIndex
from bevviz.why.reason_text import detector_ran, name_of, not_run
from bevviz.why.subject import Subject, projected_box
from bevviz.why.subject_matches import find_fused, opinion_on

_SHOWN = 5  # clusters or candidates listed in a step, at most


@dataclass(frozen=True, slots=True)
class Step:
    """The result of one stage for the subject, in words and in numbers."""

    stage: str
    text: str
    numbers: Mapping[str, Any] = field(default_factory=dict)


def steps_of(subject: Subject, evidence: Evidence, traces: FrameIndex) -> Iterator[Step]:
    """Yield the step of each stage that was run."""
    result, config = traces.result, traces.result.config
    for failure in result.failures:
        yield Step("failure", f"{failure.stage}: {failure.reason}")
    yield from _camera_steps(subject, traces)
    if not result.frame.lidar:
        yield from _detector_steps(subject, evidence, traces)
        return
    where = {"truth": "in its box", "point": "around it", "cell": "over it and around"}
    where |= dict.fromkeys(("object", "cluster", "track"), "in it")
    yield Step(
        "raw cloud",
        f"{evidence.raw} points {where.get(subject.kind, 'in its frustum')}",
        {"points": evidence.raw},
    )
    if subject.box is not None and evidence.aimed:
        share = evidence.in_front / evidence.aimed
        text = f"{evidence.in_front} of {evidence.aimed} returns in its direction end in front of it"
        if evidence.front >= 0:
            text += f", most on cluster {evidence.front}" + _class_in_brackets(traces, evidence.front)
        yield Step(
            "occlusion",
            text,
            {"in_front": evidence.in_front, "aimed": evidence.aimed, "share": round(share, 3)},
        )
    if evidence.raw and result.voxels is not None and result.ground is not None:
        merged = max(evidence.raw - evidence.voxels, 0)
        yield Step(
            "voxel grid",
            f"{evidence.voxels} voxels of {config.voxel.size:g} m, {merged} points merged into them",
            {"voxels": evidence.voxels, "merged": merged},
        )
        yield _ground_step(evidence, traces)
        if result.clusters is not None:
            yield _clustering_step(evidence, traces)
            yield from _merged_steps(evidence, traces)
    yield from _detector_steps(subject, evidence, traces)
    yield from _object_steps(subject, evidence, traces)


def _camera_steps(subject: Subject, traces: FrameIndex) -> Iterator[Step]:
    """Yield the time and position of each camera relative to the cloud."""
    for camera in (result.camera for result in traces.result.cameras):
        if subject.camera and camera.name != subject.camera:
            continue
        texts, numbers = [], {}
        if not traces.result.frame.lidar:
            yield Step(f"camera {camera.name}", ", ".join(camera.problems) or "its image makes the frame")
            continue
        if np.isfinite(camera.sync_error):
            texts.append(f"image {1e3 * camera.sync_error:+.0f} ms from the cloud")
            numbers["sync_error_ms"] = round(1e3 * camera.sync_error, 1)
        if np.isfinite(camera.tf_age):
            texts.append(f"transform {1e3 * camera.tf_age:.0f} ms old")
            numbers["tf_age_ms"] = round(1e3 * camera.tf_age, 1)
        texts.append(
            "moved to the image's time" if camera.motion_compensated else "not moved to the image's time"
        )
        texts += camera.problems
        box = projected_box(subject.box, camera) if subject.box is not None else None
        if box is not None:
            u, v = (box[:2] + box[2:]) / 2
            texts.append(f"expected at pixel {u:.0f}, {v:.0f}")
        yield Step(f"camera {camera.name}", ", ".join(texts), numbers)


def _ground_step(evidence: Evidence, traces: FrameIndex) -> Step:
    """Return the step of the ground removal."""
    lowest, highest = evidence.ground_span
    text = f"{len(evidence.ground)} of {evidence.voxels} voxels removed as ground"
    numbers: dict[str, Any] = {"removed": len(evidence.ground)}
    if np.isfinite(highest):
        text += f", {lowest:z.2f} to {highest:z.2f} m above the local ground"
        numbers |= {"lowest": round(lowest, 3), "highest": round(highest, 3)}
    config, owner = traces.result.config, traces.origin("ground")
    if not owner.ours:
        return Step("ground", f"{text} ({owner.name})", {**numbers, "by": owner.name})
    deciding = limit(config, "ground.distance_threshold")
    numbers["threshold"] = deciding.value
    return Step("ground", f"{text} ({deciding.short}, {config.ground.method})", numbers)


def _clustering_step(evidence: Evidence, traces: FrameIndex) -> Step:
    """Return the step of the clustering, with the largest clusters of the subject."""
    texts, rows = [], []
    clusters, owner = traces.result.clusters, traces.origin("clustering")
    assert clusters is not None
    boxes = clusters.boxes(traces.result.config.clustering)
    for part in evidence.parts[:_SHOWN]:
        size = " x ".join(f"{v:.1f}" for v in boxes.size[part.cluster])
        state = "" if part.kept else f", {kind_of(part.state).value}"
        name = _class_in_brackets(traces, part.cluster)
        texts.append(f"{part.points} in cluster {part.cluster}{name} of {part.count}, {size} m{state}")
        rows.append(
            {
                "cluster": part.cluster,
                "points": part.points,
                "count": part.count,
                "state": part.state.name.lower(),
            }
        )
    if len(evidence.parts) > _SHOWN:
        texts.append(f"{len(evidence.parts) - _SHOWN} clusters more")
    if evidence.noise and owner.ours:
        config = traces.result.config
        within = limit(config, "clustering.eps").number
        most = f"at most {evidence.neighbours} neighbours within {within}"
        texts.append(f"{evidence.noise} noise: {most}, {limit_of(ReasonKind.NOISE, config)}")
    elif evidence.noise:
        texts.append(f"{evidence.noise} in no cluster")
    if np.isfinite(evidence.apart):
        texts.append(f"the two largest are {evidence.apart:.2f} m apart")
    numbers: dict[str, Any] = {"clusters": rows, "noise": evidence.noise}
    if owner.ours:
        numbers["best_neighbours"] = evidence.neighbours
    else:
        numbers["by"] = owner.name
        texts.append(f"by {owner.name}")
    return Step("clustering", "; ".join(texts) or "no obstacle point", numbers)


def _merged_steps(evidence: Evidence, traces: FrameIndex) -> Iterator[Step]:
    """Yield the step about other objects in the cluster of the subject, if there are any."""
    if not np.isfinite(evidence.gap):
        return
    names = ", ".join(f"{mate.name} ({points} points)" for mate, points in evidence.mates)
    part, owner = evidence.part(evidence.main), traces.origin("clustering")
    names = names or f"{part.count - part.points if part is not None else 0} points that are not its own"
    text = f"the cluster also holds {names}; gap {evidence.gap:.2f} m"
    numbers: dict[str, Any] = {
        "others": [mate.name for mate, _ in evidence.mates],
        "gap": round(evidence.gap, 3),
    }
    if owner.ours:
        finer = (
            f"with eps {evidence.finer:g} m they fall apart"
            if evidence.finer
            else "no smaller eps parts them"
        )
        text += f", {limit(traces.result.config, 'clustering.eps').short}; {finer}"
        numbers["eps_that_parts"] = evidence.finer
    yield Step("merged", text, numbers)


def _class_in_brackets(traces: FrameIndex, cluster: int) -> str:
    """Return the class of a cluster's object in brackets, empty for none."""
    name = name_of(traces.result, cluster)
    return f" ({name})" if name else ""


def _detector_steps(subject: Subject, evidence: Evidence, traces: FrameIndex) -> Iterator[Step]:
    """Yield the steps of the detector and of the fusion for the best candidates."""
    result, config = traces.result, traces.result.config
    if not detector_ran(result, subject.camera):
        yield Step("detector", "never ran: " + "; ".join(not_run(result, subject.camera)), {"candidates": 0})
        return
    by = "" if traces.origin("detector").ours else f" of {traces.origin('detector').name}"
    if not evidence.candidates:
        yield Step("detector", f"no candidate{by} there", {"candidates": 0})
    for candidate in evidence.candidates[:_SHOWN]:
        camera = result.camera(candidate.camera)
        assert camera is not None
        detections = camera.detections
        assert detections is not None
        numbers = {
            "name": candidate.name,
            "score": round(candidate.score, 3),
            "state": candidate.state.name.lower(),
            "row": candidate.row,
        }
        if candidate.state == DetectionState.SUPPRESSED:
            numbers["suppressed_by"] = int(detections.suppressed_by[candidate.row])
        state = "kept" if candidate.kept else detection_reason(detections, candidate.row, config).text
        if not candidate.own and candidate.owner >= 0:
            state += f", the box of {traces.truth[candidate.owner].name}"
        yield Step("detector", f"{candidate.label}{by}, overlap {candidate.overlap:.2f}: {state}", numbers)
        if candidate.kept and camera.fusion is not None:
            yield from _pair_steps(candidate, evidence, traces, camera.fusion)
    more = len(evidence.candidates) - _SHOWN
    if more > 0:
        yield Step("detector", f"{more} weaker candidates more", {"more": more})


def _pair_steps(
    candidate: Candidate, evidence: Evidence, traces: FrameIndex, fusion: Fusion
) -> Iterator[Step]:
    """Yield the fusion's decision about a detection, and its pairs with the subject's clusters."""
    ours = traces.origin("objects").ours
    stage = "fusion" if ours else "our fusion"
    texts = texts_by_row(traces.result.explanations, "detection", candidate.camera)
    if candidate.row in texts:
        numbers = {"decision": candidate.decision.name.lower(), "cluster": candidate.cluster}
        yield Step(stage, texts[candidate.row], numbers)
    pairs = fusion.pairs
    interesting = {part.cluster for part in evidence.parts[:3]} - {candidate.cluster}
    for row in np.flatnonzero(pairs.detection == candidate.row).tolist():
        cluster = int(pairs.cluster[row])
        if cluster not in interesting:
            continue
        decision = kind_of(Decision(int(fusion.cluster_decision[cluster]))).value
        cost = "refused" if np.isinf(pairs.cost[row]) else f"cost {pairs.cost[row]:.2f}"
        yield Step(
            stage,
            f"{candidate.label} with cluster {cluster}: "
            f"{pairs.points[row]} points, IoU {pairs.iou[row]:.2f}, "
            f"{pairs.distance[row]:.0f} px, {pairs.depth[row]:.1f} m, {cost}; that cluster ended {decision}",
            {
                "cluster": cluster,
                "points": int(pairs.points[row]),
                "iou": round(float(pairs.iou[row]), 3),
                "distance_px": round(float(pairs.distance[row]), 1),
            },
        )


def _object_steps(subject: Subject, evidence: Evidence, traces: FrameIndex) -> Iterator[Step]:
    """Yield the steps of objects that do not come from our fusion."""
    owner, objects = traces.origin("objects"), traces.result.objects
    if owner.ours:
        return
    fused_row, opinions = find_fused(subject, evidence, traces), traces.result.opinions
    if evidence.named is None or objects is None:
        number = "no" if objects is None else str(len(objects))
        yield Step("objects", f"none of the {number} objects of {owner.name} is there", {"by": owner.name})
        if fused_row >= 0 and opinions is not None:
            fused, object_row = opinions.fused, int(opinions.partner[fused_row])
            text = f"{scored(fused, fused_row)} of cluster {fused.cluster[fused_row]}, "
            if object_row < 0 or objects is None:
                text += f"which {owner.name} has missed"
            else:
                text += f"in the box of {scored(objects, object_row)}"
            yield Step("our fusion", text, {"row": fused_row, "missed": object_row < 0})
        return
    score = float(objects.score[evidence.named.row])
    text = f"{owner.name} has {evidence.named.name} {score:.2f} there"
    yield Step("objects", text, {"by": owner.name, "row": evidence.named.row, "score": round(score, 3)})
    if opinions is not None and (opinion_text := opinion_on(traces.result, evidence.named.row)):
        opinion = Opinion(int(opinions.opinion[evidence.named.row]))
        yield Step(
            "cameras",
            opinion_text,
            {"opinion": opinion.word, "seen": not opinion.is_unseen, **_opinion_numbers(evidence, traces)},
        )


def _opinion_numbers(evidence: Evidence, traces: FrameIndex) -> Mapping[str, Any]:
    """Return the numbers behind the cameras' opinion on an object, with their limits."""
    opinions, least = traces.result.opinions, traces.result.config.opinions
    assert opinions is not None and evidence.named is not None
    row = evidence.named.row
    numbers = {
        "shown": round(float(opinions.shown[row]), 3),
        "visible": round(float(opinions.visible[row]), 3),
        "height_px": round(float(opinions.height[row]), 1),
    }
    if opinions.detection[row] >= 0:
        numbers["iou"] = round(float(opinions.iou[row]), 3)
    if not np.isnan(opinions.held[row]):
        numbers["cluster_share"] = round(float(opinions.held[row]), 3)
    limits = {"shown": least.min_shown, "visible": least.min_visible}
    return {**numbers, "least": {**limits, "height_px": least.min_height, "iou": least.min_iou}}
