"""What a user states of a LiDAR whose packets are decoded here."""

from __future__ import annotations

from pathlib import Path

from bevviz.errors import UserError


def read_calibration(path: Path) -> str:
    """The text of a file that ``source.lidar_calibration`` names.

    Raises:
        UserError: it cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "it is no text"
        raise UserError(f"source.lidar_calibration: {path}: cannot be read: {why}") from None
