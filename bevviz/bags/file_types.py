"""File formats by their first bytes, and the readers of each format."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from backports import zstd

from bevviz.bags import mcap, ros1
from bevviz.bags.chunks import ChunkFormat, ChunkReader, rescue_chunks
from bevviz.bags.reader import PIECE, ZSTD, BagFile, FileBytes, Reader, SoundReader, megabytes
from bevviz.bags.rescue import mcap as mcap_rescue
from bevviz.bags.rescue import sqlite_pages
from bevviz.bags.rescue.sqlite import SqliteRescuer
from bevviz.bags.sqlite import SoundSqlite
from bevviz.datasets.cloud_files import CLOUDS
from bevviz.datasets.dataset import IMAGES, UNREAD
from bevviz.errors import UserError
from bevviz.support import progress
from bevviz.support.files import LFS_HINT, LFS_POINTER
from bevviz.support.scratch_folder import ScratchFolder

ZSTD_FRAME = re.compile(re.escape(ZSTD))


@dataclass(frozen=True, slots=True)
class FileFormat:
    """One file format and its readers.

    Attributes:
        name: name for messages to the user.
        magic: first bytes of a file.
        suffix: file suffix by which rosbags knows the format.
        sound: opens a sound file. Its second argument is the same file under a name with that suffix.
        rescue: opens a damaged file.
    """

    name: str
    magic: bytes
    suffix: str
    sound: Callable[[Path, Path], SoundReader]
    rescue: Callable[[Path], Reader]


def _chunked_format(name: str, magic: bytes, suffix: str, form: ChunkFormat) -> FileFormat:
    return FileFormat(
        name,
        magic,
        suffix,
        lambda path, public: ChunkReader(path, form, public),
        lambda path: rescue_chunks(path, form),
    )


SQLITE = FileFormat("sqlite3", sqlite_pages.MAGIC, ".db3", SoundSqlite, SqliteRescuer)
FORMATS = (
    _chunked_format("MCAP", mcap.MAGIC, ".mcap", mcap_rescue.FORM),
    _chunked_format("ROS 1 bag", ros1.MAGIC, ".bag", ros1.FORM),
    SQLITE,
)
HEAD_SIZE = 16  # bytes read to recognise a format
OTHER_FORMATS = {
    b"RRF": "a Rerun recording: open it with 'rerun'",
    b"PK\x03\x04": "a zip archive: unpack it first",
    b"\x1f\x8b": "a gzip archive: unpack it first",
    b"BZh": "a bzip2 archive: unpack it first",
    b"\xfd7zXZ": "an xz archive: unpack it first",
    b"\xd4\xc3\xb2\xa1": "a packet capture, not a bag: record the driver's topics instead",
    LFS_POINTER[:HEAD_SIZE]: LFS_HINT,
    b"#ROSBAG V1": "a bag of ROS before 1.2: 'rosbag fix' converts it",
}


def open_file(path: Path, scratch: ScratchFolder, warn: Callable[[str], object]) -> BagFile:
    """Open a file of a recording by its first bytes. A compressed file is unpacked.

    Args:
        path: file.
        scratch: temporary folders for unpacked files.
        warn: receives a warning if a file cannot be unpacked completely.

    Raises:
        OSError: the file does not exist or cannot be read.
        UserError: the file is no bag or is empty.
    """
    if path.exists() and not path.is_file():  # Reading a pipe would block.
        raise UserError(f"{path}: no bag: it is no file")
    with path.open("rb") as file:
        head = file.read(HEAD_SIZE)
    if head.startswith(ZSTD):
        path = _unpack(path, scratch, warn)
        with path.open("rb") as file:
            head = file.read(HEAD_SIZE)
    if kind := next((kind for kind in FORMATS if head.startswith(kind.magic)), None):
        return _open_as(kind, path, scratch)
    problem = next((text for magic, text in OTHER_FORMATS.items() if head.startswith(magic)), None)
    # The first bytes may be damaged. All messages of a database may still lie in its log.
    kind = next((kind for kind in FORMATS if path.suffix == kind.suffix), None)
    if not head and not (kind is SQLITE and sqlite_pages.log_path(path).exists()):
        raise UserError(f"{path}: the file is empty")
    if kind and not problem:
        opened = _open_as(kind, path, scratch)
        if any(c.msgcount for c in opened.connections):
            return opened
        opened.close()
    if not problem and path.suffix.lower() in (*CLOUDS, *IMAGES):
        problem = f"one cloud or image, no drive: give the folder that it is in ({path.parent})"
    if not problem and (hint := UNREAD.get(path.suffix.lower())):
        problem = f"{path.suffix.lower()} files are not read: {hint}"
    raise UserError(
        f"{path}: {problem or 'not a bag: neither MCAP, nor sqlite3, nor ROS 1 by its first bytes'}"
    )


def _open_as(kind: FileFormat, path: Path, scratch: ScratchFolder) -> BagFile:
    public = path
    if path.suffix != kind.suffix or set("?#%") & set(str(path)):  # These characters have a meaning in a URI.
        public = scratch.new() / f"bag{kind.suffix}"
        public.symlink_to(path.resolve())
    return BagFile(path, kind.name, lambda: kind.sound(path, public), lambda: kind.rescue(path))


def _unpack(path: Path, scratch: ScratchFolder, warn: Callable[[str], object]) -> Path:
    target = scratch.new() / path.stem
    damaged, whole = unpack_file(path, target)
    if damaged or not whole:
        damage = f"{damaged} damaged place(s) in it" if damaged else "its end is missing"
        warn(
            f"{path.name}: the compressed file is damaged ({damage}): "
            f"{megabytes(target.stat().st_size)} could be unpacked"
        )
    return target


def unpack_file(path: Path, target: Path) -> tuple[int, bool]:
    """Unpack a zstd file. After damage, go on at the next frame.

    Returns:
        Number of damaged places, and whether the last frame is complete.
    """
    source, damaged, stream = FileBytes(path), 0, zstd.ZstdDecompressor()
    bar = progress.bar(total=source.size, unit="B", unit_scale=True, desc=f"unpack {path.name}", delay=1)
    try:
        with target.open("wb") as out, bar:
            offset = 0
            while offset < source.size:
                # The decompressor drops its output for the piece with the damage, so pieces are small.
                piece = source.read(offset, PIECE)
                try:
                    out.write(stream.decompress(piece))
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
