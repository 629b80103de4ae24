"""Ours against the robot's, frame by frame, whenever the robot's boxes come."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bevviz.compare.robot_comparison import WAITING, RobotComparison
from bevviz.config import load
from bevviz.evaluate.differences import Change
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.extras.demo.sensors import Lidar, PinholeCamera
from bevviz.model.frame import Boxes3D, Frame, LabelledBoxes2D, LabelledBoxes3D
from bevviz.model.results import FrameResult, Objects

TOPIC = "/detection/fused_3d"
CONFIG = load(settings=["live.robot_time=0.3 s"])


@pytest.fixture(scope="module")
def first() -> Frame:
    source = SyntheticSource(
        frames=1, lidar=Lidar(beams=8, azimuths=90), camera=PinholeCamera(width=64, height=36, focal=44.0)
    )
    return source.snapshot(0).frame


def boxes(x: float) -> Boxes3D:
    center = np.array([[x, 0, 0]], np.float32)
    return Boxes3D(center, np.full((1, 3), 2, np.float32), np.zeros(1, np.float32))


def theirs(frame: Frame, x: float, topic: str = TOPIC) -> LabelledBoxes3D:
    """In the world, as they come."""
    return LabelledBoxes3D(
        stamp=frame.stamp,
        frame_id="map",
        topic=topic,
        boxes=boxes(x),
        labels=("car",),
        scores=np.ones(1, np.float32),
        world_from_boxes=frame.pose,
    )


def result(first: Frame, index: int, robot: float | None = None, x: float = 10.0) -> FrameResult:
    frame = replace(first, index=index, stamp=first.stamp + index * 100_000_000)
    if robot is not None:
        frame = replace(frame, robot_boxes=(theirs(frame, robot),))
    none = np.full(1, -1, np.int32)
    objects = Objects(boxes(x), ("car",), np.ones(1, np.float32), none, ("",), none)
    return replace(FrameResult.unprocessed(frame, CONFIG), objects=objects)


def test_boxes_may_arrive_before_or_after_the_result(first: Frame) -> None:
    against = RobotComparison("")
    (with_it,) = against.compare(result(first, 0, robot=10.1))
    assert [d.change for d in with_it.objects] == [Change.SAME] and against.topic == TOPIC
    assert against.compare(result(first, 1)) == []
    early = result(first, 3)  # the robot has said so before our result is there
    late = [(result(first, 1).frame.stamp, theirs(first, 11.0)), (early.frame.stamp, theirs(first, 10.4))]
    (after,) = against.compare(result(first, 2), late)
    assert after.a.index == 1 and after.objects[0].change is Change.MOVED
    assert after.objects[0].distance == pytest.approx(1.0, abs=1e-4)
    (before,) = against.compare(early)
    # 0.4 m is no difference yet.
    assert before.a.index == 3 and (against.frames, against.differing) == (3, 1)


def detections(frame: Frame, camera: str) -> LabelledBoxes2D:
    box = np.array([[1, 1, 20, 20]], np.float32)
    return LabelledBoxes2D(
        "/camera_2d", frame.stamp, "optical", box, ("car",), np.ones(1, np.float32), camera
    )


def test_image_boxes_count_if_they_precede_the_3d_boxes(first: Frame) -> None:
    against = RobotComparison("")
    camera = first.cameras[0].name
    assert against.compare(result(first, 0)) == []
    old = result(first, 0).frame
    assert against.compare(result(first, 1), [(old.stamp, detections(old, camera))]) == []
    (after,) = against.compare(result(first, 2), [(old.stamp, theirs(old, 10.0))])
    assert after.a.index == 0 and after.b.images[camera].names == ("car",)
    assert against.late_images == 0
    (direct,) = against.compare(result(first, 3, robot=10.0))
    assert direct.b.images == {}
    known = result(first, 3).frame
    against.compare(result(first, 4), [(known.stamp, detections(known, camera))])
    assert against.late_images == 1


def test_a_difference_that_lasts_is_a_reason_once(first: Frame) -> None:
    against = RobotComparison("")
    reasons = []
    for index in range(12):
        against.compare(result(first, index, robot=10.0 if index in (0, 7) else 11.0))
        reasons.append(against.reason())
    assert [bool(reason) for reason in reasons] == [index in (4, 11) for index in range(12)]
    assert reasons[4] is not None and reasons[4].startswith(
        "robot and ours differ for 0.3 s: car 1.00 m apart"
    )


def test_several_topics_are_told_and_nothing_grows(first: Frame) -> None:
    against = RobotComparison("")
    both = result(first, 0)
    frame = both.frame
    both = replace(both, frame=replace(frame, robot_boxes=(theirs(frame, 1, "/a"), theirs(frame, 1, "/b"))))
    assert against.compare(both) == [] and "which of its topics" in against.problem
    for index in range(1, 3 * WAITING):
        against.compare(result(first, index), [(index, theirs(first, 1, "/a"))])
    assert len(against._waiting) == WAITING and len(against._boxes) <= WAITING


def test_a_frame_that_ours_made_nothing_of_is_not_compared(first: Frame) -> None:
    """Nothing was found and nothing was looked for are two things: a failed stage is no difference."""
    against = RobotComparison("")
    (before,) = against.compare(result(first, 0, robot=11.0))
    assert before.counts[Change.MOVED] == 1
    for index in range(1, 9):
        failed = replace(result(first, index, robot=11.0), objects=None)
        assert against.compare(failed) == []
        assert against.reason() is None
    assert (against.frames, against.differing, against.without_ours) == (1, 1, 8)
    assert against.compare(result(first, 9)) == []
    late = [(result(first, 9).frame.stamp, theirs(first, 10.0))]
    (after,) = against.compare(replace(result(first, 10), objects=None), late)
    assert after.a.index == 9 and after.counts == {Change.SAME: 1}
    nobody = Objects(
        Boxes3D.empty(), (), np.zeros(0, np.float32), np.zeros(0, np.int32), (), np.zeros(0, np.int32)
    )
    (nothing,) = against.compare(replace(result(first, 11, robot=10.0), objects=nobody))
    assert nothing.counts == {Change.ONLY_B: 1}
