"""Files that somebody chose badly, or on purpose: one clear line, whatever is in them."""

from __future__ import annotations

import json
import os
import shutil
import threading
import tracemalloc
from contextlib import suppress
from pathlib import Path

import pytest

import bevviz
from bevviz import UserError
from bevviz.cli import main
from bevviz.datasets.cloud_files import read_cloud, read_points
from bevviz.datasets.dataset import read_table
from bevviz.support.files import drive_files
from bevviz.support.limits import CONFIG_LIMIT, SENSOR_LIMIT, TABLE_LIMIT
from tests.support import bags, datasets
from tests.support.commands import Capture, error_of

NESTED = "[" * 3000


@pytest.fixture(autouse=True)
def drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    return bags.write(Path("drive"), bags.small_items(scans=3))


@pytest.mark.long
@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"voxel: " + NESTED.encode(), "too deep"),
        (b"\n".join(b" " * i + b"a:" for i in range(1400)), "too deep"),
        (b"voxel:\n  size: \xff\xfe\n", "it is no UTF-8 text"),
        (b"voxel: {size: 2001-99-99}\n", "is not valid YAML: month"),
        (b"clustering: {min_points: .inf}\n", "clustering.min_points must be a finite number"),
        (b"voxel: {size: .nan}\n", "voxel.size must be"),
        (b"voxel: &a {size: *a}\n", "voxel.size must be"),
        (b"? {a: b}\n: c\n", "is not valid YAML"),
        (b"a: &a [x]\nb: [*a, *a]\n", "unknown key 'a'"),
    ],
)
def test_hostile_configurations_are_one_line(content: bytes, said: str, capsys: Capture) -> None:
    Path("my.yaml").write_bytes(content)
    assert said in error_of(capsys, "bag", "drive", "--config", "my.yaml", "--save", "out.rrd")
    assert not Path("out.rrd").exists()


@pytest.mark.long
def test_a_setting_that_is_nested_too_deep_is_one_line(capsys: Capture) -> None:
    assert "too deep" in error_of(capsys, "bag", "drive", "--set", f"voxel.size={NESTED}")


@pytest.mark.parametrize("name", ["pipe.mcap", "pipe.yaml"])
def test_a_pipe_is_not_waited_for(name: str, capsys: Capture) -> None:
    os.mkfifo(name)
    call = ["info", name] if name.endswith("mcap") else ["bag", "drive", "--config", name]
    assert "it is no file" in error_of(capsys, *call)


@pytest.mark.long
def test_file_names_that_are_no_text_are_shown(tmp_path: Path) -> None:
    (source,) = Path("drive").glob("*.mcap")
    odd = Path(os.fsdecode(b"\xff\xfe\x1b[2J.mcap"))
    shutil.copy(source, odd)
    assert main(["bag", str(odd), "--save", "out.rrd"]) == 0
    assert main(["info", str(odd)]) == 0
    assert main(["report", str(odd), "--at", "0", "-o", "bug.rrd"]) == 0
    assert main(["report", "--check", "bug.rrd"]) == 0
    assert main(["batch", str(odd), "-o", "runs", "--jobs", "1"]) == 0


def test_files_without_read_permission_are_one_line(capsys: Capture) -> None:
    if os.geteuid() == 0:
        pytest.skip("root may read everything")
    Path("drive").chmod(0)
    assert "permission denied" in error_of(capsys, "info", "drive")
    Path("drive").chmod(0o755)


# --- data set folders and project files --------------------------------------------------------


def plain_folder(calibration: str = "") -> Path:
    """Write a folder with one cloud, one image and a calibration."""
    folder = Path("set")
    folder.mkdir()
    datasets.scan(0).tofile(folder / "000000.bin")
    datasets.image(folder / "camera/000000.png", 9)
    if calibration:
        (folder / "calibration.yaml").write_text(calibration)
    return folder


@pytest.mark.parametrize("name", ["calib/000000.txt", "label_2/000000.txt"])
def test_a_pipe_in_a_data_set_is_not_waited_for(name: str) -> None:
    root = Path("set")
    root.mkdir()
    datasets.kitti_object(root)
    (root / name).unlink()
    os.mkfifo(root / name)
    assert main(["info", "set"]) == 0
    assert main(["bag", "set", "--save", "out.rrd"]) == 0


def test_a_table_that_is_a_pipe_is_refused(capsys: Capture) -> None:
    root = datasets.nuscenes(Path("set"))
    (root / "v1.0-mini/scene.json").unlink()
    os.mkfifo(root / "v1.0-mini/scene.json")
    assert "scene.json: cannot be read: it is no file" in error_of(capsys, "info", "set")


@pytest.mark.long
@pytest.mark.parametrize(
    ("calibration", "said"),
    [
        ("lidars: " + NESTED, "too deep"),
        ("cameras: {camera: {K: [72, 0, 61, 0, 72, 17, 0, 0, 1], size: [4294967296, 1]}}", "size the width"),
        ("rate: 1e-300", "not frames a second"),
        (datasets.LAUGHS + "rate: *a11", "its aliases stand for more than"),
    ],
)
def test_a_strange_calibration_is_one_line(calibration: str, said: str, capsys: Capture) -> None:
    plain_folder(calibration)
    assert said in error_of(capsys, "info", "set")


