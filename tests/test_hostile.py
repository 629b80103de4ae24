"""Files that somebody chose badly, or on purpose: one clear line, whatever is in them."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from bevviz.cli import main
from tests import bags
from tests.test_cli import Capture, error_of

NESTED = "[" * 3000


@pytest.fixture(autouse=True)
def drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    return bags.write(Path("drive"), bags.small_items(scans=3))


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
def test_configurations(content: bytes, said: str, capsys: Capture) -> None:
    Path("my.yaml").write_bytes(content)
    assert said in error_of(capsys, "bag", "drive", "--config", "my.yaml", "--save", "out.rrd")
    assert not Path("out.rrd").exists()


def test_a_setting_that_is_too_deep(capsys: Capture) -> None:
    assert "too deep" in error_of(capsys, "bag", "drive", "--set", f"voxel.size={NESTED}")


@pytest.mark.parametrize("name", ["pipe.mcap", "pipe.yaml"])
def test_a_pipe_is_not_waited_for(name: str, capsys: Capture) -> None:
    os.mkfifo(name)
    call = ["info", name] if name.endswith("mcap") else ["bag", "drive", "--config", name]
    assert "it is no file" in error_of(capsys, *call)


def test_a_name_that_is_no_text(tmp_path: Path) -> None:
    (source,) = Path("drive").glob("*.mcap")
    odd = Path(os.fsdecode(b"\xff\xfe\x1b[2J.mcap"))
    shutil.copy(source, odd)
    assert main(["bag", str(odd), "--save", "out.rrd"]) == 0
    assert main(["info", str(odd)]) == 0
    assert main(["report", str(odd), "--at", "0", "-o", "bug.rrd"]) == 0
    assert main(["report", "--check", "bug.rrd"]) == 0
    assert main(["batch", str(odd), "-o", "runs", "--jobs", "1"]) == 0


def test_what_may_not_be_read(capsys: Capture) -> None:
    if os.geteuid() == 0:
        pytest.skip("root may read everything")
    Path("drive").chmod(0)
    assert "permission denied" in error_of(capsys, "info", "drive")
    Path("drive").chmod(0o755)
