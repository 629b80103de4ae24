"""Compressed chunks and files of bags: unpack them, after damage as far as they can be read."""

from __future__ import annotations

import re
import shutil
from binascii import crc32
from bz2 import BZ2Decompressor
from collections.abc import Callable
from pathlib import Path
from typing import Any

from backports import zstd
from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

from bevviz.bags.reader import FileBytes, megabytes
from bevviz.errors import UserError, first_line
from bevviz.support import progress
from bevviz.support.limits import FREE_DISK, MAX_CHUNK, MAX_RATIO, MIN_CHUNK, MIN_FILE

ZSTD = b"\x28\xb5\x2f\xfd"  # first bytes of a zstd file or message
ZSTD_FRAME = re.compile(re.escape(ZSTD))
PIECE = 1 << 12  # compressed bytes unpacked at once where the following bytes may be damaged


def unpack(
    compression: str, packed: bytes, size: int, crc: int = 0, *, cut: bool = False
) -> tuple[bytes, str]:
    """Unpack the content of a chunk. A damaged chunk gives the part before the damage.

    Args:
        compression: zstd, lz4, bz2, none or empty.
        packed: compressed bytes.
        size: unpacked size that the file states.
        crc: checksum of the content; 0: none.
        cut: the end of ``packed`` is missing, which alone is no damage.

    Returns:
        Content, and a description of its damage. The description is empty for a sound chunk.
    """
    limit, whole = min(max(size, MIN_CHUNK), MAX_CHUNK), True
    if compression in ("", "none"):
        data = packed
    elif compression not in _STREAMS:
        return b"", f"a chunk cannot be unpacked (compression '{compression}' is not known)"
    else:
        stream = _STREAMS[compression]()
        try:
            data = _decompress(stream, packed, limit, size)
            whole = stream.eof
        except _UNPACK_ERRORS as error:
            data = _before_damage(_STREAMS[compression], packed, limit)
            return data, f"a chunk cannot be unpacked ({first_line(error)})"
    if cut:
        return data, ""
    if not whole:
        return data, "a chunk ends early"
    if crc and crc32(data) != crc:
        return data, "the content of a chunk does not fit its checksum"
    return data, ""


_STREAMS: dict[str, Callable[[], Any]] = {
    "zstd": zstd.ZstdDecompressor,
    "lz4": LZ4FrameDecompressor,
    "bz2": BZ2Decompressor,
}
_UNPACK_ERRORS = (OSError, ValueError, RuntimeError, EOFError, zstd.ZstdError)  # exceptions on damage


def _decompress(stream: Any, packed: bytes, limit: int, expected: int = 0) -> bytes:
    """Decompress bytes into at most ``limit`` bytes. lz4 reserves memory for ``expected`` bytes at first."""
    parts = [stream.decompress(packed, min(expected, limit) or limit)]
    limit -= len(parts[0])
    while limit > 0 and not stream.eof and not stream.needs_input:
        parts.append(stream.decompress(b"", limit))
        limit -= len(parts[-1])
    return parts[0] if len(parts) == 1 else b"".join(parts)


def _before_damage(new_stream: Callable[[], Any], packed: bytes, limit: int) -> bytes:
    """Return the content of all compressed blocks before the damage.

    A decompressor that fails drops its output for the current piece. So the first pass finds this piece,
    and the second pass feeds it byte by byte.
    """
    data, sound = bytearray(), 0
    for step in (PIECE, 1):
        stream = new_stream()
        try:
            data = bytearray(_decompress(stream, packed[:sound], limit)) if sound else bytearray()
            while sound < len(packed) and len(data) < limit and not stream.eof:
                data += _decompress(stream, packed[sound : sound + step], limit - len(data))
                sound += step
        except _UNPACK_ERRORS:
            continue
        break
    return bytes(data)


def unpack_file(path: Path, target: Path) -> tuple[int, bool]:
    """Unpack a zstd file. After damage, go on at the next frame.

    Returns:
        Number of damaged places, and whether the last frame is complete.

    Raises:
        UserError: the content has more than ``MAX_RATIO`` times the file's bytes, or would fill the disk.
    """
    source, damaged, stream = FileBytes(path), 0, zstd.ZstdDecompressor()
    limit = max(MIN_FILE, MAX_RATIO * source.size)
    bar = progress.bar(total=source.size, unit="B", unit_scale=True, desc=f"unpack {path.name}", delay=1)
    try:
        with target.open("wb") as out, bar:
            offset = 0
            while offset < source.size:
                # The decompressor drops its output for the piece with the damage, so pieces are small.
                piece = source.read(offset, PIECE)
                try:
                    content = stream.decompress(piece)
                    _check_room(path, target, out.tell() + len(content), limit)
                    out.write(content)
                    offset += len(piece) - len(stream.unused_data)
                    next_frame = offset if stream.eof else None
                except zstd.ZstdError:
                    damaged += 1
                    next_frame = next(source.search(ZSTD_FRAME, offset + 1), source.size)
                bar.update(offset - bar.n)
                if next_frame is not None and next_frame < source.size:
                    offset, stream = next_frame, zstd.ZstdDecompressor()
                elif next_frame is not None:
                    break
    finally:
        source.close()
    return damaged, stream.eof


def _check_room(path: Path, target: Path, size: int, limit: int) -> None:
    """Check that ``size`` bytes of a compressed file may be written into ``target``.

    Raises:
        UserError: they are too many for the file, or for the disk.
    """
    if size > limit:
        raise UserError(
            f"{path}: it unpacks to more than {megabytes(limit)}, from {megabytes(path.stat().st_size)}: "
            "'zstd -d' unpacks it if you trust it"
        )
    if shutil.disk_usage(target.parent).free < FREE_DISK:
        raise UserError(
            f"{path}: unpacked, it would fill the disk of {target.parent.parent}: make room there, or name "
            "another folder for temporary files with TMPDIR"
        )
