"""Estimate of the robot's motion from its scans, on real and synthetic drives."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import bevviz
from bevviz.bags.source import BagSource
from bevviz.config import load
from bevviz.errors import StageError
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.model import geometry
from bevviz.model.frame import F64, Frame
from bevviz.model.results import FrameResult
from bevviz.pipeline.session import Session, Variants
from bevviz.recording import entities
from bevviz.stages.odometry import ESTIMATED, Odometry, place
from bevviz.workbench.recorded_drive import RecordedDrive
from tests.support.recordings import Recording
from tests.support.track_metrics import IdentityCounter, without_pose
from tests.support.waiting import until

STEP = 100_000_000  # nanoseconds between scans


@pytest.fixture(scope="module")
def street() -> list[Frame]:
    """Return a synthetic drive of 0.7 m a scan, with its true poses."""
    return [SyntheticSource(12, 1011).frame(i) for i in range(12)]


def drift(frames: list[Frame], poses: list[F64]) -> float:
    """Return the distance of the last pose from the true one, as a share of the way."""
    true = [geometry.inverse(frames[0].pose) @ frame.pose for frame in frames]
    way = sum(float(np.linalg.norm(b[:3, 3] - a[:3, 3])) for a, b in pairwise(true))
    return float(np.linalg.norm(poses[-1][:3, 3] - true[-1][:3, 3])) / way


def estimated(frames: list[Frame]) -> list[F64]:
    odometry = Odometry()
    return [odometry.estimate(frame.points, frame.stamp) for frame in frames]


@pytest.mark.long
def test_the_estimate_drifts_by_less_than_3_percent(street: list[Frame]) -> None:
    assert drift(street, estimated(street)) < 0.03


def test_missing_scans_and_a_start_at_speed_do_no_harm(street: list[Frame]) -> None:
    kept = [street[i] for i in (0, 3, 4, 5, 9, 10, 11)]
    assert drift(kept, estimated(kept)) < 0.03


def test_a_scan_without_structures_counts_as_missing(street: list[Frame]) -> None:
    empty = replace(street[5], points=street[5].points[:0])
    poses = estimated([*street[:5], empty, *street[6:]])
    np.testing.assert_array_equal(poses[5], poses[4])
    assert drift(street, poses) < 0.03


def test_one_of_two_lidars_may_miss_scans(street: list[Frame]) -> None:
    def half(frame: Frame, front: bool) -> Frame:
        return replace(frame, points=frame.points[(frame.points[:, 0] > 0) == front])

    parts = {3: True, 5: False, 8: False}
    frames = [half(frame, parts[i]) if i in parts else frame for i, frame in enumerate(street)]
    assert drift(street, estimated(frames)) < 0.03


def test_a_standing_robot_stands(street: list[Frame]) -> None:
    frames = [replace(street[0], stamp=street[0].stamp + i * STEP) for i in range(4)]
    for pose in estimated(frames):
        np.testing.assert_allclose(pose, np.eye(4), atol=1e-3)


@pytest.mark.long
def test_a_scan_elsewhere_does_not_fit_and_begins_a_new_map(street: list[Frame]) -> None:
    odometry, far = Odometry(), SyntheticSource(1, 7).frame(0).points
    before = [odometry.estimate(frame.points, frame.stamp) for frame in street[:6]][-1]
    with pytest.raises(StageError, match="does not fit"):
        odometry.estimate(far, street[6].stamp)
    np.testing.assert_array_equal(odometry.poses[street[6].stamp], before)


def test_a_long_gap_ends_the_speed(street: list[Frame]) -> None:
    odometry = Odometry()
    poses = [odometry.estimate(frame.points, frame.stamp) for frame in street[:3]]
    later = street[3].stamp + 20 * STEP
    np.testing.assert_array_equal(odometry.estimate(street[3].points, later), poses[-1])


def run(frames: list[Frame], *settings: str, estimates_motion: bool = True) -> list[FrameResult]:
    processor = Session(load(settings=settings))
    processor.estimates_motion = estimates_motion
    return [processor.run(frame) for frame in frames]


def test_a_drive_without_poses_is_placed_by_its_estimate(street: list[Frame]) -> None:
    results = run([without_pose(frame) for frame in street])
    poses = [result.frame.pose for result in results]
    assert drift(street, poses) < 0.03
    assert all("odometry" in result.timings and not result.failures for result in results)
    for result, frame in zip(results, street, strict=True):
        moved = result.frame.pose @ geometry.inverse(frame.pose)
        assert result.frame.truth is not None and frame.truth is not None
        for pose, true in (
            (result.frame.cameras[0].world_from_camera, frame.cameras[0].world_from_camera),
            (result.frame.truth.world_from_boxes, frame.truth.world_from_boxes),
        ):
            assert pose is not None and true is not None
            np.testing.assert_allclose(pose, moved @ true, atol=1e-6)
        assert result.cameras[0].camera is result.frame.cameras[0]


def test_stated_motion_none_and_live_leave_frames_alone(street: list[Frame]) -> None:
    bare = [without_pose(frame) for frame in street[:3]]
    lost = [replace(frame, world_frame="map") for frame in bare]
    for results, frames in (
        (run(street[:3]), street[:3]),
        (run(lost), lost),
        (run(bare, "odometry.method=none"), bare),
        (run(bare, estimates_motion=False), bare),
    ):
        for result, frame in zip(results, frames, strict=True):
            assert result.frame is frame and "odometry" not in result.timings


def test_kiss_icp_replaces_a_pose_that_never_changes(street: list[Frame]) -> None:
    stuck = [place(without_pose(frame), np.eye(4)) for frame in street]
    results = run(stuck, "odometry.method=kiss_icp")
    assert drift(street, [result.frame.pose for result in results]) < 0.03


def test_variants_share_one_estimate(street: list[Frame]) -> None:
    variants = Variants()
    sessions = [variants.session(config) for config in (load(), load(settings=["clustering.eps=0.6"]))]
    for frame in map(without_pose, street[:4]):
        a, b = (session.perceive(variants.frame(frame, session.config)) for session in sessions)
        np.testing.assert_array_equal(a.frame.pose, b.frame.pose)
    assert a.frame.pose[0, 3] > 1.5


def test_a_missing_package_is_one_line(street: list[Frame], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "kiss_icp.pybind", None)
    results = run([without_pose(frame) for frame in street[:3]])
    texts = [failure.reason for result in results for failure in result.failures]
    assert len(texts) == 1 and "pip install kiss-icp" in texts[0]
    assert all(result.tracks is not None for result in results)


# --- real drives -------------------------------------------------------------------------------


@pytest.mark.long
def test_a_real_drive_repeats_and_single_frames_agree(shared: Path, tmp_path: Path) -> None:
    with bevviz.open(shared / "kitti_drive") as drive:
        assert drive.at(frame=20).frame.world_from_points is None, "no run has placed it"
        first = [result.frame.pose for result in drive]
        again = {result.frame.index: result.frame for result in drive}
        single = drive.at(frame=20)
        np.testing.assert_array_equal(first, [frame.pose for frame in again.values()])
        np.testing.assert_array_equal(single.frame.pose, again[20].pose)
        assert single.frame.world_frame == ESTIMATED
        saved = drive.save(tmp_path / "drive.rrd")
    assert first[0].tolist() == np.eye(4).tolist()
    x, y, z = first[-1][:3, 3]
    assert 5.2 < x < 5.5 and abs(y) < 0.2 and abs(z) < 0.1, "Open3D matches first and last scan at 5.4 m"
    lines = [text for (text,) in Recording(saved).column(entities.EXPLAIN_LOG, "TextLog:text")]
    assert [line for line in lines if "odometry.method" in line] == lines[:1]


@pytest.mark.long
def test_the_workbench_places_questions_as_its_run_does(shared: Path) -> None:
    path = shared / "kitti_drive"
    bench = RecordedDrive(bevviz.open(path), BagSource([path], load()))
    try:
        assert bench.look(20).frame.world_from_points is None, "the run has not come that far"
        bench.go_on()
        bench.start()
        until(lambda: bench.over)
        tracks, frame = bench.tracks(20), bench.look(20).frame
        assert tracks is not None and tracks.frame_id == frame.world_frame == ESTIMATED
        assert frame.pose[0, 3] > 3.0
        np.testing.assert_array_equal(bench.look(20, ("clustering.eps=0.6",)).frame.pose, frame.pose)
    finally:
        bench.close()


@pytest.mark.long
def test_estimated_motion_shows_that_a_queue_stands(shared: Path) -> None:
    """The robot drives at 2.2 m/s past cars and trucks, most of which stand."""
    model, speeds = shared / "models" / "yolox_nano.onnx", {}
    for method in ("auto", "none"):
        counter, of_tracks = IdentityCounter(), list[float]()
        with bevviz.open(shared / "kitti_drive", model=model, set={"odometry.method": method}) as drive:
            for result in drive:
                tracks = result.tracks
                assert tracks is not None
                counter.add(tracks)
                settled = tracks.confirmed & (tracks.cluster >= 0) & (tracks.age > 1)
                of_tracks += np.hypot(*tracks.velocity[settled, :2].T).tolist()
        assert counter.switches <= 4, "as test_tracking.py"
        speeds[method] = float(np.median(of_tracks))
    assert speeds["auto"] < 0.5 < 1.5 < speeds["none"]


def test_single_frames_of_kitti_are_never_matched(shared: Path) -> None:
    for method in ("auto", "kiss_icp"):
        with bevviz.open(shared / "kitti", set={"odometry.method": method}, frames=(0, 3)) as drive:
            for result in drive:
                np.testing.assert_array_equal(result.frame.pose, np.eye(4))
                assert not result.failures
