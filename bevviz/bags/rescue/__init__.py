"""Reading of damaged bags. ``rescue`` is the one way to it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from bevviz.bags.mcap import FORM as MCAP_FORM
from bevviz.bags.mcap import MAGIC as MCAP
from bevviz.bags.rescue.chunks import RescuedChunkReader
from bevviz.bags.rescue.mcap import McapWalker
from bevviz.bags.rescue.report import RescuedReader
from bevviz.bags.rescue.ros1 import Ros1Walker
from bevviz.bags.rescue.sqlite import RescuedSqliteReader
from bevviz.bags.ros1 import FORM as ROS1_FORM
from bevviz.bags.ros1 import MAGIC as ROS1
from bevviz.bags.sqlite import MAGIC as SQLITE

_READERS: Mapping[bytes, Callable[[Path], RescuedReader]] = {
    MCAP: partial(RescuedChunkReader, form=MCAP_FORM, walker=McapWalker),
    ROS1: partial(RescuedChunkReader, form=ROS1_FORM, walker=Ros1Walker),
    SQLITE: RescuedSqliteReader,
}


def rescue(path: Path, magic: bytes) -> RescuedReader:
    """Open a damaged file, or a complete one without an index.

    A valid index is used. Otherwise the whole file is scanned for messages. The report of the reader counts
    the messages read and lost.

    Args:
        path: file.
        magic: first bytes of a sound file of this format.

    Raises:
        UserError: nothing of the file is left.
    """
    return _READERS[magic](path)
