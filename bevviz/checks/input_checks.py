"""The one list of findings about the input, for every command."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

from bevviz.anomalies import Onsets
from bevviz.anomalies.sensors import SensorWatch
from bevviz.checks.camera_views import CameraView, view_of
from bevviz.checks.detector import count_boxes, misplaced_boxes, silent_detector
from bevviz.checks.extrinsics import wrong_extrinsics
from bevviz.checks.labels import count_labels, wrong_labels
from bevviz.checks.read_input import CameraSample, ReadInput
from bevviz.config import Config
from bevviz.model.frame import Frame
from bevviz.model.input_findings import InputFinding
from bevviz.model.protocols import Items, Observer
from bevviz.model.results import Anomaly, CameraResult, FrameResult

Check = Callable[[ReadInput], Iterable[InputFinding]]

VIEWS = 6  # most images of a camera that are kept; those with detections replace others
SENSOR_KINDS = ("sensor", "sync", "tf")  # kinds of anomalies that are about the input


def source_warnings(read: ReadInput) -> Iterator[InputFinding]:
    """Yield what the source counted while it was read."""
    for text in read.source.warnings:
        yield InputFinding("source", "", text)


def sensor_faults(read: ReadInput) -> Iterator[InputFinding]:
    """Yield each kind of fault of each sensor, with the first time and the number of times."""
    for key, anomaly in read.faults.first.items():
        count = read.faults.count[key]
        text = f"{anomaly.text}; {count} times in all" if count > 1 else anomaly.text
        yield InputFinding(anomaly.kind, anomaly.subject, text)


CHECKS: tuple[Check, ...] = (
    source_warnings,
    wrong_extrinsics,
    silent_detector,
    misplaced_boxes,
    wrong_labels,
    sensor_faults,
)


class InputChecks(Observer[FrameResult]):
    """Collector of what the checks judge, and the list of their findings.

    It is an observer of a run. ``observe_frame`` takes frames without results instead.

    Args:
        source: the frames.
        config: configuration of the run.
    """

    def __init__(self, source: Items[object], config: Config) -> None:
        self._read = ReadInput(source, config)
        self._lock = threading.Lock()  # A page or a topic may ask for the list during a run.
        self._onsets = Onsets()
        self._watch = SensorWatch()

    def observe(self, result: FrameResult) -> None:
        """Collect what the checks need of one result."""
        self._collect(result, self._onsets.of(result.anomalies))

    def observe_frame(self, frame: Frame, follows: bool = True) -> None:
        """Collect what the checks need of a frame on which no stage ran.

        Args:
            frame: the frame.
            follows: it follows the frame before, so that sensors are compared with their past.
        """
        result = FrameResult.unprocessed(frame, self._read.config)
        faults = self._watch.update(frame, None, None) if follows else []
        self._collect(result, self._onsets.of(faults))

    def watched(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the frames, and collect what the checks need of each."""
        for frame in frames:
            self.observe_frame(frame, follows=False)
            yield frame

    def _collect(self, result: FrameResult, new: Iterable[Anomaly]) -> None:
        """Collect what the checks need of one frame, with the anomalies that began in it."""
        with self._lock:
            for anomaly in new:
                if anomaly.kind in SENSOR_KINDS:
                    key = anomaly.kind, anomaly.subject
                    self._read.faults.first.setdefault(key, anomaly)
                    self._read.faults.count[key] += 1
            count_labels(self._read.labels, result.frame)
            for row, camera in enumerate(result.cameras):
                if camera.detections is not None:
                    self._read.images += 1
                    self._read.answered += bool(len(camera.detections))
                    count_boxes(self._read.boxes, camera)
                sample = self._read.cameras.get(camera.camera.name)
                if sample is None or _needs_more(sample.views, camera):
                    view = view_of(result, row, result.config.objects.sizes)
                    if view is not None:
                        self._read.cameras[camera.camera.name] = _with(sample, view, result, camera)
            self._read.config = result.config

    @property
    def findings(self) -> list[InputFinding]:
        """All findings so far. A sentence is listed once."""
        with self._lock:
            findings = {str(finding): finding for check in CHECKS for finding in check(self._read)}
        return list(findings.values())

    @property
    def warnings(self) -> list[str]:
        """The same as sentences."""
        return [str(finding) for finding in self.findings]

    def warnings_beside(self, printed: Collection[str]) -> list[str]:
        """Return the sentences that are not among those printed before."""
        return [text for text in self.warnings if text not in printed]


def _needs_more(views: Sequence[CameraView], camera: CameraResult) -> bool:
    """Return whether another image of a camera would tell more than those of the sample."""
    has_detections = camera.detections is not None and bool(camera.detections.kept.any())
    return has_detections and (len(views) < VIEWS or not all(len(view.inner) for view in views))


def _with(
    sample: CameraSample | None, view: CameraView, result: FrameResult, camera: CameraResult
) -> CameraSample:
    """Return the sample with another image. An image with detections takes the place of one without any."""
    assert camera.camera.image is not None
    views = [] if sample is None else [v for v in sample.views if len(v.inner) or not len(view.inner)]
    if len(view.inner) or not views:
        views.append(view)
    return CameraSample(result.frame.points_frame, camera.camera.image.frame_id.lstrip("/"), views)
