"""Entry points of the extra: readers that search the next sound record, row or page after damage.

An index that is sound is used. Otherwise the whole file is scanned for messages. The report of a reader
counts the messages read and lost.
"""

from __future__ import annotations

from pathlib import Path

from bevviz.bags import mcap, ros1
from bevviz.bags.damage import DamagedReader
from bevviz.extras.rescue.chunks import RescuedChunkReader
from bevviz.extras.rescue.mcap import McapWalker
from bevviz.extras.rescue.ros1 import Ros1Walker
from bevviz.extras.rescue.sqlite import RescuedSqliteReader


def rescue_mcap(path: Path) -> DamagedReader:
    """Open a damaged MCAP file, or a complete one without an index."""
    return RescuedChunkReader(path, mcap.FORM, McapWalker)


def rescue_ros1(path: Path) -> DamagedReader:
    """Open a damaged ROS 1 bag."""
    return RescuedChunkReader(path, ros1.FORM, Ros1Walker)


def rescue_sqlite(path: Path) -> DamagedReader:
    """Open a damaged sqlite3 bag, with the log beside it.

    Raises:
        UserError: the file has no readable row.
    """
    return RescuedSqliteReader(path)
