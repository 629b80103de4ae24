"""Log the decisions of a frame: a page of Markdown, and lines for the log of all frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from bevviz.model.results import Detections, DetectionState, Explanation, FrameResult
from bevviz.recording import entities
from bevviz.recording.primitives import document, scored
from bevviz.recording.writer import Writer
from bevviz.support.text import markdown

_WEAK = {"not_kept", "below_threshold", "suppressed"}
_DOUBT = {"contradicted": 0, "missed": 1, "named otherwise": 2, "confirmed": 3}  # order on the page
_LINES = 5  # log lines for contradicted objects in a frame: a network may have hundreds
_MANY = {"out_of_view", "too_small", "too_large"}  # clusters in these states are only counted and numbered


def log_decisions(to: Writer, result: FrameResult) -> None:
    """Log the page of the frame's decisions and its log lines."""
    to.put(entities.EXPLAIN, document(page(result)))
    to.lines(entities.EXPLAIN_LOG, remarks(result))


def page(result: FrameResult) -> str:
    """Return the frame's decisions as Markdown: problems, detections by camera, clusters.

    Detections and clusters without a match come first.
    """
    return "\n".join(_lines(result))


def remarks(result: FrameResult) -> list[tuple[str, str]]:
    """Return log lines (level and text) for failures, problems, unmatched detections and doubtful objects."""
    lines = [("ERROR", f"{f.stage}: {f.reason}") for f in result.failures]
    lines += [("WARN", problem) for problem in result.frame.problems]
    for camera in result.cameras:
        lines += [("WARN", f"{camera.camera.name}: {problem}") for problem in camera.camera.problems]
    lines += [
        ("INFO", f"{e.camera}: {e.text}")
        for e in result.explanations
        if e.subject == "detection" and e.state not in _WEAK and e.state != "matched"
    ]
    return lines + [("INFO", text) for text in _in_doubt(result.explanations)]


def _lines(result: FrameResult) -> Iterator[str]:
    frame = result.frame
    yield f"### Frame {frame.index}"
    yield ""
    around = frame.around
    yield from _section("Marks", map(markdown, around.marks if around is not None else ()))
    yield from _section("Failures", (f"**{f.stage}**: {markdown(f.reason)}" for f in result.failures))
    problems = list(frame.problems)
    problems += [e.text for e in result.explanations if e.subject == "camera"]
    yield from _section("Problems", map(markdown, problems))
    objects = [e for e in result.explanations if e.subject == "object"]
    said = [e for e in objects if e.state != "unseen"]
    missed = [e for e in result.explanations if e.subject == "fused" and e.state == "missed"]
    worst = sorted([*said, *missed], key=lambda e: _DOUBT.get(e.state, len(_DOUBT)))
    unseen = [f"{len(objects) - len(said)} unseen"] if len(objects) > len(said) else []
    yield from _section("Objects, by cameras and our fusion", [*map(_item, worst), *unseen])
    for camera in result.cameras:
        name = camera.camera.name
        mine = [e for e in result.explanations if e.subject == "detection" and e.camera == name]
        kept = sorted((e for e in mine if e.state not in _WEAK), key=lambda e: e.state == "matched")
        if camera.detections is not None:
            yield from _section(f"{name}: detections", map(_item, kept) if kept else ["none"])
            yield from _section(f"{name}: not kept", map(markdown, _not_kept(mine, camera.detections)))
        yield from _clusters(
            [e for e in result.explanations if e.subject == "cluster" and e.camera == name], name
        )
        made = [e for e in result.explanations if e.subject == "split" and e.camera == name]
        yield from _section(f"{name}: clusters split and merged", map(_item, made))
    yield from _clusters([e for e in result.explanations if e.subject == "cluster" and not e.camera], "")


def _in_doubt(explanations: Iterable[Explanation]) -> Iterator[str]:
    """Yield a line for each contradicted object, up to a limit, and for each missed object."""
    said = [(e.subject, e.state, e.text) for e in explanations]
    denied = [text for *what, text in said if what == ["object", "contradicted"]]
    yield from denied[:_LINES]
    if len(denied) > _LINES:
        yield f"{len(denied) - _LINES} more objects contradicted"
    yield from (text for *what, text in said if what == ["fused", "missed"])


def _not_kept(explanations: Sequence[Explanation], found: Detections) -> Iterator[str]:
    """Yield a line for each detection that suppresses others, and one for all below the threshold."""
    for d in np.unique(found.suppressed_by[found.state == DetectionState.SUPPRESSED]).tolist():
        names = Counter(found.names[s] for s in np.flatnonzero(found.suppressed_by == d).tolist())
        [label] = scored([found.names[d]], [found.score[d]])
        yield f"{_counted(names)} suppressed by {label}"
    below = [e for e in explanations if e.state == "below_threshold"]
    if below:
        best = max(below, key=lambda e: found.score[e.row])
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
    told = [e for e in explanations if e.state not in _MANY]
    items = [_item(e) for e in sorted(told, key=lambda e: e.state == "matched")]
    for state in sorted(_MANY):
        rows = [e.row for e in explanations if e.state == state]
        if rows:
            items.append(f"{len(rows)} {state.replace('_', ' ')}: {', '.join(map(str, rows))}")
    yield from _section(title, items)


def _item(explanation: Explanation) -> str:
    return f"**{explanation.state.replace('_', ' ')}** {markdown(explanation.text)}"


def _section(title: str, items: Iterable[str]) -> Iterator[str]:
    """Yield the Markdown lines of a section. ``items`` are Markdown already."""
    lines = [f"- {item}" for item in items]
    if lines:
        yield f"#### {markdown(title)}"
        yield ""
        yield from lines
        yield ""
