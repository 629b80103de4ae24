"""Folders of public data sets as their documents specify them; nothing is taken from the loaders."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

# One calibration of each kind that KITTI's data sets have, 2011-09-26's rounded, for small images.
# Of where a camera is beside the first one pykitti takes what is along x alone: that is all there is here.
P2 = "7.2e+01 0 6.1e+01 4.5e+00 0 7.2e+01 1.7e+01 0 0 0 1 0"
R_RECT = "9.999239e-01 9.837760e-03 -7.445048e-03 -9.869795e-03 9.999421e-01 -4.278459e-03 7.402527e-03 "
R_RECT += "4.351614e-03 9.999631e-01"
R = "7.533745e-03 -9.999714e-01 -6.166020e-04 1.480249e-02 7.280733e-04 -9.998902e-01 9.998621e-01 "
R += "7.523790e-03 1.480755e-02"
T = "-4.069766e-03 -7.631618e-02 -2.717806e-01"
TR = "7.533745e-03 -9.999714e-01 -6.166020e-04 -4.069766e-03 1.480249e-02 7.280733e-04 -9.998902e-01 "
TR += "-7.631618e-02 9.998621e-01 7.523790e-03 1.480755e-02 -2.717806e-01"
IMU_R = "9.999976e-01 7.553071e-04 -2.035826e-03 -7.854027e-04 9.998898e-01 -1.482298e-02 2.024406e-03 "
IMU_R += "1.482454e-02 9.998881e-01"
IMU_T = "-8.086759e-01 3.195559e-01 -7.997231e-01"
IMU_TR = "9.999976e-01 7.553071e-04 -2.035826e-03 -8.086759e-01 -7.854027e-04 9.998898e-01 -1.482298e-02 "
IMU_TR += "3.195559e-01 2.024406e-03 1.482454e-02 9.998881e-01 -7.997231e-01"
PLACES = [(49.0110 + 1e-5 * i, 8.4230 + 3e-5 * i, 112.8 + 0.01 * i) for i in range(4)]
TURNS = [(0.02, 0.01 * i, -1.2 + 0.05 * i) for i in range(4)]

# What Git leaves in the place of a large file that was not fetched.
LFS_POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 1234567\n"

# YAML whose aliases stand for more than any memory holds.
LAUGHS = "a0: &a0 [x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12)
)


def scan(number: int, points: int = 400) -> NDArray[np.float32]:
    """(N, 4) x, y, z, reflectance: a floor, and a car of 4 x 1.6 x 1.5 m that is 12 m ahead of scan 0."""
    rng = np.random.default_rng(number)
    floor = rng.uniform([-20, -20, -1.75, 0], [30, 20, -1.7, 1], (points // 2, 4))
    car = rng.uniform([10 + number, -0.8, -1.6, 0], [14 + number, 0.8, -0.2, 1], (points // 2, 4))
    return np.concatenate([floor, car]).astype("<f4")


def image(path: Path, value: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((38, 124, 3), value, np.uint8))


def oxts(number: int) -> str:
    """30 numbers: latitude, longitude, altitude, roll, pitch, yaw, and what else there is."""
    return (
        " ".join(f"{value:.12f}" for value in (*PLACES[number], *TURNS[number], *([0.0] * 19))) + " 4 9 4 4 0"
    )


def kitti_object(root: Path) -> Path:
    """Write three frames with a car and a region without labels."""
    for folder in ("velodyne", "calib", "image_2", "label_2"):
        (root / folder).mkdir(parents=True)
    for number in range(3):
        scan(number).tofile(root / f"velodyne/{number:06d}.bin")
        image(root / f"image_2/{number:06d}.png", 50 * number)
        (root / f"calib/{number:06d}.txt").write_text(
            f"P0: {P2}\nP1: {P2}\nP2: {P2}\nP3: {P2}\n"
            f"R0_rect: {R_RECT}\nTr_velo_to_cam: {TR}\nTr_imu_to_velo: {IMU_TR}\n"
        )
        (root / f"label_2/{number:06d}.txt").write_text(
            "Car 0.00 0 -1.57 48.00 14.00 70.00 28.00 1.50 1.60 4.00 0.07 1.71 11.73 -1.57\n"
            "DontCare -1 -1 -10 0.00 1.00 2.00 3.00 -1 -1 -1 -1000 -1000 -1000 -10\n"
        )
    return root


def kitti_raw(root: Path) -> Path:
    """Write a drive of four frames: the third has no scan, and one tracklet starts at frame 1."""
    day = root / "2011_09_26"
    drive = day / "2011_09_26_drive_0001_sync"
    for sensor in ("velodyne_points", "oxts"):
        (drive / sensor / "data").mkdir(parents=True)
    calib = "calib_time: 09-Jan-2012 13:57:47\n"
    cameras = "corner_dist: 9.95e-02\n"
    for camera in range(4):
        p = P2.replace("4.5e+00", f"{-1.5 * camera:.1f}")
        cameras += f"S_0{camera}: 1.39e+03 5.12e+02\nR_rect_0{camera}: {R_RECT}\nP_rect_0{camera}: {p}\n"
    (day / "calib_cam_to_cam.txt").write_text(calib + cameras)
    (day / "calib_velo_to_cam.txt").write_text(f"{calib}R: {R}\nT: {T}\ndelta_f: 0 0\ndelta_c: 0 0\n")
    (day / "calib_imu_to_velo.txt").write_text(f"{calib}R: {IMU_R}\nT: {IMU_T}\n")
    for number in range(4):
        if number != 2:
            scan(number).tofile(drive / f"velodyne_points/data/{number:010d}.bin")
        (drive / f"oxts/data/{number:010d}.txt").write_text(oxts(number))
        for camera in (0, 2):
            image(drive / f"image_0{camera}/data/{number:010d}.png", 50 * number)
    stamps = {"velodyne_points": 0, "oxts": 7_000_000, "image_00": 1_000_000, "image_02": 2_000_000}
    for sensor, late in stamps.items():
        lines = [f"2011-09-26 13:02:2{5 + i // 10}.{i % 10 * 100_000_000 + late:09d}" for i in range(4)]
        (drive / sensor / "timestamps.txt").write_text("\n".join(lines) + "\n")
    poses = "".join(
        f"<item><tx>{12 + i}</tx><ty>0</ty><tz>-1.7</tz><rx>0</rx><ry>0</ry><rz>0.25</rz><state>2</state>"
        "<occlusion>0</occlusion><truncation>0</truncation></item>"
        for i in (1, 2, 3)
    )
    (drive / "tracklet_labels.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n<!DOCTYPE boost_serialization>\n'
        '<boost_serialization signature="serialization::archive" version="9"><tracklets class_id="0">'
        "<count>1</count><item_version>1</item_version><item><objectType>Car</objectType><h>1.5</h><w>1.6</w>"
        f"<l>4</l><first_frame>1</first_frame><poses><count>3</count>{poses}</poses><finished>1</finished>"
        "</item></tracklets></boost_serialization>\n"
    )
    return drive


def kitti_tracking(root: Path) -> Path:
    """Two sequences; 0000 has four frames, the third without a scan, and one object."""
    for name in ("0000", "0001"):
        (root / "velodyne" / name).mkdir(parents=True)
        for folder in ("calib", "oxts", "label_02"):
            (root / folder).mkdir(exist_ok=True)
        (root / f"calib/{name}.txt").write_text(
            f"P0: {P2}\nP1: {P2}\nP2: {P2}\nP3: {P2}\nR_rect {R_RECT}\nTr_velo_cam {TR}\n"
            f"Tr_imu_velo {IMU_TR}\n"
        )
        (root / f"oxts/{name}.txt").write_text("\n".join(map(oxts, range(4))) + "\n")
        lines = [
            f"{i} 7 Car 0 1 -1.5 20 10 60 30 1.5 1.6 4.0 0.1 1.7 {12 + i}.0 -1.57\n"
            f"{i} -1 DontCare -1 -1 -10 80 0 99 20 -1000 -1000 -1000 -10 -1 -1 -1\n"
            for i in range(4)
        ]
        (root / f"label_02/{name}.txt").write_text("".join(lines))
        for number in range(4):
            if number != 2:
                scan(number).tofile(root / f"velodyne/{name}/{number:06d}.bin")
            image(root / f"image_02/{name}/{number:06d}.png", 50 * number)
    return root


def kitti_odometry(root: Path, *, labels: bool = True) -> Path:
    """Write a sequence of three scans. SemanticKITTI's labels have the road and moving car number 5."""
    sequence = root / "sequences/00"
    for folder in ("velodyne", *(["labels"] if labels else [])):
        (sequence / folder).mkdir(parents=True)
    (sequence / "calib.txt").write_text(f"P0: {P2}\nP1: {P2}\nP2: {P2}\nP3: {P2}\nTr: {TR}\n")
    (sequence / "times.txt").write_text("0.000000e+00\n1.036224e-01\n2.073000e-01\n")
    (root / "poses").mkdir()
    rows = [f"1 0 0 {0.1 * i} 0 1 0 0 0 0 1 {1.1 * i}" for i in range(3)]
    (root / "poses/00.txt").write_text("\n".join(rows) + "\n")
    for number in range(3):
        points = scan(number)
        points.tofile(sequence / f"velodyne/{number:06d}.bin")
        image(sequence / f"image_2/{number:06d}.png", 50 * number)
        if labels:
            half = len(points) // 2
            words = [40] * half + [5 << 16 | 252] * (len(points) - half)
            words[0] = 0
            (sequence / f"labels/{number:06d}.label").write_bytes(struct.pack(f"<{len(words)}I", *words))
    return sequence


