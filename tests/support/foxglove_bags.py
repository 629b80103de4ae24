"""MCAP files with Foxglove's messages, written by Foxglove's SDK."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

foxglove = pytest.importorskip("foxglove", reason="needs Foxglove's SDK")
from foxglove import channels, messages  # noqa: E402

from bevviz.model import geometry  # noqa: E402
from bevviz.model.frame import F32, F64  # noqa: E402
from tests.support import bags, videos  # noqa: E402

SCANS = 6
K = [60.0, 0, 32, 0, 60, 24, 0, 0, 1]
CAMERA = geometry.transform(np.array([0.1, 0, -0.2]), np.array([-0.5, 0.5, -0.5, 0.5]))
FLOAT32 = messages.PackedElementFieldNumericType.Float32


def points(scan: int) -> F32:
    return np.random.default_rng(scan).uniform(1, 20, (50, 4)).astype(np.float32)


def picture(scan: int) -> Any:
    return np.full((48, 64, 3), 40 * scan, np.uint8)


def time(scan: int) -> Any:
    stamp = bags.START + scan * bags.PERIOD
    return messages.Timestamp(sec=stamp // 10**9, nsec=stamp % 10**9)


def parts(matrix: F64) -> tuple[Any, Any]:
    """Return the translation and the rotation."""
    place, turn = matrix[:3, 3].tolist(), geometry.quaternion(matrix).tolist()
    axes = dict(zip("xyz", place, strict=True))
    return messages.Vector3(**axes), messages.Quaternion(**dict(zip("xyzw", turn, strict=True)))


def pose(matrix: F64) -> Any:
    place, turn = parts(matrix)
    return messages.Pose(position=place, orientation=turn)


def edge(scan: int, parent: str, child: str, matrix: F64) -> Any:
    translation, rotation = parts(matrix)
    return messages.FrameTransform(
        timestamp=time(scan),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=translation,
        rotation=rotation,
    )


def write(path: Path, *, offset: F64 | None = None, image: str = "png") -> Path:
    """Write a bag with the topics of nuscenes2mcap. It states the pose of the camera once."""
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context):
        cloud = channels.PointCloudChannel("/LIDAR_TOP", context=context)
        raw = channels.RawImageChannel("/CAM_FRONT/image_raw", context=context)
        packed = channels.CompressedImageChannel("/CAM_FRONT/image_rect_compressed", context=context)
        video = channels.CompressedVideoChannel("/CAM_FRONT/video", context=context)
        info = channels.CameraCalibrationChannel("/CAM_FRONT/camera_info", context=context)
        tf = channels.FrameTransformsChannel("/tf", context=context)
        single = channels.FrameTransformChannel("/tf_single", context=context)
        scene = channels.SceneUpdateChannel("/markers/annotations", context=context)
        fields = [
            messages.PackedElementField(name=name, offset=4 * i, type=FLOAT32)
            for i, name in enumerate(("x", "y", "z", "intensity"))
        ]
        packets = videos.encode([cv2.resize(picture(scan), (64, 64)) for scan in range(SCANS)])
        for scan in range(SCANS):
            at = bags.START + scan * bags.PERIOD
            if scan == 0:
                single.log(edge(scan, "lidar_top", "cam_front", CAMERA), log_time=at)
            moved = geometry.transform(np.array([float(scan), 0, 0]), np.array([0.0, 0, 0, 1]))
            tf.log(messages.FrameTransforms(transforms=[edge(scan, "map", "lidar_top", moved)]), log_time=at)
            cloud.log(
                messages.PointCloud(
                    timestamp=time(scan),
                    frame_id="lidar_top",
                    pose=pose(np.eye(4) if offset is None else offset),
                    point_stride=16,
                    fields=fields,
                    data=points(scan).tobytes(),
                ),
                log_time=at,
            )
            bgr, about = picture(scan), dict[str, Any](timestamp=time(scan), frame_id="cam_front")
            if image == "png":
                encoded = cv2.imencode(".png", bgr)[1].tobytes()
                packed.log(messages.CompressedImage(format="png", data=encoded, **about), log_time=at)
            elif image == "video":
                video.log(messages.CompressedVideo(format="h264", data=packets[scan], **about), log_time=at)
            else:
                size = dict[str, Any](width=64, height=48, step=192, encoding="rgb8")
                raw.log(messages.RawImage(data=bgr.tobytes(), **size, **about), log_time=at)
            info.log(
                messages.CameraCalibration(
                    width=64,
                    height=48,
                    distortion_model="plumb_bob",
                    D=[0.0] * 5,
                    K=K,
                    R=np.eye(3).ravel().tolist(),
                    P=np.column_stack([np.reshape(K, (3, 3)), np.zeros(3)]).ravel().tolist(),
                    **about,
                ),
                log_time=at,
            )
            cube = messages.CubePrimitive(
                pose=pose(geometry.transform(np.array([10.0, 2, 1]), np.array([0, 0, 0.6, 0.8]))),
                size=messages.Vector3(x=4, y=2, z=1.5),
            )
            entity = messages.SceneEntity(
                timestamp=time(scan),
                frame_id="map",
                id="7",
                metadata=[messages.KeyValuePair(key="category", value="vehicle.car")],
                cubes=[cube],
            )
            scene.log(messages.SceneUpdate(entities=[entity]), log_time=at)
    return path


def _times(value: Any) -> Any:
    """Convert times to the form of Foxglove's JSON schemas."""
    if isinstance(value, dict):
        return {key: _time(item) if key == "timestamp" else _times(item) for key, item in value.items()}
    return [_times(item) for item in value] if isinstance(value, list) else value


def _time(text: str) -> dict[str, int]:
    stamp = int(np.datetime64(text.removesuffix("Z"), "ns").astype(np.int64))
    return {"sec": stamp // 10**9, "nsec": stamp % 10**9}
