"""Reader of the LiDAR calibration files that ``source.lidar_calibration`` names."""

from __future__ import annotations

from pathlib import Path

from bevviz.support.files import read_text


def read_calibration(path: Path) -> str:
    """Return the text of a file that ``source.lidar_calibration`` names.

    Raises:
        UserError: the file cannot be read.
    """
    return read_text(path, problem=f"source.lidar_calibration: {path}: cannot be read")
