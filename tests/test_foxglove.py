"""Foxglove's messages in MCAP, written by Foxglove's own SDK: protobuf, and JSON."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

foxglove = pytest.importorskip("foxglove", reason="needs Foxglove's SDK")
from foxglove import channels, messages  # noqa: E402

from bevviz.bags.source import BagSource  # noqa: E402
from bevviz.cli import main  # noqa: E402
from bevviz.config import load  # noqa: E402
from bevviz.messages.decoders import find_decoder  # noqa: E402
from bevviz.messages.detections import decode_detections_3d  # noqa: E402
from bevviz.messages.foxglove import parse  # noqa: E402
from bevviz.model import geometry  # noqa: E402
from bevviz.model.frame import F32  # noqa: E402
from bevviz.report.bag_window import choose_topics, cut_bag, find_window, open_window  # noqa: E402
from bevviz.stages.robot_results import in_points_frame  # noqa: E402
from tests.support import bags  # noqa: E402
from tests.support.foxglove_bags import (  # noqa: E402
    CAMERA,
    FLOAT32,
    SCANS,
    K,
    _times,
    edge,
    picture,
    points,
    pose,
    time,
    write,
)


def check(path: Path, expected: Callable[[int], F32] = lambda scan: points(scan)[:, :3]) -> None:
    with BagSource([path], load()) as source:
        frames = list(source)
        assert not source.warnings
        assert [frame.stamp for frame in frames] == [bags.START + i * bags.PERIOD for i in range(SCANS)]
        last = source.frame(SCANS - 1)
        assert last is not None
        frames[-1] = last
        for scan, frame in enumerate(frames):
            np.testing.assert_allclose(frame.points, expected(scan), atol=1e-5)
            np.testing.assert_array_equal(frame.fields["intensity"], points(scan)[:, 3])
            assert frame.world_from_points is not None
            np.testing.assert_allclose(frame.world_from_points[:3, 3], [scan, 0, 0], atol=1e-9)
            (camera,) = frame.cameras
            assert camera.name == "CAM_FRONT"
            assert camera.image is not None
            assert camera.intrinsics is not None
            assert camera.camera_from_points is not None
            assert abs(int(camera.image.bgr[20, 30].mean()) - 40 * scan) <= 3
            np.testing.assert_allclose(camera.intrinsics.K.ravel(), K)
            np.testing.assert_allclose(camera.camera_from_points, geometry.inverse(CAMERA), atol=1e-6)
            (boxes,) = frame.robot_boxes
            assert (boxes.labels, boxes.ids, boxes.frame_id) == (("vehicle.car",), ("7",), "map")
            np.testing.assert_allclose(boxes.boxes.center, [[10, 2, 1]])
            np.testing.assert_allclose(boxes.boxes.size, [[4, 2, 1.5]])
            np.testing.assert_allclose(boxes.boxes.yaw, [2 * np.arctan2(0.6, 0.8)], rtol=1e-5)


@pytest.mark.parametrize("image", ["png", "raw"])
def test_protobuf_of_foxgloves_sdk_is_read(image: str, tmp_path: Path) -> None:
    check(write(tmp_path / "drive.mcap", image=image))


def test_video_in_protobuf_is_read(tmp_path: Path) -> None:
    with BagSource([write(tmp_path / "drive.mcap", image="video")], load()) as source:
        images = [frame.cameras[0].image for frame in source]
    assert [image is not None and image.media_type for image in images] == ["video/h264"] * SCANS


def test_a_clouds_own_pose_is_applied(tmp_path: Path) -> None:
    offset = geometry.transform(np.array([1.0, 2, 3]), np.array([0, 0, 0.6, 0.8]))
    path = write(tmp_path / "drive.mcap", offset=offset)
    check(path, lambda scan: geometry.apply(offset, points(scan)[:, :3]))


@pytest.mark.parametrize("mapping", ["foxglove", "protobuf"])
def test_json_gives_the_same_frames_as_protobuf(tmp_path: Path, mapping: str) -> None:
    """Write the protobuf messages of the SDK again as JSON, in Foxglove's mapping and in protobuf's own."""
    from google.protobuf.json_format import MessageToDict, MessageToJson
    from mcap.reader import make_reader

    from bevviz.messages.foxglove import parse

    source, path, context = write(tmp_path / "protobuf.mcap"), tmp_path / "json.mcap", foxglove.Context()
    made: dict[str, Any] = {}
    with source.open("rb") as file, foxglove.open_mcap(path, context=context):
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            if channel.topic not in made:
                about = foxglove.Schema(name=schema.name, encoding="jsonschema", data=b'{"type": "object"}')
                made[channel.topic] = foxglove.Channel(
                    channel.topic, message_encoding="json", schema=about, context=context
                )
            parsed = parse(message.data, schema.name, "protobuf", schema.data.decode("latin-1"))
            fields = MessageToDict(parsed, preserving_proto_field_name=True, use_integers_for_enums=True)
            text = MessageToJson(parsed) if mapping == "protobuf" else json.dumps(_times(fields))
            made[channel.topic].log(text.encode(), log_time=message.log_time)
    check(path)


@pytest.mark.parametrize("form", ["sqlite3", "ros1"])
def test_messages_of_foxglove_in_ros_are_read(tmp_path: Path, form: str) -> None:
    """ROS 1 has matrices in upper case, and no number before the stamp."""
    made, prefix = bags.Messages(form == "ros1"), "foxglove_msgs/msg/"
    upper = str.upper if made.ros1 else str
    start = f"{'time' if made.ros1 else 'builtin_interfaces/Time'} timestamp\nstring frame_id\n"
    sizes = {"d": 5, "k": 9, "r": 9, "p": 12}
    matrices = "".join(f"float64[{'' if name == 'd' else n}] {upper(name)}\n" for name, n in sizes.items())
    for name, text in (
        ("CompressedImage", "uint8[] data\nstring format\n"),
        ("CameraCalibration", f"uint32 width\nuint32 height\nstring distortion_model\n{matrices}"),
    ):
        made.store.register(get_types_from_msg(start + text, prefix + name))
    png = np.frombuffer(cv2.imencode(".png", picture(2))[1].tobytes(), np.uint8)
    numbers = {upper(name): np.zeros(n) for name, n in sizes.items()} | {upper("k"): np.array(K)}
    items = []
    for item in bags.small_items(made, scans=3):
        if item.topic in (bags.IMAGE, bags.INFO):
            name = "CompressedImage" if item.topic == bags.IMAGE else "CameraCalibration"
            about = {"timestamp": item.message.header.stamp, "frame_id": bags.CAMERA_FRAME}
            content: dict[str, Any] = {"data": png, "format": "png"}
            if item.topic == bags.INFO:
                content = {"width": 64, "height": 48, "distortion_model": "plumb_bob", **numbers}
            message = made.make(prefix + name, **about, **content)
            item = bags.Item(item.topic, prefix + name, item.received, message)
        items.append(item)
    with BagSource([bags.write(tmp_path / "drive", items, made, form=form)], load()) as source:
        for frame in source:
            (camera,) = frame.cameras
            assert camera.intrinsics is not None and camera.intrinsics.K.ravel().tolist() == K
            assert camera.image is not None and camera.image.stamp == frame.stamp
        assert not source.warnings


def test_info_names_kinds_and_roles(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(write(tmp_path / "drive.mcap"))]) == 0
    told = capsys.readouterr().out
    for line in (
        "/LIDAR_TOP: LiDAR, by type and name",
        "/CAM_FRONT/camera_info: calibration of CAM_FRONT",
        "/markers/annotations: the robot's own result",
        "foxglove.FrameTransforms",
    ):
        assert line in told


def test_boxes_may_be_the_truth(tmp_path: Path) -> None:
    path = write(tmp_path / "drive.mcap")
    assert main(["evaluate", str(path), "--truth", "/markers/annotations", "--quiet", "--model", "demo"]) == 0


def test_an_early_transform_still_holds_later_in_the_drive(tmp_path: Path) -> None:
    context, path = foxglove.Context(), tmp_path / "drive.mcap"
    with foxglove.open_mcap(path, context=context):
        raw = channels.RawImageChannel("/CAM_FRONT/image_raw", context=context)
        cloud = channels.PointCloudChannel("/LIDAR_TOP", context=context)
        single = channels.FrameTransformChannel("/calibration", context=context)
        fields = [
            messages.PackedElementField(name=name, offset=4 * i, type=FLOAT32) for i, name in enumerate("xyz")
        ]
        for scan in range(0, 120, 10):
            at = bags.START + scan * bags.PERIOD
            if scan in (20, 70):
                single.log(edge(scan, "lidar_top", "cam_front", CAMERA), log_time=at)
            about = dict[str, Any](timestamp=time(scan), frame_id="lidar_top", point_stride=16, fields=fields)
            cloud.log(messages.PointCloud(data=points(scan).tobytes(), **about), log_time=at)
            size = dict[str, Any](width=64, height=48, step=192, encoding="rgb8", frame_id="cam_front")
            raw.log(messages.RawImage(data=picture(1).tobytes(), timestamp=time(scan), **size), log_time=at)
    with BagSource([path], load()) as source:
        placed = [frame.cameras[0].camera_from_points is not None for frame in source]
        assert not placed[0] and all(placed[2:])
        for number in (6, 11):
            frame = source.frame(number)
            assert frame is not None and frame.cameras[0].camera_from_points is not None


def test_boxes_of_a_scene_are_in_the_frames_of_their_entities(tmp_path: Path) -> None:
    context, path = foxglove.Context(), tmp_path / "drive.mcap"
    box = geometry.transform((12.0, 3.0, -1.0), (0, 0, np.sin(0.25), np.cos(0.25)))  # in the LiDAR's frame
    ahead = geometry.transform((7.0, 0, 0), (0, 0, 0.6, 0.8))  # where it is in the map
    stated = {"map": ahead @ box, "lidar_top": box, "cam_front": geometry.inverse(CAMERA) @ box}
    with foxglove.open_mcap(path, context=context):
        cloud = channels.PointCloudChannel("/LIDAR_TOP", context=context)
        tf = channels.FrameTransformsChannel("/tf", context=context)
        scene = channels.SceneUpdateChannel("/scene", context=context)
        for scan in range(2):
            at = bags.START + scan * bags.PERIOD
            edges = [edge(scan, "map", "lidar_top", ahead), edge(scan, "lidar_top", "cam_front", CAMERA)]
            tf.log(messages.FrameTransforms(transforms=edges), log_time=at)
            fields = [
                messages.PackedElementField(name=name, offset=4 * i, type=FLOAT32)
                for i, name in enumerate("xyz")
            ]
            about = dict[str, Any](timestamp=time(scan), frame_id="lidar_top", point_stride=16, fields=fields)
            cloud.log(messages.PointCloud(data=points(scan).tobytes(), **about), log_time=at)
            size = messages.Vector3(x=4.5, y=1.8, z=1.5)
            entities = [
                messages.SceneEntity(
                    timestamp=time(scan),
                    frame_id=name,
                    id=name,
                    cubes=[messages.CubePrimitive(pose=pose(matrix), size=size)],
                )
                for name, matrix in stated.items()
            ]
            scene.log(messages.SceneUpdate(entities=entities if scan else []), log_time=at)
    with BagSource([path], load()) as source:
        first, last = source
        assert not source.warnings  # a scene of nothing has neither stamp nor frame
    assert [len(boxes.boxes) for boxes in first.robot_boxes] == [0]
    boxes = in_points_frame(last.pose, last.robot_boxes[0])
    assert last.robot_boxes[0].ids == tuple(stated)
    np.testing.assert_allclose(boxes.center, [box[:3, 3]] * 3, atol=1e-5)
    np.testing.assert_allclose(boxes.size, [[4.5, 1.8, 1.5]] * 3, rtol=1e-6)
    np.testing.assert_allclose(boxes.yaw, [0.5] * 3, atol=1e-6)


def test_a_part_cut_out_runs_again(tmp_path: Path) -> None:
    path, target = write(tmp_path / "drive.mcap"), tmp_path / "cut.mcap"
    with BagSource([path], load()) as source:
        window = find_window(source, int(source.scans[3]), 0.1, 0.1)
        topics = choose_topics(source.recording, source.roles, None)
        cut_bag(source.recording, window, topics, source.roles.tf_static, target)
        expected = [frame.points for frame in source][2:5]
    with open_window([target], load(), window.low, window.high) as source:
        for frame, there in zip(source, expected, strict=True):
            np.testing.assert_array_equal(frame.points, there)
            assert frame.cameras[0].camera_from_points is not None


def test_undecodable_messages_are_one_line(tmp_path: Path) -> None:
    context, path = foxglove.Context(), tmp_path / "drive.mcap"
    good = base64.b64encode(points(0).tobytes()).decode()
    fields = [{"name": name, "offset": 4 * i, "type": 7} for i, name in enumerate("xyz")]
    cloud = {"frame_id": "l", "point_stride": 16, "fields": fields, "data": good}
    about = foxglove.Schema(name="foxglove.PointCloud", encoding="jsonschema", data=b"{}")
    with foxglove.open_mcap(path, context=context):
        channel = foxglove.Channel("/points", message_encoding="json", schema=about, context=context)
        broken = [b"{not json", b"[]", json.dumps(cloud | {"data": "?"}).encode(), b"{}"]
        for i, data in enumerate([json.dumps(cloud).encode(), *broken]):
            channel.log(data, log_time=bags.START + i * bags.PERIOD)
    with BagSource([path], load()) as source:
        assert [len(frame.points) for frame in source][:1] == [50]
        assert any("of /points could not be used, the first: /points: not a" in w for w in source.warnings)


@pytest.mark.parametrize("wrong", [{"sec": 2**70}, {"sec": "text"}, {"sec": [1]}, "2026-02-30T10:00:00Z"])
def test_a_time_of_json_that_no_date_has_is_one_line(tmp_path: Path, wrong: object) -> None:
    context, path = foxglove.Context(), tmp_path / "drive.mcap"
    schema = foxglove.Schema(
        name="foxglove.FrameTransform", encoding="jsonschema", data=b'{"type": "object"}'
    )
    edge = {"parent_frame_id": "map", "child_frame_id": "lidar_top", "timestamp": wrong}
    fields = [messages.PackedElementField(name=n, offset=4 * i, type=FLOAT32) for i, n in enumerate("xyz")]
    with foxglove.open_mcap(path, context=context):
        clouds = channels.PointCloudChannel("/LIDAR_TOP", context=context)
        tf = foxglove.Channel("/tf", message_encoding="json", schema=schema, context=context)
        for scan in range(2):
            at, about = bags.START + scan * bags.PERIOD, dict[str, Any](timestamp=time(scan), point_stride=16)
            cloud = messages.PointCloud(
                frame_id="lidar_top", fields=fields, data=points(scan).tobytes(), **about
            )
            tf.log(json.dumps(edge | {"rotation": {"w": 1}}).encode(), log_time=at)
            clouds.log(cloud, log_time=at)
    with BagSource([path], load()) as source:
        assert len(list(source)) == 2
        assert any("2 message(s) of /tf could not be used" in text for text in source.warnings)


def test_a_cloud_that_ends_within_a_point_is_doubted() -> None:
    fields = [{"name": name, "offset": 4 * i, "type": 7} for i, name in enumerate("xyz")]
    data = base64.b64encode(points(0).tobytes()[:-3]).decode()
    text = json.dumps({"frame_id": "lidar", "point_stride": 16, "fields": fields, "data": data})
    decoder = find_decoder("foxglove.PointCloud")
    assert decoder is not None and decoder.from_message is not None
    cloud = decoder.from_message(parse(text.encode(), "foxglove.PointCloud", "json", ""))
    assert len(cloud.xyz) == len(points(0)) - 1
    assert cloud.doubt == "a cloud of points of 16 bytes ends 13 bytes into a point: points may be missing"


@pytest.mark.parametrize("kind", ["PointCloud", "CompressedImage", "RawImage"])
def test_a_number_in_place_of_data_takes_no_memory(kind: str) -> None:
    name = f"foxglove.{kind}"
    message, decoder = (
        parse(b'{"data": 2147483648, "point_stride": 16}', name, "json", ""),
        find_decoder(name),
    )
    assert decoder is not None and decoder.from_message is not None
    with pytest.raises(ValueError, match="the field 'data' is the number 2147483648"):
        decoder.from_message(message)


def test_a_scene_is_read_as_ground_truth() -> None:
    cube = {
        "pose": {"position": {"x": 4, "y": 1, "z": 0}, "orientation": {"w": 1}},
        "size": {"x": 3, "y": 2, "z": 1},
    }
    scene = {
        "entities": [{"timestamp": {"sec": 2, "nsec": 7}, "frame_id": "map", "id": "a", "cubes": [cube]}]
    }
    decoder = find_decoder("foxglove.SceneUpdate")
    assert decoder is not None and decoder.from_message is not None
    content = decoder.from_message(parse(json.dumps(scene).encode(), "foxglove.SceneUpdate", "json", ""))
    boxes = decode_detections_3d(content, "/ground_truth", 9)
    assert (boxes.topic, boxes.received, boxes.stamp, boxes.frame_id) == (
        "/ground_truth",
        9,
        2_000_000_007,
        "map",
    )
    np.testing.assert_array_equal(boxes.boxes.center, [[4, 1, 0]])
    assert boxes.ids == ("a",)
