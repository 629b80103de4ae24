"""Summary of a run for a page. It is collected frame by frame and stays small."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from bevviz.model.frame import Frame
from bevviz.model.results import FrameResult
from bevviz.recording.decisions import problem_lines
from bevviz.recording.health import FrameRates, health
from bevviz.report.pictures import camera_picture, jpeg, shrink
from bevviz.why.false_objects import false_reasons
from bevviz.why.frame_index import FrameIndex

STRIP_PICTURES = 48  # pictures of all cameras and the bird's-eye view together
STRIP_WIDTH = 400


@dataclass(frozen=True, slots=True)
class FrameSummary:
    """Summary of one frame. ``states`` counts decisions by subject, class and state."""

    index: int
    stamp: int
    received: int
    health: Mapping[str, float]  # by entity path
    states: Counter[tuple[str, str, str]]
    problems: tuple[str, ...]
    marks: tuple[str, ...] = ()  # notes of people


@dataclass(slots=True)
class WindowSummary:
    """Summary of the frames of a window.

    Args:
        at: receive time, in nanoseconds, of the scan that the report is about.
        stamp: stamp of that scan, which tells it from others of the same receive time. None: it is unknown.
        total: expected number of frames.
        cameras: number of cameras.
    """

    at: int
    stamp: int | None
    total: int
    cameras: int
    frames: list[FrameSummary] = field(default_factory=list)
    strip: list[tuple[FrameSummary, dict[str, bytes]]] = field(default_factory=list)  # JPEGs by sensor
    result: FrameResult | None = None  # of the scan, or of the nearest one to it
    tracebacks: Counter[tuple[str, str]] = field(default_factory=Counter)  # by stage and traceback
    _last: Frame | None = None
    _rates: FrameRates = field(default_factory=FrameRates)

    def add(self, result: FrameResult) -> FrameSummary:
        """Add the next frame, and return its summary."""
        frame = result.frame
        names = {
            camera_result.camera.name: camera_result.detections.names
            for camera_result in result.cameras
            if camera_result.detections is not None
        }
        states = Counter(
            (
                explanation.subject,
                names[explanation.camera][explanation.row] if explanation.subject == "detection" else "",
                explanation.state,
            )
            for explanation in result.explanations
            if explanation.subject != "camera"
        )
        word = "doubtful" if frame.truth is None else "false"
        for row, reason in false_reasons(FrameIndex(result)).items():
            assert result.objects is not None
            states["object", result.objects.names[row], f"{word}: {reason.kind.value}"] += 1
        self.tracebacks.update(
            (failure.stage, failure.traceback) for failure in result.failures if failure.traceback
        )
        problems = tuple(text for _, text in problem_lines(result))
        self._rates.add(frame)
        measured = dict(health(result, self._last, self._rates))
        marks = frame.around.marks if frame.around is not None else ()
        summary = FrameSummary(frame.index, frame.stamp, frame.received, measured, states, problems, marks)
        if self._is_for_strip(len(self.frames)):
            self.strip.append((summary, strip_pictures(result)))
        if self.result is None or self._distance(frame) < self._distance(self.result.frame):
            self.result = result
        self.frames.append(summary)
        self._last = frame
        return summary

    def is_about(self, frame: Frame) -> bool:
        """Return whether the report is about this frame."""
        return self._distance(frame) == (0, False)

    def _distance(self, frame: Frame) -> tuple[int, bool]:
        """Return the nanoseconds to the scan that the report is about, and whether it is another scan."""
        return abs(frame.received - self.at), self.stamp not in (None, frame.stamp)

    def _is_for_strip(self, number: int) -> bool:
        """Return whether the strip shows a frame. Its frames are spread evenly over the window."""
        count = min(self.total, max(2, STRIP_PICTURES // (1 + self.cameras)))
        return number * count // self.total != (number - 1) * count // self.total


def strip_pictures(result: FrameResult) -> dict[str, bytes]:
    """Return small pictures of a frame as JPEG, by sensor."""
    pictures = {
        camera_result.camera.name: camera_picture(camera_result, STRIP_WIDTH)
        for camera_result in result.cameras
    }
    if result.bev is not None:
        pictures["bird's-eye view"] = shrink(result.bev.image, STRIP_WIDTH)[0]
    return {name: jpeg(picture, 70) for name, picture in pictures.items() if picture is not None}
