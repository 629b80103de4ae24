"""Log the decisions of a frame: a page of Markdown, and lines for the log of all frames."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from bevviz.model.reasons import ReasonKind
from bevviz.model.results import Detections, DetectionState, Explanation, FrameResult, explanations_of
from bevviz.recording import entities
from bevviz.recording.primitives import document, scored
from bevviz.recording.writer import Writer
from bevviz.support.text import markdown

_NOT_KEPT = {ReasonKind.NOT_KEPT, ReasonKind.BELOW_THRESHOLD, ReasonKind.SUPPRESSED}
_OBJECT_ORDER = (  # order on the page
    ReasonKind.CONTRADICTED,
    ReasonKind.MISSED,
    ReasonKind.NAMED_OTHERWISE,
    ReasonKind.CONFIRMED,
)
_MAX_LINES = 5  # log lines for contradicted objects in a frame: a network may have hundreds
_NO_DETECTOR = "no camera has any. For a detector give `--model FILE.onnx`, or name it in bevviz.toml"
# Clusters that are only counted and numbered.
_COUNTED = (ReasonKind.OUT_OF_VIEW, ReasonKind.TOO_LARGE, ReasonKind.TOO_SMALL)


def log_decisions(to: Writer, result: FrameResult) -> None:
    """Log the page of the frame's decisions and its log lines."""
    to.put(entities.EXPLAIN, document(decision_page(result)))
    to.lines(entities.EXPLAIN_LOG, decision_log_lines(result))


def decision_page(result: FrameResult) -> str:
    """Return the frame's decisions as Markdown: problems, detections by camera, clusters.

    Detections and clusters without a match come first.
    """
    return "\n".join(_lines(result))


def problem_lines(result: FrameResult) -> list[tuple[str, str]]:
    """Return log lines (level and text) for failures of stages and problems of inputs."""
    lines = [("ERROR", f"{failure.stage}: {failure.reason}") for failure in result.failures]
    lines += [("WARN", problem) for problem in result.frame.problems]
    for camera in result.cameras:
        lines += [("WARN", f"{camera.camera.name}: {problem}") for problem in camera.camera.problems]
    return lines


def decision_log_lines(result: FrameResult) -> list[tuple[str, str]]:
    """Return log lines (level and text) for failures, problems, unmatched detections and doubtful objects."""
    lines = problem_lines(result)
    lines += [
        ("INFO", f"{explanation.camera}: {explanation.text}")
        for explanation in explanations_of(result.explanations, "detection")
        if explanation.reason.kind not in _NOT_KEPT and not _is_matched(explanation)
    ]
    return lines + [("INFO", text) for text in _in_doubt(result.explanations)]


def _lines(result: FrameResult) -> Iterator[str]:
    frame = result.frame
    yield f"### Frame {frame.index}"
    yield ""
    surroundings = frame.around
    yield from _section("Marks", map(markdown, surroundings.marks if surroundings is not None else ()))
    yield from _section(
        "Failures", (f"**{failure.stage}**: {markdown(failure.reason)}" for failure in result.failures)
    )
    explanations = result.explanations
    camera_problems = [explanation.text for explanation in explanations_of(explanations, "camera")]
    yield from _section("Problems", map(markdown, [*frame.problems, *camera_problems]))
    yield from _section("Objects, by cameras and our fusion", _objects(explanations))
    for camera in result.cameras:
        name = camera.camera.name
        if camera.detections is not None:
            decided = explanations_of(explanations, "detection", name)
            kept = [explanation for explanation in decided if explanation.reason.kind not in _NOT_KEPT]
            yield from _section(
                f"{name}: detections", [*map(_item, sorted(kept, key=_is_matched))] or ["none"]
            )
            yield from _section(f"{name}: not kept", map(markdown, _not_kept(decided, camera.detections)))
        yield from _clusters(explanations_of(explanations, "cluster", name), name)
        splits = explanations_of(explanations, "split", name)
        yield from _section(f"{name}: clusters split and merged", map(_item, splits))
    yield from _clusters(explanations_of(explanations, "cluster", ""), "")


