"""The synthetic drive: reproducible, its sensors and its ground truth agree, its bag says the same."""

from __future__ import annotations

import errno
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from bevviz.bags.source import BagSource
from bevviz.config import Config, DetectorConfig, load
from bevviz.errors import UserError
from bevviz.extras.demo.bag import TOPICS, BagWriter, write_bag
from bevviz.extras.demo.drive import PERIOD, START, Snapshot, SyntheticSource
from bevviz.extras.demo.world import SECTION
from bevviz.model import geometry
from bevviz.model.frame import Frame
from bevviz.model.protocols import Items
from bevviz.model.results import DetectionState
from bevviz.pipeline.session import Session
from bevviz.stages.detector import Detector

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def source() -> SyntheticSource:
    drive: Items[Frame] = SyntheticSource(frames=20, seed=3)
    assert isinstance(drive, SyntheticSource)
    return drive


@pytest.fixture(scope="module")
def snapshot(source: SyntheticSource) -> Snapshot:
    return source.snapshot(12)


def test_frames_come_lazily_in_order_of_stamp(source: SyntheticSource) -> None:
    stream = iter(source)
    first, second = next(stream), next(stream)
    assert (first.index, second.index) == (0, 1)
    assert second.stamp - first.stamp == 100_000_000
    assert source.total == 20
    assert source.scene.cameras == (first.cameras[0].name,)
    assert source.scene.lidar == first.lidar


def test_the_seed_decides_everything(snapshot: Snapshot) -> None:
    again, other = SyntheticSource(20, 3).snapshot(12), SyntheticSource(20, 4).snapshot(12)
    assert np.array_equal(again.frame.points, snapshot.frame.points)
    assert again.frame.truth is not None and snapshot.frame.truth is not None
    assert np.array_equal(again.frame.truth.boxes.center, snapshot.frame.truth.boxes.center)
    image, image_again, image_other = (s.frame.cameras[0].image for s in (snapshot, again, other))
    assert image is not None and image_again is not None and image_other is not None
    assert np.array_equal(image_again.bgr, image.bgr)
    assert not np.array_equal(image_other.bgr, image.bgr)


def same(one: Any, other: Any) -> bool:
    """Bit for bit, down to the last field of whatever is in there."""
    if is_dataclass(one):
        return type(one) is type(other) and all(
            same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one) if f.name != "timings"
        )
    if isinstance(one, np.ndarray):
        return (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    if isinstance(one, Mapping):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, (tuple, list)):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other)


def test_a_frame_depends_on_nothing_but_what_came_before_it() -> None:
    """Not on how long the drive will be: neither what the sensors give nor what is made of it."""
    short, long = SyntheticSource(frames=6), SyntheticSource(frames=700)
    sessions = [Session(load(settings=["detector.model=demo"])) for _ in range(2)]
    for index in range(3):
        shots = [source.snapshot(index) for source in (short, long)]
        assert same(*shots), f"snapshot {index}"
        results = [session.run(shot.frame) for session, shot in zip(sessions, shots, strict=True)]
        assert same(*results), f"result of frame {index}"
        detections, objects = results[0].cameras[0].detections, results[0].objects
        assert detections is not None and len(detections) and objects is not None and len(objects)


@pytest.mark.parametrize("more", [{}, {"weave": True}, {"plant": ["merged_people"]}])
def test_frames_do_not_depend_on_the_length_of_the_drive(more: dict[str, Any]) -> None:
    """Where the street of a short drive ends, that of a longer one goes on: nobody sees as far."""
    short, long = SyntheticSource(60, 4, **more), SyntheticSource(150, 4, **more)
    for index in (0, 59):
        assert same(short.snapshot(index), long.snapshot(index))
    assert not same(short.snapshot(58), long.snapshot(59)), "it would be told"


