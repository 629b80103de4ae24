"""Objects from one process to another by a file: arrays lie in it as they are, read where they are used."""

from __future__ import annotations

import mmap
import pickle
from collections.abc import Iterator
from pathlib import Path
from struct import Struct
from typing import IO, Any

ALIGNED = 64  # bytes; what numba compiles for an array holds where it begins at a multiple of its items
_HEAD = Struct("<QQ")  # bytes of the pickle, buffers beside it
_SIZE = Struct("<Q")


def put(file: IO[bytes], value: object) -> None:
    """Append an object."""
    buffers: list[pickle.PickleBuffer] = []
    content = pickle.dumps(value, pickle.HIGHEST_PROTOCOL, buffer_callback=buffers.append)
    raw = [buffer.raw() for buffer in buffers]
    file.write(_HEAD.pack(len(content), len(raw)) + b"".join(_SIZE.pack(part.nbytes) for part in raw))
    file.write(content)
    for part in raw:
        file.write(bytes(-file.tell() % ALIGNED))
        file.write(part)


def take(path: Path) -> Iterator[Any]:
    """All of them. The file may be removed meanwhile."""
    with path.open("rb") as file:
        # Private: an array can be written to, as whoever takes it expects.
        content = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY))
    at = 0
    while at < len(content):
        size, count = _HEAD.unpack_from(content, at)
        at += _HEAD.size
        sizes = [_SIZE.unpack_from(content, at + k * _SIZE.size)[0] for k in range(count)]
        at += count * _SIZE.size
        start, at, buffers = at, at + size, []
        for part in sizes:
            at += -at % ALIGNED
            buffers.append(content[at : at + part])
            at += part
        yield pickle.loads(content[start : start + size], buffers=buffers)
