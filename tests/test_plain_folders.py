"""A plain folder: what its files are, by their names and numbers."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import bevviz
from bevviz import UserError
from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import load
from bevviz.datasets import find_loader, loaders, open_dataset
from bevviz.datasets.cloud_files import are_doubles, count_columns, read_cloud
from bevviz.datasets.folder import Folder
from bevviz.datasets.stamps import group_by_sensor
from bevviz.extras.demo.sensors import load_open3d
from bevviz.messages.camera_info import decode_camera_info
from bevviz.messages.encode import encode_points
from bevviz.model import geometry
from bevviz.model.geometry import has_distortion
from bevviz.support.extensions import registered
from tests.support import datasets
from tests.support.datasets import cloud, kitti_raw

Capture = pytest.CaptureFixture[str]


@given(st.integers(3, 7), st.integers(0, 1000), st.integers(500, 5000))
@settings(max_examples=40, deadline=None)
def test_columns_are_counted_whatever_the_order_of_the_points(columns: int, seed: int, points: int) -> None:
    assert count_columns(cloud(columns, points, seed).ravel()) == columns


def test_a_cut_file_and_points_that_met_nothing_are_counted_too() -> None:
    points = cloud(5)
    points[::3, :3] = np.nan
    assert count_columns(points.ravel()[:-7]) == 5


def test_numbers_that_tell_nothing_are_not_guessed() -> None:
    assert count_columns(np.random.default_rng(0).normal(size=30_000).astype(np.float32)) is None
    assert count_columns(np.zeros(30_000, np.float32)) is None
    assert count_columns(cloud(4, 100).ravel()) is None


def test_kitti_has_four_columns_and_is_float32(shared: Path) -> None:
    for file in sorted((shared / "kitti" / "velodyne").glob("*.bin")):
        assert count_columns(np.fromfile(file, "<f4")) == 4
        assert not are_doubles(file.read_bytes())


@pytest.mark.parametrize("kind", ["<f4", "<f8"])
def test_doubles_are_told_also_where_they_were_floats(kind: str) -> None:
    assert are_doubles(cloud(4).astype(kind).astype("<f8").tobytes())
    assert not are_doubles(cloud(6).tobytes())


def test_a_folder_of_five_columns_is_read_and_said(tmp_path: Path) -> None:
    for number in range(3):
        cloud(5, seed=number).tofile(tmp_path / f"{number:06}.bin")
    folder = Folder(tmp_path, "")
    assert [w for w in folder.warnings if "5 columns of float32, as their values tell" in w]
    points = next(s for s in folder.streams if s.topic == "/lidar/points").make(0)
    assert len(points.xyz) == 3000
    assert [*points.fields] == ["intensity", "field_4"]

    (tmp_path / "calibration.yaml").write_text("fields: [x, y, z, intensity, ring]")
    folder = Folder(tmp_path, "")
    assert not [w for w in folder.warnings if "columns" in w]


def test_a_folder_of_doubles_is_refused(tmp_path: Path) -> None:
    cloud(4).astype("<f8").tofile(tmp_path / "000000.bin")
    with pytest.raises(UserError, match="float64; save them as float32"):
        Folder(tmp_path, "")


@pytest.mark.parametrize(
    ("names", "sensors"),
    [
        (["CAM_FRONT__10", "CAM_FRONT__20", "CAM_FRONT_LEFT__11", "CAM_FRONT_LEFT__21"], ["", "LEFT"]),
        (["n015-2018-07__CAM_BACK__10", "n015-2018-07__CAM_FRONT__12"], ["BACK", "FRONT"]),
        (["000001_left", "000002_left", "000001_right", "000002_right"], ["left", "right"]),
        (["cam0_0001", "cam0_0002", "cam1_0001", "cam1_0002"], ["cam0", "cam1"]),
        (["left0001", "left0002", "right0001", "right0002"], ["left", "right"]),
        (["image_0_0001", "image_0_0002", "image_1_0001", "image_1_0002"], ["0", "1"]),
        # one sensor: a date, a run after the other, names without a number, one stray file
        (["2024-11-23_10-15-30-123", "2024-11-23_10-15-30-456", "2024-11-23_10-15-31-123"], [""]),
        (["run_1_0001", "run_1_0002", "run_2_0003", "run_2_0004"], [""]),
        (["a", "b", "c"], [""]),
        (["0001", "0002", "0003", "0004", "copy_of_0004"], [""]),
        (["12.500000", "12.600000"], [""]),
    ],
)
def test_sensors_of_one_folder_are_told_by_the_names(names: list[str], sensors: list[str]) -> None:
    groups = group_by_sensor([Path(f"{name}.png") for name in names])
    assert list(groups) == sensors
    assert sum(map(len, groups.values())) == len(names)


def test_a_sensor_that_is_stated_is_one(tmp_path: Path) -> None:
    for number in range(4):
        cloud(4, seed=number).tofile(tmp_path / f"{'left' if number % 2 else 'right'}_{number}.bin")
    assert {s.topic for s in Folder(tmp_path, "").streams} >= {"/lidar_left/points", "/lidar_right/points"}
    (tmp_path / "calibration.yaml").write_text("lidars: {lidar: {}}")
    folder = Folder(tmp_path, "")
    assert [len(s.times) for s in folder.streams if s.topic == "/lidar/points"] == [4]


LAYOUT = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_", "<u1", (4,)), ("intensity", "<f4"), ("ring", "<u2")]
LAYOUT += [("__", "<u1", (2,)), ("timestamp", "<f8")]
HEADER = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z _ intensity ring _ timestamp
SIZE 4 4 4 1 4 2 1 8
TYPE F F F U F U U F
COUNT 1 1 1 4 1 1 2 1
WIDTH 500
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 500
DATA binary
"""