def test_the_scenery_goes_on_from_section_to_section() -> None:
    """What is seen around the border between two is in both."""
    world = SyntheticSource(frames=100).world
    border = world.street.point(SECTION, 0.0)
    corners = []
    for section in (0, 1):
        mesh = world.static(section)
        near = np.linalg.norm(mesh.vertices - border, axis=1) < 120
        corners.append({tuple(vertex) for vertex in mesh.vertices[near].tolist()})
    assert corners[0] == corners[1] and len(corners[0]) > 10_000


def test_a_scan_is_that_of_a_64_beam_lidar(snapshot: Snapshot) -> None:
    points, fields = snapshot.frame.points, snapshot.frame.fields
    assert 110_000 < len(points) < 125_000
    assert points.dtype == np.float32 and points.flags.c_contiguous and np.isfinite(points).all()
    assert {len(values) for values in fields.values()} == {len(points)}
    assert np.array_equal(np.unique(fields["ring"]), np.arange(64))
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    expected = np.linspace(-24.8, 2.0, 64)[fields["ring"]]
    assert np.abs(elevation - expected).max() < 1e-3
    assert np.all(np.diff(fields["time"]) >= 0) and 0.09 < fields["time"][-1] < 0.1
    assert fields["intensity"].min() >= 1 and fields["intensity"].max() <= 255


def test_ground_truth_encloses_the_points_of_each_object(snapshot: Snapshot) -> None:
    truth = snapshot.frame.truth
    assert truth is not None
    assert set(truth.labels) == {"car", "person", "cyclist"}
    boxes = truth.boxes
    for k, number in enumerate(snapshot.truth_object):
        own = snapshot.frame.points[snapshot.point_object == number] - boxes.center[k]
        assert len(own) == snapshot.truth_hits[k]
        if not len(own):
            continue
        c, s = np.cos(boxes.yaw[k]), np.sin(boxes.yaw[k])
        local = np.stack([c * own[:, 0] + s * own[:, 1], c * own[:, 1] - s * own[:, 0], own[:, 2]], -1)
        beyond = np.abs(local) - boxes.size[k] / 2
        assert beyond.max() < 5 * 0.015, "five sigma of the range noise"
    assert np.sum(snapshot.truth_hits > 50) >= 8


def test_every_object_hit_in_range_has_a_box(snapshot: Snapshot) -> None:
    near = np.linalg.norm(snapshot.frame.points, axis=1) < 70
    assert set(np.unique(snapshot.point_object[near])) - {0} <= set(snapshot.truth_object)


def test_boxes_have_the_size_of_what_they_hold(snapshot: Snapshot) -> None:
    truth = snapshot.frame.truth
    assert truth is not None
    labels = np.array(truth.labels)
    for label, low, high in (
        ("car", (3.7, 1.6, 1.3), (5.6, 2.5, 2.5)),
        ("person", (0.15, 0.25, 0.9), (1.4, 1.4, 2.1)),
        ("cyclist", (1.5, 0.4, 1.5), (2.1, 0.8, 2.1)),
    ):
        sizes = truth.boxes.size[labels == label]
        assert np.all(sizes > low) and np.all(sizes < high), label


def _agreement(snapshot: Snapshot, camera_from_points: np.ndarray) -> float:
    """Share of the near object points, facing the camera, that land on or next to a pixel of their object."""
    camera = snapshot.frame.cameras[0]
    assert camera.intrinsics is not None
    uv, depth = geometry.project(geometry.apply(camera_from_points, snapshot.frame.points), camera.intrinsics)
    height, width = snapshot.pixel_object.shape
    with np.errstate(invalid="ignore"):
        seen = (
            (depth > 3)
            & (depth < 40)
            & (np.abs(uv - (width / 2, height / 2)) < (width / 2 - 3, height / 2 - 3)).all(1)
        )
    seen &= snapshot.point_object > 0
    u, v = np.rint(uv[seen]).astype(int).T
    around = [snapshot.pixel_object[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)]
    assert seen.sum() > 1000
    return float(np.mean(np.any(np.array(around) == snapshot.point_object[seen], axis=0)))


