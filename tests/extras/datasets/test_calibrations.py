"""Calibrations of other tools in plain folders, as the documents of the tools specify them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bevviz
from bevviz.cli import main
from bevviz.datasets import find_loader
from bevviz.datasets.folder import Folder
from bevviz.extras.datasets.kitti_drives import KittiObject
from bevviz.model import geometry
from bevviz.model.frame import F64, Camera
from tests.support import datasets

K = [72.0, 0.0, 61.0, 0.0, 71.0, 17.0, 0.0, 0.0, 1.0]
D = [-0.2, 0.1, 0.001, 0.002]
# The camera is 0.3 m ahead of the LiDAR and 0.2 m below it, and looks ahead.
CAMERA_FROM_LIDAR = np.array([[0, -1, 0, 0], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1.0]])
ROWS = CAMERA_FROM_LIDAR.tolist()
LIDAR_FROM_CAMERA = np.linalg.inv(CAMERA_FROM_LIDAR)


def opencv(name: str, rows: int, columns: int, values: Any) -> str:
    data = ", ".join(str(float(value)) for value in np.reshape(values, -1))
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [{data}]\n"


def matrix_yaml(name: str, rows: int, columns: int, values: Any) -> str:
    return f"{name}:\n  rows: {rows}\n  cols: {columns}\n  data: {np.reshape(values, -1).tolist()}\n"


SUPERVISELY = {
    "sensorsData": {
        "extrinsicMatrix": np.reshape(ROWS[:3], -1).tolist(),
        "intrinsicMatrix": K,
    }
}
OPENCALIB = {
    "calib/center_camera-intrinsic.json": json.dumps(
        {
            "center_camera-intrinsic": {
                "sensor_name": "center_camera",
                "device_type": "camera",
                "param": {
                    "img_dist_w": 124,
                    "img_dist_h": 38,
                    "cam_K": {"rows": 3, "cols": 3, "data": np.reshape(K, (3, 3)).tolist()},
                    "cam_dist": {"rows": 1, "cols": 4, "data": [D]},
                },
            }
        }
    ),
    "calib/top_center_lidar-to-center_camera-extrinsic.json": json.dumps(
        {
            "top_center_lidar-to-center_camera-extrinsic": {
                "sensor_name": "top_center_lidar",
                "target_sensor_name": "center_camera",
                "param": {"sensor_calib": {"rows": 4, "cols": 4, "data": ROWS}},
            }
        }
    ),
}
CAMERA_INFO = (
    "image_width: 124\nimage_height: 38\ncamera_name: front\n"
    + matrix_yaml("camera_matrix", 3, 3, K)
    + "distortion_model: plumb_bob\n"
    + matrix_yaml("distortion_coefficients", 1, 5, [*D, 0.0])
)
AUTOWARE_AI = (
    "%YAML:1.0\n---\n"
    + opencv("CameraExtrinsicMat", 4, 4, LIDAR_FROM_CAMERA)
    + opencv("CameraMat", 3, 3, K)
    + opencv("DistCoeff", 1, 5, [*D, 0.0])
    + "ImageSize: [124, 38]\n"
)
KALIBR = (
    "cam0:\n  camera_model: pinhole\n  intrinsics: [72, 71, 61, 17]\n  distortion_model: radtan\n"
    f"  distortion_coeffs: {D}\n  resolution: [124, 38]\n  rostopic: /cam0/image_raw\n  T_cam_lidar: {ROWS}\n"
)
AUTOWARE = (
    "base_link:\n  sensor_kit_base_link: {x: 1.0, y: 0, z: 1.5, roll: 0, pitch: 0, yaw: 0}\n"
    "sensor_kit_base_link:\n"
    "  front/camera_link: {x: 0.3, y: 0, z: -0.2, roll: 0, pitch: 0, yaw: 0}\n"
    "  velodyne_top_base_link: {x: 0, y: 0, z: 0, roll: 0, pitch: 0, yaw: 0}\n"
)
NUSCENES = {
    "LIDAR_TOP": {"translation": [1.0, 0.0, 1.5], "rotation": [1, 0, 0, 0]},
    "CAM_FRONT": {
        "translation": [1.3, 0.0, 1.3],
        "rotation": [0.5, -0.5, 0.5, -0.5],
        "camera_intrinsic": np.reshape(K, (3, 3)).tolist(),
    },
}
KITTI = (
    f"P2: {' '.join(map(str, np.column_stack([np.reshape(K, (3, 3)), np.zeros(3)]).reshape(-1)))}\n"
    f"R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: {' '.join(map(str, CAMERA_FROM_LIDAR[:3].reshape(-1)))}\n"
)
K_TEXT, POSE_TEXT = (" ".join(map(str, values)) for values in (K, CAMERA_FROM_LIDAR[:3].reshape(-1)))
KITTI_RAW = {
    "calib/calib_velo_to_cam.txt": "calib_time: 15-Mar-2012 11:37:16\n"
    f"R: {' '.join(map(str, CAMERA_FROM_LIDAR[:3, :3].reshape(-1)))}\nT: 0 -0.2 -0.3\n",
    "calib/calib_cam_to_cam.txt": "R_rect_00: 1 0 0 0 1 0 0 0 1\n"
    f"P_rect_00: {KITTI.splitlines()[0].partition(': ')[2].replace('72.0', '99')}\n"
    f"P_rect_02: {KITTI.splitlines()[0].partition(': ')[2]}\n",
}
SUSTECH = json.dumps({"extrinsic": CAMERA_FROM_LIDAR.reshape(-1).tolist(), "intrinsic": K})


def camera_of(folder: Path) -> tuple[Camera, F64]:
    """Return the only camera of the first frame, and camera_from_lidar."""
    frame = bevviz.open(folder).raw(0)
    (camera,) = frame.cameras
    assert camera.camera_from_points is not None and camera.intrinsics is not None
    return camera, camera.camera_from_points @ frame.points_from_clouds[0]


def write_drive(folder: Path, camera: str = "front", lidar: str = "lidar") -> Path:
    for number in range(2):
        (folder / lidar).mkdir(parents=True, exist_ok=True)
        datasets.scan(number).tofile(folder / lidar / f"{number:06}.bin")
        datasets.image(folder / camera / f"{number:06}.png", 90)
    return folder


@pytest.mark.parametrize(
    ("camera", "files", "model"),
    [
        ("front", {"calib/camera/front.json": SUSTECH}, ""),
        ("img", {f"cam_info/{n:06}.json": json.dumps(SUPERVISELY) for n in range(2)}, ""),
        (
            "image_orig",
            {"config.json": json.dumps({"cam": {"D": D, "K": [K[:3], K[3:6], K[6:]]}, "tf": ROWS})},
            "plumb_bob",
        ),
        ("center_camera", OPENCALIB, "plumb_bob"),
        ("camera", {"autoware.yaml": AUTOWARE_AI}, "plumb_bob"),
        ("cam0", {"calib/camchain.yaml": KALIBR}, "plumb_bob"),
        ("front", {"front.yaml": CAMERA_INFO, "sensor_kit_calibration.yaml": AUTOWARE}, "plumb_bob"),
        ("CAM_FRONT", {"sensors.json": json.dumps(NUSCENES)}, ""),
        ("pictures", {"calib/000000.txt": KITTI, "calib/000001.txt": KITTI}, ""),
        ("pictures", KITTI_RAW, ""),
        ("pictures", {"calib.txt": f"P0: {' '.join(['-10'] * 12)}\n{KITTI}"}, ""),
        ("camera", {"calib.txt": f"K: {K_TEXT}\nD: {' '.join(map(str, D))}\nT: {POSE_TEXT}\n"}, "plumb_bob"),
        (
            "camera",
            {"calib.txt": KITTI.splitlines()[0] + "\n" + KITTI_RAW["calib/calib_velo_to_cam.txt"]},
            "",
        ),
        ("front", {"k.json": json.dumps({"K": K}), "calib.txt": f"Tr: {POSE_TEXT}"}, ""),
    ],
    ids=[
        "SUSTechPOINTS",
        "Supervisely",
        "PlyCal",
        "OpenCalib",
        "Autoware.AI",
        "Kalibr",
        "Autoware",
        "nuScenes",
        "KITTI",
        "KITTI raw",
        "placeholders",
        "CalibAnything",
        "P2, R and T",
        "K and Tr apart",
    ],
)
def test_calibrations_of_tools_place_the_camera(
    tmp_path: Path, camera: str, files: dict[str, str], model: str
) -> None:
    folder = write_drive(tmp_path, camera)
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    found, pose = camera_of(folder)
    assert found.intrinsics is not None
    np.testing.assert_allclose(found.intrinsics.K.reshape(-1), K)
    np.testing.assert_allclose(pose, CAMERA_FROM_LIDAR, atol=1e-6)
    assert found.intrinsics.distortion_model == model
    assert found.intrinsics.D[:4].tolist() == (D if model else [])
    loader = find_loader(folder)
    assert loader is not None
    warnings = loader(folder, "").warnings
    assert loader is not Folder or any(text.startswith("calibrated by ") for text in warnings)
    assert not any("is not read" in text for text in warnings)


@pytest.mark.parametrize("cameras", [("img",), ("left", "right")])
def test_images_in_a_folder_for_each_cloud(tmp_path: Path, cameras: tuple[str, ...]) -> None:
    """The folders of images, not their names, tell the clouds that they belong to."""
    for number in range(2):
        (tmp_path / "pointcloud").mkdir(exist_ok=True)
        datasets.scan(number).tofile(tmp_path / f"pointcloud/scene{number}.bin")
        folder = tmp_path / f"related_images/scene{number}_bin"
        for place, camera in enumerate(cameras):
            name = f"scene{number}_{camera}.png" if len(cameras) > 1 else f"img{9 - number}.png"
            datasets.image(folder / name, 40 + 50 * number + 20 * place)
            calibrated = SUPERVISELY if place == 0 else {"sensorsData": {"intrinsicMatrix": [0] * 9}}
            (folder / f"{name}.json").write_text(json.dumps({"name": name, "meta": calibrated}))
    drive = bevviz.open(tmp_path)
    for number in range(2):
        frame = drive.raw(number)
        assert [c.name for c in frame.cameras] == (["camera"] if len(cameras) == 1 else [*cameras])
        grey = [int(c.image.bgr.mean()) for c in frame.cameras if c.image is not None]
        assert grey == [40 + 50 * number + 20 * place for place in range(len(cameras))]
        assert frame.cameras[0].camera_from_points is not None


def test_what_calibration_yaml_states_wins(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_drive(tmp_path)
    (folder / "front.json").write_text(SUSTECH)
    (folder / "calibration.yaml").write_text("cameras: {front: {K: [50, 0, 60, 0, 50, 20, 0, 0, 1]}}")
    found, pose = camera_of(folder)
    assert found.intrinsics is not None and found.intrinsics.K[0, 0] == 50
    np.testing.assert_allclose(pose, CAMERA_FROM_LIDAR, atol=1e-6)
    broken = {"extrinsic": [2.0] * 16, "intrinsic": K}
    (folder / "front.json").write_text(json.dumps(broken))
    assert main(["info", str(folder)]) == 0
    assert "front.json: is not used: ValueError: its upper left part is no rotation" in " ".join(
        capsys.readouterr().out.split()
    )


def test_two_cameras_get_their_own_calibrations(tmp_path: Path) -> None:
    folder = write_drive(tmp_path)
    write_drive(folder, "rear")
    turned = CAMERA_FROM_LIDAR @ np.diag([-1, -1, 1, 1.0])
    (folder / "calib").mkdir()
    (folder / "calib/front.json").write_text(SUSTECH)
    rear = {"extrinsic": turned.reshape(-1).tolist(), "intrinsic": K}
    (folder / "calib/rear.json").write_text(json.dumps(rear))
    frame = bevviz.open(folder).raw(0)
    poses = {camera.name: camera.camera_from_points for camera in frame.cameras}
    for name, wanted in (("front", CAMERA_FROM_LIDAR), ("rear", turned)):
        pose = poses[name]
        assert pose is not None
        np.testing.assert_allclose(pose @ frame.points_from_clouds[0], wanted, atol=1e-6)


def test_kitti_with_a_mounting_for_each_camera_has_all(tmp_path: Path) -> None:
    """Write a folder with five cameras as converters of other data sets do: each has a Tr_velo_to_cam_N."""
    root = datasets.kitti_object(tmp_path / "training")
    turned = np.eye(4)
    turned[:2, :2] = [[0, 1], [-1, 0]]
    for file in sorted((root / "image_2").iterdir()):
        for number in (0, 1):
            datasets.image(root / f"image_{number}" / file.name, 60 + number)
    for file in (root / "calib").iterdir():
        rows = [f"P{number}: {KITTI.splitlines()[0].partition(': ')[2]}" for number in (0, 1)]
        rows.append("R0_rect: 1 0 0 0 1 0 0 0 1")
        for number, pose in enumerate((CAMERA_FROM_LIDAR, CAMERA_FROM_LIDAR @ turned)):
            rows.append(f"Tr_velo_to_cam_{number}: {' '.join(map(str, pose[:3].reshape(-1)))}")
        file.write_text("\n".join(rows))
    frame = bevviz.open(root).raw(1)
    assert [camera.name for camera in frame.cameras] == ["image_0", "image_1"]
    for camera, wanted in zip(frame.cameras, (CAMERA_FROM_LIDAR, CAMERA_FROM_LIDAR @ turned), strict=True):
        assert camera.camera_from_points is not None
        np.testing.assert_allclose(camera.camera_from_points, wanted, atol=1e-6)
    assert frame.truth is not None and len(frame.truth.labels) == 1


def test_images_belong_to_the_clouds_of_their_names(tmp_path: Path) -> None:
    """Names without a number, and fewer images than clouds."""
    for row, name in enumerate(("alpha", "beta", "gamma")):
        (tmp_path / "lidar").mkdir(exist_ok=True)
        datasets.scan(row).tofile(tmp_path / "lidar" / f"{name}.bin")
        if name != "beta":
            datasets.image(tmp_path / "camera" / f"{name}.png", 50 + 50 * row)
    drive = bevviz.open(tmp_path, set={"sync.tolerance": 0.05})
    images = [camera.image for n in range(3) for camera in drive.raw(n).cameras]
    assert [None if image is None else int(image.bgr[0, 0, 0]) for image in images] == [50, None, 150]


def test_a_rotation_with_few_digits_is_made_one() -> None:
    from bevviz.extras.datasets.calibrations import _rigid

    rounded = np.round(CAMERA_FROM_LIDAR @ geometry.transform(np.zeros(3), (0, 0, 0.0998, 0.995)), 2)
    rotation = _rigid(rounded)[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_a_folder_of_clouds_and_images_has_two_frames(tmp_path: Path) -> None:
    """Both are named after the folder, as in the examples of OpenCalib."""
    folder = write_drive(tmp_path, "data", "data")
    (folder / "data/front.json").write_text(SUSTECH)
    camera, pose = camera_of(folder)
    assert camera.name == "data_camera"
    np.testing.assert_allclose(pose, CAMERA_FROM_LIDAR, atol=1e-6)


@pytest.mark.parametrize("names", [("points", "calibs", "img"), ("point_clouds", "calib", "pictures")])
def test_copies_of_kitti_name_its_folders(tmp_path: Path, names: tuple[str, str, str]) -> None:
    """Each frame has its own calibration, as in the benchmark: the frames are of several drives."""
    root = datasets.kitti_object(tmp_path / "data")
    for old, new in zip(("velodyne", "calib", "image_2"), names, strict=True):
        (root / old).rename(root / new)
    file = root / names[1] / "000002.txt"
    file.write_text(file.read_text().replace("7.2e+01", "9.9e+01"))
    drive = bevviz.open(root)
    focal = [c.intrinsics.K[0, 0] for n in range(3) for c in drive.raw(n).cameras if c.intrinsics is not None]
    assert focal == [72, 72, 99]


def test_labels_of_copies_count_if_they_are_kittis(tmp_path: Path) -> None:
    root = datasets.kitti_object(tmp_path / "data")
    (root / "label_2").rename(root / "labels")
    truth = bevviz.open(root).raw(1).truth
    assert truth is not None and truth.labels == ("Car",)
    for file in (root / "labels").iterdir():
        file.write_text("2 0.5 0.5 0.1 0.1\n")  # as YOLO is trained
    loader = KittiObject(root, "")
    assert "labels is not read: its lines have 5 columns, KITTI's have 15" in loader.warnings
    assert bevviz.open(root).raw(1).truth is None


def test_labels_of_another_format_are_named(tmp_path: Path) -> None:
    """View of Delft has JSON for its radar."""
    root = datasets.kitti_object(tmp_path / "data")
    for file in (root / "label_2").iterdir():
        file.rename(file.with_suffix(".json"))
    assert "label_2 is not read: no .txt in it has the name of a scan" in KittiObject(root, "").warnings
    assert bevviz.open(root).raw(1).truth is None


def test_calibrations_of_sixteen_cameras_are_read(tmp_path: Path) -> None:
    folder = write_drive(tmp_path)
    (folder / "calib").mkdir()
    for number in range(16):
        other = {"extrinsic": np.eye(4).reshape(-1).tolist(), "intrinsic": K}
        (folder / f"calib/camera_{number}.json").write_text(json.dumps(other))
    (folder / "calib/front.json").write_text(SUSTECH)
    np.testing.assert_allclose(camera_of(folder)[1], CAMERA_FROM_LIDAR, atol=1e-6)


def test_kitti_archives_each_in_its_folder(tmp_path: Path) -> None:
    root = datasets.kitti_object(tmp_path / "copied")
    for name in ("velodyne", "calib", "image_2", "label_2"):
        (tmp_path / f"data_object_{name}/training").mkdir(parents=True)
        (root / name).rename(tmp_path / f"data_object_{name}/training/{name}")
    root.rmdir()
    frame = bevviz.open(tmp_path).raw(1)
    assert frame.cameras[0].camera_from_points is not None
    assert frame.truth is not None and len(frame.truth.labels) == 1


def test_images_of_unclear_cameras_are_named(tmp_path: Path) -> None:
    root = datasets.kitti_object(tmp_path)
    (root / "image_2").rename(root / "left")
    datasets.image(root / "depth/000000.png", 3)
    assert any("there are images in depth, left" in text for text in KittiObject(root, "").warnings)


@pytest.mark.parametrize("projection", ["1 0 0 0 0 1 0 0 0 0 1 0", " ".join(["-10"] * 12)])
def test_placeholders_are_no_calibration(tmp_path: Path, projection: str) -> None:
    folder = write_drive(tmp_path)
    (folder / "calib.txt").write_text(f"P2: {projection}\nTr: {POSE_TEXT}\n")
    assert any("is that of no camera" in text for text in Folder(folder, "").warnings)
    assert bevviz.open(folder).raw(0).cameras[0].intrinsics is None


def test_the_first_of_two_rows_counts(tmp_path: Path) -> None:
    root = datasets.kitti_object(tmp_path)
    for file in (root / "calib").iterdir():
        file.write_text(file.read_text() + f"P2: {' '.join(['-10'] * 12)}\n")
    intrinsics = bevviz.open(root).raw(0).cameras[0].intrinsics
    assert intrinsics is not None and intrinsics.K[0, 0] == 72


def test_calibrations_that_differ_are_named(tmp_path: Path) -> None:
    folder = write_drive(tmp_path)
    (folder / "a.txt").write_text(KITTI)
    (folder / "b.txt").write_text(KITTI.replace("72.0", "99"))
    assert "b.txt states another K of front than a.txt: the first is used for all frames" in (
        Folder(folder, "").warnings
    )