@pytest.fixture(scope="module")
def padded() -> np.ndarray:
    """As PCL has points with intensity, ring and time."""
    rng = np.random.default_rng(0)
    points = np.zeros(500, LAYOUT)
    for name in ("x", "y", "z", "intensity", "timestamp"):
        points[name] = rng.uniform(1, 50, 500)
    points["ring"] = rng.integers(0, 32, 500)
    return points


@pytest.mark.parametrize("cut", [0, 100])
def test_pcd_with_padding_and_a_cut_one(padded: np.ndarray, cut: int, tmp_path: Path) -> None:
    data = HEADER.encode() + padded.tobytes()
    file = tmp_path / "0001.pcd"
    file.write_bytes(data[: len(data) - cut])
    points, announced = read_cloud(file, ())
    assert announced == 500 and len(points) == (496 if cut else 500)  # 32 bytes each
    assert points.dtype.names == ("x", "y", "z", "intensity", "ring", "timestamp")
    for name in points.dtype.names:
        np.testing.assert_array_equal(points[name], padded[name][: len(points)])


def test_pcd_of_open3d_and_of_pypcd4(tmp_path: Path) -> None:
    o3d = load_open3d()
    xyz = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
    cloud = o3d.t.geometry.PointCloud(xyz)
    cloud.point["intensity"] = np.arange(300, dtype=np.float32)[:, None]
    for name, compressed, ascii in (("a", False, True), ("b", False, False), ("c", True, False)):
        file = tmp_path / f"{name}.pcd"
        o3d.t.io.write_point_cloud(str(file), cloud, write_ascii=ascii, compressed=compressed)
        points, _ = read_cloud(file, ())
        np.testing.assert_allclose(np.column_stack([points[n] for n in "xyz"]), xyz, atol=1e-6)
        assert points["intensity"][299] == 299

    one = tmp_path / "one.pcd"  # a single point, no COUNT, numbers that no PointCloud2 holds
    head = "VERSION .7\nFIELDS x y z t\nSIZE 4 4 4 8\nTYPE F F F U\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n"
    one.write_text(head + "1 2 3 1700000000000000000\n")
    points, _ = read_cloud(one, ())
    assert points.tolist() == [(1, 2, 3, 1.7e18)]


@given(st.integers(0, 3000), st.binary(min_size=1, max_size=8))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_pcd_is_read_or_refused(padded: np.ndarray, tmp_path: Path, at: int, damage: bytes) -> None:
    data = bytearray(HEADER.encode() + padded.tobytes())
    data[at : at + len(damage)] = damage
    (tmp_path / "0001.pcd").write_bytes(data)
    try:
        points, announced = read_cloud(tmp_path / "0001.pcd", ())
    except UserError as error:
        assert "0001.pcd: cannot be read as a cloud" in str(error)
    else:
        assert encode_points(0, "lidar", points, announced).width >= len(points)