def test_points_land_on_the_pixels_of_their_object(snapshot: Snapshot) -> None:
    camera_from_points = snapshot.frame.cameras[0].camera_from_points
    assert camera_from_points is not None
    assert _agreement(snapshot, camera_from_points) > 0.9  # the rest is hidden from one of the two sensors
    turned = camera_from_points @ geometry.transform(
        np.zeros(3), np.array([0, 0, np.sin(0.02), np.cos(0.02)])
    )
    assert _agreement(snapshot, turned) < 0.9


def test_motion_between_scan_and_image_is_in_the_transform(
    source: SyntheticSource, snapshot: Snapshot
) -> None:
    camera = snapshot.frame.cameras[0]
    assert camera.image is not None and camera.camera_from_points is not None
    assert camera.sync_error == pytest.approx((camera.image.stamp - snapshot.frame.stamp) * 1e-9)
    rigid = geometry.inverse(source.base_from_camera) @ source.base_from_lidar
    moved = np.linalg.norm((camera.camera_from_points - rigid)[:3, 3])
    assert moved == pytest.approx(8.0 * 0.012, rel=0.15)


def test_the_road_climbs_and_turns() -> None:
    source = SyntheticSource(frames=200, seed=0)
    poses = np.array([source.map_from_base(START + i * PERIOD) for i in range(0, 200, 10)])
    grade = poses[:, 2, 0]
    heading = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    assert np.ptp(grade) > 0.03
    assert np.ptp(heading) > 0.05
    step = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert np.all((step > 6.5) & (step < 9.5)), "about 8 m in a second"


def test_the_bag_holds_what_the_source_gives(tmp_path: Path) -> None:
    source, path = SyntheticSource(frames=2, seed=5), tmp_path / "drive.mcap"
    write_bag(source, path)
    assert [p.name for p in tmp_path.iterdir()] == ["drive.mcap"]
    frames = list(source)
    with AnyReader([path]) as reader:
        assert {c.topic: c.msgtype for c in reader.connections} == TOPICS
        messages: dict[str, list[Any]] = {
            t: [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages() if c.topic == t]
            for t in TOPICS
        }
        static = next(c for c in reader.connections if c.topic == "/tf_static")
        assert static.ext.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL"  # type: ignore[union-attr]

    for frame, cloud, image, boxes in zip(
        frames,
        messages["/rslidar_points"],
        messages["/zed2/zed/rgb/image_rect_color"],
        messages["/ground_truth"],
        strict=True,
    ):
        names = [f.name for f in cloud.fields]
        assert names == ["x", "y", "z", "intensity", "ring", "time", "label"]
        kinds = {4: "<u2", 7: "<f4"}
        layout: dict[str, Any] = {
            "names": names,
            "formats": [kinds[f.datatype] for f in cloud.fields],
            "offsets": [f.offset for f in cloud.fields],
            "itemsize": cloud.point_step,
        }
        table: Any = cloud.data.view(np.dtype(layout))  # type: ignore[call-overload]
        assert np.array_equal(np.stack([table[n] for n in "xyz"], -1), frame.points)
        assert np.array_equal(table["ring"], frame.fields["ring"])
        shot = frame.cameras[0].image
        assert shot is not None and frame.truth is not None
        assert image.encoding == "bgr8" and image.header.frame_id == shot.frame_id
        assert np.array_equal(image.data.reshape(image.height, image.width, 3), shot.bgr)
        assert image.header.stamp.sec * 10**9 + image.header.stamp.nanosec == shot.stamp
        assert [d.results[0].hypothesis.class_id for d in boxes.detections] == list(frame.truth.labels)
        first = boxes.detections[0].bbox
        assert [first.center.position.x, first.size.x] == pytest.approx(
            [frame.truth.boxes.center[0, 0], frame.truth.boxes.size[0, 0]]
        )


