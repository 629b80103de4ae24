"""Frames whose cameras are stated at a wrong place, angle or time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from bevviz.extras.calib.result import TIME, Calibration, error_pose
from bevviz.extras.calib.score import gather
from bevviz.extras.calib.solve import calibrate
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.model import geometry
from bevviz.model.frame import F64, Camera, Cloud, Frame, Image, Intrinsics

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


class Kitti:
    """Real frames, whose own calibration is taken for the truth. Nothing tells how the car moved."""

    def __init__(self, folder: Path, numbers: Iterable[int]) -> None:
        self.frames = [_read(folder, number) for number in numbers]

    def calibrate(self, offsets: F64, chosen: Sequence[int] | None = None) -> Calibration:
        frames = self.frames if chosen is None else [self.frames[i] for i in chosen]
        return calibrate(gather(stated_wrongly(frames, offsets), ["image_2"], _nowhere)["image_2"])


def _nowhere(frame: Frame, stamp: int) -> None:
    return None


def _read(folder: Path, number: int) -> Frame:
    calibration = folder / "calib" / f"{number:06}.txt"
    lines = (calibration if calibration.exists() else folder / "calib.txt").read_text().splitlines()
    rows = {
        name: np.array(values.split(), np.float64)
        for name, values in (line.split(":") for line in lines if line)
    }
    projection = rows["P2"].reshape(3, 4)
    beside, rectified, reference = np.eye(4), np.eye(4), np.eye(4)
    beside[:3, 3] = np.linalg.solve(projection[:, :3], projection[:, 3])
    rectified[:3, :3] = rows["R0_rect"].reshape(3, 3)
    reference[:3] = rows["Tr_velo_to_cam"].reshape(3, 4)
    bgr = cv2.imread(str(folder / "image_2" / f"{number:06}.png"))
    assert bgr is not None
    points = np.fromfile(folder / "velodyne" / f"{number:06}.bin", np.float32).reshape(-1, 4)
    xyz = np.ascontiguousarray(points[:, :3])
    camera = Camera(
        "image_2",
        Image(0, "image_2", np.asarray(bgr, np.uint8)),
        Intrinsics(bgr.shape[1], bgr.shape[0], projection[:, :3]),
        beside @ rectified @ reference,
        None,
    )
    cloud = Cloud(0, "velodyne", xyz, {"intensity": points[:, 3]})
    return Frame(
        number, 0, 0, "velodyne", xyz, "velodyne",
        clouds=(cloud,), points_from_clouds=(np.eye(4),), cameras=(camera,),
    )  # fmt: skip