def test_npy_of_named_columns_in_any_byte_order(tmp_path: Path) -> None:
    there = np.array(
        [(1, 2, 3, 4, True)], [("x", ">f8"), ("y", ">f4"), ("z", "<f2"), ("t", "<i8"), ("good", "?")]
    )
    np.save(tmp_path / "0001.npy", there)
    points, _ = read_cloud(tmp_path / "0001.npy", ())
    assert points.tolist() == [(1, 2, 3, 4, 1)]
    assert encode_points(0, "lidar", points).fields[3].datatype == 8


PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "uint16", "u4": "uint", "i1": "char"}


def ply(points: np.ndarray, kind: str, before: str = "") -> tuple[bytes, bytes]:
    """Header and points as PLY's document has them."""
    order = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}[kind]
    names = points.dtype.names or ()
    properties = [f"property {PLY_TYPES[points.dtype[n].str[1:]]} {n}" for n in names]
    head = ["ply", "comment before the format", f"format {kind} 1.0", *before.splitlines()]
    head += [f"element vertex {len(points)}", *properties, "element face 1"]
    head += ["property list uchar int vertex_indices", "end_header", ""]
    if kind == "ascii":
        body = "".join(" ".join(repr(v) for v in row) + "\n" for row in points.tolist()).encode()
    else:
        body = points.astype([(n, order + points.dtype[n].str[1:]) for n in names]).tobytes()
    return "\n".join(head).encode(), body


