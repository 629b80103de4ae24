"""The KITTI object benchmark: labelled, unrelated frames of many drives."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from bevviz.datasets.dataset import BOXES, IMAGES, SECOND, Dataset, Stream, files_in, image_stream
from bevviz.datasets.kitti import (
    LIDAR,
    MAP,
    Calibration,
    cloud_stream,
    ground_truth_stream,
    mounting_stream,
    named_rows,
    read_labels,
)
from bevviz.errors import UserError
from bevviz.messages.encode import encode_intrinsics, encode_transforms
from bevviz.model import geometry
from bevviz.model.frame import Intrinsics

CAMERA = "image_2"
FRAME_GAP = 100 * SECOND  # nanoseconds between frames: they are unrelated, so none may influence the next


class KittiObject(Dataset):
    """Frames of ``velodyne/000000.bin`` and ``calib/000000.txt``; optional ``image_2``, ``label_2``."""

    name = "kitti-object"
    about = "KITTI object benchmark"
    expects = "velodyne/000000.bin and calib/000000.txt, mostly image_2/000000.png and label_2/000000.txt too"
    single_frames = True

    @classmethod
    def fits(cls, path: Path) -> bool:
        """Tell whether a folder has the layout of the benchmark."""
        if any((path / "calib").glob("[0-9]" * 6 + ".txt")):
            return (path / "velodyne").is_dir()
        # Sets in this layout name frames differently: View of Delft by five digits, converters by tokens.
        calibrations = [path / f"calib/{scan.stem}.txt" for scan in files_in(path / "velodyne", [".bin"])[:1]]
        return any("Tr_velo_to_cam" in named_rows(file) for file in calibrations if file.is_file())

    def __init__(self, path: Path, sequence: str) -> None:
        super().__init__(path, sequence)
        scans = files_in(path / "velodyne", [".bin"])
        if not scans:
            raise UserError(f"{path / 'velodyne'}: no scan in it; expected 000000.bin")
        fields = self.column_names(scans)
        self.check_sizes(scans, 4 * len(fields))
        times = FRAME_GAP * np.arange(1, len(scans) + 1, dtype=np.int64)
        names = [scan.stem for scan in scans]

        @lru_cache(maxsize=8)
        def calibration(row: int) -> Calibration:
            return Calibration(path / f"calib/{names[row]}.txt")

        def mounting(row: int) -> Any:
            _, camera_from_lidar = calibration(row).camera(2)
            edge = (LIDAR, CAMERA, geometry.inverse(camera_from_lidar))
            return encode_transforms(int(times[row]), [edge])

        # Each frame has its own map with the LiDAR at the origin.
        self.streams = [
            mounting_stream(int(times[0]), [(MAP, LIDAR, np.eye(4))]),
            Stream("/tf", "tf2_msgs/msg/TFMessage", times, mounting),
        ]
        images = {image.stem: image for image in files_in(path / CAMERA, IMAGES)}
        with_image = [row for row, name in enumerate(names) if name in images]
        if with_image:
            image_times = times[with_image]

            def info(row: int) -> Any:
                matrix, _ = calibration(with_image[row]).camera(2)
                return encode_intrinsics(int(image_times[row]), CAMERA, Intrinsics(0, 0, matrix))

            self.streams += [
                Stream(f"/{CAMERA}/camera_info", "sensor_msgs/msg/CameraInfo", image_times, info),
                image_stream(CAMERA, image_times, [images[names[row]] for row in with_image]),
            ]
        labels = [path / f"label_2/{name}.txt" for name in names]
        with_labels = [row for row, file in enumerate(labels) if file.is_file()]
        if with_labels:
            self.streams.append(
                ground_truth_stream(
                    BOXES, times[with_labels], lambda row: read_labels(labels[with_labels[row]])
                )
            )
        self.streams.append(cloud_stream(times, scans, fields))
