"""The report as one self-contained HTML file that every browser shows, also offline."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from bevviz.bags.source import SECOND
from bevviz.findings.frame_findings import find_findings
from bevviz.model.results import Explanation, FrameResult
from bevviz.recording import entities
from bevviz.report.facts import Facts
from bevviz.report.pictures import Plot, Series, camera_picture, jpeg, marked_pictures, plot, shrink
from bevviz.report.summary import WindowSummary
from bevviz.support.html import render
from bevviz.why import Answer, FrameExplainer

PICTURE_WIDTH = 960
SUBJECT_WIDTH = 800
COMMON = 5  # problems that are listed

_QUIET = {"below_threshold", "suppressed", "not_kept", "out_of_view", "too_small", "too_large"}


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture with its caption."""

    data: bytes  # JPEG
    caption: str
    tall: bool = False


@dataclass(frozen=True, slots=True)
class FramePage:
    """Content of the page about its frame."""

    when: str
    verdict: Sequence[str]  # a few lines to read first
    pictures: Sequence[Picture]
    decisions: Sequence[Explanation]  # of detections, failed ones first
    folded: Mapping[str, Sequence[Explanation]]  # further decisions, by title


@dataclass(frozen=True, slots=True)
class StripFrame:
    """Small pictures of one frame of the window. ``here``: it is nearest to the frame of the report."""

    label: str
    pictures: Mapping[str, bytes]  # JPEG by sensor
    here: bool


@dataclass(frozen=True, slots=True)
class DecisionTotal:
    """Number of equal decisions in the window, and the frames that have them."""

    what: str
    state: str
    times: int
    frames: str


def page(facts: Facts, summary: WindowSummary, seal: str, answers: Sequence[Answer] = ()) -> str:
    """Return the HTML text.

    Args:
        facts: text beside the results.
        summary: results of the window.
        seal: SHA-256 of the recording.
        answers: the answer about the report's subject, to mark in pictures.
    """
    bad = [frame for frame in summary.frames if frame.problems]
    common = Counter(problem for frame in bad for problem in frame.problems).most_common(COMMON)
    return render(
        "report.html",
        title=facts.title,
        facts=facts,
        seal=seal,
        marked=[
            Picture(jpeg(picture, 88), caption)
            for answer in answers
            if summary.result is not None
            for picture, caption in marked_pictures(summary.result, answer, SUBJECT_WIDTH)
        ],
        frame=None if summary.result is None else _frame(summary.result, facts),
        frames=len(summary.frames),
        bad_frames=len(bad),
        problems=[f"{text} ({n} frame{'s' * (n > 1)})" for text, n in common],
        marks=[f"{_when(f.received, facts)}: {mark}" for f in summary.frames for mark in f.marks],
        strip=list(_strip(summary, facts)),
        totals=list(_totals(summary)),
        plots=list(_plots(summary, facts)),
    )


# --- the frame of the report -------------------------------------------------------------------


def _frame(result: FrameResult, facts: Facts) -> FramePage:
    """Return the content about the frame of the report."""
    loud = [explanation for explanation in result.explanations if explanation.state not in _QUIET]
    detections = [explanation for explanation in loud if explanation.subject == "detection"]
    clusters = [explanation for explanation in loud if explanation.subject in ("cluster", "split")]
    doubted = sorted(
        (explanation for explanation in loud if explanation.subject in ("object", "fused")),
        key=lambda explanation: explanation.state,
    )
    objects = {"objects, by cameras and our fusion": doubted} if doubted else {}
    return FramePage(
        when=_when(result.frame.received, facts),
        verdict=list(_verdict(result)),
        pictures=list(_pictures(result)),
        decisions=sorted(detections, key=lambda explanation: explanation.state == "matched"),
        folded={
            **objects,
            "clusters": sorted(clusters, key=lambda explanation: explanation.state == "matched"),
            "more: not kept, or out of view": [
                explanation for explanation in result.explanations if explanation.state in _QUIET
            ],
        },
    )


def _when(received: int, facts: Facts) -> str:
    """Return a log time as text, in seconds since the start of the recording."""
    return f"{(received - facts.start) / SECOND:.3f} s"