@pytest.fixture(scope="module")
def measured() -> np.ndarray:
    rng = np.random.default_rng(0)
    points = np.zeros(50, [(n, "<f8") for n in "xyz"] + [("intensity", "<f4"), ("ring", "<u2"), ("t", "<u4")])
    for name in "xyz":
        points[name] = rng.normal(0, 20, 50)
    points["ring"], points["t"] = np.arange(50) % 16, np.arange(50) * 1000
    return points


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_keeps_every_field_and_whole_points_of_cut_files(
    kind: str, measured: np.ndarray, tmp_path: Path
) -> None:
    head, body = ply(measured, kind)
    face = b"3 0 1 2\n" if kind == "ascii" else bytes(13)
    file = tmp_path / "0001.ply"
    file.write_bytes(head + body + face)
    points, announced = read_cloud(file, ())
    assert announced == 50 and points.dtype.names == measured.dtype.names
    np.testing.assert_array_equal(points, measured)

    rows = body.splitlines(keepends=True) if kind == "ascii" else [bytes(len(body) // 50)] * 50
    file.write_bytes(head + body[: len(body) - len(rows[-1]) - len(rows[-2]) // 2])
    points, announced = read_cloud(file, ())
    assert announced == 50
    np.testing.assert_array_equal(points, measured[:48])


def test_ply_with_another_element_first(measured: np.ndarray, tmp_path: Path) -> None:
    file = tmp_path / "0001.ply"
    head, body = ply(measured, "binary_little_endian", "element camera 2\nproperty float f\nproperty uchar i")
    file.write_bytes(head.replace(b"\n", b"\r\n") + bytes(10) + body)
    np.testing.assert_array_equal(read_cloud(file, ())[0], measured)
    head, body = ply(measured, "ascii", "element camera 1\nproperty list uchar int seen")
    file.write_bytes(head + b"2 0 1\n" + body)
    with pytest.raises(UserError, match="properties of the type list in its element camera are not read"):
        read_cloud(file, ())


@given(st.integers(0, 400), st.binary(min_size=1, max_size=8), st.booleans())
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_ply_is_read_or_refused(
    measured: np.ndarray, tmp_path: Path, at: int, damage: bytes, text: bool
) -> None:
    data = bytearray(b"".join(ply(measured, "ascii" if text else "binary_little_endian")))
    data[at : at + len(damage)] = damage
    (tmp_path / "0001.ply").write_bytes(data)
    try:
        points, announced = read_cloud(tmp_path / "0001.ply", ())
    except UserError as error:
        assert "0001.ply: cannot be read as a cloud" in str(error)
    else:
        assert encode_points(0, "lidar", points, announced).width >= len(points)


@pytest.mark.parametrize(
    "head",
    [
        "VERSION .5\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\n",
        "VERSION .6\nCOLUMNS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nPOINTS 2\n",
        "FIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH 1\nHEIGHT 2\nVIEWPOINT 0 0 -2 0 1 0 0\n",
        "FIELDS x y z _ intensity\nSIZE 4 4 4 1 4\nTYPE F F F U F\nCOUNT 1 1 1 0 1\nPOINTS 2\n",
    ],
    ids=["v0.5", "columns", "no points", "padding of none"],
)
def test_pcd_with_headers_of_other_times_and_writers(head: str, tmp_path: Path) -> None:
    file = tmp_path / "0001.pcd"
    numbers = np.arange(8, dtype="<f4").reshape(2, 4)
    for body in (b"DATA ascii\n0 1 2 3\n4 5 6 7\n", b"DATA binary\n" + numbers.tobytes()):
        file.write_bytes(head.encode() + body)
        points, announced = read_cloud(file, ())
        assert announced == 2 and points.dtype.names == ("x", "y", "z", "intensity")
        np.testing.assert_array_equal(points.view("<f4").reshape(2, 4), numbers)


def drive_of(folder: Path, names: list[str]) -> Folder:
    for name in names:
        cloud(4, 20).tofile(folder / f"{name}.bin")
    return Folder(folder, "")


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        (["0000000000", "0000000003"], [1.0, 1.3]),  # as long as seconds since 1970, but of frames
        (["1700000000", "1700000003"], [1700000000.0, 1700000003.0]),
        (["f_20121214T142259.814212", "f_20121214T142300.068683"], [1355494979.814212, 1355494980.068683]),
        (["2011-09-26_13-02-25-594", "2011-09-26_13-02-26-100"], [1317042145.594, 1317042146.1]),
        (["20121399T142259.5", "20121399T142300.5"], [142259.5, 142300.5]),  # no date
    ],
)
def test_stamps_of_names(names: list[str], stamps: list[float], tmp_path: Path) -> None:
    drive = drive_of(tmp_path, names)
    (clouds,) = [stream for stream in drive.streams if stream.topic == "/lidar/points"]
    assert clouds.times.tolist() == [round(stamp * 1e6) * 1000 for stamp in stamps]


def test_sensors_whose_names_end_with_dates() -> None:
    files = [Path(f"{side}_20240131_2359{at}.500.png") for side in ("left", "right") for at in range(10, 60)]
    assert {name: len(found) for name, found in group_by_sensor(files).items()} == {"left": 50, "right": 50}


def test_the_only_lidar_is_placed_by_what_is_stated(tmp_path: Path) -> None:
    assert [stream.topic for stream in drive_of(tmp_path, ["1"]).streams] == ["/lidar/points"]
    (tmp_path / "calibration.yaml").write_text("lidars: {lidar: {pose: [0, 0, 1.9, 0, 0, 0, 1]}}")
    assert [stream.topic for stream in Folder(tmp_path, "").streams] == ["/tf_static", "/lidar/points"]


def test_what_is_no_table_of_points_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "heights.npy", np.zeros((300, 500)))
    with pytest.raises(UserError, match=r"has the shape \(300, 500\), not \(N, 3\) to \(N, 64\)"):
        read_cloud(tmp_path / "heights.npy", ())


@pytest.mark.parametrize(
    ("scale", "origin", "said"), [(1000, 0, "millimetres are"), (1, 5e6, "a map (UTM) are")]
)
def test_points_that_are_far_from_the_lidar_are_told(
    scale: float, origin: float, said: str, tmp_path: Path
) -> None:
    np.save(tmp_path / "1.npy", cloud(4)[:, :3].astype(np.float64) * scale + origin)
    with bevviz.open(tmp_path) as drive:
        assert len(list(drive.frames)) == 1
        assert any(f"as coordinates in {said}" in warning for warning in drive.warnings)


@pytest.mark.parametrize(
    ("given", "files", "said"),
    [
        (".", ["a.las", "b.las"], "2 .las files are not read: save them as PCD, PLY, BIN or NPY"),
        (".", ["sensors/1.feather"], "1 .feather file is not read: save them as PCD"),
        ("a.laz", ["a.laz"], ".laz files are not read: save them as PCD, PLY, BIN or NPY"),
        ("a.pcd", ["a.pcd"], "one cloud or image, no drive: give the folder that it is in"),
        ("sensors/1.jpg", ["sensors/1.jpg"], "one cloud or image, no drive: give the folder that it is in"),
    ],
)
def test_what_is_not_read_is_named(given: str, files: list[str], said: str, tmp_path: Path) -> None:
    (tmp_path / "sensors").mkdir()
    for name in files:
        (tmp_path / name).write_bytes(b"LASF of another kind")
    with pytest.raises(UserError, match=re.escape(said)):
        bevviz.open(tmp_path / given)


def test_images_that_are_not_read_are_told(tmp_path: Path) -> None:
    (tmp_path / "front").mkdir()
    (tmp_path / "front/1.tif").write_bytes(b"II*")
    assert "1 .tif file is not read: save them as PNG or JPEG" in drive_of(tmp_path, ["1"]).warnings


@pytest.mark.parametrize("kind", ["labels/1.txt", "annotations/1.json", "ann/1.pcd.json"])
def test_labels_of_other_tools_are_named(tmp_path: Path, kind: str) -> None:
    (tmp_path / kind).parent.mkdir()
    (tmp_path / kind).write_text("{}")
    (said,) = [text for text in drive_of(tmp_path, ["1"]).warnings if "labels" in text]
    assert said.startswith(f"{kind}, named as the scans, not read: labels of plain folders")


@pytest.mark.parametrize(
    ("lens", "topic"),
    [
        ("", "image_rect"),
        ("D: [0.1, 0, 0, 0, 0]", "image_raw"),
        ("distortion_model: equidistant", "image_raw"),
    ],
)
def test_images_are_rectified_unless_a_lens_is_stated(lens: str, topic: str, tmp_path: Path) -> None:
    (tmp_path / "front").mkdir()
    (tmp_path / "front/1.png").write_bytes(b"")
    (tmp_path / "calibration.yaml").write_text(
        f"cameras:\n  front:\n    K: [700, 0, 640, 0, 700, 360, 0, 0, 1]\n    {lens}\n"
    )
    streams = {stream.topic: stream for stream in drive_of(tmp_path, ["1"]).streams}
    assert f"/front/{topic}/compressed" in streams
    camera = decode_camera_info(streams["/front/camera_info"].make(0), topic == "image_rect")
    assert has_distortion(camera) == bool(lens)


def test_a_folder_of_cameras_has_one_for_each(tmp_path: Path) -> None:
    for place in ("camera/front", "camera/left", "images/left", "labels/front"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "1.jpg").write_bytes(b"")
    topics = {stream.topic for stream in drive_of(tmp_path, ["1"]).streams}
    assert topics == {
        "/lidar/points",
        *(f"/{name}/image_rect/compressed" for name in ("front", "left", "images_left")),
    }


def test_twelve_numbers_are_no_poses_with_stamps(tmp_path: Path) -> None:
    """KITTI's poses lie beside clouds in public folders, which are shown without them."""
    cloud(4).tofile(tmp_path / "000000.bin")
    (tmp_path / "poses.txt").write_text("1 0 0 4 0 1 0 5 0 0 1 6\n")
    folder = Folder(tmp_path, "")
    assert any("poses.txt has 12 numbers in a line, as KITTI's" in text for text in folder.warnings)
    assert all(stream.topic != "/tf" for stream in folder.streams)


def test_a_scan_as_pcd_and_as_bin_is_one_scan(tmp_path: Path) -> None:
    points = cloud(4, 300)
    points.tofile(tmp_path / "000000.bin")
    head = "VERSION 0.7\nFIELDS x y z i\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 300\nHEIGHT 1\n"
    head += "POINTS 300\nDATA binary\n"
    (tmp_path / "000000.pcd").write_bytes(head.encode() + points.tobytes())
    (scans,) = (stream for stream in Folder(tmp_path, "").streams if stream.topic.endswith("/points"))
    assert [*scans.make(0).fields] == ["i"]  # as the PCD file names it


def test_range_images_beside_clouds_are_no_lidar(tmp_path: Path) -> None:
    cloud(4).tofile(tmp_path / "000000.bin")
    (tmp_path / "residuals").mkdir()
    np.save(tmp_path / "residuals/000000.npy", np.zeros((64, 2048), np.float32))
    folder = Folder(tmp_path, "")
    assert any("of the shape (64, 2048), no points" in text for text in folder.warnings)
    assert [s.topic for s in folder.streams if s.topic.endswith("/points")] == ["/lidar/points"]


def test_a_piece_of_a_kitti_drive_is_a_plain_folder(tmp_path: Path) -> None:
    """Without stamps and calibration it was refused."""
    root = kitti_raw(tmp_path)
    for file in (*root.rglob("timestamps.txt"), *root.parent.glob("calib_*.txt")):
        file.unlink()
    drive = bevviz.open(root)
    assert len(drive) == 3 and [camera.name for camera in drive.raw(0).cameras] == ["image_00", "image_02"]


# --- whole drives ---------------------------------------------------------------------------


def plain(root: Path) -> Path:
    """Two clouds of three points in each format, and images."""
    for folder in ("top", "front"):
        (root / folder).mkdir(parents=True)
    for i, stamp in enumerate(("1700000000.100000000", "1700000000.200000000")):
        head = (
            "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
            "WIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\n"
        )
        if i == 0:
            (root / f"top/{stamp}.pcd").write_text(head + "DATA ascii\n1 2 3 4\n5 6 7 8\n9 10 11 12\n")
        else:
            body = np.arange(1, 13, dtype="<f4").tobytes()
            (root / f"top/{stamp}.pcd").write_bytes(head.encode() + b"DATA binary\n" + body)
        datasets.image(root / f"front/{stamp}.png", 80 * i)
    return root


POINTS = np.arange(1, 13, dtype=np.float32).reshape(3, 4)
PCD = (
    b"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    b"WIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA binary\n"
)


def test_a_folder_of_clouds_and_images_is_read(tmp_path: Path) -> None:
    root = plain(tmp_path)
    (root / "calibration.yaml").write_text(
        "cameras:\n  front:\n    K: [100, 0, 62, 0, 100, 19, 0, 0, 1]\n"
        "    pose: [0.5, 0, -0.2, -0.5, 0.5, -0.5, 0.5]\n"
    )
    (root / "poses.txt").write_text(
        "# stamp\n".replace("# stamp\n", "") + "".join(f"1700000000.{i} {i} 0 0 0 0 0 1\n" for i in (1, 2))
    )
    with bevviz.open(root) as drive:
        frames = [drive.raw(i) for i in range(len(drive))]
        assert drive.warnings == []
    for i, frame in enumerate(frames, 1):
        assert frame.stamp == 1_700_000_000_000_000_000 + i * 100_000_000
        np.testing.assert_array_equal(frame.points, POINTS[:, :3])
        np.testing.assert_array_equal(frame.fields["intensity"], POINTS[:, 3])
        (camera,) = frame.cameras
        assert camera.name == "front"
        assert camera.camera_from_points is not None
        # Seen from half a metre ahead and 20 cm below: x ahead is z, left is -x, up is -y.
        np.testing.assert_allclose(
            geometry.apply(camera.camera_from_points, np.array([[10.5, 2, 0.8]])), [[-2, -1, 10]], atol=1e-5
        )
        np.testing.assert_allclose(frame.pose[:3, 3], [i, 0, 0])


@pytest.mark.parametrize("form", ["bin", "npy", "ply", "ply-ascii"])
def test_every_cloud_format_is_read(tmp_path: Path, form: str) -> None:
    """Two frames by number; PLY as its document has it."""
    for i in range(2):
        file = tmp_path / f"{i:06d}.{form[:3]}"
        if form == "bin":
            POINTS.tofile(file)
        elif form == "npy":
            np.save(file, POINTS)
        else:
            kind = "ascii" if form == "ply-ascii" else "binary_little_endian"
            head = f"ply\nformat {kind} 1.0\nelement vertex 3\n"
            head += (
                "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity")) + "end_header\n"
            )
            body = b"1 2 3 4\n5 6 7 8\n9 10 11 12\n" if form == "ply-ascii" else POINTS.tobytes()
            file.write_bytes(head.encode() + body)
    with bevviz.open(tmp_path) as drive:
        frames = [drive.raw(i) for i in range(len(drive))]
        assert any("taken for frame numbers, at 10 a second" in warning for warning in drive.warnings)
    assert [frame.stamp for frame in frames] == [1_000_000_000, 1_100_000_000]
    for frame in frames:
        np.testing.assert_array_equal(frame.points, POINTS[:, :3])
        np.testing.assert_array_equal(frame.fields["intensity"], POINTS[:, 3])


