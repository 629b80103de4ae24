"""The bag that ``bevviz live`` and ``bevviz report`` save next to a recording."""

from __future__ import annotations

from pathlib import Path

from bevviz.errors import UserError


def find_saved_bag(path: Path) -> Path:
    """Return the bag NAME.mcap next to a recording NAME.rrd. Return any other path unchanged.

    Raises:
        UserError: there is no such bag next to the recording.
    """
    if path.suffix != ".rrd" or not path.is_file():
        return path
    bag = path.with_suffix(".mcap")
    if not bag.is_file():
        raise UserError(
            f"{path}: a recording has no messages that could be run again, and {bag.name}, which "
            f"'bevviz live' saves with it, is not beside it: give the bag that it was made from"
        )
    return bag
