"""Recordings: what is logged is read back through the SDK and compared with the results it was made from."""

from __future__ import annotations

import dataclasses
import os
import re
import signal
import socket
import subprocess
import sys
import textwrap
import urllib.request
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bevviz.anomalies import KINDS
from bevviz.config import Config, load
from bevviz.errors import UserError
from bevviz.model import geometry
from bevviz.model.decisions import explain
from bevviz.model.frame import (
    Boxes3D,
    Cloud,
    LabelledBoxes2D,
    LabelledBoxes3D,
    LateBoxes,
    Scene,
)
from bevviz.model.results import (
    Anomaly,
    Clusters,
    Detections,
    DetectionState,
    Failure,
    FrameResult,
    Objects,
    Tracks,
)
from bevviz.recording import entities
from bevviz.recording.boxes import TRACK_LANES, TrackLanes
from bevviz.recording.cloud import round_voxels
from bevviz.recording.decisions import decision_page
from bevviz.recording.entities import DEPTH_BINS, DEPTH_RANGE, TRACK_COLORS, ClassId
from bevviz.recording.frame_logger import FrameLogger
from bevviz.recording.health import FrameRates
from bevviz.recording.sinks import open_recording
from bevviz.stages.fusion import clusters_in_view
from bevviz.stages.tracking import Tracker
from bevviz.support.files import unfinished_files
from tests.support.logged_frames import (
    INTRINSICS,
    JPEG,
    SCENE,
    START,
    WORLD_FROM_CAMERA,
    WORLD_FROM_LIDAR,
    f32,
    make,
)
from tests.support.recordings import Recording, verify
from tests.support.waiting import PATIENCE

Make = Callable[..., FrameResult]


def nothing(index: int, *failures: Failure, **changes: Any) -> FrameResult:
    """Make the result of a frame of which only the stamp of the cloud is known."""
    empty = make(index)
    frame = dataclasses.replace(
        empty.frame, points=np.zeros((0, 3), np.float32), clouds=(), cameras=(), **changes
    )
    return FrameResult(frame, load(), None, None, None, None, (), None, None, (), {"total": 0.001}, failures)


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., Recording]:
    def run(results: Iterable[FrameResult], config: Config | None = None, scene: Scene = SCENE) -> Recording:
        path = tmp_path / "test.rrd"
        config = config or load()
        with open_recording(scene, config, save=path) as sinks:
            logger = FrameLogger(sinks.recording, config, scene)
            logger.log_static()
            for result in results:
                logger.log(result)
        return Recording(path)

    return run


# --- entities and values -----------------------------------------------------------------------


@pytest.mark.long
def test_a_drive_with_gaps_is_a_valid_recording(tmp_path: Path) -> None:
    path = tmp_path / "drive.rrd"
    with open_recording(SCENE, load(), save=path) as sinks:
        logger = FrameLogger(sinks.recording, load(), SCENE)
        logger.log_static()
        for index in range(10):
            logger.log(nothing(index, Failure("voxel", "out of memory")) if index % 4 == 3 else make(index))
    verify(path)
    assert Recording(path).blueprints == 1


@pytest.mark.long
def test_late_results_of_the_robot_are_at_their_own_stamp(tmp_path: Path) -> None:
    row = np.ones((1, 3), np.float32)
    three = LabelledBoxes3D(
        "/late", START + 12_000_000, "map", Boxes3D(row, row, row[:, 0]), ("car",), row[0, :1]
    )
    two = LabelledBoxes2D(
        "/seen", START + 15_000_000, "zed", np.ones((1, 4), np.float32), ("car",), row[0, :1], "zed"
    )
    late = [LateBoxes(boxes, START, np.eye(4), index=0) for boxes in (three, two)]
    path = tmp_path / "drive.rrd"
    with open_recording(SCENE, load(), save=path) as sinks:
        logger = FrameLogger(sinks.recording, load(), SCENE)
        logger.log_static()
        for index in range(40):
            logger.log(make(index), late=late if index == 7 else ())
    found = Recording(path)
    for topic, at, kind in (("/late", 12, "Boxes3D"), ("/seen", 15, "Boxes2D")):
        rows = found.rows[f"/robot{topic}"]
        (shown,) = (row for row in rows if row.get(f"{kind}:half_sizes"))
        assert (shown["frame"], shown["stamp"]) == (0, START + at * 1_000_000)
        assert found.cleared(f"/robot{topic}") == {31}  # three seconds later nobody may think that it is new


def test_every_timeline_has_its_times(record: Callable[..., Recording]) -> None:
    found = record([make(0), make(3)])
    assert set(found.times) == {"frame", "stamp", "received"}
    assert found.times["stamp"] == {0: START, 3: START + 300_000_000}
    assert found.times["received"][3] == START + 330_000_000