def test_frames_read_back_from_the_bag_are_those_of_the_source(tmp_path: Path) -> None:
    source, path = SyntheticSource(frames=2, seed=5), tmp_path / "drive.mcap"
    write_bag(source, path)
    with BagSource([path], Config()) as bag:
        for read, made in zip(bag, source, strict=True):
            assert (read.index, read.stamp, read.received) == (made.index, made.stamp, made.received)
            assert (read.lidar, read.points_frame, read.world_frame) == ("rslidar", "rslidar", "map")
            assert np.array_equal(read.points, made.points)
            assert read.world_from_points is not None and made.world_from_points is not None
            assert np.allclose(read.world_from_points, made.world_from_points, atol=1e-9)
            camera, original = read.cameras[0], made.cameras[0]
            assert camera.name == original.name and camera.motion_compensated
            assert camera.camera_from_points is not None and original.camera_from_points is not None
            # Between the 50 Hz poses of the bag motion is taken as straight.
            assert np.allclose(camera.camera_from_points, original.camera_from_points, atol=5e-4)
            assert camera.sync_error == pytest.approx(original.sync_error)
            assert read.truth is not None and made.truth is not None
            assert read.truth.labels == made.truth.labels
            assert np.allclose(read.truth.boxes.yaw, made.truth.boxes.yaw, atol=1e-6)
            assert (read.problems, camera.problems) == ((), ())


def test_a_failing_writer_leaves_nothing(tmp_path: Path) -> None:
    source = SyntheticSource(frames=1)
    with pytest.raises(KeyboardInterrupt), BagWriter(source, tmp_path / "drive.mcap"):
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with (
        pytest.raises(UserError, match=r"drive\.mcap: cannot write the bag: No space left on device"),
        BagWriter(SyntheticSource(frames=1), tmp_path / "drive.mcap") as bag,
    ):
        monkeypatch.setattr("bevviz.bags.completion.write_all", full)
        bag.write(next(iter(SyntheticSource(frames=1))))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("drive.bag", "must end in .mcap"),
        ("there.mcap", "exists already"),
        ("no/where.mcap", "cannot write the bag"),
    ],
)
def test_a_wrong_path_is_one_clear_line(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / "there.mcap").touch()
    with pytest.raises(UserError, match=words):
        write_bag(SyntheticSource(frames=1), tmp_path / name)


def test_a_drive_needs_a_frame_and_a_seed() -> None:
    with pytest.raises(UserError, match="at least 1 frame"):
        SyntheticSource(frames=0)
    with pytest.raises(UserError, match="seed -1: "):
        SyntheticSource(seed=-1)


def test_the_network_finds_what_is_clearly_in_view() -> None:
    """On seeds that it was not trained on: each object of 40 pixels or more, no part of it hidden."""
    detector = Detector(DetectorConfig(model="demo", threads=2))
    asked = found = right = given = 0
    for seed in (70_001, 70_002, 70_003):
        snapshot = SyntheticSource(frames=12, seed=seed).snapshot(6)
        image, truth = snapshot.frame.cameras[0].image, snapshot.frame.truth
        assert image is not None and truth is not None
        detections = detector(image.bgr)
        kept = detections.state == DetectionState.KEPT
        boxes, names = detections.xyxy[kept], np.array(detections.names)[kept]
        label = dict(zip(snapshot.truth_object.tolist(), truth.labels, strict=True))
        on_object = np.zeros(len(boxes), bool)
        for number in set(np.unique(snapshot.pixel_object)) - {-1, 0}:
            v, u = np.nonzero(snapshot.pixel_object == number)
            visible = np.array([[u.min(), v.min(), u.max() + 1, v.max() + 1]], np.float32)
            same = (geometry.iou(boxes, visible)[:, 0] > 0.5) & (names == label.get(int(number)))
            on_object |= same
            if np.ptp(v) >= 40 and len(u) > 0.35 * np.ptp(u) * np.ptp(v):
                asked += 1
                found += bool(same.any())
        right += int(on_object.sum())
        given += len(boxes)
    assert asked >= 8
    assert found >= 0.8 * asked
    assert right >= 0.8 * given