def test_links_to_nowhere_and_pipes_count_no_bytes() -> None:
    folder = plain_folder()
    (folder / "000001.bin").symlink_to("nowhere")
    os.mkfifo(folder / "000002.bin")
    size = (folder / "000000.bin").stat().st_size + (folder / "camera/000000.png").stat().st_size
    with bevviz.open(folder) as drive:
        assert len(drive) == 1
        assert any("a link to what is not there" in line for line in drive.warnings)
    assert sum(file.stat().st_size for file in drive_files(folder)) == size
    assert main(["info", "set"]) == 0
    assert main(["bag", "set", "--save", "out.rrd"]) == 0


@pytest.mark.parametrize("name", ["/etc/passwd", "../outside.bin", "samples/../../outside.bin"])
def test_nuscenes_names_no_file_outside(name: str, capsys: Capture) -> None:
    root = datasets.nuscenes(Path("set"))
    Path("outside.bin").write_bytes(b"0" * 400)
    table = root / "v1.0-mini/sample_data.json"
    rows = json.loads(table.read_text())
    rows[0]["filename"] = name
    table.write_text(json.dumps(rows))
    said = error_of(capsys, "info", "set", "--sequence", "scene-0061")
    assert f"names the file {name}, which is not in the data set" in said


def test_nuscenes_may_have_its_sweeps_on_another_disk(tmp_path: Path) -> None:
    root = datasets.nuscenes(Path("set"))
    (root / "sweeps").rename(tmp_path / "disk")
    (root / "sweeps").symlink_to(tmp_path / "disk")
    Path("link").symlink_to(root)
    with bevviz.open("link", set={"source.sequence": "scene-0061"}) as drive:
        assert len(drive) == 3


@pytest.mark.parametrize(
    ("name", "header"),
    [
        (
            "a.npy",
            b"\x93NUMPY\x01\0\x76\0{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000, 4)}",
        ),
        ("a.pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1000000000000\nHEIGHT 1\nDATA binary\n"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1000000000000\nproperty float x\nend_header\n"),
    ],
)
def test_a_cloud_that_claims_a_trillion_points(name: str, header: bytes) -> None:
    Path(name).write_bytes(header.ljust(128) + b"\n" + bytes(640))
    with pytest.raises(UserError, match="cannot be read as a cloud"):
        read_cloud(Path(name), ("x", "y", "z"))


def test_a_scan_beyond_the_limit_is_not_read() -> None:
    with Path("a.bin").open("wb") as file:
        file.truncate(SENSOR_LIMIT + 1)
    with pytest.raises(UserError, match="has more than 1,073,741,824 bytes"):
        read_points(Path("a.bin"), ("x", "y", "z"))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("x = " + NESTED, "too deep"),
        ("voxel_size = " + "9" * 5000, "bevviz.toml: is no TOML: Exceeds the limit"),
        ("preset = 0x" + "f" * 5000, "a number of thousands of digits"),
        ('config = "/dev/zero"', "/dev/zero: cannot read the configuration: it is no file"),
        ('config = "pipe"', "it is no file"),
        ("a." * 100_000 + "a = 1", "a line has more than 1000 dots"),
        ("#" * (CONFIG_LIMIT + 1), "has more than 1,048,576 bytes"),
        ("[voxel]\nsize = '" + "x" * 100_000 + "'", "voxel.size"),
    ],
)
def test_a_strange_project_file_is_one_line(content: str, said: str, capsys: Capture) -> None:
    os.mkfifo("pipe")
    Path("bevviz.toml").write_text(content)
    line = error_of(capsys, "info", "drive")
    assert said in line
    assert len(line) < 5000


def test_a_configuration_may_come_from_the_shell(capsys: Capture) -> None:
    for content, status in (("voxel: {size: 0.2}\n", 0), ("#" * (CONFIG_LIMIT + 2), 2)):
        read_end, write_end = os.pipe()
        writer = threading.Thread(target=write_and_close, args=(write_end, content.encode()))
        writer.start()
        assert main(["config", "--config", f"/dev/fd/{read_end}"]) == status
        os.close(read_end)
        writer.join()
    assert "size: 0.2" in capsys.readouterr().out


def write_and_close(handle: int, data: bytes) -> None:
    with suppress(BrokenPipeError), os.fdopen(handle, "wb") as file:
        file.write(data)


def test_a_line_without_end_is_not_read() -> None:
    with Path("times.txt").open("wb") as file:
        file.truncate(TABLE_LIMIT)
    tracemalloc.start()
    with pytest.raises(UserError, match="line 1 has more than 65,536 characters"):
        read_table(Path("times.txt"), 1)
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()


@pytest.mark.parametrize("name", ["pipe", "/dev/zero"])
def test_a_network_that_is_no_file_is_not_read(name: str, capsys: Capture) -> None:
    os.mkfifo("pipe")
    assert main(["info", "drive", "--model", name]) == 0
    assert "it is no file" in capsys.readouterr().out
    assert "no such file" in error_of(capsys, "bag", "drive", "--model", name, "--save", "out.rrd")


@pytest.mark.parametrize("last", ["-1", "nan"])
def test_times_that_do_not_grow_are_refused(last: str, capsys: Capture) -> None:
    sequence = datasets.kitti_odometry(Path("set"))
    (sequence / "times.txt").write_text(f"0.0\n0.1\n{last}\n")
    assert "times.txt: its times do not grow line by line" in error_of(capsys, "info", "set")