def test_a_cloud_is_logged_with_its_fields(record: Callable[..., Recording]) -> None:
    result = make()
    found = record([result])
    raw = found.at["/world/lidar/points"]
    np.testing.assert_array_equal(np.array(raw["Points3D:positions"][0], np.float32), result.frame.points)
    assert result.ground is not None and result.obstacles is not None
    expected = np.where(result.ground.mask, ClassId.GROUND, ClassId.OBSTACLE)
    assert raw["Points3D:class_ids"][0] == expected.tolist()
    for entity, points in (
        ("/world/lidar/points/ground", result.frame.points[result.ground.mask]),
        ("/world/lidar/points/obstacles", result.obstacles),
    ):
        np.testing.assert_allclose(found.at[entity]["Points3D:positions"][0], points, atol=0.1 / 8)


@given(st.floats(0.01, 2), st.integers(0, 2**32 - 1))
def test_voxelised_points_move_by_an_eighth_of_a_voxel_at_most(size: float, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-100, 100, (50, 3)).astype(np.float32)
    moved = round_voxels(points, size)
    np.testing.assert_allclose(moved, points, rtol=0, atol=size / 8)
    step = next(2.0**n for n in range(-12, 3) if 2.0**n >= size / 8)
    assert step < size / 4
    np.testing.assert_array_equal(np.round(moved / step), moved / step)


def test_poses_and_calibration_are_logged(record: Callable[..., Recording]) -> None:
    found = record([make()])
    for entity, pose in (
        ("/world/lidar", WORLD_FROM_LIDAR),
        ("/world/zed", WORLD_FROM_CAMERA),
    ):
        (translation,) = found.at[entity]["Transform3D:translation"][0]
        (turn,) = found.at[entity]["Transform3D:quaternion"][0]
        np.testing.assert_allclose(geometry.transform(np.array(translation), np.array(turn)), pose, atol=1e-6)
    (k,) = found.static["/world/zed"]["Pinhole:image_from_camera"]
    corner = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # where Rerun counts pixels from
    np.testing.assert_allclose(np.array(k).reshape(3, 3).T, INTRINSICS.K + corner)
    assert found.static["/world/zed"]["Pinhole:resolution"] == [[64, 36]]
    assert found.static["/world"]["ViewCoordinates:xyz"] == [[5, 4, 1]]  # forward, left, up


def test_clusters_are_logged_with_boxes(record: Callable[..., Recording]) -> None:
    result = make()
    found = record([result])
    seen = found.at["/world/lidar/clusters"]
    assert result.clusters is not None and result.obstacles is not None
    np.testing.assert_array_equal(seen["Boxes3D:centers"][0], result.clusters.obb.center)
    np.testing.assert_allclose(
        2 * np.array(seen["Boxes3D:half_sizes"][0]), result.clusters.obb.size, rtol=1e-6
    )
    turns = np.array(seen["Boxes3D:quaternions"][0])
    np.testing.assert_allclose(2 * np.arctan2(turns[:, 2], turns[:, 3]), result.clusters.obb.yaw, atol=1e-6)
    assert seen["Boxes3D:labels"][0] == ["0", "1"]
    members = result.clusters.labels >= 0
    points = np.array(seen["Points3D:positions"][0])
    np.testing.assert_allclose(points, result.obstacles[members], atol=0.1 / 8)
    box_classes = np.array(seen["Boxes3D:class_ids"][0])
    assert len(set(box_classes)) == 2
    assert seen["Points3D:class_ids"][0] == box_classes[result.clusters.labels[members]].tolist()
    assert (box_classes >= ClassId.TRACK).all()


def test_clusters_outside_the_limits_are_set_aside(record: Callable[..., Recording]) -> None:
    result = make()
    assert result.clusters is not None
    clusters = dataclasses.replace(result.clusters, state=np.array([0, 1], np.int32))
    found = record([dataclasses.replace(result, clusters=clusters)])
    assert found.at["/world/lidar/clusters"]["Boxes3D:labels"][0] == ["0"]
    assert len(found.at["/world/lidar/clusters"]["Points3D:positions"][0]) == 20
    assert found.at["/world/lidar/clusters/set_aside"]["Boxes3D:labels"][0] == ["1: 15 points"]
    assert found.at["/health/count/clusters"]["Scalars:scalars"][0] == [1]


def test_images_and_detections_are_logged(record: Callable[..., Recording]) -> None:
    result = make()
    (camera,) = result.cameras
    found = record([result])
    image = found.at["/world/zed/image"]
    assert bytes(image["EncodedImage:blob"][0][0]) == JPEG  # passed through untouched
    assert image["EncodedImage:media_type"][0] == ["image/jpeg"]

    kept = found.at["/world/zed/image/detections"]
    assert kept["Boxes2D:labels"][0] == ["person 0.90", "car 0.50"]
    assert kept["Boxes2D:centers"][0] == [[25.5, 20.5], [50.5, 20.5]]
    assert kept["Boxes2D:half_sizes"][0] == [[5, 10], [10, 5]]
    assert kept["Boxes2D:class_ids"][0] == [ClassId.DETECTION + DetectionState.KEPT] * 2
    weak = found.at["/world/zed/image/detections/weak"]
    assert weak["Boxes2D:labels"][0] == ["car 0.10"]
    assert weak["Boxes2D:class_ids"][0] == [ClassId.DETECTION + DetectionState.BELOW_THRESHOLD]

    points = found.at["/world/zed/image/points"]
    assert camera.uv is not None and camera.depth is not None
    np.testing.assert_array_equal(np.array(points["Points2D:positions"][0], np.float32), camera.uv[:20] + 0.5)
    bins = (camera.depth[:20] / DEPTH_RANGE * DEPTH_BINS).astype(int)
    assert points["Points2D:class_ids"][0] == bins.tolist()


