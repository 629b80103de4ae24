"""Base class of data set loaders, and their reader. One drive becomes topics with messages made on demand."""

from __future__ import annotations

import os
import re
import struct
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat

from bevviz.datasets.cloud_files import (
    SAMPLE_BYTES,
    are_doubles,
    are_whole,
    count_columns,
    is_pointer,
    read_bytes,
)
from bevviz.errors import UserError, first_line
from bevviz.messages.definitions import typestore
from bevviz.messages.encode import encode_compressed_image, encode_intrinsics, encode_transforms
from bevviz.model.frame import F64, I64, Intrinsics
from bevviz.support.files import LFS_HINT, TABLE_LIMIT, read_lines

SECOND = 1_000_000_000
MAP, BASE = "map", "base_link"  # frames of the world and of the vehicle
MAX_POINTER_BYTES = 1024  # bytes of a pointer file, by the specification of Git LFS
FIELDS = ("x", "y", "z", "intensity")
BOXES = "bevviz_msgs/msg/Detection3DArray"
HIDDEN = re.compile(r"\.|__MACOSX$")
IMAGES = (".png", ".jpg", ".jpeg", ".webp")

AS_CLOUDS = "save them as PCD, PLY, BIN or NPY"
AS_IMAGES = "save them as PNG or JPEG"
UNREAD = {
    **dict.fromkeys(
        (".las", ".laz", ".e57", ".xyz", ".pts", ".npz", ".vtk", ".feather", ".pkl", ".h5", ".hdf5"),
        AS_CLOUDS,
    ),
    **dict.fromkeys((".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".exr", ".raw"), AS_IMAGES),
    **dict.fromkeys((".mp4", ".avi", ".mkv", ".mov"), "save their images as PNG or JPEG"),
    **dict.fromkeys((".gz", ".zip", ".zst"), "unpack them"),
    ".pcap": "give the file itself",
    ".tfrecord": "convert them, for instance to KITTI's layout",
}
MAX_LISTED_FILES = 10_000  # files examined in each folder
# Exceptions of a loader for files that do not follow the documentation of the data set.
NOT_AS_DOCUMENTED = (
    *(KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError),
    *(struct.error, RecursionError, MemoryError),  # numbers, depths or sizes out of range
)


def describe_error(error: Exception) -> str:
    """Format an exception as its type and first line."""
    return f"{type(error).__name__}: {first_line(error)}"


@dataclass(frozen=True, slots=True)
class Stream:
    """One topic of a drive.

    Attributes:
        topic: name that a driver would give it. So roles are found as in a bag.
        type: ROS 2 type of the messages.
        times: (N,) sorted stamps in nanoseconds. The header of a message has the same stamp.
        make: makes the message of a row of ``times`` with ``bevviz.messages.encode``. May raise UserError.
        aside: reason why the topic gets no role by default; empty: it gets one.
        files: cloud file of each message, for clouds that may be cut.
    """

    topic: str
    type: str
    times: I64
    make: Callable[[int], Any]
    aside: str = ""
    files: Sequence[Path] = ()


class Dataset:
    """One drive of a data set. A subclass is a loader; the entry points ``bevviz.datasets`` register it.

    Attributes:
        name: name for ``--dataset``.
        about: name in messages to the user.
        single_frames: the frames are unrelated, and their stamps are made up.
        any_folder: the loader takes folders that no other loader recognises.
        streams: topics. Of messages with the same stamp, those of the earlier stream come first.
        warnings: missing or damaged data met so far, one sentence each.
        sample_stamps: stamp of each sample by the token that the data set gives it.

    Args:
        path: folder.
        sequence: name of one of several drives; empty: not stated.

    Raises:
        UserError: data is missing or wrong. The message names the file and the remedy.
    """

    name: ClassVar[str]
    about: ClassVar[str]
    expects: ClassVar[str]  # layout of a folder, for the end of a sentence
    single_frames: ClassVar[bool] = False
    any_folder: ClassVar[bool] = False

    def __init__(self, path: Path, sequence: str) -> None:
        self.path, self.sequence = path, sequence
        self.streams: Sequence[Stream] = ()
        self.warnings: list[str] = []
        self.sample_stamps: dict[str, int] = {}

    @classmethod
    def fits(cls, path: Path) -> bool:
        """Tell whether a folder looks like this data set. The check opens at most one small file."""
        raise NotImplementedError

    @classmethod
    def states(cls, path: Path) -> bool:
        """Tell whether a file says that a folder is this data set, so that drives below it do not matter."""
        return False

    @classmethod
    def drives(cls, path: Path) -> list[Path]:
        """Return the folders of the drives if each drive has its own."""
        return [path]

    def warn(self, text: str) -> None:
        """Add a warning unless it is there already."""
        if text not in self.warnings:
            self.warnings.append(text)

    def column_names(self, files: Sequence[Path], names: Sequence[str] = FIELDS, hint: str = "") -> list[str]:
        """Return the column names of BIN files of float32. The values of the largest file give their number.

        Args:
            files: files of any kind.
            names: documented columns, used if the values give no number.
            hint: advice on how to state the columns.

        Raises:
            UserError: the file holds float64 or integers, or it is a Git LFS pointer.
        """
        raw = [file for file in files if file.suffix.lower() == ".bin"]
        if not raw:
            return [*names]
        largest = max(raw, key=lambda file: file.stat().st_size)
        data = read_bytes(largest, SAMPLE_BYTES)
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
        """Warn about scans that are cut, empty, or pointers of Git LFS.

        Args:
            files: BIN files.
            step: bytes of a point.
        """
        sizes = {file: file.stat().st_size for file in files}
        pointers = sorted(file for file in files if sizes[file] < MAX_POINTER_BYTES and is_pointer(file))
        if pointers:
            self.warn(f"{self._name_files(pointers)}: {LFS_HINT}")
        for file in pointers:
            del sizes[file]
        if cut := [file for file, size in sizes.items() if size % step]:
            self.warn(
                f"{self._name_files(cut)}: {sizes[cut[0]]} bytes are no whole number "
                f"of points of {step} bytes: cut; the whole points in it are read"
            )
        if empty := [file for file, size in sizes.items() if size < step]:
            self.warn(f"{self._name_files(empty)}: no point in it")

    def _name_files(self, files: Sequence[Path]) -> str:
        """Name the first file and count the others."""
        more = f" and {len(files) - 1} more" if len(files) > 1 else ""
        return f"{files[0].relative_to(self.path)}{more}"

    def choose_folder(self) -> Path:
        """Return the folder of the drive that the user chose.

        Raises:
            UserError: there is no drive with this name, or several drives and no choice.
        """
        drives = {folder.name: folder for folder in self.drives(self.path)}
        if list(drives.values()) == [self.path]:
            if self.sequence not in ("", self.path.name):
                raise UserError(f"{self.path}: is one drive; leave --sequence {self.sequence} out")
            return self.path
        return drives[self.choose_drive(list(drives))]

    def choose_drive(self, sequences: Sequence[str], others: str = "") -> str:
        """Return the drive that the user chose.

        Args:
            sequences: names of the drives.
            others: clause about drives that are not among these, for the error message.

        Raises:
            UserError: there is no drive with this name, or several drives and no choice.
        """
        choices = f"there are {', '.join(sequences[:8])}{' ...' if len(sequences) > 8 else ''}{others}"
        if not sequences:
            raise UserError(f"{self.path}: no drive in it; {self.about} has {self.expects}")
        if self.sequence:
            if self.sequence not in sequences:
                raise UserError(f"{self.path}: there is no --sequence {self.sequence}; {choices}")
            return self.sequence
        if len(sequences) > 1:
            raise UserError(f"{self.path}: {len(sequences)} drives; choose with --sequence NAME; {choices}")
        return sequences[0]


def image_stream(
    camera: str, times: I64, files: Sequence[Path], *, rectified: bool = True, aside: str = ""
) -> Stream:
    """Return the stream of a camera's image files. The images stay compressed."""

    def make(row: int) -> Any:
        kind = files[row].suffix.lower().lstrip(".").replace("jpg", "jpeg")
        return encode_compressed_image(int(times[row]), camera, read_bytes(files[row]), kind)

    topic = f"/{camera}/{'image_rect' if rectified else 'image_raw'}/compressed"
    return Stream(topic, "sensor_msgs/msg/CompressedImage", times, make, aside)


def intrinsics_stream(camera: str, times: I64, intrinsics: Callable[[int], Intrinsics]) -> Stream:
    """Return the stream of a camera's calibrations."""

    def make(row: int) -> Any:
        return encode_intrinsics(int(times[row]), camera, intrinsics(row))

    return Stream(f"/{camera}/camera_info", "sensor_msgs/msg/CameraInfo", times, make)


def mounting_stream(start: int, edges: Sequence[tuple[str, str, F64]]) -> list[Stream]:
    """Return the stream of static transforms (parent, child, parent_from_child); none without transforms."""
    times = np.array([start], np.int64)
    stream = Stream("/tf_static", "tf2_msgs/msg/TFMessage", times, lambda _: encode_transforms(start, edges))
    return [stream] if edges else []


def pose_stream(times: I64, frame: str, pose: Callable[[int], F64]) -> Stream:
    """Return the stream of the (4, 4) poses of a frame in ``MAP``."""

    def make(row: int) -> Any:
        return encode_transforms(int(times[row]), [(MAP, frame, pose(row))])

    return Stream("/tf", "tf2_msgs/msg/TFMessage", times, make)


def files_in(
    folder: Path, suffixes: Sequence[str], chosen: Callable[[os.DirEntry[str]], bool] = os.DirEntry.is_file
) -> list[Path]:
    """Return the files with these suffixes in lower or upper case by name; none if the folder does not exist.

    Hidden system files are left out. The files are not opened, which matters for many thousands.
    """
    if not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        names = [e.name for e in entries if e.name.lower().endswith((*suffixes,)) and chosen(e)]
    return [folder / name for name in sorted(names) if not HIDDEN.match(name)]


def subfolders(path: Path) -> list[Path]:
    """Return the folders in a folder by name, without hidden ones and those that may not be read."""
    folders = sorted(child for child in path.iterdir() if child.is_dir() and not HIDDEN.match(child.name))
    return [folder for folder in folders if os.access(folder, os.R_OK | os.X_OK)]


def read_table(path: Path, columns: int, names: str = "") -> F64:
    """Read a (N, columns) table of numbers from a text file with one row per line. A comment begins with #.

    Args:
        path: file.
        columns: number of values taken from each line.
        names: names of the columns. If given, a line must not have more values.

    Raises:
        UserError: the file cannot be read, or a line has other content.
    """
    numbers = array("d")  # A list of lists would take ten times the memory.
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


def frame_stamps(rate: float, numbers: Sequence[int]) -> I64:
    """Return (N,) stamps of frame numbers at a rate in Hz. Frame 0 is at one second."""
    return SECOND + np.round(np.asarray(numbers, np.float64) * (SECOND / rate)).astype(np.int64)


def describe_unread(folder: Path) -> str:
    """Return a clause about the most frequent unread type in a folder and its subfolders; empty: none."""
    folders = [folder, *(d for d in sorted(folder.iterdir()) if d.is_dir())]
    files = [f for place in folders for f, _ in zip(place.iterdir(), range(MAX_LISTED_FILES), strict=False)]
    counts = Counter(kind for file in files if (kind := file.suffix.lower()) in UNREAD)
    if not counts:
        return ""
    kind, count = counts.most_common(1)[0]
    return f"{count} {kind} file{'s are' if count > 1 else ' is'} not read: {UNREAD[kind]}"


LAST_TIME = 2**63 - 1  # nanoseconds


class DatasetReader:
    """Messages of one drive in order of stamp. The stamp is also the log time."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._streams = [stream for stream in dataset.streams if len(stream.times)]
        self.connections = tuple(
            make_connection(number, stream.topic, stream.type, len(stream.times))
            for number, stream in enumerate(self._streams)
        )
        self.compression = ""
        # By stream: reason for each row without a message, and for each row with a part of its points.
        self._lost, self._cut = defaultdict[int, dict[int, str]](dict), defaultdict[int, dict[int, str]](dict)

    @property
    def span(self) -> tuple[int, int]:
        """Log time of the first message, and log time of the last message plus one nanosecond."""
        if not self._streams:
            return 0, 0
        return (
            min(int(stream.times[0]) for stream in self._streams),
            max(int(stream.times[-1]) for stream in self._streams) + 1,
        )

    @property
    def warnings(self) -> list[str]:
        """Warnings of the data set, unreadable files and cut files."""
        sentences = [*self._dataset.warnings]
        for reasons, description in ((self._lost, "cannot be read"), (self._cut, "are cut")):
            for number, rows in reasons.items():
                stream, first = self._streams[number], rows[min(rows)]
                several = f"{stream.topic}: {len(rows)} of {len(stream.times)} {description}; the first: "
                sentences.append(f"{several if len(rows) > 1 else ''}{first}")
        return list(dict.fromkeys(sentences))

    def messages(
        self, ids: Collection[int], start: int, stop: int
    ) -> Iterator[tuple[Connection, int, bytes | memoryview]]:
        """Yield messages as ``bevviz.bags.reader.Reader`` does.

        An unreadable file gives an empty message and a line in ``warnings``.
        """
        times, numbers, rows = list[I64](), list[I64](), list[I64]()
        for number in sorted(ids):
            first, last = np.searchsorted(self._streams[number].times, [start, stop])
            times.append(self._streams[number].times[first:last])
            numbers.append(np.full(last - first, number, np.int64))
            rows.append(np.arange(first, last, dtype=np.int64))
        stamps, stream_of, row_of = (np.concatenate(parts) for parts in (times, numbers, rows))
        for i in np.lexsort((row_of, stream_of, stamps)).tolist():
            stream, at_row = self._streams[int(stream_of[i])], int(row_of[i])
            data: bytes | memoryview = b""
            try:
                message = stream.make(at_row)
                data = typestore().serialize_cdr(message, stream.type)
            except UserError as error:
                self._lost[int(stream_of[i])][at_row] = str(error)
            except NOT_AS_DOCUMENTED as error:
                self._dataset.warn(
                    f"{stream.topic}: not as {self._dataset.about} is documented ({describe_error(error)})"
                )
            else:
                if stream.files and (whole_points := len(message.data) // message.point_step) < message.width:
                    self._cut[int(stream_of[i])][at_row] = (
                        f"{stream.files[at_row]}: is cut: {whole_points} of {message.width} points are there"
                    )
            yield self.connections[int(stream_of[i])], int(stamps[i]), data

    def times(self, ids: Collection[int], start: int = 0, stop: int = LAST_TIME) -> I64:
        """Return the sorted log times of the connections ``ids`` with start <= time < stop."""
        times = np.sort(np.concatenate([self._streams[number].times for number in ids]))
        return times[(times >= start) & (times < stop)]

    def close(self) -> None:
        """Do nothing: no file stays open."""

    @property
    def aside(self) -> dict[str, str]:
        """Reason by topic why it gets no role by default."""
        return {stream.topic: stream.aside for stream in self._streams if stream.aside}


def make_connection(number: int, topic: str, kind: str, count: int) -> Connection:
    """Return the connection of messages that a reader makes."""
    text, digest = typestore().generate_msgdef(kind, ros_version=2)
    definition = MessageDefinition(MessageDefinitionFormat.MSG, text)
    return Connection(number, topic, kind, definition, digest, count, ConnectionExtRosbag2("cdr", []), None)