def test_stamps_come_from_a_table_or_from_names(tmp_path: Path, capsys: Capture) -> None:
    for name in "ab":
        POINTS.tofile(tmp_path / f"{name}.bin")
    (tmp_path / "stamps.csv").write_text("file,stamp\na.bin,1700000000.5\nb.bin,1700000000600000000\n")
    with bevviz.open(tmp_path) as drive:
        assert [drive.raw(i).stamp for i in (0, 1)] == [
            1_700_000_000_500_000_000,
            1_700_000_000_600_000_000,
        ]
    (tmp_path / "stamps.csv").write_text("file,stamp\na.bin,1700000000.5\n")
    assert main(["info", str(tmp_path)]) == 2
    assert "stamps.csv: no stamp for b.bin" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cameras: {front: {K: [1, 2]}}", "camera front: K needs 9 numbers"),
        ("cameras: {front: {pose: [1, 2, 3]}}", "pose of front: 3 numbers; expected x y z qx qy qz qw"),
        ("cameras: {front: {K: [7, 0, 0, 0, 7, 0, 4, 3, 1]}}", "row by row (the last 0 0 1)"),
        ("cameras: {front: {pose: [1, 2, 3, 0, 0, 1, 1]}}", "its quaternion has the length 1.41, not 1"),
        (
            "lidars: {top: {pose: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]}}",
            "last row is not 0 0 0 1",
        ),
        ("lidars: {top: {pose: [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}}", "is no rotation"),
        ("lidars: {top: {fields: [x, y, i]}}", "is no list with x, y and z in it"),
        ("cameras: {rear: {}}", "no rear among the cameras; there are front"),
        ("camera: {}", "camera is not known; there are D, K, cameras"),
        ("cameras: [", "is not valid YAML"),
    ],
)
def test_a_wrong_calibration_is_one_line(tmp_path: Path, text: str, message: str, capsys: Capture) -> None:
    root = plain(tmp_path)
    (root / "calibration.yaml").write_text(text)
    assert main(["info", str(root)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert "calibration.yaml" in line


def test_a_damaged_cloud_is_told_and_the_rest_goes_on(tmp_path: Path, capfd: Capture) -> None:
    root = plain(tmp_path)
    (root / "top/1700000000.300000000.pcd").write_bytes(b"no cloud")
    with bevviz.open(root) as drive:
        frames = list(drive.frames)
        assert len(frames) == 2
        (told,) = [w for w in drive.warnings if "1700000000.300000000.pcd" in w or "/top/points" in w]
        assert "1700000000.300000000.pcd: cannot be read as a cloud" in told
    assert capfd.readouterr().out == ""


def test_a_scan_that_no_frame_takes_is_not_read(tmp_path: Path) -> None:
    for number in range(4):
        (tmp_path / f"{number:06}.pcd").write_bytes(b"no cloud" if number % 2 else PCD + POINTS.tobytes())
    with BagSource([tmp_path], load(), every=2) as source:
        assert len(list(source)) == 2
        assert not [warning for warning in source.warnings if "cannot be read" in warning]


def test_a_bag_cut_out_of_a_folder_has_the_same_clouds(tmp_path: Path) -> None:
    """Points without a return are left out of the bag, and counted there as well."""
    root, part = tmp_path / "drive", tmp_path / "part.mcap"
    root.mkdir()
    points = POINTS.copy()
    points[1, :3] = 0
    for number in range(2):
        (root / f"{number:06}.pcd").write_bytes(PCD + points.tobytes()[: 40 if number else None])
    assert main(["cut", str(root), "-o", str(part), "--start", "0", "--end", "1"]) == 0
    with bevviz.open(root) as folder, bevviz.open(part) as bag:
        for number, (count, dropped) in enumerate([(2, 1), (1, 2)]):
            ours, theirs = folder.raw(number).clouds[0], bag.raw(number).clouds[0]
            assert (len(ours.xyz), ours.dropped) == (len(theirs.xyz), theirs.dropped) == (count, dropped)
            np.testing.assert_array_equal(ours.xyz, theirs.xyz)
            np.testing.assert_array_equal(ours.fields["intensity"], theirs.fields["intensity"])
        assert any("000001.pcd: is cut: 2 of 3 points are there" in warning for warning in folder.warnings)


def test_two_drives_in_one_folder_are_two(tmp_path: Path, capsys: Capture) -> None:
    for name in ("monday", "tuesday"):
        (tmp_path / name).mkdir()
        for number in range(2):
            datasets.scan(number).tofile(tmp_path / name / f"{number:06}.bin")
            datasets.image(tmp_path / name / f"{number:06}.png", 60)
    assert main(["info", str(tmp_path)]) == 2
    assert "2 drives; choose with --sequence NAME; there are monday, tuesday" in capsys.readouterr().err
    assert main(["info", str(tmp_path), "--sequence", "tuesday"]) == 0
    (tmp_path / "calibration.yaml").write_text("rate: 10")  # says that the folders are sensors of one drive
    capsys.readouterr()
    assert main(["info", str(tmp_path)]) == 0
    assert "/monday/points" in capsys.readouterr().out


# --- what packages register ------------------------------------------------------------------------


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str, str], None]]:
    """Return a function that installs a package: the source of its module, and its entry points."""

    def install(source: str, points: str) -> None:
        (tmp_path / "my_sets-1.0.dist-info").mkdir()
        (tmp_path / "my_sets-1.0.dist-info/METADATA").write_text("Name: my_sets\nVersion: 1.0\n")
        (tmp_path / "my_sets-1.0.dist-info/entry_points.txt").write_text(points)
        (tmp_path / "my_sets.py").write_text(source)
        monkeypatch.syspath_prepend(tmp_path)
        registered.cache_clear()
        loaders.cache_clear()

    yield install
    sys.modules.pop("my_sets", None)
    registered.cache_clear()
    loaders.cache_clear()


