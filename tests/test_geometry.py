"""Transforms, projection and boxes, against OpenCV and brute force."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bevviz.model import box_overlap, geometry
from bevviz.model.box_points import inside_each
from bevviz.model.frame import F64, Boxes3D, Intrinsics

K = np.array([[320.0, 0, 310], [0, 330, 170], [0, 0, 1]])
OAK = (4.985, 1.378, -1.6e-5, 1.9e-4, 0.0126, 5.356, 2.905, 0.162, 0.01, -0.002, 0.03, 0.001, 0.02, -0.01)
CAMERAS = {
    "pinhole": Intrinsics(640, 360, K),
    "plumb_bob": Intrinsics(640, 360, K, "plumb_bob", np.array([-0.28, 0.09, 0.001, -0.0005, -0.012])),
    "rational_polynomial": Intrinsics(
        640, 360, K, "rational_polynomial", np.array([3.2, 1.1, 2e-4, 1e-4, 0.04, 3.5, 2.0, 0.25])
    ),
    "thin prism and tilt": Intrinsics(640, 360, K, "rational_polynomial", np.array(OAK)),
    "equidistant": Intrinsics(640, 360, K, "equidistant", np.array([0.03, -0.01, 0.006, -0.002])),
}

reals = st.floats(-50, 50)
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)


@st.composite
def poses(draw: st.DrawFn) -> F64:
    return geometry.transform(np.array(draw(st.tuples(reals, reals, reals))), np.array(draw(quaternions)))


@settings(deadline=None)
@given(quaternions)
def test_quaternion_round_trip(q: tuple[float, ...]) -> None:
    unit = np.array(q) / np.linalg.norm(q)
    back = geometry.quaternion(geometry.transform(np.zeros(3), np.array(q)))
    assert back[3] >= 0
    assert abs(unit @ back) == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("q", [(0, 0, 0, 0), (np.nan, 0, 0, 1)])
def test_the_zero_quaternion_is_refused(q: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="is no rotation"):
        geometry.transform(np.zeros(3), np.array(q))


@settings(deadline=None)
@given(poses())
def test_inverse_undoes_a_transform(pose: F64) -> None:
    np.testing.assert_allclose(geometry.inverse(pose) @ pose, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)


@settings(deadline=None)
@given(poses(), poses(), st.floats(0, 1))
def test_interpolation_turns_evenly_on_the_shorter_arc(a: F64, b: F64, t: float) -> None:
    def angle(m: F64, n: F64) -> float:
        q = geometry.quaternion(geometry.inverse(m) @ n)
        return 2 * float(np.arctan2(np.linalg.norm(q[:3]), q[3]))

    middle = geometry.interpolate(a, b, t)
    np.testing.assert_allclose(middle[:3, 3], a[:3, 3] * (1 - t) + b[:3, 3] * t, atol=1e-9)
    assert angle(a, middle) == pytest.approx(t * angle(a, b), abs=1e-6)
    assert angle(middle, b) == pytest.approx((1 - t) * angle(a, b), abs=1e-6)


@settings(deadline=None)
@given(poses(), st.lists(st.tuples(reals, reals, reals), max_size=20))
def test_apply_equals_the_matrix_product(pose: F64, points: list[tuple[float, float, float]]) -> None:
    p = np.array(points, np.float32).reshape(-1, 3)
    moved = geometry.apply(pose, p)
    assert moved.dtype == np.float32
    np.testing.assert_allclose(moved, (pose @ np.c_[p, np.ones(len(p))].T).T[:, :3], atol=1e-3)


@settings(deadline=None)
@given(st.floats(-3.1, 3.1))
def test_yaw_is_read_from_a_transform(angle: float) -> None:
    pose = geometry.transform(np.zeros(3), np.array([0, 0, np.sin(angle / 2), np.cos(angle / 2)]))
    assert geometry.yaw(pose) == pytest.approx(angle)


# --- cameras -----------------------------------------------------------------------------------


def seen_points(camera: Intrinsics, count: int = 500) -> F64:
    """Points of the optical frame within, and a little around, the field of view."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1.1, 1.1, count), rng.uniform(-0.65, 0.65, count)
    z = rng.uniform(0.5, 80, count)
    return np.column_stack([x * z, y * z, z])


@pytest.mark.parametrize("model", CAMERAS)
def test_projection_equals_opencvs(model: str) -> None:
    camera = CAMERAS[model]
    points = seen_points(camera)
    uv, depth = geometry.project(points.astype(np.float32), camera)
    none = np.zeros(3)
    if model == "equidistant":
        expected, _ = cv2.fisheye.projectPoints(points.reshape(-1, 1, 3), none, none, K, camera.D)
    else:
        expected, _ = cv2.projectPoints(points, none, none, K, camera.D if camera.D.size else None)
    np.testing.assert_allclose(uv, expected.reshape(-1, 2), atol=0.01)
    np.testing.assert_allclose(depth, points[:, 2], rtol=1e-6)


