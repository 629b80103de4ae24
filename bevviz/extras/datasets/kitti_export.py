"""Export to the layout of KITTI's object benchmark (Geiger et al. 2012)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bevviz.extras.datasets.folder_export import FolderExport, encode_image, rectify
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, U8, Camera, Intrinsics
from bevviz.model.results import FrameResult, Objects

TYPES = {  # KITTI type by class name; other classes become Misc
    "car": "Car",
    "van": "Van",
    "truck": "Truck",
    "bus": "Truck",
    "person": "Pedestrian",
    "pedestrian": "Pedestrian",
    "bicycle": "Cyclist",
    "motorcycle": "Cyclist",
    "cyclist": "Cyclist",
    "train": "Tram",
    "tram": "Tram",
}
UNKNOWN = 0  # occlusion; a detected object counts as visible


class KittiExport(FolderExport):
    """Observer that writes frames. It skips a frame without an image, a calibration or a camera pose.

    Points are those that bevviz works on: upright, z up, several LiDARs merged. Images are rectified, so P2
    projects into them. Only the images of one camera are written: ``camera``, or the first camera.
    """

    def _folders(self, cameras: Sequence[str]) -> Sequence[str]:
        return "velodyne", "image_2", "calib", "label_2"

    def observe(self, result: FrameResult) -> None:
        """Write a frame, or count why it is skipped."""
        frame = result.frame
        camera = next((c for c in frame.cameras if self._takes(c.name)), None)
        if camera is None or camera.image is None or camera.intrinsics is None:
            self._skip("no image, or no CameraInfo")
        elif camera.camera_from_points is None:
            self._skip("no transform to the camera")
        else:
            self._write(result, camera, camera.image.bgr, camera.intrinsics, camera.camera_from_points)

    def _write(
        self, result: FrameResult, camera: Camera, bgr: U8, intrinsics: Intrinsics, camera_from_points: F64
    ) -> None:
        frame, name = result.frame, f"{self.frames:06}"
        intensity = frame.fields.get("intensity")
        points = np.zeros((len(frame.points), 4), np.float32)
        points[:, :3] = frame.points
        if intensity is not None:
            points[:, 3] = intensity
        lines = [] if result.objects is None else label_lines(result.objects, intrinsics, camera_from_points)
        with self._saving():
            self._write_file(f"velodyne/{name}.bin", points.tobytes())
            self._write_file(f"image_2/{name}.png", encode_image(rectify(bgr, intrinsics), ".png"))
            self._write_file(f"calib/{name}.txt", calibration(intrinsics.K, camera_from_points).encode())
            self._write_file(f"label_2/{name}.txt", "".join(f"{line}\n" for line in lines).encode())
        self.frames += 1
        self.labels += len(lines)


def calibration(K: F64, camera_from_points: F64) -> str:
    """Return the text of a calibration. The camera is the reference, and P0 to P3 are all its own."""
    projection = np.column_stack([K, np.zeros(3)])
    rows = {f"P{number}": projection for number in range(4)}
    rows |= {"R0_rect": np.eye(3), "Tr_velo_to_cam": camera_from_points[:3], "Tr_imu_to_velo": np.eye(4)[:3]}
    lines = (f"{name}: {' '.join(f'{v:.12e}' for v in matrix.ravel())}" for name, matrix in rows.items())
    return "".join(f"{line}\n" for line in lines)


def label_lines(objects: Objects, intrinsics: Intrinsics, camera_from_points: F64) -> list[str]:
    """Return a line for each object in the image: KITTI's fifteen columns and the score.

    Occlusion is unknown and stated as 0.
    """
    flat = Intrinsics(intrinsics.width, intrinsics.height, intrinsics.K)
    width, height = intrinsics.width, intrinsics.height
    lines = []
    corners = geometry.corners(objects.boxes)
    for row, name in enumerate(objects.names):
        uv, _ = geometry.project(geometry.apply(camera_from_points, corners[row]), flat)
        if not np.isfinite(uv).all():
            continue  # The object is partly behind the camera.
        low, high = uv.min(axis=0), uv.max(axis=0)
        inside = np.clip(np.concatenate([low, high]), 0, [width - 1, height - 1] * 2)
        area, whole = _area(inside), _area(np.concatenate([low, high]))
        if area <= 0 or whole <= 0:
            continue
        center, size = objects.boxes.center[row].astype(np.float64), objects.boxes.size[row]
        # A location is the centre of the bottom, in the camera frame, where boxes stand upright.
        x, y, z = camera_from_points[:3, :3] @ center + camera_from_points[:3, 3] + [0, size[2] / 2, 0]
        yaw = float(objects.boxes.yaw[row])
        ahead = camera_from_points[:3, :3] @ [np.cos(yaw), np.sin(yaw), 0]
        turn = float(np.arctan2(-ahead[2], ahead[0]))
        alpha = (turn - np.arctan2(x, z) + np.pi) % (2 * np.pi) - np.pi
        length, broad, tall = map(float, size)
        numbers = [alpha, *inside, tall, broad, length, x, y, z, turn, float(objects.score[row])]
        text = " ".join(f"{value:.4f}" for value in numbers)
        lines.append(f"{TYPES.get(name.lower(), 'Misc')} {max(0, 1 - area / whole):.2f} {UNKNOWN} {text}")
    return lines


def _area(box: F32) -> float:
    return float(np.prod(np.maximum(box[2:] - box[:2], 0)))
