"""Reading and damaging of the bags of ``bag_formats``."""

from __future__ import annotations

import struct
from collections import Counter
from pathlib import Path

from bevviz.bags import mcap
from bevviz.bags.bag import Recording
from tests.support.bag_formats import items

Found = list[tuple[str, int, bytes]]


def whole(name: str) -> Found:
    """Return the messages that were written."""
    return [(topic, time, data) for topic, _, time, data in items(name.startswith("ros1"))]


def read(path: Path) -> tuple[Found, list[str]]:
    """Return every message and the warnings. Counts and times must be those of the messages."""
    with Recording([path]) as recording:
        names = [topic.name for topic in recording.topics]
        found = [(m.topic, m.received, bytes(m.content())) for m in recording.messages(names)]
        times = [time for _, time, _ in found]
        assert times == sorted(times)
        assert recording.message_count == len(found)
        for name in names:
            assert recording.times(name).tolist() == [time for topic, time, _ in found if topic == name]
        return found, recording.warnings


def missing(found: Found, name: str) -> int:
    """Return how many messages are missing. There must be none that were not written."""
    assert not Counter(found) - Counter(whole(name))
    return len(whole(name)) - len(found)


def records(data: bytes, opcode: int) -> list[int]:
    """Return the offsets of the records of a kind in an MCAP file, those in uncompressed chunks, too."""
    found, at = [], 8
    while at + 9 < len(data):
        (size,) = struct.unpack_from("<Q", data, at + 1)
        inner = at + 9 + 40 if data[at] == mcap.CHUNK else at + 9 + size
        if data[at] == opcode:
            found.append(at)
        while inner < at + 9 + size and not data[at + 9 + 28]:
            if data[inner] == opcode:
                found.append(inner)
            inner += 9 + struct.unpack_from("<Q", data, inner + 1)[0]
        at += 9 + size
    return found


def change(path: Path, at: int, new: bytes) -> None:
    """Overwrite bytes of a file."""
    data = bytearray(path.read_bytes())
    data[at : at + len(new)] = new
    path.write_bytes(data)
