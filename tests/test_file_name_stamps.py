"""What the names of a folder's files tell: whose they are, and when they were taken."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

import bevviz
from bevviz import UserError
from bevviz.datasets.folder import Folder
from bevviz.datasets.stamps import file_times, group_by_sensor
from tests.support.datasets import cloud

START = 1_700_000_000_950_000_000
STAMPS = [START + 100_000_000 * i + 100 * (i * 7919 % 30_000) for i in range(40)]  # 10 Hz, some jitter
SECOND = 10**9


def date(stamp: int, form: str) -> str:
    return datetime.fromtimestamp(stamp // SECOND, UTC).strftime(form)


@pytest.mark.parametrize(
    ("name", "off", "precision"),
    [
        (lambda i, t: f"{t}", 0, 1),
        (lambda i, t: f"{t // 1000}", 0, 1000),
        (lambda i, t: repr(t / SECOND), 0, 1000),
        (lambda i, t: f"{t // SECOND}.{t % SECOND}", 0, 1),  # ROS 2's, without leading zeros
        (lambda i, t: f"{t // SECOND}_{t % SECOND}", 0, 1),
        (lambda i, t: f"{t // SECOND}-{t % SECOND // 1000:06}", 0, 1000),
        (lambda i, t: f"{t}_{i:06}", 0, 1),
        (lambda i, t: f"{i}_{t}", 0, 1),
        (lambda i, t: f"lidar_{t / SECOND:.6f}_{i}", 0, 1000),
        (lambda i, t: f"PC_{t - 1384 * 10**15}", 1384 * 10**15, 1),  # 18 digits, as of Argoverse
        (lambda i, t: f"{t - START + 12_345_678_901_234}", START - 12_345_678_901_234, 1),  # since the start
        (lambda i, t: f"{100_000 * i}", 0, 0),  # microseconds of a simulator
        (lambda i, t: date(t, "%Y%m%d%H%M%S") + f"{t % SECOND // 10**6:03}", 0, 10**6),
        (lambda i, t: date(t, "%Y-%m-%dT%H-%M-%S") + f".{t % SECOND // 1000:06}Z", 0, 1000),
    ],
)
def test_stamps_of_common_programs_are_read(
    name: Callable[[int, int], str], off: int, precision: int
) -> None:
    files = [Path(f"{name(i, stamp)}.pcd") for i, stamp in enumerate(STAMPS)]
    told = file_times(sorted(files))
    assert told and not told.frames
    there = STAMPS if precision else [SECOND // 10 * i for i in range(len(files))]
    off_by = [abs(told.values[file] + off - stamp) for file, stamp in zip(files, there, strict=True)]
    assert max(off_by) < max(precision, 1)


@pytest.mark.parametrize(
    "name",
    [
        "{i}",
        "{i:06}",
        "frame{i}_pcd",
        "{i:04}_v2",
        "{i:06}_hdl64",
        "run_20240131_235959_{i:06}",
        "2024-01-31-23-59-59_{i:03}",
        "scan.7.{i:06}",
        "1700000000_{i}",
        "cloud ({i})",
    ],
)
@pytest.mark.parametrize("count", [5, 40])
def test_frame_numbers_are_found_anywhere_in_names(name: str, count: int) -> None:
    files = [Path(name.format(i=i) + ".pcd") for i in range(count)]
    assert list(group_by_sensor(files)) == [""]
    told = file_times(files)
    assert told and told.frames
    assert [told.values[file] for file in files] == list(range(count))


@pytest.mark.parametrize(
    "name",
    [
        "{frame:06}_cam{camera}",
        "{frame}_cam{camera}",
        "cam{camera}_{frame}",
        "cam{camera}_{frame:06}_{stamp}",
        "cam{camera}_1700000{frame:03}_{camera}5",
    ],
)
def test_several_cameras_in_one_folder_are_separated(name: str) -> None:
    pairs = [(frame, camera) for frame in range(30) for camera in range(2)]
    names = [name.format(frame=f, camera=c, stamp=STAMPS[f] + 777 * c) for f, c in pairs]
    groups = group_by_sensor([Path(f"{name}.png") for name in names])
    assert [len(found) for found in groups.values()] == [30, 30]
    for camera, found in enumerate(groups.values()):
        assert all(f"cam{camera}" in file.stem for file in found)


def drive_in(folder: Path, files: dict[str, str], calibration: str = "") -> dict[str, list[float]]:
    """Seconds of each topic of clouds and images; of sensors with the names of their files."""
    for sensor, names in files.items():
        (folder / sensor).mkdir(exist_ok=True)
        for name in names.split():
            (folder / sensor / name).write_bytes(cloud(4, 20).tobytes())
    if calibration:
        (folder / "calibration.yaml").write_text(calibration)
    drive = Folder(folder, "")
    drive_in.warnings = drive.warnings  # type: ignore[attr-defined]
    return {s.topic.split("/")[1]: (s.times / 1e9).tolist() for s in drive.streams if s.topic != "/tf_static"}


def test_a_picture_beside_the_drive_leaves_its_stamps_alone(tmp_path: Path) -> None:
    """Of all files the stamps were lost, as one name has none."""
    (tmp_path / "overview.png").write_bytes(b"")
    there = drive_in(
        tmp_path,
        {"top": "1700000001.5.bin 1700000001.6.bin", "front": "1700000001.52.png 1700000001.62.png x.png"},
    )
    assert there == {"top": [1700000001.5, 1700000001.6], "front": [1700000001.52, 1700000001.62]}
    told = drive_in.warnings  # type: ignore[attr-defined]
    assert sum("left out (stamps.csv can say it)" in line for line in told) == 1
    assert "overview.png: beside the folders of the cameras: left out" in told


def test_images_that_are_numbered_beside_clouds_with_stamps(tmp_path: Path) -> None:
    there = drive_in(
        tmp_path,
        {
            "top": "1700000002.5.bin 1700000001.5.bin",
            "front": "2.png 10.png",
            "rear": "1.png 2.png 3.png",
        },
    )
    assert there == {"top": [1700000001.5, 1700000002.5], "front": [1700000001.5, 1700000002.5]}
    told = drive_in.warnings  # type: ignore[attr-defined]
    assert any(
        "front: its names do not tell when, as those of top do: taken in their order" in t for t in told
    )
    assert any(t.startswith("rear/1.png and 2 more: the name does not tell") for t in told)


def test_a_camera_that_counts_its_own_frames(tmp_path: Path) -> None:
    files = {
        "top": " ".join(f"{i:06}.bin" for i in range(10)),
        "front": " ".join(f"{i:06}.png" for i in range(30)),
    }
    assert drive_in(tmp_path, files)["front"][29] == pytest.approx(3.9)
    said = "front has the frames 0 to 29, top 0 to 9: taken for the same"
    assert any(said in line for line in drive_in.warnings)  # type: ignore[attr-defined]
    there = drive_in(tmp_path, files, "cameras: {front: {rate: 30}}")
    assert there["front"][29] == pytest.approx(1 + 29 / 30) and there["top"][9] == pytest.approx(1.9)
    assert not any(said in line for line in drive_in.warnings)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("stamps", "seconds"),
    [
        (["1700000001.5", "1700000001.25"], [1700000001.25, 1700000001.5]),
        (["316000001500000000", "316000001250000000"], [316000001.25, 316000001.5]),
        (["0", "7"], [0, 7]),
        (["1700000001,50000000", "1700000001,250000000"], [1700000001.05, 1700000001.25]),
        (["250000000", "500000000", "750000000"], [0.25, 0.5, 0.75]),
    ],
)
def test_a_table_states_the_stamps(stamps: list[str], seconds: list[float], tmp_path: Path) -> None:
    rows = ["file,stamp", *(f"top/{name}.bin,{stamp}" for name, stamp in zip("abc", stamps, strict=False))]
    (tmp_path / "stamps.csv").write_text("\n".join(rows), encoding="utf-8-sig")
    names = " ".join(f"{name}.bin" for name in "abc"[: len(stamps)])
    assert drive_in(tmp_path, {"top": names})["top"] == pytest.approx(seconds, abs=1e-6)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("# stamp x y z qx qy qz qw\n1700000001.5 1 2 3 0 0 0 1\n", 1700000001.5),
        ("1700000001500000000 1 2 3 0 0 0 1\n", 1700000001.5),
        ("1 0 0 4 0 1 0 5 0\n", "line 1 has 9 numbers, not 8 (stamp x y z qx qy qz qw)"),
    ],
)
def test_poses_of_other_programs_are_read(line: str, expected: float | str, tmp_path: Path) -> None:
    """Nine numbers are not read as a stamp and a pose."""
    (tmp_path / "poses.txt").write_text(line)
    if isinstance(expected, str):
        with pytest.raises(UserError) as error:
            drive_in(tmp_path, {"top": "1700000001.5.bin"})
        assert expected in str(error.value)
    else:
        assert drive_in(tmp_path, {"top": "1700000001.5.bin"})["tf"] == [expected]


def test_lidars_may_have_different_columns(tmp_path: Path) -> None:
    """The columns of the largest file were taken for all of them."""
    for name, columns in (("top", 5), ("livox", 4)):
        (tmp_path / name).mkdir()
        cloud(columns, 3000).tofile(tmp_path / name / "000000.BIN")
    drive = Folder(tmp_path, "")
    for name, columns in (("top", 5), ("livox", 4)):
        (stream,) = [stream for stream in drive.streams if stream.topic == f"/{name}/points"]
        scan = stream.make(0)
        assert len(scan.fields) == columns - 3
        np.testing.assert_array_equal(scan.xyz, cloud(columns, 3000)[:, :3])
    assert any(line.startswith("nothing says how livox, top are mounted") for line in drive.warnings)


def test_files_of_operating_systems_are_ignored(tmp_path: Path) -> None:
    """Of a drive from a Mac each cloud was there twice, and the second could not be read."""
    files = {"top": "1.bin ._1.bin .hidden.bin", "front": "1.png ._1.png", "__MACOSX": "1.bin 2.bin"}
    assert drive_in(tmp_path, files) == {"top": [1.1], "front": [1.1]}
    (tmp_path / "front/2.png").symlink_to("not_fetched.png")
    drive_in(tmp_path, {})
    assert "front/2.png: a link to what is not there" in drive_in.warnings  # type: ignore[attr-defined]


def test_labels_and_matrices_are_no_lidars(tmp_path: Path) -> None:
    """Their numbers were points beside those of the LiDAR."""
    drive_in(tmp_path, {"top": "1.bin"})
    for name in ("labels", "pose", "K", "kinds"):
        (tmp_path / name).mkdir()
    np.arange(20, dtype=np.uint32).tofile(tmp_path / "labels/1.bin")
    np.save(tmp_path / "pose/1.npy", np.eye(4))
    np.save(tmp_path / "K/1.npy", np.eye(3))
    np.save(tmp_path / "kinds/1.npy", np.zeros(20))
    assert drive_in(tmp_path, {}) == {"top": [1.1]}
    told = drive_in.warnings  # type: ignore[attr-defined]
    for said in (
        "labels/1.bin: whole numbers",
        "pose/1.npy: of the shape (4, 4)",
        "kinds/1.npy: of the shape",
    ):
        assert any(line.startswith(said) and line.endswith("left out") for line in told)
    np.arange(2000, dtype=np.int64).tofile(tmp_path / "labels/1.bin")
    with pytest.raises(UserError, match="its numbers are whole ones; save points as float32"):
        Folder(tmp_path / "labels", "")


def test_sensors_in_a_folder_of_sensors(tmp_path: Path) -> None:
    files = ("lidar/left/1.bin", "velodyne/data/1.bin", "2.bin", "images/front/1.png", "images/train/1.png")
    for name in (*files, "velodyne/0001/1.bin", "front/1.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(cloud(4, 20).tobytes())
    there = drive_in(tmp_path, {"lidar": "3.bin"})
    of_root = f"{tmp_path.name}_lidar"
    of_others = {name: [1.1] for name in ("left", "velodyne", "front", "images_front")}
    assert there == {"lidar": [1.3], of_root: [1.2]} | of_others


def test_drives_in_a_folder_are_named(tmp_path: Path) -> None:
    for name in ("monday", "tuesday"):
        (tmp_path / name).mkdir()
        drive_in(tmp_path / name, {"top": "1.bin"})
    with pytest.raises(UserError, match="its folders that are one: monday, tuesday"):
        bevviz.open(tmp_path)
    drive_in(tmp_path / "monday", {"0000": "1.bin", "0001": "1.bin", "top": ""})
    (tmp_path / "monday/top/1.bin").unlink()
    with pytest.raises(UserError, match="its folders that are one: 0000, 0001"):
        bevviz.open(tmp_path / "monday")


def test_many_files_that_cannot_be_read_are_one_sentence(tmp_path: Path) -> None:
    drive_in(tmp_path, {"top": "1.bin"})
    points = "".join(f"{i} 2 -1\n" for i in range(9))
    for i in range(2, 6):
        np.save(tmp_path / f"top/{i}.npy", np.zeros((4, 500), np.float32))
        (tmp_path / f"top/1{i}.pcd").write_text(
            f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 20\nDATA ascii\n{points}"
        )
    with bevviz.open(tmp_path) as drive:
        assert len(list(drive.frames)) == 5
        told = [line for line in drive.warnings if "/top/points: " in line]
    assert len(told) == 2
    assert "4 of 9 cannot be read; the first: " in told[0] and "has the shape (4, 500)" in told[0]
    assert "4 of 9 are cut; the first: " in told[1] and "12.pcd: is cut: 9 of 20 points" in told[1]


@pytest.mark.parametrize(("size", "told"), [("", True), ("size: [1280, 720], ", False)])
def test_a_calibration_for_larger_images_is_scaled(size: str, told: bool, tmp_path: Path) -> None:
    """What was projected fell beside the image, and nothing said why."""
    drive_in(tmp_path, {"top": "1.bin", "front": ""})
    cv2.imwrite(str(tmp_path / "front/1.png"), np.zeros((360, 640, 3), np.uint8))
    about = f"{{{size}K: [700, 0, 640, 0, 700, 360, 0, 0, 1], pose: [0, 0, 0, -0.5, 0.5, -0.5, 0.5]}}"
    (tmp_path / "calibration.yaml").write_text(f"cameras: {{front: {about}}}")
    with bevviz.open(tmp_path) as drive:
        (frame,) = drive.frames
        intrinsics = frame.cameras[0].intrinsics
        assert intrinsics and (intrinsics.width, intrinsics.K[0, 0]) == (640, 700 if told else 350)
        assert any("the principal point (640, 360) is far from" in line for line in drive.warnings) == told


@pytest.mark.parametrize("rate", ["0", "-1", "fast", ".nan"])
def test_an_invalid_rate_is_one_line(rate: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"calibration\.yaml: rate is"):
        drive_in(tmp_path, {"top": "1.bin"}, f"rate: {rate}")


def test_calibrations_of_other_programs_are_named(tmp_path: Path) -> None:
    (tmp_path / "calib/camera").mkdir(parents=True)
    for name in ("calib/camera/front.json", "calib/camera/rear.json", "intrinsics.yaml"):
        (tmp_path / name).write_text("{}")
    drive_in(tmp_path, {"top": "1.bin", "front": "1.png"})
    said = "front: calibration.yaml does not state K; intrinsics.yaml and 2 more are not read"
    assert said in drive_in.warnings  # type: ignore[attr-defined]


def test_a_pose_in_millimetres_is_told(tmp_path: Path) -> None:
    drive_in(tmp_path, {"top": "1.bin"}, "lidars: {top: {pose: [500, 0, 1900, 0, 0, 0, 1]}}")
    said = "calibration.yaml: top is 1,900 m from base_link: a pose is in metres"
    assert said in drive_in.warnings  # type: ignore[attr-defined]


def test_images_paired_by_order_get_the_times_of_the_clouds(tmp_path: Path) -> None:
    about = "lidars: {top: {rate: 5}}\ncameras: {front: {rate: 30}}"
    there = drive_in(tmp_path, {"top": "3.bin 4.bin", "front": "a.png b.png"}, about)
    assert there["front"] == there["top"] == [1.6, 1.8]