def test_an_image_that_came_raw_is_compressed_and_logged_once(record: Callable[..., Recording]) -> None:
    results = []
    for index in range(3):
        result = make(index)
        (camera,) = result.cameras
        assert camera.camera.image is not None
        image = dataclasses.replace(
            camera.camera.image, encoded=None, stamp=START + index // 2, media_type=""
        )
        camera = dataclasses.replace(camera, camera=dataclasses.replace(camera.camera, image=image))
        results.append(dataclasses.replace(result, cameras=(camera,)))
    found = record(results)
    blobs = found.at["/world/zed/image"]["EncodedImage:blob"]
    assert sorted(blobs) == [0, 2]  # frame 1 has the same image as frame 0
    assert found.cleared("/world/zed/image") == set()
    shown = cv2.imdecode(np.array(blobs[0][0], np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    np.testing.assert_allclose(shown, image.bgr, atol=4)


def test_fused_boxes_have_their_reason(record: Callable[..., Recording]) -> None:
    found = record([make()])
    fused = found.at["/world/fused"]
    assert fused["Boxes3D:labels"][0] == ["person 0.90"]
    np.testing.assert_allclose(fused["Boxes3D:centers"][0], [[8, 0.5, -0.8]], rtol=1e-6)
    np.testing.assert_allclose(fused["Transform3D:translation"][0], [[5, -2, 1.7]], rtol=1e-6)
    (reason,) = fused["reason"][0]
    assert "14 points of cluster 0" in reason
    assert "matched" in reason


def test_the_seen_part_is_logged_beside_the_whole_box(record: Callable[..., Recording]) -> None:
    plain = make()
    assert plain.objects is not None
    seen = plain.objects.boxes
    whole = dataclasses.replace(seen, size=seen.size + f32(1.0, 0.5, 0.0))
    sides = np.array([[False, True, True, False]])
    objects = dataclasses.replace(plain.objects, boxes=whole, measured=seen, seen=sides)
    found = record([make(objects=objects)])
    np.testing.assert_allclose(found.at["/world/fused"]["Boxes3D:half_sizes"][0], whole.size / 2, rtol=1e-5)
    measured = found.at["/world/fused/measured"]
    np.testing.assert_allclose(measured["Boxes3D:half_sizes"][0], seen.size / 2, rtol=1e-5)
    assert found.at["/world/fused"]["seen"][0] == ["back, left"]
    assert "/world/fused/measured" not in record([plain]).at, "nothing was completed"


def test_frustums_end_at_the_matched_depth(record: Callable[..., Recording]) -> None:
    found = record([make()])
    strips = found.at["/world/frustums"]["LineStrips3D:strips"][0]
    camera_from_world = geometry.inverse(WORLD_FROM_CAMERA)
    matched, unmatched = (geometry.apply(camera_from_world, np.array(strip)) for strip in strips)
    assert np.unique(matched[:, 2].round(3)).tolist() == pytest.approx([0.3, 7.8], abs=1e-3)
    assert unmatched[:, 2].max() > 10
    far = matched[matched[:, 2] > 1]
    uv, _ = geometry.project(far, INTRINSICS)
    np.testing.assert_allclose([uv.min(0), uv.max(0)], [[20, 10], [30, 30]], atol=1e-3)


def test_grid_lies_on_the_ground_the_right_way_round(record: Callable[..., Recording]) -> None:
    result = make()
    found = record([result])
    grid = found.at["/world/bev"]
    assert result.bev is not None
    np.testing.assert_array_equal(
        np.array(grid["GridMap:data"][0][0], np.uint8).view(np.int8),
        result.bev.channels["occupancy"].ravel(),
    )
    (translation,), (turn,) = grid["GridMap:translation"][0], grid["GridMap:quaternion"][0]
    assert not any(name.startswith("Transform3D") for name in grid), "the viewer would hold all grids"
    pose = geometry.inverse(result.frame.pose) @ geometry.transform(translation, turn)
    origin, (c, s) = pose[:3, 3], pose[:2, 0]
    assert pose[2, 2] == pytest.approx(1)
    rows, columns = result.bev.channels["occupancy"].shape
    v, u = np.argwhere(result.bev.channels["occupancy"] == 100).T
    right, up = (u + 0.5) * result.bev.resolution, (rows - v - 0.5) * result.bev.resolution
    x, y = origin[0] + c * right - s * up, origin[1] + s * right + c * up
    assert result.obstacles is not None
    nearest = np.hypot(x[:, None] - result.obstacles[:, 0], y[:, None] - result.obstacles[:, 1]).min(1)
    assert nearest.max() < 0.1  # each occupied cell has an obstacle point within the cell
    assert abs(origin[2] + 1.7) < 0.1
    assert columns == rows == 800


def test_reference_image_is_stored_without_loss(record: Callable[..., Recording]) -> None:
    config = load(preset="reference")
    result = make(config=config)
    found = record([result], config)
    blob = np.array(found.at["/bev"]["EncodedImage:blob"][0][0], np.uint8)
    assert result.bev is not None
    np.testing.assert_array_equal(cv2.imdecode(blob, cv2.IMREAD_COLOR), result.bev.image)


def test_channels_are_logged_on_request(record: Callable[..., Recording]) -> None:
    config = load(settings=["bev.channels=[density, height, intensity, occupancy]"])
    result = make(config=config)
    found = record([result], config)
    assert result.bev is not None
    assert {"density", "height", "occupancy"} <= set(result.bev.channels)
    for name in ("density", "height"):
        grid = result.bev.channels[name]
        buffer = bytes(found.at[f"/bev/{name}"]["Image:buffer"][0][0])
        np.testing.assert_array_equal(np.frombuffer(buffer, grid.dtype).reshape(grid.shape), grid)


def test_truth_and_results_of_the_robot_are_logged(record: Callable[..., Recording]) -> None:
    result = make()
    boxes = Boxes3D(f32([2, 1, 0], [60, 0, 0]), f32([4, 2, 1.5], [4, 2, 1.5]), f32(0.5, 0))
    stated = LabelledBoxes3D(
        "/detection/fused_3d", START, "lidar", boxes, ("car", "bus"), f32(0.7, 0.6), WORLD_FROM_LIDAR
    )
    truth = dataclasses.replace(stated, topic="/ground_truth", scores=f32(1, 1))
    flat = LabelledBoxes2D(
        "/detection/camera_2d", START, "zed", f32([1, 2, 11, 22]), ("dog",), f32(0.3), "zed"
    )
    frame = dataclasses.replace(result.frame, truth=truth, robot_boxes=(stated,), robot_detections=(flat,))
    found = record([dataclasses.replace(result, frame=frame)])
    for entity in ("/world/ground_truth", "/robot/detection/fused_3d"):
        assert found.at[entity]["Boxes3D:centers"][0] == [[2, 1, 0], [60, 0, 0]]
        np.testing.assert_allclose(found.at[entity]["Transform3D:translation"][0], [[5, -2, 1.7]], rtol=1e-6)
    assert found.at["/robot/detection/fused_3d"]["Boxes3D:labels"][0] == ["car 0.70", "bus 0.60"]
    robot = found.at["/robot/detection/camera_2d"]
    assert robot["Boxes2D:centers"][0] == [[6.5, 12.5]]
    frame = found.static["/robot/detection/camera_2d"]["CoordinateFrame:frame"]
    assert frame == ["tf#/world/zed/image"]
    (outline,) = found.at["/bev/overlay/ground_truth"]["LineStrips2D:strips"][0]
    center = np.mean(outline[:4], axis=0)
    np.testing.assert_allclose(center, [(40 - 1) / 0.1, (40 - 2) / 0.1], atol=0.01)
    assert found.at["/bev/overlay/robot/detection/fused_3d"]["LineStrips2D:labels"][0] == ["car"]


def test_foreign_names_do_not_overwrite_entities(record: Callable[..., Recording]) -> None:
    """A topic called like an entity of ours, and one and a class that are no good parts of a path."""
    result = make()
    boxes = Boxes3D(f32([2, 1, 0]), f32([4, 2, 1.5]), f32(0.5))
    tracks = LabelledBoxes3D("/tracks", START, "lidar", boxes, ("car",), f32(0.7), WORLD_FROM_LIDAR)
    odd = dataclasses.replace(tracks, topic="/my boxes\\x/\x1b[2J")
    (camera,) = result.cameras
    assert camera.detections is not None
    named = dataclasses.replace(camera.detections, names=("a / b\n", "car", "car"))
    frame = dataclasses.replace(result.frame, robot_boxes=(tracks, odd))
    cameras = (dataclasses.replace(camera, detections=named),)
    result = dataclasses.replace(tracked([result])[0], frame=frame, cameras=cameras)
    found = record([result])
    assert found.at["/bev/overlay/robot/tracks"]["LineStrips2D:labels"][0] == ["car"]
    assert "/bev/overlay/tracks" not in found.rows  # no track is confirmed in the first frame
    assert any(path.startswith("/robot/my_boxes_x/") for path in found.at)
    assert found.column("/explain/states/zed/a___b_", "StateChange:state") == [["matched"]]


def test_several_lidars_keep_their_own_frames(record: Callable[..., Recording]) -> None:
    result = make()
    shift = geometry.transform(np.array([1.0, 0, 0]), np.array([0, 0, 0, 1]))
    first = Cloud(START, "front_lidar", result.frame.points[:60], {}, "/front/points", name="front_lidar")
    second = Cloud(START, "rear_lidar", result.frame.points[60:], {}, "/rear/points", name="rear_lidar")
    frame = dataclasses.replace(
        result.frame, lidar="lidars", clouds=(first, second), points_from_clouds=(np.eye(4), shift)
    )
    scene = dataclasses.replace(SCENE, lidar="lidars", lidars=("front_lidar", "rear_lidar"))
    found = record([dataclasses.replace(result, frame=frame)], scene=scene)
    assert len(found.at["/world/front_lidar/points"]["Points3D:positions"][0]) == 60
    rear = found.at["/world/rear_lidar"]["Transform3D:translation"][0]
    np.testing.assert_allclose(rear, [(WORLD_FROM_LIDAR @ shift)[:3, 3]], rtol=1e-6)
    classes = found.at["/world/rear_lidar/points"]["Points3D:class_ids"][0]
    assert classes == [ClassId.GROUND] * 40 + [ClassId.OBSTACLE] * 36
    assert "/world/lidars/points" not in found.at
    assert "Boxes3D:centers" in found.at["/world/lidars/clusters"]


# --- decisions and health ----------------------------------------------------------------------


def test_explanations_are_logged_as_text_and_states(record: Callable[..., Recording]) -> None:
    result = make()
    found = record([result, make(1)])
    (page,) = found.at["/explain"]["TextDocument:text"][0]
    assert found.at["/explain"]["TextDocument:media_type"][0] == ["text/markdown"]
    for explanation in result.explanations:
        listed = explanation.text in page
        assert listed or explanation.state == "out_of_view", explanation
    assert "1 out of view: 1" in page
    assert page.index("car 0.50") < page.index("person 0.90") < page.index("car 0.10")

    lines = [row for row in found.rows["/explain/log"] if row["frame"] == 0]
    assert [row["TextLog:level"] for row in lines] == [["INFO"]]
    assert "car 0.50: no cluster" in lines[0]["TextLog:text"][0]

    assert found.at["/explain/states/zed/person"]["StateChange:state"] == {0: ["matched"]}
    assert found.at["/explain/states/zed/car"]["StateChange:state"] == {0: ["no cluster"]}
    assert found.at["/explain/states/pipeline"]["StateChange:state"] == {0: ["ok"]}


def test_rates_are_counted_over_a_second() -> None:
    rates = FrameRates()
    frame = make().frame
    found = []
    for index in range(40):  # two at a time, 60 ns apart, five times a second
        at = START + index // 2 * 200_000_000 + index % 2 * 60
        rates.add(dataclasses.replace(frame, stamp=at, received=at))
        found.append(dict(rates))
    assert found[1] == {}  # nothing is known of two
    assert all(8 <= rate <= 13 for rates in found[4:] for rate in rates.values())
    slow = FrameRates()
    for index in range(3):  # every two seconds
        slow.add(dataclasses.replace(frame, stamp=index * 2_000_000_000, received=0))
    assert dict(slow) == {"sensor": 0.5}


def test_the_health_of_a_run_is_logged(record: Callable[..., Recording]) -> None:
    found = record([make(0), make(3)])
    value = {
        entity: scalars["Scalars:scalars"]
        for entity, scalars in found.at.items()
        if "Scalars:scalars" in scalars
    }
    assert value["/health/time_ms/voxel"][0] == [4]
    assert value["/health/rate_hz/pipeline"][0] == [50]
    assert value["/health/rate_hz/sensor"] == {3: pytest.approx([1 / 0.3])}
    assert value["/health/sync_error_ms/zed"][0] == [20]
    assert value["/health/tf_age_ms/zed"][0] == [5]
    assert value["/health/tf_age_ms/lidar"][0] == [4]
    counts = {name.rpartition("/")[2]: v[3] for name, v in value.items() if name.startswith("/health/count")}
    assert counts == {
        "points": [136],
        "invalid_points": [7],
        "voxels": [136],
        "obstacle_points": [36],
        "clusters": [2],
        "detections": [2],
        "matches": [1],
        "problems": [0],
        "failures": [0],
        "skipped_frames": [2],
    }


@pytest.mark.long
def test_batched_numbers_are_logged_unchanged(tmp_path: Path) -> None:
    """Also across a frame without a time of receipt, and where the run ends with an error."""
    results = [make(0), make(1), nothing(2, received=0), make(3), make(4)]
    found = []
    for wait in (0.0, 1e9):
        path = tmp_path / f"{wait}.rrd"
        with (
            pytest.raises(ValueError, match="cut"),
            open_recording(SCENE, load(), save=path) as sinks,
            FrameLogger(sinks.recording, load(), SCENE, wait=wait) as logger,
        ):
            logger.log_static()
            for result in results:
                logger.log(result)
            raise ValueError("cut")
        assert not path.exists()
        (path,) = unfinished_files(path)  # whole all the same: an error leaves it under this name
        verify(path)
        rows = {e: r for e, r in Recording(path).rows.items() if e.startswith("/health")}
        found.append({e: sorted(r, key=lambda row: int(row["frame"])) for e, r in rows.items()})
    at_once, waited = found
    assert at_once == waited
    assert [row["frame"] for row in waited["/health/time_ms/total"]] == [0, 1, 2, 3, 4]
    received = [row.get("received") for row in waited["/health/count/failures"]]
    assert received[1:4] == [START + 130_000_000, None, START + 330_000_000]


def test_entities_that_a_frame_lacks_are_cleared(record: Callable[..., Recording]) -> None:
    found = record([make(0), nothing(1), make(2)])
    for entity in (
        "/world/lidar/points",
        "/world/lidar/points/ground",
        "/world/lidar/points/obstacles",
        "/world/lidar/clusters",
        "/world/zed/image",
        "/world/zed/image/detections",
        "/world/zed/image/detections/weak",
        "/world/zed/image/points",
        "/world/frustums",
        "/world/fused",
        "/world/bev",
        "/bev",
    ):
        assert found.cleared(entity) == {1}, entity
    assert len(found.at["/world/zed/image"]["EncodedImage:blob"]) == 2
    assert found.at["/explain/states/zed/person"]["StateChange:state"][1] in ([""], [])


def test_a_frame_that_failed_is_logged_with_its_reason(record: Callable[..., Recording]) -> None:
    failed = nothing(0, Failure("ground", "only 2 points"), problems=("no odometry at this time",))
    found = record([failed])
    lines = {row["TextLog:level"][0]: row["TextLog:text"][0] for row in found.rows["/explain/log"]}
    assert lines == {"ERROR": "ground: only 2 points", "WARN": "no odometry at this time"}
    (page,) = found.at["/explain"]["TextDocument:text"][0]
    assert "**ground**: only 2 points" in page
    assert "no odometry at this time" in page
    assert found.at["/explain/states/pipeline"]["StateChange:state"][0] == ["failed"]
    assert found.at["/health/count/failures"]["Scalars:scalars"][0] == [1]


def test_a_recording_says_how_it_was_made(record: Callable[..., Recording]) -> None:
    config = load(settings=["clustering.eps=0.7"])
    found = record([make()], config)
    (text,) = found.static["/config"]["TextDocument:text"]
    assert "eps: 0.7" in text
    properties = found.static["/__properties/bevviz"]
    assert "eps: 0.7" in properties["config"][0]
    assert properties["preset"] == ["default"]
    assert any(line.startswith("rerun-sdk 0.") for line in properties["versions"])
    assert properties["cameras"] == ["zed"]


# --- colours that stay -------------------------------------------------------------------------


def test_colours_follow_the_object_not_the_row(record: Callable[..., Recording]) -> None:
    first, second = make(0), make(1)
    assert second.clusters is not None
    swapped = Clusters(
        np.array([1, 0, -1], np.int32)[second.clusters.labels],
        second.clusters.state,
        second.clusters.count[::-1],
        second.clusters.centroid[::-1],
        second.clusters.aabb,
        Boxes3D(*(np.ascontiguousarray(a[::-1]) for a in dataclasses.astuple(second.clusters.obb))),
    )
    found = record(tracked([first, dataclasses.replace(second, clusters=swapped)]))
    classes = found.at["/world/lidar/clusters"]["Boxes3D:class_ids"]
    assert classes[1] == classes[0][::-1]
    assert max(classes[0]) < ClassId.TRACK + TRACK_COLORS


# --- tracks and anomalies ----------------------------------------------------------------------


def tracked(results: Iterable[FrameResult]) -> list[FrameResult]:
    tracker, config, found = Tracker(), load().tracking, []
    for r in results:
        assert r.clusters is not None
        seen = clusters_in_view(r.cameras, len(r.clusters))
        found.append(
            dataclasses.replace(r, tracks=tracker.update(r.frame, r.clusters, seen, r.objects, config))
        )
    return found


def test_tracks_are_logged_with_their_trails(record: Callable[..., Recording]) -> None:
    results = tracked(make(i) for i in range(4))
    results[3] = dataclasses.replace(results[3], objects=None)
    last = results[3].tracks
    assert last is not None
    results[3] = dataclasses.replace(results[3], tracks=dataclasses.replace(last, object=last.object * 0 - 1))
    found = record(results)
    assert found.column("/world/fused", "Boxes3D:labels") == [
        ["person 0.90"],
        ["person 0.90"],
        ["person #0 0.0 m/s"],
    ]
    assert found.column("/world/fused", "track") == [[-1], [-1], [0]]
    assert found.at["/world/tracks"]["Boxes3D:labels"] == {2: ["person #0 0.0 m/s"]}
    assert found.at["/world/tracks/unseen"]["Boxes3D:labels"] == {3: ["person #0, not named"]}
    assert found.cleared("/world/tracks") == {3}
    (center,) = found.at["/world/tracks"]["Boxes3D:centers"][2]
    np.testing.assert_allclose(center, geometry.apply(WORLD_FROM_LIDAR, f32([8, 0.5, -0.8]))[0], atol=1e-3)
    (trail,) = found.at["/world/tracks/trails"]["LineStrips3D:strips"][3]
    assert len(trail) == 4
    (trail,) = found.at["/bev/overlay/trails"]["LineStrips2D:strips"][3]
    np.testing.assert_allclose(trail, [[395.0, 320.0]] * 4, atol=0.1)
    assert found.at["/bev/overlay/tracks"]["LineStrips2D:labels"][3] == ["person #0 0.0 m/s"]
    assert found.column("/tracks/states/00", "StateChange:state") == [["person #0"]]
    speeds = found.column("/tracks/speed_m_s", "Scalars:scalars")
    assert [np.isfinite(lanes).sum() for lanes in speeds] == [0, 0, 1, 1]


def test_every_entity_is_in_the_table(record: Callable[..., Recording]) -> None:
    found = record([make()])
    templates = "|".join(re.sub(r"{\w+}", ".+", entity) for entity in entities.table().values())
    assert [path for path in found.at if not re.fullmatch(rf"(?:{templates})|/__properties.*", path)] == []
    assert entities.CLASS_STATE.path("zed", "traffic light/red") == "/explain/states/zed/traffic_light_red"
    assert entities.ROBOT.path("/a/b c") == "/robot/a/b_c"


def test_lanes_are_few_and_are_kept() -> None:
    tracks = tracked(make(i) for i in range(3))[-1].tracks
    assert tracks is not None

    def crowd(*ids: int) -> Tracks:
        rows = np.zeros(len(ids), np.int64)
        return dataclasses.replace(tracks, id=np.array(ids), confirmed=tracks.confirmed[rows])

    lanes = TrackLanes()
    assert lanes.update(crowd(4, 7)) == {0: 0, 1: 1}
    assert lanes.update(crowd(7, 9)) == {1: 0, 0: 1}
    assert len(lanes.update(crowd(*range(100, 150)))) == TRACK_LANES
    assert lanes.update(None) == {}


def test_what_is_hovered_over_says_what_it_is(record: Callable[..., Recording]) -> None:
    """The viewer's tooltip shows what differs from row to row, three values at most."""
    result = make()
    found = record([result, dataclasses.replace(make(1), objects=None)])
    for boxes, sentences, names in (
        ("/world/fused", ["person 0.90, 8.0 m away: 14 points"] * 2, []),
        (
            "/world/zed/image/detections",
            ["person 0.90: 14 points", "car 0.50: no cluster"],
            ["", "car 0.50"],
        ),
    ):
        children = {"outlines": ("strips", "colors"), "names": ("positions", "labels")}
        for child, columns in list(children.items())[: 2 if names else 1]:
            rows = found.at[f"{boxes}/{child}"]
            perrow = {key: value[0] for key, value in rows.items() if len(value.get(0, ())) > 1}
            assert {key.rpartition(":")[2] for key in perrow} == {*columns, "says"}
            for says, sentence in zip(perrow["says"], sentences, strict=True):
                assert says.startswith(sentence)
        assert found.at[f"{boxes}/names"]["Points2D:labels"].get(0, []) == names
    assert found.cleared("/world/fused/outlines") == {1}
    (corner, *_), _ = found.at["/world/zed/image/detections/outlines"]["LineStrips2D:strips"][0]
    assert list(corner) == [20.5, 10.5]


def test_few_names_are_shown(record: Callable[..., Recording]) -> None:
    """Objects with an anomaly have names, others only under the pointer."""
    frames = [make(i) for i in range(4)]
    many = Boxes3D(
        f32(*([10.0 * k + 5, 24.0 * (k % 2) - 12, 0] for k in range(9))),
        f32(*[[1, 1, 1]] * 9),
        np.zeros(9, np.float32),
    )
    last = frames[-1].objects
    assert last is not None
    rows = np.zeros(9, np.int32)
    objects = Objects(many, ("car",) * 9, np.full(9, 0.5, np.float32), rows, ("zed",) * 9, rows)
    frames[-1] = dataclasses.replace(frames[-1], objects=objects, anomalies=())
    assert not record(frames[-1:]).column("/world/fused/names", "Points3D:labels")
    tracked_last = list(tracked(make(i) for i in range(4)))[-1]
    assert tracked_last.tracks is not None
    tracks = dataclasses.replace(tracked_last.tracks, object=np.array([8]))
    odd = Anomaly("jump", "person #0", "person #0 moved")
    frame = dataclasses.replace(tracked_last, objects=objects, tracks=tracks, anomalies=(odd,))
    (labels,) = record([frame]).column("/world/fused/names", "Points3D:labels")
    assert [bool(label) for label in labels] == [False] * 8 + [True]
    assert labels[8].startswith("person #0 ")


def test_suppressed_detections_are_counted() -> None:
    result = make()
    detections = Detections(
        f32(*[[20, 10, 30, 30]] * 5),
        f32(0.9, 0.8, 0.7, 0.6, 0.2),
        np.array([2, 2, 7, 2, 2], np.int32),
        ("car", "car", "truck", "car", "car"),
        np.array([DetectionState.KEPT, *[DetectionState.SUPPRESSED] * 3, DetectionState.BELOW_THRESHOLD]),
        np.array([-1, 0, 0, 0, -1], np.int32),
        f32(0, 0.9, 0.9, 0.9, 0),
    )
    camera = dataclasses.replace(result.cameras[0], detections=detections, fusion=None)
    explanations = explain([camera], None, load())
    text = decision_page(dataclasses.replace(result, cameras=(camera,), explanations=explanations))
    assert "- 3 (2 car, 1 truck) suppressed by car 0.90\n- car 0.20: below" in text
    assert text.count("suppressed") == 1


def test_anomalies_are_logged(record: Callable[..., Recording]) -> None:
    stamps = [make(i).frame.stamp for i in range(4)]
    late = Anomaly("sync", "zed", "zed is +60 ms off the cloud", since=stamps[1])
    lost = [Anomaly("tf", name, f"{name} is lost", "ERROR", since=stamps[2]) for name in ("zed", "lidar")]
    found = record(
        dataclasses.replace(make(i), anomalies=anomalies)
        for i, anomalies in enumerate([(), (late,), (late, *lost), ()])
    )
    assert found.column("/anomalies/states/sync", "StateChange:state") == [["zed"], [""]]
    assert found.column("/anomalies/states/tf", "StateChange:state") == [["zed +1"], [""]]
    assert [row["TextLog:text"] for row in found.rows["/anomalies/log"]] == [
        ["sync: zed is +60 ms off the cloud"],
        ["tf: zed is lost"],
        ["tf: lidar is lost"],
    ]
    colors = found.static["/anomalies/states/tf"]
    assert colors["StateConfiguration:values"] == ["zed +1"]
    counts = np.array(found.column("/anomalies/count", "Scalars:scalars"))
    assert counts[:, KINDS.index("tf")].tolist() == [0, 0, 2, 0]


# --- sinks -------------------------------------------------------------------------------------


@pytest.mark.long
def test_several_outputs_get_the_same_data(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    path = tmp_path / "both.rrd"
    with open_recording(SCENE, load(), save=path, serve=port) as sinks:
        (url,) = sinks.urls
        assert url.startswith(f"http://localhost:{port}/?url=rerun%2Bhttp%3A%2F%2Flocalhost%3A")
        with urllib.request.urlopen(url, timeout=PATIENCE) as page:
            assert b"rerun" in page.read().lower()
        FrameLogger(sinks.recording, load(), SCENE).log(make())
    verify(path)
    assert Recording(path).blueprints == 1


@pytest.mark.long
def test_an_error_on_the_way_leaves_a_readable_file(tmp_path: Path) -> None:
    path = tmp_path / "broken.rrd"
    with pytest.raises(KeyboardInterrupt), open_recording(SCENE, load(), save=path) as sinks:
        logger = FrameLogger(sinks.recording, load(), SCENE)
        logger.log_static()
        logger.log(make(0))
        logger.log(make(1))
        raise KeyboardInterrupt
    verify(path)
    assert sorted(Recording(path).at["/world/lidar/points"]["Points3D:positions"]) == [0, 1]


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_killed_process_leaves_what_it_had_logged(tmp_path: Path) -> None:
    path = tmp_path / "killed.rrd"
    script = f"""
        import os, signal, time
        from pathlib import Path
        from bevviz.config import load
        from bevviz.recording.frame_logger import FrameLogger
        from bevviz.recording.sinks import open_recording
        from tests.support.logged_frames import SCENE, make
        with open_recording(SCENE, load(), save=Path({str(path)!r})) as sinks:
            logger = FrameLogger(sinks.recording, load(), SCENE)
            logger.log_static()
            for index in range(5):
                logger.log(make(index))
            time.sleep(1.5)
            os.kill(os.getpid(), signal.SIGKILL)
    """
    root = Path(__file__).resolve().parents[1]
    env = {**os.environ, "PYTHONPATH": str(root)}
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)], cwd=root, env=env, timeout=PATIENCE
    )
    assert done.returncode == -signal.SIGKILL
    (left,) = unfinished_files(path)
    assert not path.exists()
    assert sorted(Recording(left).at["/world/lidar/points"]["Points3D:positions"]) == [0, 1, 2, 3, 4]
    with open_recording(SCENE, load(), save=path) as sinks:  # the next run tells
        assert sinks.warnings == [f"{left.name}: left by a run that did not end; keep or delete it"]
    assert path.exists() and left.exists()


@pytest.mark.parametrize(
    ("where", "message"),
    [
        (
            {"save": Path("/nonexistent/a.rrd")},
            "/nonexistent/a.rrd: cannot write the recording",
        ),
        ({"connect": "localhost"}, "--connect localhost: expected a URL such as rerun"),
        ({"connect": "rerun+http://127.0.0.1:x/proxy"}, "expected a URL such as rerun"),
        ({"connect": "rerun+http://127.0.0.1:1/proxy"}, "no viewer answers there"),
        ({"blueprint": "debgu"}, "did you mean 'debug'"),
    ],
)
def test_outputs_that_cannot_be_opened_are_one_line(where: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message) as caught, open_recording(SCENE, load(), **where):
        pass
    assert "\n" not in str(caught.value)


def test_a_port_in_use_names_a_free_one() -> None:
    with socket.socket() as taken:
        taken.bind(("", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with (
            pytest.raises(UserError, match=rf"--serve {port}: the port is in use; another one: --serve \d+"),
            open_recording(SCENE, load(), serve=port),
        ):
            pass