def nuscenes(root: Path) -> Path:
    """Two scenes; of scene-0061 two key frames with a sweep between, one camera, a car and an animal."""
    tables: dict[str, list[dict[str, object]]] = {name: [] for name in NUSCENES}
    tables["visibility"] = [{"token": "4", "level": "v80-100", "description": ""}]
    tables["attribute"] = [{"token": "att", "name": "vehicle.moving", "description": ""}]
    for token, name in (("cat0", "vehicle.car"), ("cat1", "animal")):
        tables["category"].append({"token": token, "name": name, "description": ""})
    for token, channel, modality in (
        ("s0", "LIDAR_TOP", "lidar"),
        ("s1", "CAM_FRONT", "camera"),
        ("s2", "RADAR_FRONT", "radar"),
    ):
        tables["sensor"].append({"token": token, "channel": channel, "modality": modality})
    lidar = [0.7077955, -0.0064959, 0.0106443, -0.7063073]  # of scene-0061: x to the right
    camera = [0.4998015, -0.5030317, 0.4997798, -0.4973712]
    intrinsic = [[126.6, 0.0, 81.6], [0.0, 126.6, 49.1], [0.0, 0.0, 1.0]]
    for token, sensor, place, turn, matrix_of in (
        ("c0", "s0", [0.9437130, 0.0, 1.8402300], lidar, []),
        ("c1", "s1", [1.7007912, 0.0159456, 1.5109576], camera, intrinsic),
        ("c2", "s2", [3.4, 0.0, 0.5], [1.0, 0.0, 0.0, 0.0], []),
    ):
        row = {"token": token, "sensor_token": sensor, "translation": place, "rotation": turn}
        tables["calibrated_sensor"].append({**row, "camera_intrinsic": matrix_of})
    tables["log"] = [
        {
            "token": "log",
            "logfile": "n015",
            "vehicle": "n015",
            "date_captured": "2018-07-24",
            "location": "singapore-onenorth",
        }
    ]
    tables["map"] = [
        {"token": "map", "log_tokens": ["log"], "category": "semantic_prior", "filename": "maps/m.png"}
    ]
    (root / "maps").mkdir(parents=True)
    image(root / "maps/m.png", 0)
    for number, scene in enumerate(("scene-0061", "scene-0103")):
        start = 1532402927647951 + 60_000_000 * number
        keys = [f"sample{number}{k}" for k in range(2)]
        tables["scene"].append(
            {
                "token": scene,
                "name": scene,
                "description": "",
                "log_token": "log",
                "nbr_samples": 2,
                "first_sample_token": keys[0],
                "last_sample_token": keys[1],
            }
        )
        for k, sample in enumerate(keys):
            tables["sample"].append(
                {
                    "token": sample,
                    "timestamp": start + 500_000 * k,
                    "scene_token": scene,
                    "prev": keys[0] if k else "",
                    "next": "" if k else keys[1],
                }
            )
        for i in range(3):  # scans at 4 Hz, the middle one a sweep
            at, key = start + 250_000 * i, i != 1
            for channel, calibration, late, suffix in (
                ("LIDAR_TOP", "c0", 0, ".pcd.bin"),
                ("CAM_FRONT", "c1", -35_491, ".jpg"),
                ("RADAR_FRONT", "c2", 11, ".pcd"),
            ):
                token = f"{channel}-{number}-{i}"
                folder = "samples" if key else "sweeps"
                name = f"{folder}/{channel}/n015-2018-07-24-11-22-45+0800__{channel}__{at + late}{suffix}"
                half = np.radians(-20.0 + 4 * i + late * 1e-5) / 2
                tables["ego_pose"].append(
                    {
                        "token": token,
                        "timestamp": at + late,
                        "rotation": [np.cos(half), 0.0, 0.0, np.sin(half)],
                        "translation": [411.3 + 0.7 * i + late * 1e-6, 1180.9 - 0.3 * i, 0.0],
                    }
                )
                tables["sample_data"].append(
                    {
                        "token": token,
                        "sample_token": keys[i // 2],
                        "ego_pose_token": token,
                        "is_key_frame": key,
                        "calibrated_sensor_token": calibration,
                        "timestamp": at + late,
                        "filename": name,
                        "fileformat": "jpg" if suffix == ".jpg" else "pcd",
                        "width": 0,
                        "height": 0,
                        "prev": "",
                        "next": "",
                    }
                )
                path = root / name
                path.parent.mkdir(parents=True, exist_ok=True)
                if channel == "CAM_FRONT":
                    assert cv2.imwrite(str(path), np.full((90, 160, 3), 60 * i, np.uint8))
                elif channel == "LIDAR_TOP":
                    points = scan(10 * number + i)[:, [1, 0, 2, 3]]
                    rings = np.arange(len(points)) % 32
                    np.column_stack([points, rings]).astype("<f4").tofile(path)
        for token, category in ((f"car{number}", "cat0"), (f"dog{number}", "cat1")):
            tables["instance"].append(
                {
                    "token": token,
                    "category_token": category,
                    "nbr_annotations": 2,
                    "first_annotation_token": f"{token}-0",
                    "last_annotation_token": f"{token}-1",
                }
            )
            for k, sample in enumerate(keys):
                half = np.radians(-20.0 + 5 * k) / 2
                tables["sample_annotation"].append(
                    {
                        "token": f"{token}-{k}",
                        "sample_token": sample,
                        "instance_token": token,
                        "visibility_token": "4",
                        "attribute_tokens": ["att"] if category == "cat0" else [],
                        "translation": [423.5 + 2 * k, 1176.4, 0.9],
                        "size": [1.9, 4.4, 1.6],
                        "rotation": [np.cos(half), 0.0, 0.0, np.sin(half)],
                        "prev": "",
                        "next": "",
                        "num_lidar_pts": 20,
                        "num_radar_pts": 0,
                    }
                )
    (root / "v1.0-mini").mkdir()
    for name, rows in tables.items():
        (root / f"v1.0-mini/{name}.json").write_text(json.dumps(rows, indent=0))
    return root


NUSCENES = (
    "attribute",
    "calibrated_sensor",
    "category",
    "ego_pose",
    "instance",
    "log",
    "map",
    "sample",
    "sample_annotation",
    "sample_data",
    "scene",
    "sensor",
    "visibility",
)


def matrix(text: str, columns: int = 3) -> NDArray[np.float64]:
    return np.array(text.split(), float).reshape(-1, columns)


def lines_of(values: Sequence[float]) -> str:
    return " ".join(map(str, values))


def cloud(columns: int, points: int = 3000, seed: int = 0) -> np.ndarray:
    """x, y, z, intensity, ring, time, and the distance, of points in no order."""
    rng = np.random.default_rng(seed)
    xyz = rng.normal([5, 0, -1], [20, 15, 0.7], (points, 3))
    rest = [
        rng.integers(0, 256, points),
        rng.integers(0, 32, points),
        rng.random(points) * 0.1,
        np.linalg.norm(xyz, axis=1),
    ]
    return np.column_stack([xyz, *rest])[:, :columns].astype("<f4")
