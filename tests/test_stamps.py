"""What the names of a folder's files tell: whose they are, and when they were taken."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from bevviz import UserError
from bevviz.datasets.folder import Folder
from bevviz.datasets.stamps import sensors_of, told_by
from tests.test_folders import cloud

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
def test_stamps_as_programs_write_them(name: Callable[[int, int], str], off: int, precision: int) -> None:
    files = [Path(f"{name(i, stamp)}.pcd") for i, stamp in enumerate(STAMPS)]
    told = told_by(sorted(files))
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
def test_numbers_of_frames_wherever_they_are(name: str, count: int) -> None:
    files = [Path(name.format(i=i) + ".pcd") for i in range(count)]
    assert list(sensors_of(files)) == [""]
    told = told_by(files)
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
def test_cameras_in_one_folder(name: str) -> None:
    pairs = [(frame, camera) for frame in range(30) for camera in range(2)]
    names = [name.format(frame=f, camera=c, stamp=STAMPS[f] + 777 * c) for f, c in pairs]
    groups = sensors_of([Path(f"{name}.png") for name in names])
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
    assert sum("left out (stamps.csv can say it)" in line for line in told) == 2
    assert any(line.startswith("overview.png: the name does not tell") for line in told)


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
        (["250000000", "500000000", "750000000"], [0.25, 0.5, 0.75]),
    ],
)
def test_stamps_of_a_table(stamps: list[str], seconds: list[float], tmp_path: Path) -> None:
    rows = ["file,stamp", *(f"top/{name}.bin,{stamp}" for name, stamp in zip("abc", stamps, strict=False))]
    (tmp_path / "stamps.csv").write_text("\n".join(rows), encoding="utf-8-sig")
    names = " ".join(f"{name}.bin" for name in "abc"[: len(stamps)])
    assert drive_in(tmp_path, {"top": names})["top"] == pytest.approx(seconds, abs=1e-6)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("# stamp x y z qx qy qz qw\n1700000001.5 1 2 3 0 0 0 1\n", 1700000001.5),
        ("1700000001500000000 1 2 3 0 0 0 1\n", 1700000001.5),
        ("1 0 0 4 0 1 0 5 0 0 1 6\n", "line 1 has 12 numbers, not 8 (stamp x y z qx qy qz qw)"),
    ],
)
def test_poses_of_other_programs(line: str, expected: float | str, tmp_path: Path) -> None:
    """KITTI's twelve numbers were read as a stamp and a quaternion."""
    (tmp_path / "poses.txt").write_text(line)
    if isinstance(expected, str):
        with pytest.raises(UserError) as error:
            drive_in(tmp_path, {"top": "1700000001.5.bin"})
        assert expected in str(error.value)
    else:
        assert drive_in(tmp_path, {"top": "1700000001.5.bin"})["tf"] == [expected]


def test_lidars_with_other_columns(tmp_path: Path) -> None:
    """The columns of the largest file were taken for all of them."""
    for name, columns in (("top", 5), ("livox", 4)):
        (tmp_path / name).mkdir()
        cloud(columns, 3000).tofile(tmp_path / name / "000000.BIN")
    drive = Folder(tmp_path, "")
    for name, columns in (("top", 5), ("livox", 4)):
        (stream,) = [stream for stream in drive.streams if stream.topic == f"/{name}/points"]
        message = stream.make(0)
        assert len(message.fields) == columns and message.width == 3000
        xyz = np.frombuffer(bytes(message.data), "<f4").reshape(-1, columns)[:, :3]
        np.testing.assert_array_equal(xyz, cloud(columns, 3000)[:, :3])
    assert any(line.startswith("nothing says how livox, top are mounted") for line in drive.warnings)
