"""Frames whose cameras are stated at a wrong place, angle or time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from tqdm import tqdm

from bevviz.calib import Calibration, calibrate, gather
from bevviz.calib.offsets import TIME, error_pose
from bevviz.model import geometry
from bevviz.model.frame import F64, Frame
from bevviz.synthetic import SyntheticSource

EVERY = 3  # frames of the synthetic drive from one that is taken to the next


def stated_wrongly(frames: Iterable[Frame], offsets: F64) -> Iterator[Frame]:
    """Yield the frames with the mounting of their first camera wrong by (7,) ``offsets`` (rad, metres)."""
    stated_from_true = geometry.inverse(error_pose(offsets))
    for frame in frames:
        camera = frame.cameras[0]
        assert camera.camera_from_points is not None
        wrong = replace(camera, camera_from_points=stated_from_true @ camera.camera_from_points)
        yield replace(frame, cameras=(wrong,))


class Drive:
    """Frames of a synthetic drive, rendered once: an error of what is stated changes no pixel, no point."""

    def __init__(self, frames: int, seed: int, weave: bool, every: int = EVERY) -> None:
        self.source = SyntheticSource(frames, seed, weave=weave)
        numbers = tqdm(range(0, frames, every), unit="scan", desc="simulate", disable=None, leave=False)
        self.frames = [self.source.snapshot(i).frame for i in numbers]

    def pose(self, frame: Frame, stamp: int) -> F64:
        return self.source.map_from_base(stamp) @ self.source.base_from_lidar

    def planted(self, offsets: F64) -> Iterator[Frame]:
        """Yield the frames as a robot delivers them whose calibration is wrong by (7,) ``offsets``."""
        camera_from_lidar = geometry.inverse(self.source.base_from_camera) @ self.source.base_from_lidar
        stated = geometry.inverse(error_pose(offsets)) @ camera_from_lidar
        for frame in self.frames:
            camera = frame.cameras[0]
            assert camera.image is not None
            stamp = camera.image.stamp + round(offsets[TIME] * 1e9)
            moved = geometry.inverse(self.pose(frame, stamp)) @ self.pose(frame, frame.stamp)
            image = replace(camera.image, stamp=stamp)
            wrong = replace(camera, image=image, camera_from_points=stated @ moved)
            yield replace(frame, cameras=(wrong,))

    def calibrate(self, offsets: F64) -> Calibration:
        return calibrate(gather(self.planted(offsets), ["zed"], self.pose)["zed"])
