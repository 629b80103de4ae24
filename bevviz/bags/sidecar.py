"""The bag that belongs to a recording by its name, as ``bevviz live`` and ``bevviz report`` save them."""

from __future__ import annotations

from pathlib import Path

from bevviz.errors import UserError


def bag_beside(path: Path) -> Path:
    """What to read where a bag is wanted: NAME.mcap for a NAME.rrd, anything else itself.

    Raises:
        UserError: there is none beside the recording.
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
