"""Export of a scene with the tables of nuScenes (Caesar et al. 2020), in the form that its devkit reads."""

from __future__ import annotations

import hashlib
import json
import re
from collections import defaultdict
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bevviz.extras.datasets.folder_export import FolderExport, encode_image, rectify
from bevviz.model import geometry
from bevviz.model.box_points import inside_each
from bevviz.model.frame import F32, F64, Camera, Frame
from bevviz.model.protocols import Items
from bevviz.model.results import FrameResult, Objects, Tracks

VERSION = "v1.0-bevviz"
TABLES = (
    *("attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample"),
    *("sample_annotation", "sample_data", "scene", "sensor", "visibility"),
)
# Tables with the same tokens in every scene, so that tables of several scenes can be joined.
SHARED = ("category", "sensor")
LIDAR = "LIDAR_TOP"
MAP = "maps/unknown.png"  # placeholder for the map that the devkit requires
JPEG_QUALITY = 95
CATEGORIES = {  # nuScenes category by class name; another class becomes its own category
    "car": "vehicle.car",
    "van": "vehicle.car",
    "truck": "vehicle.truck",
    "bus": "vehicle.bus.rigid",
    "trailer": "vehicle.trailer",
    "construction_vehicle": "vehicle.construction",
    "motorcycle": "vehicle.motorcycle",
    "bicycle": "vehicle.bicycle",
    "cyclist": "vehicle.bicycle",
    "person": "human.pedestrian.adult",
    "pedestrian": "human.pedestrian.adult",
    "barrier": "movable_object.barrier",
    "traffic_cone": "movable_object.trafficcone",
    "traffic cone": "movable_object.trafficcone",
}