@pytest.mark.parametrize("model", CAMERAS)
def test_rays_invert_the_projection(model: str) -> None:
    camera = CAMERAS[model]
    points = seen_points(camera)
    uv, _ = geometry.project(points, camera)
    seen = np.all((uv >= 0) & (uv < (camera.width, camera.height)), axis=1)
    assert seen.sum() > 100
    rays = geometry.rays(uv[seen], camera)
    np.testing.assert_allclose(rays, points[seen] / points[seen, 2:], atol=2e-5)


def test_no_rays_of_no_pixels() -> None:
    assert geometry.rays(np.zeros((0, 2)), CAMERAS["plumb_bob"]).shape == (0, 3)


def test_nothing_behind_the_camera_is_projected() -> None:
    points = np.array([[0, 0, -1], [1, 1, 0], [0, 0, 1], [np.nan, 0, 1]], np.float32)
    uv, depth = geometry.project(points, CAMERAS["pinhole"])
    assert np.isnan(uv[[0, 1]]).all()
    np.testing.assert_allclose(uv[2], [310, 170])
    np.testing.assert_array_equal(depth, [-1, 0, 1, 1])


@pytest.mark.parametrize(
    ("model", "d"),
    [
        ("plumb_bob", [-0.4, 0.0, 0, 0, 0.0]),  # turns over once
        ("plumb_bob", [-0.5, 0.08, 0, 0, 0.0]),  # turns over, and grows again farther out
        ("rational_polynomial", [0, 0, 0, 0, 0, -0.1, 0, 0]),  # has a pole
        ("equidistant", [-0.3, 0, 0, 0]),
    ],
)
def test_folded_distortion_brings_nothing_back_into_the_image(model: str, d: list[float]) -> None:
    camera = Intrinsics(640, 360, K, model, np.array(d))
    tangent = np.geomspace(0.01, 50, 2000)
    points = np.column_stack([tangent, np.zeros_like(tangent), np.ones_like(tangent)])
    uv, _ = geometry.project(points, camera)
    valid = np.isfinite(uv[:, 0])
    edge = np.count_nonzero(valid)
    assert 0 < edge < len(points)
    assert valid[:edge].all(), "one range about the axis, nothing beyond it"
    assert np.all(np.diff(uv[:edge, 0]) > 0)


@pytest.mark.parametrize("model", CAMERAS)
def test_frustum_projects_to_its_box(model: str) -> None:
    camera = CAMERAS[model]
    boxes = np.array([[100, 50, 200, 150], [300, 100, 330, 300]], np.float32)
    corners = geometry.frustum(boxes, camera, 0.5, np.array([8.0, 20.0]))
    assert corners.shape == (2, 8, 3)
    assert corners.dtype == np.float32
    np.testing.assert_allclose(corners[:, :4, 2], 0.5)
    np.testing.assert_allclose(corners[:, 4:, 2], [[8] * 4, [20] * 4])
    uv, _ = geometry.project(corners.reshape(-1, 3), camera)
    for box, pixels in zip(boxes, uv.reshape(2, 2, 4, 2), strict=True):
        x0, y0, x1, y1 = box
        expected = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
        np.testing.assert_allclose(pixels, [expected, expected], atol=0.01)
    assert geometry.frustum(boxes[:0], camera, 0.5, 1.0).shape == (0, 8, 3)


# --- boxes -------------------------------------------------------------------------------------

whole_boxes = st.lists(
    st.tuples(*[st.integers(0, 12)] * 4).map(
        lambda b: (min(b[0], b[2]), min(b[1], b[3]), max(b[0], b[2]), max(b[1], b[3]))
    ),
    max_size=6,
)


@settings(deadline=None)
@given(whole_boxes, whole_boxes)
def test_iou_counts_cells(a: list[tuple[int, ...]], b: list[tuple[int, ...]]) -> None:
    def cells(box: tuple[int, ...]) -> set[tuple[int, int]]:
        return {(x, y) for x in range(box[0], box[2]) for y in range(box[1], box[3])}

    value = geometry.iou(np.array(a, np.float32).reshape(-1, 4), np.array(b, np.float32).reshape(-1, 4))
    assert value.shape == (len(a), len(b))
    for i, p in enumerate(a):
        for j, q in enumerate(b):
            union = cells(p) | cells(q)
            expected = len(cells(p) & cells(q)) / len(union) if union else 0
            assert value[i, j] == pytest.approx(expected, abs=1e-6)


def test_iou_with_a_box_that_is_nowhere() -> None:
    box, nowhere = np.array([[0.0, 0, 1, 1]]), np.full((1, 4), np.nan)
    assert geometry.iou(box, nowhere) == 0


@settings(deadline=None)
@given(st.tuples(reals, reals, reals), st.tuples(*[st.floats(0.1, 10)] * 3), st.floats(-3.1, 3.1))
def test_corners_of_a_turned_box(center: tuple[float, ...], size: tuple[float, ...], angle: float) -> None:
    boxes = Boxes3D(*(np.array([v], np.float32) for v in (center, size, angle)))
    corners = geometry.corners(boxes)[0]
    np.testing.assert_allclose(corners.mean(axis=0), center, atol=1e-3)
    np.testing.assert_allclose(corners[4:] - corners[:4], np.tile([0, 0, size[2]], (4, 1)), atol=1e-3)
    lower = corners[:4, :2].astype(np.float64)
    x, y = lower.T
    area = 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    assert area == pytest.approx(size[0] * size[1], rel=0.05, abs=0.01), "counter-clockwise, of that size"
    along = lower[0] - lower[1]
    np.testing.assert_allclose(along, size[0] * np.array([np.cos(angle), np.sin(angle)]), atol=1e-3)


