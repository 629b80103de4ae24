"""Everything but the synthetic drive runs where Open3D cannot be imported."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.kept_drives import BAG
from tests.support.waiting import PATIENCE

COMMAND = (
    sys.executable,
    "-c",
    "import sys; sys.modules['open3d'] = sys.modules['libusb_package'] = None; "
    "from bevviz.cli import main; sys.exit(main(sys.argv[1:]))",
)


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command without Open3D."""
    return subprocess.run(
        [*COMMAND, *arguments], cwd=folder, capture_output=True, text=True, timeout=PATIENCE, check=False
    )


@pytest.mark.parametrize("preset", ["default", pytest.param("reference", marks=pytest.mark.long)])
def test_a_bag_runs(tmp_path: Path, preset: str) -> None:
    command = ["bag", str(BAG), "--model", "demo", "--frames", ":2", "--preset", preset]
    done = run(tmp_path, *command, "--save", f"{preset}.rrd", "--quiet")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / f"{preset}.rrd").stat().st_size > 100_000


@pytest.mark.long
def test_a_bag_is_described_and_explained(tmp_path: Path) -> None:
    described = run(tmp_path, "info", str(BAG))
    assert described.returncode == 0 and "/rslidar_points: LiDAR" in " ".join(described.stdout.split())
    explained = run(tmp_path, "why", str(BAG), "--model", "demo", "--at-frame", "1", "--quiet")
    assert explained.returncode == 0 and "frame 1" in explained.stdout


@pytest.mark.long
def test_the_workbench_opens(tmp_path: Path) -> None:
    command = [*COMMAND, "open", str(BAG), "--model", "demo", "--no-browser"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=tmp_path) as server:
        assert server.stderr is not None
        lines = list[str]()
        try:
            for line in server.stderr:
                lines.append(line)
                if "workbench at http" in line:
                    break
        finally:
            server.send_signal(signal.SIGINT)
            server.communicate(timeout=PATIENCE)
    assert "workbench at http" in lines[-1], lines


@pytest.mark.long
def test_the_synthetic_drive_says_in_one_line_what_it_lacks(tmp_path: Path) -> None:
    done = run(tmp_path, "demo", "--frames", "1", "-o", "drive.mcap", "--quiet")
    assert done.returncode != 0
    assert done.stderr.startswith("bevviz: error: the synthetic drive needs Open3D, which cannot be imported")
    assert "pip install 'bevviz[demo]'" in done.stderr and done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())
