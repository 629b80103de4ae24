"""What a loader of a data set is: the topics of one drive as in a bag, made when they are read."""

from __future__ import annotations

import os
import re
import struct
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bevviz.datasets.columns import are_doubles, are_whole, count_columns
from bevviz.errors import UserError, first_line
from bevviz.messages.encode import encode_compressed_image
from bevviz.model.frame import F32, I64
from bevviz.support.files import (
    LFS_HINT,
    LFS_POINTER,
    SENSOR_LIMIT,
    TABLE_LIMIT,
    read_head,
    read_lines,
)
from bevviz.support.files import read_bytes as read_limited

SECOND = 1_000_000_000
LOOKED_AT = 500_000  # bytes of a BIN file, for the number of its columns
MOST_OF_POINTER = 1024  # bytes, by Git LFS's specification
FIELDS = ("x", "y", "z", "intensity")
BOXES = "bevviz_msgs/msg/Detection3DArray"
HIDDEN = re.compile(r"\.|__MACOSX$")
CLOUDS = (".pcd", ".ply", ".bin", ".npy")
IMAGES = (".png", ".jpg", ".jpeg", ".webp")


# What a loader raises where a file holds something else than its data set documents.
NOT_AS_DOCUMENTED = (
    *(KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError),
    *(struct.error, RecursionError, MemoryError),  # a number, a depth or a size beyond all measure
)


def describe(error: Exception) -> str:
    """In a few words."""
    return f"{type(error).__name__}: {first_line(error)}"


@dataclass(frozen=True, slots=True)
class Stream:
    """One topic.

    Attributes:
        topic: as a driver would call it, so that roles are found as in a bag.
        type: ROS 2 type of its messages.
        times: (N,) stamps in nanoseconds, sorted; what is made has them in its header.
        make: the message of a row of ``times``, from ``bevviz.messages.encode``; may raise UserError.
        aside: why the topic plays no role unless it is asked for; "": it plays.
        files: of clouds that may be cut, each that of a message.
    """

    topic: str
    type: str
    times: I64
    make: Callable[[int], Any]
    aside: str = ""
    files: Sequence[Path] = ()


