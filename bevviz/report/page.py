"""The report as one HTML file that needs nothing else: any browser shows it, online or not."""

from __future__ import annotations

from base64 import b64encode
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from importlib.resources import files

from bevviz.bags.source import SECOND
from bevviz.frame import Explanation, FrameResult
from bevviz.logging import entities
from bevviz.report.facts import Facts
from bevviz.report.pictures import camera_picture, jpeg, shrink
from bevviz.report.plots import Series, plot
from bevviz.report.summary import WindowSummary

PICTURE_WIDTH = 960

_LOOKS = {
    "matched": "good",
    "no_cluster": "bad",
    "low_overlap": "poor",
    "too_few_points": "poor",
    "taken": "poor",
    "too_far": "poor",
}
_QUIET = {"below_threshold", "suppressed", "not_kept", "out_of_view", "too_small", "too_large"}


def page(facts: Facts, summary: WindowSummary) -> str:
    """The whole file."""
    result = summary.result
    parts = [
        f"<h1>{escape(facts.title)}</h1>",
        f'<p class="faint">{escape(facts.where)}</p>',
        f'<div class="note">{escape(facts.note)}</div>' if facts.note else "",
        _section("What happened", _verdict(summary)),
    ]
    if result is not None:
        parts += [
            _section(f"The scene, {_when(result, facts)}", _pictures(result)),
            _section(f"What was decided, {_when(result, facts)}", _decisions(result)),
        ]
    parts += [
        _section("The window", _strip(summary, facts)),
        _section("Decisions over the window", _summary(summary)),
        _section("Health", _plots(summary, facts)),
        _section("How to run it again", _commands(facts)),
        _section("How it was made", _origin(facts)),
    ]
    style, script = (files("bevviz.report").joinpath(f"page.{kind}").read_text() for kind in ("css", "js"))
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8"/>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1"/>\n'
        f"<title>{escape(facts.title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        + "\n".join(part for part in parts if part)
        + f"\n<script>\n{script}</script>\n</body>\n</html>\n"
    )


def _section(title: str, content: Iterable[str]) -> str:
    text = "\n".join(content)
    return f"<h2>{escape(title)}</h2>\n{text}" if text else ""


def _list(items: Iterable[str], look: str = "") -> str:
    lines = "".join(f"<li>{escape(item)}</li>" for item in items)
    kind = f' class="{look}"' if look else ""
    return f"<ul{kind}>{lines}</ul>" if lines else ""


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """``rows`` are of cells that are HTML already."""
    body = "".join(f"<tr>{''.join(row)}</tr>" for row in rows)
    titles = "".join(f"<th>{escape(title)}</th>" for title in head)
    return f"<table><thead><tr>{titles}</tr></thead><tbody>{body}</tbody></table>" if body else ""


def _cell(text: object, look: str = "") -> str:
    kind = f' class="{look}"' if look else ""
    return f"<td{kind}>{escape(str(text))}</td>"


def _state(state: str) -> str:
    return _cell(state.replace("_", " "), f"state {_LOOKS.get(state, '')}".strip())


def _when(result: FrameResult, facts: Facts) -> str:
    return f"{(result.frame.received - facts.start) / SECOND:.3f} s"


# --- at the time -------------------------------------------------------------------------------


def _verdict(summary: WindowSummary) -> Iterator[str]:
    """The few lines to read first."""
    if summary.result is None:
        yield "<p>No frame was made.</p>"
        return
    result, lines = summary.result, []
    kept = [e for e in result.explanations if e.subject == "detection" and e.state not in _QUIET]
    if kept:
        counts = Counter(e.state.replace("_", " ") for e in kept)
        told = ", ".join(f"{n} {state}" for state, n in counts.most_common())
        lines.append(f"{len(kept)} detection{'s' * (len(kept) > 1)}: {told}")
        lines += [f"{e.camera}: {e.text}" for e in kept if e.state != "matched"]
    elif any(camera.detections is not None for camera in result.cameras):
        lines.append("nothing was detected")
    lines += [f"{f.stage} failed: {f.reason}" for f in result.failures]
    lines += result.frame.problems
    lines += [e.text for e in result.explanations if e.subject == "camera"]
    if result.objects is not None:
        names = Counter(result.objects.names)
        lines.append("objects: " + (", ".join(f"{n} {name}" for name, n in names.items()) or "none"))
    yield _list(lines, "verdict")
    frames, troubled = len(summary.frames), [m for m in summary.frames if m.problems]
    if troubled:
        common = Counter(problem for m in troubled for problem in m.problems).most_common(5)
        yield f"<p>{len(troubled)} of the window's {frames} frames have problems:</p>"
        yield _list(f"{text} ({n} frame{'s' * (n > 1)})" for text, n in common)
    else:
        yield f"<p>None of the window's {frames} frames has a failure or lacks anything.</p>"


def _pictures(result: FrameResult) -> Iterator[str]:
    yield '<div class="pictures">'
    for camera in result.cameras:
        picture = camera_picture(camera, PICTURE_WIDTH, labels=True, points=True)
        if picture is not None:
            yield _figure(jpeg(picture), f"{camera.camera.name}: thick: matched, thin: not; points by depth")
    if result.bev is not None:
        picture = shrink(result.bev.image, PICTURE_WIDTH)[0]
        reach = f"{result.bev.range_x:g} m ahead and behind, {result.bev.range_y:g} m to the sides"
        yield _figure(jpeg(picture), f"bird's-eye view: {reach}", "tall")
    yield "</div>"