def _verdict(result: FrameResult) -> Iterator[str]:
    """Yield the lines that summarise a frame."""
    decisions = [
        explanation
        for explanation in result.explanations
        if explanation.subject == "detection" and explanation.state not in _QUIET
    ]
    if decisions:
        counts = Counter(explanation.state.replace("_", " ") for explanation in decisions)
        states = ", ".join(f"{n} {state}" for state, n in counts.most_common())
        yield f"{len(decisions)} detection{'s' * (len(decisions) > 1)}: {states}"
    elif any(camera.detections is not None for camera in result.cameras):
        yield "nothing was detected"
    yield from (f"{failure.stage} failed: {failure.reason}" for failure in result.failures)
    yield from result.frame.problems
    yield from (explanation.text for explanation in result.explanations if explanation.subject == "camera")
    if result.objects is not None:
        names = Counter(result.objects.names)
        yield "objects: " + (", ".join(f"{n} {name}" for name, n in names.items()) or "none")
    findings = find_findings(FrameExplainer(result))
    yield from (f"{finding.what}: {finding.text}" for finding in findings if finding.what != "unnamed")


def _pictures(result: FrameResult) -> Iterator[Picture]:
    """Yield the camera images and the bird's-eye image of a frame."""
    for camera in result.cameras:
        picture = camera_picture(camera, PICTURE_WIDTH, labels=True, points=True)
        if picture is not None:
            yield Picture(jpeg(picture), f"{camera.camera.name}: thick: matched, thin: not; points by depth")
    if result.bev is not None:
        picture = shrink(result.bev.image, PICTURE_WIDTH)[0]
        reach = f"{result.bev.range_x:g} m ahead and behind, {result.bev.range_y:g} m to the sides"
        yield Picture(jpeg(picture), f"bird's-eye view: {reach}", tall=True)


# --- the whole window --------------------------------------------------------------------------


def _strip(summary: WindowSummary, facts: Facts) -> Iterator[StripFrame]:
    """Yield the strip of small frames."""
    distances = [abs(frame.received - summary.at) for frame, _ in summary.strip]
    for (frame, pictures), distance in zip(summary.strip, distances, strict=True):
        label = f"{(frame.received - facts.start) / SECOND:.2f} s, frame {frame.index}"
        yield StripFrame(label, pictures, distance == min(distances))


def _totals(summary: WindowSummary) -> Iterator[DecisionTotal]:
    """Yield the number of each decision and its frames, with matched and quiet decisions last."""
    frames: dict[tuple[str, str, str], list[int]] = defaultdict(list)
    total: Counter[tuple[str, str, str]] = Counter()
    for frame in summary.frames:
        total += frame.states
        for key in frame.states:
            frames[key].append(frame.index)
    for key in sorted(total, key=lambda key: (key[0] != "detection", key[1], key[2] in _QUIET, -total[key])):
        subject, name, state = key
        yield DecisionTotal(f"{name} {subject}".strip(), state, total[key], spans(frames[key]))


def spans(numbers: Sequence[int]) -> str:
    """Return sorted numbers as text, with neighbours joined to spans.

    >>> spans([1, 2, 3, 7, 9, 10])
    '1-3, 7, 9-10'
    """
    groups: list[list[int]] = []
    for number in numbers:
        if groups and number == groups[-1][1] + 1:
            groups[-1][1] = number
        else:
            groups.append([number, number])
    return ", ".join(f"{first}-{last}" if first < last else f"{first}" for first, last in groups)


def _plots(summary: WindowSummary, facts: Facts) -> Iterator[Plot]:
    """Yield the plots of health data over the window."""
    at = (summary.at - facts.start) / SECOND
    counted = ("clusters", "detections", "matches", "problems", "failures")
    for title, prefix, names in (
        ("Stage times, ms", entities.STAGE_TIME.path(""), None),
        ("Image stamp - cloud stamp, ms", entities.SYNC_ERROR.path(""), None),
        ("Age of the transforms, ms", entities.TF_AGE.path(""), None),
        ("Counts", entities.COUNT.path(""), counted),
        ("Points", entities.COUNT.path(""), ("points", "voxels", "obstacle_points")),
        ("Scans left out, invalid points", entities.COUNT.path(""), ("skipped_frames", "invalid_points")),
    ):
        if (drawn := plot(title, _series(summary, facts, prefix, names), at)) is not None:
            yield drawn


def _series(
    summary: WindowSummary, facts: Facts, prefix: str, names: Sequence[str] | None
) -> Mapping[str, Series]:
    """Return (seconds, value) pairs of each scalar below ``prefix``, by name."""
    series: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for frame in summary.frames:
        for path, value in frame.health.items():
            name = path.removeprefix(prefix)
            if path.startswith(prefix) and value == value and (names is None or name in names):
                series[name].append(((frame.received - facts.start) / SECOND, value))
    return series
