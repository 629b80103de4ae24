"""What a user states of a LiDAR whose packets are decoded here."""

from __future__ import annotations

from pathlib import Path

from bevviz.support.files import read_text


def read_calibration(path: Path) -> str:
    """The text of a file that ``source.lidar_calibration`` names.

    Raises:
        UserError: it cannot be read.
    """
    return read_text(path, problem=f"source.lidar_calibration: {path}: cannot be read")
