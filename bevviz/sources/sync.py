"""Brings clouds, images, transforms and boxes of one time together into frames; the LiDAR drives."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from bevviz.config import Config
from bevviz.frame import Cloud, Frame, Image, Intrinsics, LabelledBoxes2D, LabelledBoxes3D
from bevviz.sources.messages import StampedTransform
from bevviz.sources.roles import Roles


@dataclass(slots=True)
class SyncReport:
    """What arrived, what was lost and what looked wrong so far."""

    clouds: int = 0
    frames: int = 0

    def warnings(self) -> tuple[str, ...]:
        """One sentence each."""
        raise NotImplementedError


class Synchronizer:
    """Bounded in memory; the same for a bag and a live robot. Messages come in the order of receipt."""

    report: SyncReport

    def __init__(self, roles: Roles, config: Config) -> None:
        raise NotImplementedError

    def add_cloud(self, cloud: Cloud) -> None:
        """A scan of a LiDAR, told by ``cloud.topic``."""
        raise NotImplementedError

    def add_image(
        self, topic: str, stamp: int, frame_id: str, received: int, load: Callable[[], Image]
    ) -> None:
        """An image not yet decoded: only the header is looked at, ``load`` is called when it is chosen.

        ``load`` may raise a UserError, which becomes a problem of that frame's camera.
        """
        raise NotImplementedError

    def add_camera_info(self, topic: str, intrinsics: Intrinsics) -> None:
        """``topic`` is that of the CameraInfo; the newest one holds."""
        raise NotImplementedError

    def add_transform(self, transform: StampedTransform, static: bool = False, fallback: bool = False) -> None:
        """``fallback``: taken from Odometry, used only where no other source has a parent for the child."""
        raise NotImplementedError

    def add_boxes(self, boxes: LabelledBoxes3D) -> None:
        """The robot's own 3D boxes."""
        raise NotImplementedError

    def add_detections(self, detections: LabelledBoxes2D) -> None:
        """The robot's own image boxes."""
        raise NotImplementedError

    def add_truth(self, truth: LabelledBoxes3D) -> None:
        """Ground truth boxes."""
        raise NotImplementedError

    def ready(self, now: int | None = None) -> Iterator[Frame]:
        """The frames, in order of stamp, that have all they wait for, or have waited long enough.

        ``now``: newest received time in nanoseconds; None: that of the messages added so far. Call it
        after every message, or every few.
        """
        raise NotImplementedError

    def flush(self) -> Iterator[Frame]:
        """The frames still held, at the end of the stream."""
        raise NotImplementedError