class NuScenesExport(FolderExport):
    """Observer that writes each frame as a sample: scan, camera images, and objects as annotations.

    The vehicle frame is the points frame: upright, z up, several LiDARs merged. Images are rectified, and
    each has the vehicle pose at its own time. An instance is a track. Its category is its most frequent
    class, weighted by score. The tables are written at the end, also of an interrupted run.
    """

    def __init__(self, folder: Path, camera: str = "") -> None:
        super().__init__(folder, camera)
        self._tables: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
        self._previous_rows: dict[tuple[str, str], dict[str, Any]] = {}  # previous row by table and chain
        self._channels: dict[str, str] = {}
        self._tokens: dict[tuple[str, str], str] = {}  # tokens of shared rows by table and key
        self._annotations: dict[str, list[str]] = defaultdict(list)
        # Summed score by instance and class.
        self._class_scores: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
        self._scene, self._start = "", 0  # scene name, and stamp of the first frame in nanoseconds

    def _prepare(self, items: Items[object]) -> None:
        """Write the placeholder map and begin the visibility table."""
        self._scene = items.scene.name
        self._write_file(MAP, encode_image(np.zeros((8, 8), np.uint8), ".png"))
        for token, level in (("1", "v0-40"), ("2", "v40-60"), ("3", "v60-80"), ("4", "v80-100")):
            self._tables["visibility"].append({"token": token, "level": level, "description": ""})

    def _folders(self, cameras: Sequence[str]) -> Sequence[str]:
        channels = [self._channel(name) for name in cameras if self._takes(name)]
        return VERSION, "maps", "sweeps", *(f"samples/{name}" for name in (LIDAR, *channels))

    def _channel(self, camera: str) -> str:
        name = re.sub(r"[^A-Z0-9]+", "_", camera.upper()).strip("_").removeprefix("CAM_") or "CAMERA"
        others_channels = {channel for other, channel in self._channels.items() if other != camera}
        channel = f"CAM_{name}"
        while channel in others_channels:
            channel += "_"
        return self._channels.setdefault(camera, channel)

    def observe(self, result: FrameResult) -> None:
        """Write a frame as a sample, or count why it is skipped."""
        frame = result.frame
        if not frame.lidar:
            self._skip("no scan")
            return
        self._start = self._start or frame.stamp
        scene, token = self._token("scene"), self._token("sample", self.frames)
        sample = self._add_linked("sample", "", token, timestamp=_micros(frame.stamp), scene_token=scene)
        with self._saving():
            name = self._write_points(frame)
            mounted = self._calibrated(LIDAR, "lidar", np.eye(4), [])
            self._data(LIDAR, sample["token"], mounted, frame.stamp, frame.pose, name, "pcd", (0, 0))
            for camera in frame.cameras:
                if self._takes(camera.name):
                    self._write_camera(frame, camera, sample["token"])
        if result.objects is not None:
            self._annotate(frame, sample["token"], result.objects, result.tracks)
        self.frames += 1

    def _write_points(self, frame: Frame) -> str:
        points = np.zeros((len(frame.points), 5), np.float32)
        points[:, :3] = frame.points
        for column, field in ((3, "intensity"), (4, "ring")):
            if field in frame.fields:
                points[:, column] = frame.fields[field]
        name = f"samples/{LIDAR}/{LIDAR}__{_micros(frame.stamp)}.pcd.bin"
        self._write_file(name, points.tobytes())
        return name

    def _write_camera(self, frame: Frame, camera: Camera, sample: str) -> None:
        image, intrinsics = camera.image, camera.intrinsics
        if image is None or intrinsics is None or camera.camera_from_points is None:
            return
        mounting = camera.camera_from_points if camera.mounting is None else camera.mounting
        channel = self._channel(camera.name)
        name = f"samples/{channel}/{channel}__{_micros(image.stamp)}__{self.frames:06}.jpg"
        if image.media_type == "image/jpeg" and image.encoded and not intrinsics.distortion_model:
            data = image.encoded
        else:
            flat = rectify(image.bgr, intrinsics)
            data = encode_image(flat, ".jpg", [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        self._write_file(name, data)
        mounted = self._calibrated(
            channel, "camera", geometry.inverse(mounting), np.asarray(intrinsics.K).tolist()
        )
        # This is the vehicle pose at the time of the image, so that points project as they do in bevviz.
        pose = frame.pose @ geometry.inverse(camera.camera_from_points) @ mounting
        height, width = image.bgr.shape[:2]
        self._data(channel, sample, mounted, image.stamp, pose, name, "jpg", (width, height))

    def _calibrated(self, channel: str, modality: str, pose: F64, matrix: Sequence[Sequence[float]]) -> str:
        """Return the token of a mounted sensor. Every change of its mounting gives a new token."""
        sensor = self._token_of("sensor", channel, channel=channel, modality=modality)
        pose_fields = _pose_fields(pose)
        return self._token_of(
            "calibrated_sensor",
            json.dumps([channel, pose_fields, matrix]),
            sensor_token=sensor,
            **pose_fields,
            camera_intrinsic=matrix,
        )

    def _data(
        self,
        channel: str,
        sample: str,
        mounted: str,
        stamp: int,
        pose: F64,
        name: str,
        form: str,
        size: tuple[int, int],
    ) -> None:
        token = self._token("sample_data", channel, self.frames)
        self._tables["ego_pose"].append({"token": token, "timestamp": _micros(stamp), **_pose_fields(pose)})
        self._add_linked(
            "sample_data",
            channel,
            token,
            sample_token=sample,
            ego_pose_token=token,
            calibrated_sensor_token=mounted,
            timestamp=_micros(stamp),
            fileformat=form,
            is_key_frame=True,
            width=size[0],
            height=size[1],
            filename=name,
        )

    def _annotate(self, frame: Frame, sample: str, objects: Objects, tracks: Tracks | None) -> None:
        track_of = {}
        if tracks is not None:
            track_of = {int(row): int(number) for number, row in zip(tracks.id, tracks.object, strict=True)}
        boxes = objects.boxes
        hits = {row: len(rows) for row, rows in inside_each(frame.points, boxes)}
        for row, name in enumerate(objects.names):
            key = f"track {track_of[row]}" if row in track_of else f"object {self.frames} {row}"
            category = CATEGORIES.get(name.lower(), f"other.{name}")
            instance = self._token_of("instance", key)
            self._class_scores[instance][category] += float(objects.score[row])
            turned = geometry.transform(
                boxes.center[row], (0, 0, np.sin(boxes.yaw[row] / 2), np.cos(boxes.yaw[row] / 2))
            )
            annotation = self._add_linked(
                "sample_annotation",
                instance,
                self._token("sample_annotation", self.frames, row),
                sample_token=sample,
                instance_token=instance,
                visibility_token="",  # unknown
                attribute_tokens=[],
                **_pose_fields(frame.pose @ turned),
                size=[float(side) for side in _width_first(boxes.size[row])],
                num_lidar_pts=hits[row],
                num_radar_pts=0,
                score=float(objects.score[row]),
            )
            self._annotations[instance].append(annotation["token"])
            self.labels += 1

    def _token_of(self, table: str, key: str, **values: Any) -> str:
        """Return the token of a row. The first call with a key writes the row."""
        if (table, key) not in self._tokens:
            token = self._tokens[table, key] = self._token(table, key)
            self._tables[table].append({"token": token, **values})
        return self._tokens[table, key]

    def _token(self, table: str, *key: object) -> str:
        """Return a token of 32 hexadecimal digits. Tokens differ by scene except in shared tables."""
        parts = (table, *key) if table in SHARED else (self._scene, self._start, table, *key)
        return hashlib.md5("\0".join(map(str, parts)).encode(), usedforsecurity=False).hexdigest()

    def _add_linked(self, table: str, chain: str, token: str, **values: Any) -> dict[str, Any]:
        """Add a row and link it with the previous row of its chain."""
        previous = self._previous_rows.get((table, chain))
        row = {"token": token, **values, "prev": previous["token"] if previous else "", "next": ""}
        if previous:
            previous["next"] = token
        self._previous_rows[table, chain] = row
        self._tables[table].append(row)
        return row

    def _finish(self) -> None:
        """Write the tables."""
        samples = self._tables["sample"]
        captured = datetime.fromtimestamp(samples[0]["timestamp"] / 1e6, UTC)
        log, scene = self._token("log"), self._token("scene")
        self._tables["log"] = [
            {
                "token": log,
                "logfile": self._scene,
                "vehicle": "",
                "date_captured": f"{captured:%Y-%m-%d}",
                "location": "",
            }
        ]
        self._tables["map"] = [
            {"token": self._token("map"), "log_tokens": [log], "category": "semantic_prior", "filename": MAP}
        ]
        self._tables["scene"] = [
            {
                "token": scene,
                "log_token": log,
                "name": self._scene,
                "description": "written by bevviz; annotations are what it found",
                "nbr_samples": len(samples),
                "first_sample_token": samples[0]["token"],
                "last_sample_token": samples[-1]["token"],
            }
        ]
        for row in self._tables["instance"]:
            annotations, scores = self._annotations[row["token"]], self._class_scores[row["token"]]
            kind = max(scores, key=scores.__getitem__)
            row["category_token"] = self._token_of("category", kind, name=kind, description="")
            row["nbr_annotations"] = len(annotations)
            row["first_annotation_token"], row["last_annotation_token"] = annotations[0], annotations[-1]
        for table, rows in self._tables.items():
            self._write_file(f"{VERSION}/{table}.json", json.dumps(rows, indent=0).encode())


def _micros(stamp: int) -> int:
    return stamp // 1000


def _pose_fields(pose: F64) -> dict[str, list[float]]:
    x, y, z, w = map(float, geometry.quaternion(pose))
    return {"translation": [float(v) for v in pose[:3, 3]], "rotation": [w, x, y, z]}


def _width_first(size: F32) -> F32:
    """Reorder a size from length, width, height to width, length, height, as in nuScenes."""
    return size[[1, 0, 2]]