def test_a_package_registers_its_data_set(tmp_path: Path, package: Callable[[str, str], None]) -> None:
    source = """
from bevviz.datasets.folder import Folder

class Mine(Folder):
    name, about, expects, any_folder = "mine", "our data set", "mine.txt", False

    @classmethod
    def fits(cls, path):
        return (path / "mine.txt").is_file()
"""
    package(source, "[bevviz.datasets]\nmine = my_sets:Mine\n")
    drive = tmp_path / "drive"
    drive.mkdir()
    cloud(4).tofile(drive / "000000.bin")
    assert find_loader(drive) is Folder
    (drive / "mine.txt").touch()
    opened = open_dataset(drive)
    assert opened and opened.about == "our data set" and len(opened.streams[0].times) == 1


def test_what_is_no_data_set_is_one_line(package: Callable[[str, str], None]) -> None:
    package("Mine = 5", "[bevviz.datasets]\nmine = my_sets:Mine\n")
    with pytest.raises(UserError, match=r"^the dataset 'mine' \(my_sets:Mine\) .*repair or uninstall"):
        loaders()


def test_a_package_reads_its_calibrations(tmp_path: Path, package: Callable[[str, str], None]) -> None:
    source = """
from bevviz.datasets.folder import FoundCalibration

def find(path, lidars, cameras):
    K = [float(number) for number in (path / "ours.cal").read_text().split()]
    return FoundCalibration(cameras={name: {"K": K} for name in cameras}, files=[path / "ours.cal"])
"""
    package(source, "[bevviz.calibrations]\nmine = my_sets:find\n")
    root = plain(tmp_path / "drive")
    (root / "ours.cal").write_text("100 0 62 0 100 19 0 0 1")
    folder = Folder(root, "")
    assert "calibrated by ours.cal" in folder.warnings
    assert "/front/camera_info" in [stream.topic for stream in folder.streams]
