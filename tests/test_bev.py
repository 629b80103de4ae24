"""Bird's-eye view: the reference image pixel for pixel, the channels, the looks of the rich style."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bevviz.config import BevConfig, load
from bevviz.model.frame import F32, I32, U8, Boxes3D
from bevviz.model.results import Clusters, Objects
from bevviz.stages.bev import _ground_shades, _obstacle_shades, bev

REFERENCE = load(preset="reference").bev

metres = st.floats(-12, 12, width=32)
clouds = hnp.arrays(np.float32, st.tuples(st.integers(0, 200), st.just(3)), elements=metres)


def boxes(center: list[list[float]], size: list[list[float]], yaw: list[float] | None = None) -> Boxes3D:
    turned = np.zeros(len(center), np.float32) if yaw is None else np.array(yaw, np.float32)
    return Boxes3D(np.array(center, np.float32), np.array(size, np.float32), turned)


def named(b: Boxes3D, *names: str) -> Objects:
    k = np.arange(len(names), dtype=np.int32)
    return Objects(b, names, np.full(len(names), 0.8, np.float32), k, ("zed",) * len(names), k)


def expected(points: F32, objects: Objects | None) -> U8:
    """Draw the tutorial's image point by point with its defaults: 10 m, 10 m, 0.05 m -> 400 x 400."""
    image = np.zeros((400, 400, 3), np.uint8)
    for x, y, _ in points:
        u = np.floor((np.float32(10) - y) / np.float32(0.05))
        v = np.floor((np.float32(10) - x) / np.float32(0.05))
        if 0 <= u < 400 and 0 <= v < 400:
            image[int(v), int(u)] = (200, 200, 200)
    if objects is not None:
        for name, (x, y, _), (length, width, _) in zip(
            objects.names, objects.boxes.center, objects.boxes.size, strict=True
        ):
            u = int(np.floor((np.float32(10) - y) / np.float32(0.05)))
            v = int(np.floor((np.float32(10) - x) / np.float32(0.05)))
            w, h = int(width / np.float32(0.05)), int(length / np.float32(0.05))
            low = (u - w // 2, v - h // 2)
            cv2.rectangle(image, low, (u + w // 2, v + h // 2), (0, 0, 255), 2)
            cv2.putText(
                image, f"ID:{name}", (low[0], low[1] - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 255, 0), 1
            )
    return image


@given(clouds, st.lists(st.tuples(metres, metres, st.floats(0.1, 5), st.floats(0.1, 5)), max_size=4))
@settings(max_examples=60, deadline=None)
def test_the_reference_image_is_equal_pixel_for_pixel(
    points: F32, found: list[tuple[float, float, float, float]]
) -> None:
    objects = None
    if found:
        b = boxes([[x, y, 0] for x, y, _, _ in found], [[a, b, 1] for _, _, a, b in found])
        objects = named(b, *["person", "car", "bus", "dog"][: len(found)])
    result = bev(points, None, None, objects, None, REFERENCE)
    np.testing.assert_array_equal(result.image, expected(points, objects))


def test_the_reference_image_of_a_real_scan_is_equal(shared: Path) -> None:
    scan = np.fromfile(shared / "kitti/velodyne/000000.bin", np.float32).reshape(-1, 4)
    points = np.ascontiguousarray(scan[:, :3])
    objects = named(boxes([[8.7, -1.9, -0.7]], [[0.5, 1.2, 1.9]]), "person")
    result = bev(points, scan[:, 3], None, objects, None, REFERENCE)
    np.testing.assert_array_equal(result.image, expected(points, objects))
    assert (result.image == 200).all(axis=2).sum() > 10_000


@pytest.mark.parametrize(
    ("x", "y", "row", "column"),
    [
        (10.0, 10.0, 0, 0),
        (9.99, 9.99, 0, 0),
        (0.0, 0.0, 200, 200),
        (-9.99, -9.99, 399, 399),
        (3.01, -2.01, 139, 240),
    ],
)
def test_a_point_falls_on_its_pixel(x: float, y: float, row: int, column: int) -> None:
    image = bev(np.array([[x, y, 0]], np.float32), None, None, None, None, REFERENCE).image
    assert np.argwhere(image.any(axis=2)).tolist() == [[row, column]]


@pytest.mark.parametrize(("x", "y"), [(10.01, 0), (0, 10.01), (-10.0, 0), (0, -10.0), (1e30, 0), (np.nan, 0)])
def test_a_point_outside_the_image_is_left_out(x: float, y: float) -> None:
    assert not bev(np.array([[x, y, 0]], np.float32), None, None, None, None, REFERENCE).image.any()


CHANNELS = ("density", "height", "intensity", "occupancy")


@pytest.mark.long
@given(clouds, st.data())
@settings(max_examples=40, deadline=None)
def test_channels_equal_plain_numpy(points: F32, data: st.DataObject) -> None:
    n = len(points)
    intensity = data.draw(hnp.arrays(np.uint8, n))
    ground = data.draw(hnp.arrays(np.bool_, n))
    config = BevConfig(range_x=8, range_y=5, resolution=0.5, style="reference", channels=CHANNELS)
    result = bev(points, intensity, ground, None, None, config)

    r = np.floor((np.float32(8) - points[:, 0]) / np.float32(0.5)).astype(int)
    c = np.floor((np.float32(5) - points[:, 1]) / np.float32(0.5)).astype(int)
    inside = (r >= 0) & (r < 32) & (c >= 0) & (c < 20)
    density, height = np.zeros((32, 20), int), np.full((32, 20), -np.inf)
    total, solid = np.zeros((32, 20)), np.zeros((32, 20), bool)
    at = r[inside], c[inside]
    np.add.at(density, at, 1)
    np.add.at(total, at, intensity[inside])
    np.maximum.at(height, at, points[inside, 2])
    np.logical_or.at(solid, at, ~ground[inside])

    seen = density > 0
    np.testing.assert_array_equal(result.channels["density"], density)
    np.testing.assert_array_equal(
        result.channels["height"], np.where(seen, height, np.nan).astype(np.float32)
    )
    mean = np.divide(total, density, out=np.full((32, 20), np.nan), where=seen)
    np.testing.assert_allclose(result.channels["intensity"], mean, rtol=1e-5)
    np.testing.assert_array_equal(result.channels["occupancy"], np.where(solid, 100, np.where(seen, 0, -1)))


def test_only_requested_and_possible_channels_are_made() -> None:
    points = np.zeros((3, 3), np.float32)
    for style in ("rich", "reference"):
        config = BevConfig(style=style, channels=("height", "occupancy", "intensity"))
        assert list(bev(points, None, None, None, None, config).channels) == ["height"]
        ground, intensity = np.ones(3, bool), np.ones(3)
        channels = bev(points, intensity, ground, None, None, config).channels
        assert list(channels) == ["height", "occupancy", "intensity"]
        assert bev(points, intensity, ground, None, None, BevConfig(style=style, channels=())).channels == {}


def test_values_for_other_points_are_refused() -> None:
    points = np.zeros((3, 3), np.float32)
    with pytest.raises(ValueError, match="ground has 2 values for 3 points"):
        bev(points, None, np.ones(2, bool), None, None, REFERENCE)
    with pytest.raises(ValueError, match="intensity has 4 values for 3 points"):
        bev(points, np.ones(4), None, None, None, REFERENCE)


def clusters_of(b: Boxes3D) -> Clusters:
    k = len(b)
    zero: I32 = np.zeros(k, np.int32)
    return Clusters(np.zeros(0, np.int32), zero, zero + 20, b.center.astype(np.float32), b, b)


def test_rich_style_turns_the_boxes() -> None:
    config = BevConfig(range_x=20, range_y=20, resolution=0.1, channels=())
    b = boxes([[10, 0, 0]], [[6, 2, 1.5]], [np.pi / 4])
    empty = np.zeros((0, 3), np.float32)
    plain = bev(empty, None, None, None, None, config).image
    drawn = bev(empty, None, None, None, clusters_of(b), config).image
    rows, columns = np.nonzero((drawn != plain).any(axis=2))
    # A 6 x 2 m box at 45 degrees reaches (6 + 2) / 2 * sin(45 degrees) = 2.83 m in both directions.
    assert abs(np.ptp(rows) * 0.1 - 2 * 2.83) < 0.25
    assert abs(np.ptp(columns) * 0.1 - 2 * 2.83) < 0.25
    assert abs((rows.mean() + 0.5) * 0.1 - 10) < 0.1  # 10 m ahead of 20
    assert abs((columns.mean() + 0.5) * 0.1 - 20) < 0.1


@given(clouds, st.data())
@settings(max_examples=15, deadline=None)
def test_rich_style_equals_plain_python(points: F32, data: st.DataObject) -> None:
    ground = data.draw(hnp.arrays(np.bool_, len(points)))
    config = BevConfig(range_x=8, range_y=5, resolution=0.5, channels=CHANNELS)
    result = bev(points, np.zeros(len(points)), ground, None, None, config)
    empty = bev(points[:0], np.zeros(0), ground[:0], None, None, config).image
    level = float(np.median(points[ground, 2])) if ground.any() else -1.7
    heights, shades = _obstacle_shades(), _ground_shades()
    for cell in np.ndindex(32, 20):
        count = int(result.channels["density"][cell])
        if count == 0:
            color = empty[cell]
        elif result.channels["occupancy"][cell] == 100:
            step = (float(result.channels["height"][cell]) - level) / 3 * len(heights)
            color = heights[int(np.clip(step, 0, len(heights) - 1))]
        else:
            color = shades[min(count, len(shades)) - 1]
        np.testing.assert_array_equal(result.image[cell], color)


def test_rich_style_tells_ground_from_obstacles() -> None:
    config = BevConfig(range_x=20, range_y=20, resolution=0.5, channels=())
    points = np.array([[5.2, 5.2, -1.7], [-5.2, 5.2, -1.7], [-5.2, 5.2, 0.5]], np.float32)
    ground = np.array([True, True, False])
    empty = bev(points[:0], None, None, None, None, config).image.copy()
    image = bev(points, None, ground, None, None, config).image
    road, obstacle = image[29, 29], image[50, 29]
    assert (image != empty).any(axis=2).sum() == 2
    assert np.ptp(road.astype(int)) < 40  # grey
    assert np.ptp(obstacle.astype(int)) > 100  # a strong colour
    np.testing.assert_array_equal(bev(points[:0], None, None, None, None, config).image, empty)


def test_names_of_the_rich_style_are_whole_and_cover_no_other() -> None:
    """Three people who walk together, and one at the right edge of the image."""
    config = load().bev
    center = [[8.0, 2.0, 0.0], [8.3, 1.9, 0.0], [8.0, 1.4, 0.0], [5.0, -config.range_y + 0.5, 0.0]]
    names = ("anna", "bert", "carl", "dora")
    nothing = np.zeros((0, 3), np.float32)
    image = bev(nothing, None, None, named(boxes(center, [[0.5, 0.5, 1.8]] * 4), *names), None, config).image
    for name in names:
        text = f"{name} 0.80"
        (wide, high), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)
        drawn = np.zeros((high + below, wide, 3), np.uint8)
        cv2.putText(drawn, text, (0, high), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255,) * 3, 1, cv2.LINE_AA)
        bright = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        found = cv2.matchTemplate(bright, drawn[..., 0], cv2.TM_CCOEFF_NORMED)
        assert found.max() > 0.8, name
