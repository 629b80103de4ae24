"""What a user reads where no working rclpy is found."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from bevviz.errors import UserError
from bevviz.live.node import load_rclpy, middlewares


def _install(folder: Path, code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install an rclpy that is found first and fails."""
    (folder / "rclpy").mkdir()
    (folder / "rclpy" / "__init__.py").write_text(code)
    for name in [name for name in sys.modules if name.partition(".")[0] == "rclpy"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)


def test_a_missing_rclpy_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    with pytest.raises(UserError, match=r"not installed; pip install 'bevviz\[ros\]'"):
        load_rclpy()


def test_numpy_of_a_sourced_ros_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy")
    monkeypatch.setattr(np, "__version__", "1.26.4")
    with pytest.raises(UserError, match=r"numpy 1\.26\.4 of the sourced ROS in /opt/ros/jazzy is too old"):
        load_rclpy()


def test_wheels_of_another_environment_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _install(tmp_path, "raise ImportError('librcl.so: cannot open shared object file')", monkeypatch)
    monkeypatch.setenv("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "1")
    with pytest.raises(UserError, match="start bevviz in a new shell"):
        load_rclpy()


@pytest.mark.parametrize(
    "failure",
    [
        "raise ImportError('numpy.core.multiarray failed to import')",
        "raise AttributeError('_ARRAY_API not found')",
        "import rclpy._of_another_python",
    ],
)
def test_rclpy_for_another_python_is_named(
    failure: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _install(tmp_path, failure, monkeypatch)
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy:/elsewhere")
    with pytest.raises(UserError, match=r"sourced ROS in /opt/ros/jazzy .* without `source"):
        load_rclpy()


def test_middlewares_are_told_from_their_libraries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "lib").mkdir()
    for name in (
        "rmw_zenoh_cpp",
        "rmw_dds_common__rosidl_typesupport_fastrtps_cpp",
        "rmw_fastrtps_shared_cpp",
    ):
        (tmp_path / f"lib/lib{name}.so").touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    there = middlewares()
    assert "rmw_zenoh_cpp" in there and not any("__" in name or "shared" in name for name in there)