def upright(*rows: tuple[float, ...]) -> Boxes3D:
    """Boxes of x, y, length, width, yaw."""
    values = np.array(rows, np.float32).reshape(-1, 5)
    height = np.ones(len(values), np.float32)
    center, size = np.c_[values[:, :2], 0 * height], np.c_[values[:, 2:4], height]
    return Boxes3D(center, size, values[:, 4])


places = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.5, 5), st.floats(0.5, 5), st.floats(-4, 4))


@settings(deadline=None)
@given(places, places, st.floats(-4, 4), st.floats(-60, 60))
def test_bev_iou_counts_points(a: tuple[float, ...], b: tuple[float, ...], turn: float, shift: float) -> None:
    boxes = upright(a, b)
    value = box_overlap.bev_iou(boxes, boxes)
    np.testing.assert_allclose(np.diag(value), 1, atol=1e-4)
    assert value[0, 1] == pytest.approx(value[1, 0], abs=1e-4)
    # As fine as the two boxes are small: their edges may run along a row of the grid.
    reach = [np.array([np.hypot(box[2], box[3]) / 2]) for box in (a, b)]
    low = np.minimum(np.subtract(a[:2], reach[0]), np.subtract(b[:2], reach[1]))
    high = np.maximum(np.add(a[:2], reach[0]), np.add(b[:2], reach[1]))
    sides = [np.linspace(start, end, 200) for start, end in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*sides), -1).reshape(-1, 2)
    inside = []
    for x, y, length, width, angle in (a, b):
        c, s = np.cos(angle), np.sin(angle)
        local = (grid - [x, y]) @ np.array([[c, -s], [s, c]])
        inside.append((np.abs(local) <= [length / 2, width / 2]).all(axis=1))
    expected = (inside[0] & inside[1]).sum() / max((inside[0] | inside[1]).sum(), 1)
    assert value[0, 1] == pytest.approx(expected, abs=0.03)
    # The same wherever the two are, and however they are turned together.
    c, s = np.cos(turn), np.sin(turn)
    moved = [(c * x - s * y + shift, s * x + c * y, w, h, angle + turn) for x, y, w, h, angle in (a, b)]
    assert box_overlap.bev_iou(upright(moved[0]), upright(moved[1]))[0, 0] == pytest.approx(
        value[0, 1], abs=1e-3
    )


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ((0, 0, 4, 2, 0), (0, 0, 4, 2, np.pi), 1.0),
        ((0, 0, 4, 2, 0), (2, 0, 4, 2, 0), 1 / 3),
        ((0, 0, 2, 2, 0), (0, 0, 2, 2, np.pi / 2), 1.0),
        ((0, 0, 2, 2, 0), (2, 0, 2, 2, 0), 0.0),  # an edge in common
        ((0, 0, 0, 0, 0), (0, 0, 2, 2, 0), 0.0),
    ],
)
def test_bev_iou_equals_shapely(a: tuple[float, ...], b: tuple[float, ...], expected: float) -> None:
    assert box_overlap.bev_iou(upright(a), upright(b))[0, 0] == pytest.approx(expected, abs=1e-5)


def test_bev_iou_of_no_boxes_is_empty() -> None:
    assert box_overlap.bev_iou(Boxes3D.empty(), upright((0, 0, 1, 1, 0))).shape == (0, 1)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 300), st.integers(0, 20))
def test_points_in_many_boxes_are_those_in_each(seed: int, count: int, number: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-5, 5, (count, 3)).astype(np.float32)
    boxes = Boxes3D(
        rng.uniform(-6, 6, (number, 3)).astype(np.float32),
        rng.uniform(0.1, 6, (number, 3)).astype(np.float32),
        rng.uniform(-np.pi, np.pi, number).astype(np.float32),
    )
    points = np.concatenate([points, geometry.corners(boxes)[:, 0]])  # on the edge, too
    found = dict(inside_each(points, boxes))
    for k in range(number):
        rows = np.flatnonzero(geometry.inside(points, boxes, k))
        np.testing.assert_array_equal(np.sort(found.get(k, rows[:0])), rows)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_points_beside_the_camera_overflow_no_distortion() -> None:
    lens = Intrinsics(64, 48, np.diag([60.0, 60, 1]), "plumb_bob", np.array([0.1, 0.05, 0, 0, 0.02]))
    points = np.array([[1e8, 1e8, 0.002], [1e8, -1, 5], [1, 1, 5]], np.float32)
    uv, _ = geometry.project(points, lens)
    assert np.isnan(uv[:2]).all() and np.isfinite(uv[2]).all()