def _is_matched(explanation: Explanation) -> bool:
    return explanation.reason.kind is ReasonKind.MATCHED


def _objects(explanations: Sequence[Explanation]) -> Iterator[str]:
    """Yield an item for each object that a camera can judge or that is missed, the worst first."""
    objects = explanations_of(explanations, "object")
    judged = [explanation for explanation in objects if explanation.reason.kind is not ReasonKind.UNSEEN]
    fused = explanations_of(explanations, "fused")
    missed = [explanation for explanation in fused if explanation.reason.kind is ReasonKind.MISSED]
    for explanation in sorted([*judged, *missed], key=_severity):
        yield _item(explanation)
    if len(objects) > len(judged):
        yield f"{len(objects) - len(judged)} unseen"


def _severity(explanation: Explanation) -> int:
    """Return the position of an object's opinion on the page."""
    return _OBJECT_ORDER.index(explanation.reason.kind)


def _in_doubt(explanations: Sequence[Explanation]) -> Iterator[str]:
    """Yield a line for each contradicted object, up to a limit, and for each missed object."""
    objects, fused = explanations_of(explanations, "object"), explanations_of(explanations, "fused")
    contradicted = [
        explanation.text for explanation in objects if explanation.reason.kind is ReasonKind.CONTRADICTED
    ]
    yield from contradicted[:_MAX_LINES]
    if len(contradicted) > _MAX_LINES:
        yield f"{len(contradicted) - _MAX_LINES} more objects contradicted"
    yield from (explanation.text for explanation in fused if explanation.reason.kind is ReasonKind.MISSED)


def _not_kept(explanations: Sequence[Explanation], detections: Detections) -> Iterator[str]:
    """Yield a line for each detection that suppresses others, and one for all below the threshold."""
    suppressed = np.flatnonzero(detections.state == DetectionState.SUPPRESSED)
    names: dict[int, Counter[str]] = defaultdict(Counter)
    for row, by in zip(suppressed.tolist(), detections.suppressed_by[suppressed].tolist(), strict=True):
        names[by][detections.names[row]] += 1
    for by in sorted(names):
        [label] = scored([detections.names[by]], [detections.score[by]])
        yield f"{_counted(names[by])} suppressed by {label}"
    below = [
        explanation for explanation in explanations if explanation.reason.kind is ReasonKind.BELOW_THRESHOLD
    ]
    if below:
        best = max(below, key=lambda explanation: detections.score[explanation.row])
        yield f"{len(below)} more, the best {best.text}" if below[1:] else best.text


def _counted(names: Counter[str]) -> str:
    """Format counts as ``3`` for one name, or as ``3 (2 car, 1 truck)`` for several."""
    if len(names) == 1:
        return str(names.total())
    return f"{names.total()} ({', '.join(f'{count} {name}' for name, count in names.most_common())})"


def _clusters(explanations: list[Explanation], camera: str) -> Iterator[str]:
    if not explanations:
        return
    title = f"{camera}: clusters" if camera else "Clusters"
    detailed = [explanation for explanation in explanations if explanation.reason.kind not in _COUNTED]
    items = [*map(_item, sorted(detailed, key=_is_matched))]
    kept = [explanation for explanation in detailed if explanation.reason.kind is ReasonKind.KEPT]
    if kept:  # No camera has detections.
        items = [f"{len(kept)} clusters, not compared with detections: {_NO_DETECTOR}"]
    for kind in _COUNTED:
        rows = [explanation.row for explanation in explanations if explanation.reason.kind is kind]
        if rows:
            items.append(f"{len(rows)} {kind.value}: {', '.join(map(str, rows))}")
    yield from _section(title, items)


def _item(explanation: Explanation) -> str:
    return f"**{explanation.reason.kind.value}** {markdown(explanation.text)}"


def _section(title: str, items: Iterable[str]) -> Iterator[str]:
    """Yield the Markdown lines of a section. ``items`` are Markdown already."""
    lines = [f"- {item}" for item in items]
    if lines:
        yield f"#### {markdown(title)}"
        yield ""
        yield from lines
        yield ""
