"""Base class of data set loaders, and their reader. One drive becomes topics with messages made on demand."""

from __future__ import annotations

import os
import re
import struct
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray
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
from bevviz.messages.clouds import LayoutError, make_cloud
from bevviz.messages.decoders import MessageError, Scan
from bevviz.messages.definitions import typestore
from bevviz.messages.encode import (
    encode_cloud,
    encode_compressed_image,
    encode_intrinsics,
    encode_transforms,
)
from bevviz.model.frame import F64, I64, Cloud, Intrinsics
from bevviz.support.files import LFS_HINT, read_lines
from bevviz.support.limits import TABLE_LIMIT

SECOND = 1_000_000_000
MAP, BASE = "map", "base_link"  # frames of the world and of the vehicle
MAX_POINTER_BYTES = 1024  # bytes of a pointer file, by the specification of Git LFS
FIELDS = ("x", "y", "z", "intensity")
POINTS = "sensor_msgs/msg/PointCloud2"
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
        make: makes a row of ``times``: a ``Cloud``, or a message of another type with
            ``bevviz.messages.encode``. May raise UserError.
        aside: reason why the topic gets no role by default; empty: it gets one.
        cut: reason by row why a part of the points is missing, of the rows made so far.
    """

    topic: str
    type: str
    times: I64
    make: Callable[[int], Any]
    aside: str = ""
    cut: dict[int, str] = field(default_factory=dict)


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


def cloud_stream(
    topic: str,
    frame_id: str,
    times: I64,
    read: Callable[[int], tuple[NDArray[np.void], int]],
    files: Sequence[Path] = (),
) -> Stream:
    """Return the stream of a LiDAR's scans.

    Args:
        topic: topic of the scans.
        frame_id: frame of the points.
        times: (N,) sorted stamps in nanoseconds.
        read: returns the (N,) structured points of a row, and the number that its file announces, else 0.
        files: file of each row, where a file may be cut.
    """
    cut = dict[int, str]()

    def make(row: int) -> Cloud:
        points, announced = read(row)
        if files and announced > len(points):
            cut[row] = f"{files[row]}: is cut: {len(points)} of {announced} points are there"
        try:
            return make_cloud(int(times[row]), frame_id, points, announced)
        except LayoutError as error:
            raise UserError(f"{topic}: {error}") from None

    return Stream(topic, POINTS, times, make, cut=cut)


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
T = TypeVar("T")


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
        # By stream: reason for each row without a message.
        self._lost = defaultdict[int, dict[int, str]](dict)

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
        cut = {number: stream.cut for number, stream in enumerate(self._streams) if stream.cut}
        for reasons, description in ((self._lost, "cannot be read"), (cut, "are cut")):
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
        for number, row, stamp in self._rows(ids, start, stop):
            yield self.connections[number], stamp, self._serialized(number, row)

    def scans(
        self, ids: Collection[int], start: int, stop: int
    ) -> Iterator[tuple[Connection, int, bytes | memoryview, Scan | None]]:
        """Yield messages as ``messages`` does, but clouds as scans with no data.

        A file is read when its scan is decoded. It gives its cloud without a message.
        """
        for number, row, stamp in self._rows(ids, start, stop):
            if self._streams[number].type == POINTS:
                yield self.connections[number], stamp, b"", Scan(stamp, partial(self._cloud, number, row))
            else:
                yield self.connections[number], stamp, self._serialized(number, row), None

    def _rows(self, ids: Collection[int], start: int, stop: int) -> Iterator[tuple[int, int, int]]:
        """Yield stream, row and stamp of each message with start <= stamp < stop in order of stamp."""
        times, numbers, rows = list[I64](), list[I64](), list[I64]()
        for number in sorted(ids):
            first, last = np.searchsorted(self._streams[number].times, [start, stop])
            times.append(self._streams[number].times[first:last])
            numbers.append(np.full(last - first, number, np.int64))
            rows.append(np.arange(first, last, dtype=np.int64))
        stamps, stream_of, row_of = (np.concatenate(parts) for parts in (times, numbers, rows))
        for i in np.lexsort((row_of, stream_of, stamps)).tolist():
            yield int(stream_of[i]), int(row_of[i]), int(stamps[i])

    def _serialized(self, number: int, row: int) -> bytes | memoryview:
        """Return the message of a row; empty if it cannot be made."""

        def serialized(made: Any) -> bytes | memoryview:
            message = encode_cloud(made) if isinstance(made, Cloud) else made
            return typestore().serialize_cdr(message, self._streams[number].type)

        return self._read(number, row, serialized) or b""

    def _cloud(self, number: int, row: int) -> Cloud:
        """Return the cloud of a row.

        Raises:
            MessageError: it cannot be made. ``warnings`` says why.
        """
        cloud = self._read(number, row, lambda made: made)
        if not isinstance(cloud, Cloud):
            raise MessageError(f"{self._streams[number].topic}: a scan cannot be read")
        return cloud

    def _read(self, number: int, row: int, convert: Callable[[Any], T]) -> T | None:
        """Make a row and convert it; None, and a line in ``warnings``, if it cannot be made."""
        try:
            return convert(self._streams[number].make(row))
        except UserError as error:
            self._lost[number][row] = str(error)
        except NOT_AS_DOCUMENTED as error:
            self._dataset.warn(
                f"{self._streams[number].topic}: not as {self._dataset.about} is documented "
                f"({describe_error(error)})"
            )
        return None

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
