"""The transform tree over time."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bevviz.messages.transforms import StampedTransform
from bevviz.model import geometry
from bevviz.model.frame import F64
from bevviz.sync.transform_tree import Origin, TransformBuffer, TransformError

SECOND = 1_000_000_000


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> F64:
    return geometry.transform(np.array([x, y, z]), np.array([0, 0, np.sin(yaw / 2), np.cos(yaw / 2)]))


def sample(parent: str, child: str, seconds: float, matrix: F64) -> StampedTransform:
    return StampedTransform(round(seconds * SECOND), parent, child, matrix)


def turning(t: float) -> F64:
    """Return the pose of a robot on a circle of 5 m at 0.4 rad/s."""
    return pose(5 * np.sin(0.4 * t), 5 - 5 * np.cos(0.4 * t), yaw=0.4 * t)


def drive(buffer: TransformBuffer, seconds: float = 2.0, rate: float = 50.0) -> None:
    for t in np.arange(0, seconds + 1e-9, 1 / rate):
        buffer.add(sample("odom", "base_link", t, turning(t)))


@pytest.fixture
def robot() -> TransformBuffer:
    """Build the transforms map -> odom -> base_link -> rslidar, and base_link -> zed -> optical."""
    buffer = TransformBuffer()
    buffer.add(sample("map", "odom", 0, pose(100, 50, yaw=1.0)), static=True)
    buffer.add(sample("base_link", "rslidar", 0, pose(0.3, 0, 1.2, yaw=0.1)), static=True)
    buffer.add(sample("base_link", "zed", 0, pose(0.5, 0.06, 0.9)), static=True)
    optical = geometry.transform(np.zeros(3), np.array([-0.5, 0.5, -0.5, 0.5]))
    buffer.add(sample("zed", "optical", 0, optical), static=True)
    drive(buffer)
    return buffer


def test_interpolated_through_the_tree_as_in_closed_form(robot: TransformBuffer) -> None:
    for t in (0.0, 0.513, 1.0, 1.777):
        found = robot.lookup("map", "rslidar", round(t * SECOND), 0.0)
        expected = pose(100, 50, yaw=1.0) @ turning(t) @ pose(0.3, 0, 1.2, yaw=0.1)
        np.testing.assert_allclose(found.matrix, expected, atol=1e-3)  # the chord of 0.02 s of the circle
        np.testing.assert_allclose(found.matrix[:3, :3], expected[:3, :3], atol=1e-9)
        assert found.age <= 0.0101
    assert robot.lookup("map", "rslidar", SECOND, 0.0).age == 0.0


def test_static_chain_needs_no_stamp(robot: TransformBuffer) -> None:
    found = robot.lookup("optical", "rslidar", 10**18, 0.0)
    assert found.age == 0.0
    ahead = found.matrix @ np.array([10.0, 1.0, 0.0, 1.0])  # of the LiDAR, turned by 0.1 rad
    x, y = 10 * np.cos(0.1) - np.sin(0.1) - 0.2, 10 * np.sin(0.1) + np.cos(0.1) - 0.06
    np.testing.assert_allclose(ahead[:3], [-y, -0.3, x], atol=1e-12)
    assert robot.latest("optical", "rslidar") is None
    assert robot.latest("map", "optical") == 2 * SECOND


def test_moving_lookup_keeps_the_world_in_place(robot: TransformBuffer) -> None:
    early, late = round(0.5 * SECOND), round(0.58 * SECOND)
    point = np.array([8.0, 3.0, 0.5, 1.0])
    fixed = robot.lookup("odom", "rslidar", early, 0.0).matrix @ point
    seen = robot.lookup("odom", "optical", late, 0.0).matrix
    found = robot.lookup_moving("optical", late, "rslidar", early, "odom", 0.0).matrix @ point
    np.testing.assert_allclose(found, geometry.inverse(seen) @ fixed, atol=1e-12)
    still = robot.lookup("optical", "rslidar", early, 0.0).matrix @ point
    assert np.linalg.norm(found - still) > 0.1


def test_held_past_the_end_within_the_tolerance(robot: TransformBuffer) -> None:
    found = robot.lookup("odom", "base_link", round(2.15 * SECOND), 0.2)
    np.testing.assert_allclose(found.matrix, turning(2.0), atol=1e-12)
    assert found.age == pytest.approx(0.15)
    with pytest.raises(TransformError, match=r"'odom' -> 'base_link' ends 1\.20 s before the asked stamp"):
        robot.lookup("map", "rslidar", round(3.2 * SECOND), 0.2)
    with pytest.raises(TransformError, match=r"'odom' -> 'base_link' begins 0\.50 s after the asked stamp"):
        robot.lookup("rslidar", "map", -SECOND // 2, 0.2)


def test_a_repeated_pose_holds_until_the_next_pose() -> None:
    buffer = TransformBuffer()
    for t in (3.0, 8.0):
        buffer.add(sample("base_link", "camera", t, pose(0.5)), held=True)
        for stamp in (0, 5, 20):
            np.testing.assert_array_equal(
                buffer.lookup("base_link", "camera", stamp * SECOND, 0.2).matrix, pose(0.5)
            )
    buffer.add(sample("base_link", "camera", 9.0, pose(0.6)), held=True)
    np.testing.assert_allclose(buffer.lookup("base_link", "camera", 17 * SECOND // 2, 0.2).matrix, pose(0.55))
    with pytest.raises(TransformError, match=r"'base_link' -> 'camera' ends 11\.00 s before the asked stamp"):
        buffer.lookup("base_link", "camera", 20 * SECOND, 0.2)


def test_unconnected_frames_are_reported(robot: TransformBuffer) -> None:
    with pytest.raises(TransformError, match="from 'velodyne' to 'odom': frame 'velodyne' is unknown"):
        robot.lookup("odom", "velodyne", 0, 0.2)
    robot.add(sample("dock", "beacon", 0, pose()), static=True)
    with pytest.raises(TransformError, match=r"two unconnected trees \(roots 'dock' and 'map'\)"):
        robot.lookup("rslidar", "beacon", 0, 0.2)
    with pytest.raises(TransformError, match="states no frame_id"):
        robot.lookup("odom", "", 0, 0.2)
    assert not robot.knows("rslidar", "beacon") and robot.knows("rslidar", "map")
    assert robot.root("optical") == "map" and "beacon" in robot.frames()


def test_any_order_of_arrival_gives_the_same(robot: TransformBuffer) -> None:
    times = np.arange(0, 2 + 1e-9, 0.02)
    np.random.default_rng(1).shuffle(times)
    shuffled = TransformBuffer()
    for t in [*times, *times[:20]]:  # some of them twice
        shuffled.add(sample("/odom", "/base_link", t, turning(t)))  # as ROS 1 writes them
    for t in (0.013, 1.234):
        asked = round(t * SECOND)
        ours, theirs = (b.lookup("odom", "base_link", asked, 0.0) for b in (shuffled, robot))
        np.testing.assert_array_equal(ours.matrix, theirs.matrix)
    assert shuffled.problems == ()


def test_a_repeated_stamp_replaces_the_sample() -> None:
    buffer = TransformBuffer()
    for x in (1.0, 2.0):
        buffer.add(sample("odom", "base_link", 1, pose(x)))
    assert buffer.lookup("odom", "base_link", SECOND, 0.0).matrix[0, 3] == 2.0


def test_newer_parent_wins_and_is_told(robot: TransformBuffer) -> None:
    robot.add(sample("arm", "rslidar", 0, pose(9)), static=True)
    robot.add(sample("odom", "arm", 0, pose(1)), static=True)
    assert robot.tree()["rslidar"] == "arm"
    assert robot.lookup("odom", "rslidar", SECOND, 0.0).matrix[0, 3] == 10.0
    assert any("'rslidar' has two parents, 'arm' and 'base_link'" in p for p in robot.problems)
    robot.add(sample("elsewhere", "base_link", 0.5, pose()))  # older than what odom said
    assert robot.tree()["base_link"] == "odom"


def test_a_cycle_is_refused(robot: TransformBuffer) -> None:
    before = dict(robot.tree())
    robot.add(sample("optical", "map", 3, pose()))
    robot.add(sample("zed", "zed", 3, pose()))
    assert robot.tree() == before
    assert any("'optical' -> 'map' is refused" in p for p in robot.problems)
    assert robot.lookup("map", "optical", SECOND, 0.0).age == 0.0


def test_the_authority_of_a_transform_decides() -> None:
    buffer = TransformBuffer()
    buffer.add(sample("odom", "base_link", 0, pose(1)), origin=Origin.ODOMETRY)
    buffer.add(sample("base_link", "odom", 0, pose(2)))  # /tf has the same edge the other way round
    assert buffer.tree() == {"odom": "base_link"}
    buffer.add(sample("odom", "base_link", 0.1, pose(1)), origin=Origin.ODOMETRY)
    assert buffer.lookup("base_link", "odom", 0, 0.0).matrix[0, 3] == 2.0
    buffer.add(sample("base_link", "rslidar", 0, pose(3)), static=True, origin=Origin.CONFIG)
    buffer.add(sample("base_link", "rslidar", 0, pose(4)), static=True)
    assert buffer.lookup("base_link", "rslidar", 0, 0.0).matrix[0, 3] == 3.0
    assert buffer.problems == (
        "'base_link' -> 'rslidar' is ignored: source.extrinsics states the parent of 'rslidar' (1 time)",
    )


def test_unusable_samples_are_left_out_and_counted(robot: TransformBuffer) -> None:
    robot.add(sample("odom", "", 1, pose()))
    robot.add(sample("odom", "base_link", 1.01, np.full((4, 4), np.nan)))
    robot.add(sample("odom", "base_link", 1.01, np.diag([2.0, 2.0, 2.0, 1.0])))
    assert np.isfinite(robot.lookup("odom", "base_link", round(1.01 * SECOND), 0.0).matrix).all()
    assert len(robot.problems) == 2 and robot.problems[1].endswith("(2 times)")


def test_history_is_bounded_and_cleared_when_time_jumps_back() -> None:
    buffer = TransformBuffer(duration=5.0)
    for i in range(10_000):
        buffer.add(sample("odom", "base_link", i * 0.01, pose(i)))
    kept = buffer._edges["base_link"].stamps
    assert 500 <= len(kept) <= 626
    assert buffer.lookup("odom", "base_link", round(95.005 * SECOND), 0.0).matrix[0, 3] == pytest.approx(
        9500.5
    )
    buffer.add(sample("odom", "base_link", 0.5, pose(-1)))
    assert buffer.lookup("odom", "base_link", SECOND // 2, 0.0).matrix[0, 3] == -1
    assert any("jumped back" in p for p in buffer.problems)
    with pytest.raises(TransformError):
        buffer.lookup("odom", "base_link", 99 * SECOND, 0.2)


def test_forget_after_keeps_what_is_static(robot: TransformBuffer) -> None:
    robot.forget_after(SECOND)
    assert robot.latest("map", "rslidar") == SECOND
    robot.forget_after(-1)
    assert "base_link" not in robot.tree() and robot.knows("rslidar", "optical")


quaternions = st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1)
poses = st.builds(
    lambda t, q: geometry.transform(np.array(t), np.array(q)),
    st.lists(st.floats(-100, 100), min_size=3, max_size=3),
    quaternions,
)


@pytest.mark.long
@settings(max_examples=50, deadline=None)
@given(st.data())
def test_any_tree_is_consistent(data: st.DataObject) -> None:
    count = data.draw(st.integers(2, 8))
    buffer = TransformBuffer()
    for child in range(1, count):
        parent = data.draw(st.integers(0, child - 1))
        static = data.draw(st.booleans())
        for seconds in (0,) if static else (0, 1, 2):
            buffer.add(sample(f"f{parent}", f"f{child}", seconds, data.draw(poses)), static)
    names = st.integers(0, count - 1).map("f{}".format)
    a, b, c = data.draw(names), data.draw(names), data.draw(names)
    stamp = data.draw(st.integers(0, 2 * SECOND))

    def at(target: str, source: str) -> F64:
        return buffer.lookup(target, source, stamp, 0.0).matrix

    np.testing.assert_allclose(at(a, b) @ at(b, a), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(at(a, b) @ at(b, c), at(a, c), atol=1e-9)
    product = np.eye(4)
    path = buffer.ancestors(a)
    for child_name, parent_name in pairwise(path):
        product = at(parent_name, child_name) @ product
    np.testing.assert_allclose(at("f0", a), product, atol=1e-9)