def _figure(data: bytes, caption: str, look: str = "") -> str:
    kind = f' class="{look}"' if look else ""
    return f"<figure{kind}>{_image(data, caption)}<figcaption>{escape(caption)}</figcaption></figure>"


def _image(data: bytes, about: str) -> str:
    return f'<img src="data:image/jpeg;base64,{b64encode(data).decode()}" alt="{escape(about)}"/>'


def _decisions(result: FrameResult) -> Iterator[str]:
    """All of them, what is quiet folded away."""
    loud = [e for e in result.explanations if e.state not in _QUIET]
    detections = [e for e in loud if e.subject == "detection"]
    yield _explained(sorted(detections, key=lambda e: e.state == "matched"))
    folded = {
        "clusters": sorted((e for e in loud if e.subject == "cluster"), key=lambda e: e.state == "matched"),
        "more: not kept, or out of view": [e for e in result.explanations if e.state in _QUIET],
    }
    for title, explanations in folded.items():
        if explanations:
            yield f"<details><summary>{len(explanations)} {title}</summary>"
            yield _explained(explanations)
            yield "</details>"


def _explained(explanations: Sequence[Explanation]) -> str:
    rows = [[_cell(e.subject), _cell(e.camera), _state(e.state), _cell(e.text)] for e in explanations]
    return _table(("what", "camera", "decision", "why"), rows)


# --- over the window ---------------------------------------------------------------------------


def _strip(summary: WindowSummary, facts: Facts) -> Iterator[str]:
    if not summary.strip:
        return
    nearest = min(summary.strip, key=lambda shown: abs(shown[0].received - summary.at))
    yield '<div class="strip">'
    for shown in summary.strip:
        moment, pictures = shown
        label = f"{(moment.received - facts.start) / SECOND:.2f} s, frame {moment.index}"
        images = "".join(_image(data, f"{name}, {label}") for name, data in pictures.items())
        look = ' class="here"' if shown is nearest else ""
        yield f'<div{look}><p class="faint">{escape(label)}</p>{images}</div>'
    yield "</div>"


def _summary(summary: WindowSummary) -> Iterator[str]:
    """How many of each decision, and in which frames what is neither matched nor quiet."""
    frames: dict[tuple[str, str, str], list[int]] = defaultdict(list)
    total: Counter[tuple[str, str, str]] = Counter()
    for moment in summary.frames:
        total += moment.states
        for key in moment.states:
            frames[key].append(moment.index)
    rows = []
    for key in sorted(total, key=lambda k: (k[0] != "detection", k[1], k[2] in _QUIET, -total[k])):
        subject, name, state = key
        rows.append(
            [
                _cell(f"{name} {subject}".strip()),
                _state(state),
                _cell(f"{total[key]}", "n"),
                _cell(spans(frames[key])),
            ]
        )
    yield _table(("what", "decision", "times", "in frames"), rows)


def spans(numbers: Sequence[int]) -> str:
    """Numbers in order, neighbours as a span.

    >>> spans([1, 2, 3, 7, 9, 10])
    '1-3, 7, 9-10'
    """
    found: list[list[int]] = []
    for number in numbers:
        if found and number == found[-1][1] + 1:
            found[-1][1] = number
        else:
            found.append([number, number])
    return ", ".join(f"{a}-{b}" if a < b else f"{a}" for a, b in found)


def _plots(summary: WindowSummary, facts: Facts) -> Iterator[str]:
    at = (summary.at - facts.start) / SECOND
    counted = ("clusters", "detections", "matches", "problems", "failures")
    groups = {
        "Stage times, ms": _series(summary, facts, entities.stage_time("")),
        "Image stamp - cloud stamp, ms": _series(summary, facts, entities.sync_error("")),
        "Age of the transforms, ms": _series(summary, facts, entities.tf_age("")),
        "Counts": _series(summary, facts, entities.count(""), counted),
        "Points": _series(summary, facts, entities.count(""), ("points", "voxels", "obstacle_points")),
        "Scans left out, invalid points": _series(
            summary, facts, entities.count(""), ("skipped_frames", "invalid_points")
        ),
    }
    yield '<div class="plots">'
    for title, series in groups.items():
        yield plot(title, series, at)
    yield "</div>"


def _series(
    summary: WindowSummary, facts: Facts, prefix: str, names: Sequence[str] | None = None
) -> dict[str, Series]:
    found: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for moment in summary.frames:
        for path, value in moment.health.items():
            name = path.removeprefix(prefix)
            if path.startswith(prefix) and value == value and (names is None or name in names):
                found[name].append(((moment.received - facts.start) / SECOND, value))
    return dict(found)


# --- where it comes from -----------------------------------------------------------------------


def _commands(facts: Facts) -> Iterator[str]:
    yield f"<pre>{escape(chr(10).join(facts.commands))}</pre>"
    yield _list(facts.files)


def _origin(facts: Facts) -> Iterator[str]:
    yield f"<p>{escape(facts.config)}</p>"
    rows = [[_cell(key), _cell(here), _cell(there, "faint")] for key, (there, here) in facts.changes.items()]
    yield _table(("parameter", "here", "in the preset"), rows)
    for title, lines in (
        ("Warnings", facts.warnings),
        ("Versions", facts.versions),
        ("Hardware", facts.hardware),
    ):
        if lines:
            yield f"<h3>{title}</h3>{_list(lines)}"