class Dataset:
    """One drive of a data set. A subclass in a file of this package is a loader: it is found by itself.

    Attributes:
        name: as ``--dataset`` takes it.
        about: what it is called in sentences.
        single_frames: nothing in one frame is in the next; the stamps are made up.
        any_folder: it takes what no other loader knows.
        streams: of messages with the same stamp those of the earlier stream come first.
        warnings: what is missing or damaged, as far as it was met, one sentence each.

    Args:
        path: the folder.
        sequence: which of several drives in it; "": not said.

    Raises:
        UserError: something is missing or wrong; the sentence names the file and what to do.
    """

    name: ClassVar[str]
    about: ClassVar[str]
    expects: ClassVar[str]  # what a folder of it looks like, for the end of a sentence
    single_frames: ClassVar[bool] = False
    any_folder: ClassVar[bool] = False

    def __init__(self, path: Path, sequence: str) -> None:
        self.path, self.sequence = path, sequence
        self.streams: Sequence[Stream] = ()
        self.warnings: list[str] = []

    @classmethod
    def fits(cls, path: Path) -> bool:
        """Whether a folder looks like one of it; quick, and at most one small file is opened."""
        raise NotImplementedError

    @classmethod
    def drives(cls, path: Path) -> list[Path]:
        """The folders that are one drive each, as far as drives have folders."""
        return [path]

    def warn(self, text: str) -> None:
        """Once."""
        if text not in self.warnings:
            self.warnings.append(text)

    def columns_in(self, files: Sequence[Path], names: Sequence[str] = FIELDS, hint: str = "") -> list[str]:
        """Names of the columns of BIN files of float32, of as many as the values of the largest tell.

        Args:
            files: of any kind.
            names: of the columns that the data set has, taken where the values do not tell.
            hint: how the columns can be stated.

        Raises:
            UserError: it holds float64, or Git LFS has not fetched it.
        """
        raw = [file for file in files if file.suffix.lower() == ".bin"]
        if not raw:
            return [*names]
        largest = max(raw, key=lambda file: file.stat().st_size)
        data = read_bytes(largest, LOOKED_AT)
        if are_doubles(data):
            raise UserError(f"{largest}: its numbers are float64; save them as float32, or as NPY")
        if are_whole(data):
            raise UserError(f"{largest}: its numbers are whole ones; save points as float32, or as NPY")
        count = count_columns(np.frombuffer(data[: len(data) // 4 * 4], "<f4")) or len(names)
        fields = [*names, *(f"field_{column}" for column in range(len(names), count))][:count]
        if count != len(names):
            self.warn(
                f"BIN files are taken for {count} columns of float32, as their values tell: "
                f"{', '.join(fields)}{hint}"
            )
        return fields

    def check_sizes(self, files: Sequence[Path], step: int) -> None:
        """Tell of scans that are no whole number of points, as cut ones are not."""
        sizes = {file: file.stat().st_size for file in files}
        away = sorted(file for file in files if sizes[file] < MOST_OF_POINTER and is_pointer(file))
        if away:
            self.warn(f"{self._first(away)}: {LFS_HINT}")
        for file in away:
            del sizes[file]
        if cut := [file for file, size in sizes.items() if size % step]:
            self.warn(
                f"{self._first(cut)}: {sizes[cut[0]]} bytes are no whole number "
                f"of points of {step} bytes: cut; the whole points in it are read"
            )
        if empty := [file for file, size in sizes.items() if size < step]:
            self.warn(f"{self._first(empty)}: no point in it")

    def _first(self, files: Sequence[Path]) -> str:
        """The first one, and how many more there are."""
        more = f" and {len(files) - 1} more" if len(files) > 1 else ""
        return f"{files[0].relative_to(self.path)}{more}"

    def one_of(self, sequences: Sequence[str], others: str = "") -> str:
        """The drive that was asked for; ``others``: what is said of those that are not among these.

        Raises:
            UserError: none of that name, or several to choose from.
        """
        there = f"there are {', '.join(sequences[:8])}{' ...' if len(sequences) > 8 else ''}{others}"
        if not sequences:
            raise UserError(f"{self.path}: no drive in it; {self.about} has {self.expects}")
        if self.sequence:
            if self.sequence not in sequences:
                raise UserError(f"{self.path}: there is no --sequence {self.sequence}; {there}")
            return self.sequence
        if len(sequences) > 1:
            raise UserError(f"{self.path}: {len(sequences)} drives; choose with --sequence NAME; {there}")
        return sequences[0]


def read_points(path: Path, fields: Sequence[str]) -> NDArray[np.void]:
    """(N,) the whole points of a BIN file with these columns of float32.

    Raises:
        UserError: it cannot be read, or Git LFS has not fetched it.
    """
    data = read_bytes(path)
    whole = np.frombuffer(data, "<f4", len(data) // (4 * len(fields)) * len(fields))
    return columns_of(whole.reshape(-1, len(fields)), fields)


def pictures(
    camera: str, times: I64, files: Sequence[Path], *, rectified: bool = True, aside: str = ""
) -> Stream:
    """Images of a camera, as their files have them."""

    def make(row: int) -> Any:
        kind = files[row].suffix.lower().lstrip(".").replace("jpg", "jpeg")
        return encode_compressed_image(int(times[row]), camera, read_bytes(files[row]), kind)

    topic = f"/{camera}/{'image_rect' if rectified else 'image_raw'}/compressed"
    return Stream(topic, "sensor_msgs/msg/CompressedImage", times, make, aside)


def files_in(
    folder: Path, suffixes: Sequence[str], chosen: Callable[[os.DirEntry[str]], bool] = os.DirEntry.is_file
) -> list[Path]:
    """Files with these suffixes, in lower or upper case, by name; none where there is no such folder.

    What systems hide there is left out. Of many thousands none is looked at by itself.
    """
    if not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        names = [e.name for e in entries if e.name.lower().endswith((*suffixes,)) and chosen(e)]
    return [folder / name for name in sorted(names) if not HIDDEN.match(name)]


def read_bytes(path: Path, first: int = 0) -> bytes:
    """Read a scan, an image or labels.

    Args:
        path: of the file.
        first: how many bytes from its beginning on; 0: all of it.

    Raises:
        UserError: it cannot be read, is larger than ``SENSOR_LIMIT``, or Git LFS has not fetched it.
    """
    try:
        data = read_head(path, first) if first else read_limited(path, SENSOR_LIMIT)
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None
    if data.startswith(LFS_POINTER):
        raise UserError(f"{path}: {LFS_HINT}")
    return data


def is_pointer(path: Path) -> bool:
    """Whether Git LFS has yet to fetch a file. Raises OSError: it cannot be read."""
    return read_head(path, len(LFS_POINTER)) == LFS_POINTER


def read_table(path: Path, columns: int, names: str = "") -> NDArray[np.float64]:
    """(N, columns) numbers, a row a line, of which further ones are left out; comments begin with #.

    Args:
        path: the file.
        columns: how many numbers are taken of each line.
        names: what they are, where a line may have no others.

    Raises:
        UserError: it cannot be read, or a line has something else.
    """
    numbers = array("d")  # a list of lists would take ten times the memory
    for number, line in enumerate(read_lines(path, TABLE_LIMIT), 1):
        values = line.split()
        if not values or values[0].startswith("#"):
            continue
        if len(values) < columns or (names and len(values) > columns):
            expected = f" ({names})" if names else ""
            raise UserError(f"{path}: line {number} has {len(values)} numbers, not {columns}{expected}")
        try:
            numbers.extend([float(value) for value in values[:columns]])
        except ValueError:
            raise UserError(f"{path}: line {number} has something that is no number") from None
    return np.array(numbers, np.float64).reshape(-1, columns)


def frames_at(rate: float, numbers: Sequence[int]) -> I64:
    """(N,) stamps of frames by their number, at so many a second, from one second on."""
    return SECOND + np.round(np.asarray(numbers, np.float64) * (SECOND / rate)).astype(np.int64)


def joined_columns(points: NDArray[np.void], more: dict[str, NDArray[Any]]) -> NDArray[np.void]:
    """The points with further fields."""
    layout = np.dtype(
        [*((n, points.dtype[n]) for n in points.dtype.names or ()), *((n, v.dtype) for n, v in more.items())]
    )
    wider = np.empty(len(points), layout)
    for name in points.dtype.names or ():
        wider[name] = points[name]
    for name, values in more.items():
        wider[name] = values
    return wider


def columns_of(values: F32, names: Sequence[str]) -> NDArray[np.void]:
    """(N, C) float32 as (N,) points with those fields, without a copy."""
    layout = np.dtype([(name, "<f4") for name in names])
    return np.ascontiguousarray(values, "<f4").view(layout).reshape(-1)
