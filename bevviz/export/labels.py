"""Export of detections as COCO, and of objects as OpenLABEL (ASAM OpenLABEL 1.0.0)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bevviz.export.folder import FolderExport
from bevviz.model import geometry
from bevviz.model.frame import Camera, Frame, Image
from bevviz.model.results import CameraResult, FrameResult, Objects, Tracks

LABELS = "labels.json"
SUFFIXES = {"image/jpeg": "jpg", "image/png": "png"}
LIDAR, FIXED = "lidar", "map"  # names in OpenLABEL


class LabelExport(FolderExport):
    """Observer that writes images as they came, in ``images/CAMERA/NUMBER``, and labels at the end."""

    def _folders(self, cameras: Sequence[str]) -> Sequence[str]:
        return [f"images/{name}" for name in cameras if self._takes(name)]

    def _write_image(self, camera: str, image: Image, number: int) -> str:
        """Write an image and return its path. One that came compressed is not touched.

        Raises:
            OSError: the image cannot be encoded or written.
        """
        data, suffix = image.encoded, SUFFIXES.get(image.media_type)
        if not (data and suffix):
            done, encoded = cv2.imencode(".png", image.bgr)
            if not done:
                raise OSError(0, "the image cannot be written")
            data, suffix = encoded.tobytes(), "png"
        name = f"images/{camera}/{number:06}.{suffix}"
        (self._folder / name).write_bytes(data)
        return name


class CocoExport(LabelExport):
    """Observer that writes images with the kept detections, as COCO's object detection has them.

    Boxes have the score of the detector.
    """

    def __init__(self, folder: Any, camera: str = "") -> None:
        super().__init__(folder, camera)
        self._images: list[dict[str, Any]] = []
        self._annotations: list[dict[str, Any]] = []
        self._categories: dict[str, int] = {}

    def observe(self, result: FrameResult) -> None:
        """Write the images of a frame, or count why it is skipped."""
        chosen = [c for c in result.cameras if self._takes(c.camera.name) and c.camera.image is not None]
        if not chosen:
            self._skip("no image")
            return
        for camera in chosen:
            with self._saving():
                self._write(result.frame, camera)
        self.frames += 1

    def _write(self, frame: Frame, result: CameraResult) -> None:
        camera = result.camera
        assert camera.image is not None
        name = self._write_image(camera.name, camera.image, frame.index)
        height, width = camera.image.bgr.shape[:2]
        number = len(self._images) + 1
        self._images.append({"id": number, "file_name": name, "width": width, "height": height})
        detections = result.detections
        for row in np.flatnonzero(detections.kept) if detections is not None else ():
            assert detections is not None
            category = self._categories.setdefault(detections.names[row], len(self._categories) + 1)
            x0, y0, x1, y1 = (float(value) for value in detections.xyxy[row])
            self._annotations.append(
                {
                    "id": len(self._annotations) + 1,
                    "image_id": number,
                    "category_id": category,
                    "bbox": [x0, y0, x1 - x0, y1 - y0],
                    "area": (x1 - x0) * (y1 - y0),
                    "iscrowd": 0,
                    "score": float(detections.score[row]),
                }
            )
            self.labels += 1

    def end(self) -> None:
        """Write the annotations."""
        categories = [{"id": number, "name": name} for name, number in self._categories.items()]
        tree = {"images": self._images, "annotations": self._annotations, "categories": categories}
        with self._saving():
            (self._folder / LABELS).write_text(json.dumps({"info": {"description": "bevviz"}, **tree}))


class OpenLabelExport(LabelExport):
    """Observer that writes clouds, images and the objects as cuboids, with the ids of their tracks.

    Cuboids are in the frame of the points, whose pose in the fixed frame is stated for each frame.
    """

    def __init__(self, folder: Any, camera: str = "") -> None:
        super().__init__(folder, camera)
        self._objects: dict[str, dict[str, Any]] = {}
        self._frames: dict[str, dict[str, Any]] = {}
        self._systems: dict[str, dict[str, Any]] = {
            FIXED: {"type": "scene_cs", "parent": "", "children": [LIDAR]},
            LIDAR: {"type": "sensor_cs", "parent": FIXED, "children": []},
        }
        self._streams: dict[str, dict[str, Any]] = {LIDAR: {"type": "lidar", "uri": f"{LIDAR}/"}}

    def _folders(self, cameras: Sequence[str]) -> Sequence[str]:
        return [LIDAR, *super()._folders(cameras)]

    def observe(self, result: FrameResult) -> None:
        """Write a frame, or count why it is skipped."""
        frame = result.frame
        if not frame.lidar:
            self._skip("no scan")
            return
        streams = {LIDAR: {"uri": f"{LIDAR}/{frame.index:06}.pcd"}}
        with self._saving():
            _write_pcd(self._folder / streams[LIDAR]["uri"], frame)
            for camera in frame.cameras:
                if camera.image is not None and self._takes(camera.name):
                    name = self._write_image(camera.name, camera.image, frame.index)
                    streams[camera.name] = {"uri": name}
                    self._state_camera(camera)
        self._frames[str(frame.index)] = {
            "frame_properties": {
                "timestamp": f"{frame.stamp / 1e9:.9f}",
                "streams": {name: {"stream_properties": about} for name, about in streams.items()},
                "transforms": {
                    f"{LIDAR}_to_{FIXED}": {
                        "src": LIDAR,
                        "dst": FIXED,
                        "transform_src_to_dst": {"matrix4x4": frame.pose.reshape(-1).tolist()},
                    }
                },
            },
            "objects": {} if result.objects is None else self._cuboids(frame, result.objects, result.tracks),
        }
        self.frames += 1

    def _state_camera(self, camera: Camera) -> None:
        """State lens and mounting of a camera once."""
        if camera.name in self._streams or camera.intrinsics is None or camera.image is None:
            return
        about, (height, width) = camera.intrinsics, camera.image.bgr.shape[:2]
        matrix = np.column_stack([about.K, np.zeros(3)])
        pinhole = {
            "camera_matrix_3x4": matrix.reshape(-1).tolist(),
            "distortion_coeffs_1xN": np.asarray(about.D).tolist(),
            "height_px": height,
            "width_px": width,
        }
        self._streams[camera.name] = {
            "type": "camera",
            "uri": f"images/{camera.name}/",
            "stream_properties": {"intrinsics_pinhole": pinhole},
        }
        if camera.camera_from_points is not None:
            pose = geometry.inverse(camera.camera_from_points)
            self._systems[LIDAR]["children"].append(camera.name)
            self._systems[camera.name] = {
                "type": "sensor_cs",
                "parent": LIDAR,
                "children": [],
                "pose_wrt_parent": {"matrix4x4": pose.reshape(-1).tolist()},
            }

    def _cuboids(self, frame: Frame, objects: Objects, tracks: Tracks | None) -> dict[str, Any]:
        """Return the objects of a frame by the number of the track, or a negative number without one."""
        ids: dict[int, str] = {}
        if tracks is not None:
            named = zip(tracks.id.tolist(), tracks.object.tolist(), strict=True)
            ids = {row: str(number) for number, row in named if row >= 0}
        found = {}
        for row, name in enumerate(objects.names):
            key = ids.get(row, str(-1 - self.labels))  # numbers, as the schema wants them
            label = {"name": f"{name} {key}", "type": name, "frame_intervals": []}
            about = self._objects.setdefault(key, label)
            _extend(about["frame_intervals"], frame.index)
            turn = float(objects.boxes.yaw[row]) / 2
            center, size = objects.boxes.center[row].tolist(), objects.boxes.size[row].tolist()
            cuboid = {
                "name": "box",
                "val": [*center, 0.0, 0.0, float(np.sin(turn)), float(np.cos(turn)), *size],
                "coordinate_system": LIDAR,
                "attributes": {"num": [{"name": "score", "val": float(objects.score[row])}]},
            }
            found[key] = {"object_data": {"cuboid": [cuboid]}}
            self.labels += 1
        return found

    def end(self) -> None:
        """Write the labels."""
        intervals: list[dict[str, int]] = []
        for number in self._frames:
            _extend(intervals, int(number))
        tree = {
            "metadata": {"schema_version": "1.0.0", "annotator": "bevviz"},
            "coordinate_systems": self._systems,
            "streams": self._streams,
            "objects": self._objects,
            "frames": self._frames,
            "frame_intervals": intervals,
        }
        with self._saving():
            (self._folder / LABELS).write_text(json.dumps({"openlabel": tree}))


def _extend(intervals: list[dict[str, int]], number: int) -> None:
    """Add a frame to the intervals of an object."""
    if intervals and intervals[-1]["frame_end"] == number - 1:
        intervals[-1]["frame_end"] = number
    else:
        intervals.append({"frame_start": number, "frame_end": number})


def _write_pcd(path: Path, frame: Frame) -> None:
    """Write the points as a binary PCD file."""
    from pypcd4.pypcd4 import PointCloud

    points = np.zeros((len(frame.points), 4), np.float32)
    points[:, :3] = frame.points
    if "intensity" in frame.fields:
        points[:, 3] = frame.fields["intensity"]
    PointCloud.from_xyzi_points(points).save(path)
