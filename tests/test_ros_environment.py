"""What a user reads where no working rclpy is found."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from bevviz.errors import UserError
from bevviz.ros.environment import load_rclpy


def test_no_rclpy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    with pytest.raises(UserError, match=r"not installed; pip install 'bevviz\[ros\]'"):
        load_rclpy()


def test_numpy_of_a_sourced_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy")
    monkeypatch.setattr(np, "__version__", "1.26.4")
    with pytest.raises(UserError, match=r"numpy 1\.26\.4 of the sourced ROS in /opt/ros/jazzy is too old"):
        load_rclpy()


@pytest.mark.parametrize(
    "failure",
    [
        "raise ImportError('numpy.core.multiarray failed to import')",
        "raise AttributeError('_ARRAY_API not found')",
        "import rclpy._of_another_python",
    ],
)
def test_rclpy_of_a_sourced_ros_for_another_python(
    failure: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "rclpy").mkdir()
    (tmp_path / "rclpy" / "__init__.py").write_text(failure)
    for name in [name for name in sys.modules if name.partition(".")[0] == "rclpy"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy:/elsewhere")
    with pytest.raises(UserError, match=r"sourced ROS in /opt/ros/jazzy .* without `source"):
        load_rclpy()
