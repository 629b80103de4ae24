"""Content of the input that the checks judge: the source, and a sample of what was read from it."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field

from bevviz.bags.source import BagSource
from bevviz.checks.camera_views import CameraView
from bevviz.config import Config
from bevviz.model.input_findings import InputFinding
from bevviz.model.protocols import Items
from bevviz.model.results import Anomaly


@dataclass(slots=True)
class SensorFaults:
    """Faults of sensors, clocks and transforms, by kind and subject."""

    first: dict[tuple[str, str], Anomaly] = field(default_factory=dict)
    count: Counter[tuple[str, str]] = field(default_factory=Counter)


@dataclass(slots=True)
class CameraSample:
    """Sample of the images of one camera.

    Attributes:
        points_frame: frame of the points, as ``source.extrinsics`` names it.
        image_frame: frame of the images.
        views: the images, at least one.
        finding: finding about the camera's pose, if it is judged.
        judged: whether the pose is judged. It is judged again after another image.
    """

    points_frame: str
    image_frame: str
    views: list[CameraView]
    finding: InputFinding | None = None
    judged: bool = False


@dataclass(slots=True)
class ReadInput:
    """What was read of a drive or from a robot so far.

    Attributes:
        source: the frames. Its ``warnings`` are the oddities that it counted.
        config: configuration of the run.
        faults: faults of the sensors in the frames.
        cameras: sample of the images of each placed camera, by name.
        images: images that the detector judged.
        answered: those for which it had a candidate, however weak.
        boxes: its kept boxes, and those that are odd, see ``bevviz.checks.detector``.
        labels: boxes near the LiDAR, and those that are odd, by "ground truth" or the topic of a result file.
    """

    source: Items[object]
    config: Config
    faults: SensorFaults = field(default_factory=SensorFaults)
    cameras: dict[str, CameraSample] = field(default_factory=dict)
    images: int = 0
    answered: int = 0
    boxes: Counter[str] = field(default_factory=Counter)
    labels: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))

    @property
    def bag(self) -> BagSource | None:
        """The recorded drive; None: the frames are a robot's or the synthetic drive's."""
        return self.source if isinstance(self.source, BagSource) else None
