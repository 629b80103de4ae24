"""A recording on disk: bags of MCAP, sqlite3 or ROS 1 (compressed, split or cut) and data sets."""

from __future__ import annotations

import heapq
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, partial
from itertools import islice
from operator import attrgetter, itemgetter
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from backports import zstd
from rosbags.interfaces import Connection
from rosbags.typesys import Stores

from bevviz.bags import mcap
from bevviz.bags.file_types import BagFile, find_saved_bag, open_file
from bevviz.bags.log_clock import Piece, describe, find_pieces, is_odd
from bevviz.bags.message import MessageTypes, RawMessage, foxglove_encoding, is_ros1, unread
from bevviz.bags.reader import LAST_TIME, normalized
from bevviz.bags.remote import address_of, beside, open_bytes
from bevviz.config import SourceConfig
from bevviz.config.files import parse_yaml
from bevviz.datasets import find_loader, open_dataset
from bevviz.datasets.dataset import DatasetReader, describe_unread
from bevviz.drivers.video import VideoPacket, decode_packet, is_video
from bevviz.errors import UserError
from bevviz.messages.decoders import (
    MessageError,
    PacketStream,
    Scan,
    ScanDecoder,
    Serialization,
    decode_scan,
    reads_bytes,
)
from bevviz.messages.definitions import deserialize_cdr
from bevviz.messages.guard import decode_message, guard
from bevviz.messages.packet_topics import open_calibrated, packet_stream
from bevviz.messages.surroundings import decode_mark
from bevviz.messages.topics import Topic
from bevviz.model.frame import I64
from bevviz.support import progress
from bevviz.support.contexts import Closable
from bevviz.support.files import bag_files, drive_files, full_disk_error, read_text
from bevviz.support.limits import CONFIG_LIMIT, MAX_TOPICS
from bevviz.support.scratch_folder import ScratchFolder
from bevviz.support.text import path_text

ATTACHED = "lidar_calibration"  # name prefix of an attached calibration; the topic and the file name follow
METADATA = "metadata.yaml"
PART = re.compile(r"_[1-9]\d*(?=\.(mcap|db3|bag)(\.zstd)?$)")  # number of a later part of a bag
COMPRESSED = "sensor_msgs/msg/CompressedImage"
STAMPED = ["timestamp", "frame_id"]  # first fields of Foxglove messages whose layout is that of a Header
MAX_ENCAPSULATION = 3  # of CDR and of parameter lists in CDR
REWIND = 2_000_000_000  # nanoseconds of the first search for a key frame; each next one spans four times more
LONGEST_SCAN = 1_000_000_000  # nanoseconds from the first packet of a scan to the last
MANY = 12  # longest list of files in a sentence
MAX_HEADERS = 16  # messages at the start of a video that may be codec headers


class Recording(Closable):
    """Messages of one or several bags or data sets as one stream in order of log time.

    Args:
        paths: bag files, bag folders and data set folders, in any order.
        config: name of the data set and its sequence, where the user states them.

    Attributes:
        single_frames: the scans are unrelated, and their times are made up.
        calibrations: calibration file of a LiDAR by topic, from ``source.lidar_calibration`` or from an
            attachment of the bag.
        is_dataset: the messages are made from data set files. An unreadable file gives an empty message
            and a line in ``warnings``.
        types: message types.
        sample_stamps: as of ``Dataset``.
        folder: folder of the data set's drive, else the first path.

    Raises:
        UserError: a path does not exist, cannot be read, is empty, or is neither a bag nor a data set.
    """

    def __init__(self, paths: Sequence[Path], config: SourceConfig | None = None) -> None:
        if not paths:
            raise UserError("no bag given")
        self.paths = tuple(map(find_saved_bag, paths))
        self.single_frames = self.is_dataset = False
        self.sample_stamps: dict[str, int] = {}
        self.folder = self.paths[0]
        self._config = config or SourceConfig()
        self._aside: dict[str, str] = {}
        self._scan_times: dict[str, I64] = {}
        self._grouped: dict[BagFile, tuple[Sequence[Connection], dict[str, list[Connection]]]] = {}
        self.files: list[BagFile] = []
        self._datasets: dict[BagFile, DatasetReader] = {}
        self._notes: list[str] = []
        self.types = MessageTypes(self._notes.append)
        self._scratch = ScratchFolder()
        self._pieces: Sequence[Piece] = ()  # of log times, if their clock jumps
        try:
            for path in self.paths:
                self._open(path)
            if (count := len(self._types_by_topic)) > MAX_TOPICS:
                raise UserError(f"{self.name}: it has {count:,} topics: {MAX_TOPICS:,} at most are read")
            self.calibrations = {**self._config.lidar_calibration, **self._attached()}
            if not self.message_count:
                raise UserError("; ".join([f"{self.name}: there are no messages in it", *self.warnings]))
            self._find_jumps()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close all files and delete the temporary ones."""
        while self.files:
            self.files.pop().close()
        self._scratch.close()

    @property
    def name(self) -> str:
        """Name of the first path without its folder."""
        return path_text(beside(self.paths[0]).name)

    @cached_property
    def size(self) -> int:
        """Size on disk in bytes."""
        local = [p for p in self.paths if not address_of(p)]
        files = [f for p in local for f in (drive_files(p) if p.is_dir() else [p])]
        return sum(f.stat().st_size for f in files) + sum(
            open_bytes(p).size for p in self.paths if address_of(p)
        )

    @cached_property
    def start(self) -> int:
        """Log time of the first message, in nanoseconds."""
        if self._pieces:
            return min(int(self._moved(f.times(f.connections)).min(initial=LAST_TIME)) for f in self.files)
        return min(f.span[0] for f in self.files if f.span[1])

    @cached_property
    def end(self) -> int:
        """Log time of the last message, in nanoseconds."""
        if self._pieces:
            return max(int(self._moved(f.times(f.connections)).max(initial=0)) for f in self.files)
        return max(f.span[1] for f in self.files) - 1

    def note(self, text: str) -> None:
        """Add a warning."""
        self._notes.append(text)

    def _find_jumps(self) -> None:
        """Find jumps of the clock of the log times, and note them."""
        if self._datasets or not is_odd(self.start, self.end):
            return
        times = np.sort(np.concatenate([f.times(f.connections) for f in self.files]))
        stamped = {c.topic: c.msgcount for f in self.files for c in self._typed(f) if self._has_header(c)}
        topics = sorted(stamped, key=lambda topic: -stamped[topic])[:MANY]

        def lag(low: int, high: int) -> int | None:
            for message in self.messages(topics, low, high):
                with suppress(MessageError):
                    if stamp := message.header()[0]:
                        return message.received - stamp
            return None

        pieces = find_pieces(times, lag)
        if pieces:
            self._notes.append(f"{self.name}: {describe(pieces)}")
            self._pieces = pieces
            del self.start, self.end  # They are computed again.

    def _moved(self, times: I64) -> I64:
        """Return log times of a file on the time line of the recording."""
        moved = times.copy()
        for piece in self._pieces:
            moved[(times >= piece.low) & (times < piece.high)] += piece.shift
        return np.sort(moved)

    @property
    def message_count(self) -> int:
        """Number of messages of all files. Those of a topic's second type do not count, see ``_typed``."""
        return sum(c.msgcount for f in self.files for c in self._typed(f))

    @property
    def warnings(self) -> list[str]:
        """Missing or damaged data met so far, one sentence each."""
        return [*self._notes, *(text for file in self.files for text in file.warnings)]

    @cached_property
    def topics(self) -> tuple[Topic, ...]:
        """All topics by name, each with the frame_id of its first message."""
        counts: Counter[str] = Counter()
        first: dict[str, Connection] = {}
        for file in self.files:
            for connection in self._typed(file):
                first.setdefault(connection.topic, connection)
                counts[connection.topic] += connection.msgcount
        described = {(c.topic, normalized(c.msgtype)): None for f in self.files for c in f.connections}
        self._notes += [
            f"{topic} is recorded both as {used} and as {msgtype}: only the former is used"
            for topic, msgtype in described
            if (used := self._types_by_topic.get(topic, msgtype)) != msgtype
        ]
        if not any(name.endswith("tf_static") and count for name, count in counts.items()):
            self._note_first_part()
        duration = (self.end - self.start) / 1e9
        self._aside |= {name: why for name in first if (why := self._lacks(first[name]))}
        return tuple(
            Topic(
                name,
                normalized(first[name].msgtype),
                counts[name],
                self._sensors[name]().frame_id
                if name in self._sensors
                else self._frame_id(name)
                if counts[name] and self._has_header(first[name])
                else "",
                (counts[name] - 1) / duration if counts[name] > 1 and duration else None,
                self._aside.get(name, ""),
                video=normalized(first[name].msgtype) == COMPRESSED and self._holds_video(name),
                scans=name in self._sensors,
            )
            for name in sorted(first)
        )

    def _note_first_part(self) -> None:
        """Note that the static transforms may be in the first part of a bag, of which this is a later one."""
        for path in self.paths:
            first = path.with_name(PART.sub("_0", path.name))
            if first not in self.paths and not address_of(path) and first.is_file():
                self._notes.append(
                    f"{path.name}: no static transforms in it, but it is a later part of a bag that begins "
                    f"with {first.name}: give both, or their folder"
                )

    def publishers(self, topic: str) -> str:
        """Return the names of the nodes that published a topic. Empty: the recording does not say them."""
        owners = (c.owner for f in self.files for c in f.connections if c.topic == topic)
        return next((owner for owner in owners if isinstance(owner, str)), "")

    @cached_property
    def _types_by_topic(self) -> dict[str, str]:
        """Type by topic: that of its first messages, else the first that any file states."""
        connections = [c for f in self.files for c in f.connections]
        types: dict[str, str] = {}
        for connection in sorted(connections, key=lambda c: not c.msgcount):
            types.setdefault(connection.topic, normalized(connection.msgtype))
        return types

    def _typed(self, file: BagFile) -> list[Connection]:
        """Return the connections of a file that have the type of their topic.

        Connections of one type with different definitions are all among them: each message is decoded by the
        definition of its own connection.
        """
        return [c for connections in self._by_topic(file).values() for c in connections]

    def _by_topic(self, file: BagFile) -> Mapping[str, list[Connection]]:
        """Return the connections of ``_typed`` by topic."""
        connections, by_topic = self._grouped.get(file, ((), {}))
        if connections is not file.connections:  # A damaged file may show a topic that no index has named.
            connections, by_topic = file.connections, {}
            for connection in connections:
                msgtype = normalized(connection.msgtype)
                if msgtype == self._types_by_topic.setdefault(connection.topic, msgtype):
                    by_topic.setdefault(connection.topic, []).append(connection)
            self._grouped[file] = connections, by_topic
        return by_topic

    def messages(
        self,
        topics: Collection[str],
        start: int | None = None,
        stop: int | None = None,
        *,
        few: bool = False,
        scans: bool = False,
    ) -> Iterator[RawMessage]:
        """Yield messages of ``topics`` with start <= log time < stop in nanoseconds, in order of log time.

        Args:
            topics: names of topics.
            start: first log time; None: that of the recording.
            stop: end of the log times; None: that of the recording.
            few: see ``ChunkReader.messages``.
            scans: give the scans of a data set as such, see ``DatasetReader.scans``.
        """
        if not self._pieces:
            yield from self._stored(topics, start, stop, few=few, scans=scans)
            return
        low, high = start or 0, LAST_TIME if stop is None else stop
        pieces = [
            (piece.shift, max(low - piece.shift, piece.low), min(high - piece.shift, piece.high))
            for piece in self._pieces
        ]
        moved = [
            map(partial(_moved_by, shift), self._stored(topics, first, end, few=few, scans=scans))
            for shift, first, end in pieces
            if first < end
        ]
        yield from heapq.merge(*moved, key=attrgetter("received"))

    def _stored(
        self, topics: Collection[str], start: int | None, stop: int | None, *, few: bool, scans: bool
    ) -> Iterator[RawMessage]:
        """Yield messages as ``messages`` does, by the log times in the files."""
        sources = [self._lazy_messages(f, topics, start, stop, few, scans) for f in self.files]
        for _, message in heapq.merge(*sources, key=itemgetter(0)):
            if message is not None:
                yield message

    def _lazy_messages(
        self,
        file: BagFile,
        topics: Collection[str],
        start: int | None,
        stop: int | None,
        few: bool,
        scans: bool,
    ) -> Iterator[tuple[int, RawMessage | None]]:
        """Yield the messages of one file after an empty item.

        A merge draws the first item of every file at once. The empty item defers opening the file until its
        time.
        """
        by_topic = self._by_topic(file)
        connections = [c for topic in topics for c in by_topic.get(topic, ())]
        if not connections:
            return
        yield file.span[0], None
        if scans and file in self._datasets:
            ids, high = [c.id for c in connections], LAST_TIME if stop is None else stop
            for connection, time, data, scan in self._datasets[file].scans(ids, start or 0, high):
                yield time, RawMessage(connection.topic, time, data, connection, scan)
            return
        for connection, time, data in file.messages(connections, start, stop, few):
            yield time, RawMessage(connection.topic, time, data, connection)

    def scans(
        self, topics: Collection[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[RawMessage]:
        """Yield messages as ``messages`` does, but the scans of a data set and of a LiDAR's packets as such.

        The packets of a LiDAR become one message per scan, which is received at the time of its last packet.
        """
        single = [topic for topic in topics if topic in self._sensors]
        others = [topic for topic in topics if topic not in self._sensors]
        messages = self.messages(others, start, stop, scans=True)
        parts = [messages, *(self._scans(name, start, stop) for name in single)]
        yield from heapq.merge(*parts, key=attrgetter("received"))

    def _scans(self, topic: str, start: int | None, stop: int | None) -> Iterator[RawMessage]:
        decoder = self._sensors[topic]()
        low = None if start is None else start - LONGEST_SCAN
        high = None if stop is None else stop + LONGEST_SCAN
        message: RawMessage | None = None

        def given(scans: Iterator[Scan]) -> Iterator[RawMessage]:
            for scan in scans:
                received = scan.received
                if message and (start is None or start <= received) and (stop is None or received < stop):
                    yield replace(message, data=b"", received=received, scan=scan)

        for message in self.messages([topic], low, high):
            # A message that cannot be read, or is no packet of the sensor, counts as a lost packet.
            with suppress(zstd.ZstdError, ValueError):
                data, ros1 = message.content(), is_ros1(message.connection)
                yield from given(decoder.add(message.received, data, ros1=ros1))
        yield from given(decoder.rest())

    def scan_times(self, topic: str) -> I64:
        """Return the log times of the scans of a topic, as ``times`` does for messages.

        Where messages are single packets, all of them are read. The result is kept.
        """
        if topic not in self._sensors:
            return self.times(topic)
        if topic not in self._scan_times:
            bar = progress.bar(self._scans(topic, None, None), desc=f"scans of {topic}", unit="scan", delay=1)
            self._scan_times[topic] = np.array([scan.received for scan in bar], np.int64)
        return self._scan_times[topic]

    @cached_property
    def _sensors(self) -> Mapping[str, Callable[[], ScanDecoder]]:
        """Functions that make a new decoder, by topic whose messages are single LiDAR packets."""
        found = {}
        for connection in {c.topic: c for f in self.files for c in self._typed(f)}.values():
            topic, stream = connection.topic, packet_stream(connection.msgtype)
            if stream is not None and (make_decoder := self._scan_decoder(topic, stream)) is not None:
                message = self.first(topic)
                if message and len(message.data) > stream.smallest:
                    found[topic] = make_decoder
        return found

    def _scan_decoder(self, topic: str, stream: PacketStream) -> Callable[[], ScanDecoder] | None:
        """Return a function that makes a decoder by the sensor's metadata; None if there are none."""
        if file := self.calibrations.get(topic, ""):
            make_decoder = partial(open_calibrated, stream, file)
        else:
            name = stream.metadata_topic(topic)
            message = self.first(name)
            try:
                text = guard(message, decode_mark, self.decode(message)) if message else None
            except MessageError:
                text = None
            if text is None:
                return None
            make_decoder = partial(stream.open, text, name)
        make_decoder()  # Raises the error of metadata that cannot be used.
        return make_decoder

    def _lacks(self, connection: Connection) -> str:
        """Return why the messages of a topic are not read; empty: they are."""
        if why := unread(connection):
            return why
        stream = packet_stream(connection.msgtype)
        if stream is None or connection.topic in self._sensors:
            return ""
        message = self.first(connection.topic)
        small = message is not None and len(message.data) <= stream.smallest
        return stream.imu if small else stream.lacks_metadata

    def first(self, topic: str) -> RawMessage | None:
        """Return the first message of a topic; None if it has none."""
        return next(self.messages([topic]), None)

    def times(self, topic: str) -> I64:
        """Return the sorted log times in nanoseconds of all messages of a topic. Their data is not read."""
        parts = [f.times(self._by_topic(f).get(topic, [])) for f in self.files]
        times = np.sort(np.concatenate(parts))
        return self._moved(times) if self._pieces else times

    def packets(self, topic: str, received: int) -> list[VideoPacket]:
        """Return the video packets that the picture received at a given time needs, including its own.

        The list begins with the codec headers from the start of the stream. The last key frame before the
        picture follows, or the start of the recording if there is no key frame.
        """
        start, found = received + 1, list[VideoPacket]()
        back = REWIND
        while start > self.start and not any(packet.is_key for packet in found):
            stop, start, back = start, max(self.start, start - back), 4 * back
            found = [*self._packets(topic, start, stop), *found]
        keys = [row for row, packet in enumerate(found) if packet.is_key]
        first = islice(self._packets(topic, None, None), MAX_HEADERS)
        return [*(packet for packet in first if packet.is_header), *found[keys[-1] if keys else 0 :]]

    def _packets(self, topic: str, start: int | None, stop: int | None) -> Iterator[VideoPacket]:
        for message in self.messages([topic], start, stop):
            with suppress(MessageError):  # The error is counted when the message itself is handled.
                yield guard(message, decode_packet, self.decode(message), topic, message.received)

    def decode(self, message: RawMessage) -> Any:
        """Decode a message into an object with the fields of its definition.

        A message type with a decoder becomes what its decoder makes of it, such as a ``Cloud``.

        Raises:
            MessageError: the data does not fit the definition, or there is none.
            UserError: a file that the configuration names for the topic cannot be used.
        """
        if message.scan is not None:
            return guard(message, decode_scan, message.scan)
        data = guard(message, RawMessage.content, message)
        if foxglove_encoding(message.connection):
            return decode_message(message, data, message.parsed, Serialization(message.type))
        serialization = Serialization(
            message.type,
            is_ros1(message.connection),
            self.calibrations.get(message.topic, ""),
            self.types.fields(message.connection),
        )
        return decode_message(message, data, partial(self._deserialized, message), serialization)

    def deserialize(self, message: RawMessage) -> Any:
        """Return a message as its definition has it, also where its type has a decoder.

        Raises:
            MessageError: the data does not fit the definition, or there is none.
        """
        data = guard(message, RawMessage.content, message)
        return guard(message, partial(self._deserialized, message), data)

    def _deserialized(self, message: RawMessage, data: bytes | memoryview) -> Any:
        connection, msgtype = message.connection, message.type
        if why := unread(connection):
            raise MessageError(f"{message.topic}: {why}")
        store = self.types.store(connection)
        if not is_ros1(connection) and len(data) > 3 and data[1] > MAX_ENCAPSULATION:
            raise MessageError(
                f"{message.topic}: encoded as XCDR2 (encapsulation {data[1]}), which is not read; set the "
                "data representation of its publisher to XCDR1"
            )
        try:
            if is_ros1(connection):
                return store.deserialize_ros1(data, msgtype)
            return deserialize_cdr(store, data, msgtype)
        except KeyError:
            raise MessageError(
                f"{message.topic}: the bag does not say what a {msgtype} is made of, and neither does bevviz"
            ) from None

    def encode(self, message: RawMessage, content: Any) -> memoryview:
        """Serialise ``content``, a changed result of ``deserialize``, in the format of ``message``."""
        store, msgtype = self.types.store(message.connection), normalized(message.connection.msgtype)
        if is_ros1(message.connection):
            return store.serialize_ros1(content, msgtype)
        return store.serialize_cdr(content, msgtype)

    def _has_header(self, connection: Connection) -> bool:
        if foxglove_encoding(connection):
            return True
        if unread(connection):
            return False
        try:
            _, fields = self.types.store(connection).fielddefs[normalized(connection.msgtype)]
        except KeyError:
            return reads_bytes(connection.msgtype)
        names = [name for name, _ in fields[:2]]
        return bool(fields) and (fields[0][1][1] == "std_msgs/msg/Header" or names == STAMPED)

    def _frame_id(self, topic: str) -> str:
        message = self.first(topic)
        try:
            return message.header()[1] if message else ""
        except MessageError:
            return ""

    def _holds_video(self, topic: str) -> bool:
        """Tell whether the images of a topic are video packets."""
        message = self.first(topic)
        try:
            return message is not None and guard(message, is_video, self.decode(message))
        except MessageError:
            return False

    def _open(self, path: Path) -> None:
        try:
            if path.name == METADATA:
                path = path.parent
            if path.is_dir():
                self._open_folder(path)
            elif self._config.dataset and path.exists():
                open_dataset(path, self._config.dataset)
            else:
                self.files.append(open_file(path, self._scratch, self._notes.append))
        except FileNotFoundError:
            raise UserError(f"{path}: no such file or folder") from None
        except PermissionError:
            raise UserError(f"{path}: permission denied: you may not read it") from None
        except OSError as error:
            if (full := full_disk_error(error)) is not None:  # Unpacking a file filled the temporary folder.
                raise full from None
            raise UserError(f"{path}: cannot be read: {error.strerror or error}") from None

    def _attached(self) -> dict[str, str]:
        """Extract the LiDAR calibrations attached to the bags. Return the files by topic.

        An attachment replaces the stated file only where that file does not exist here. So a part cut out
        of a bag runs on another machine with the configuration of the original bag.
        """
        found = dict[str, str]()
        stated = self._config.lidar_calibration
        for file in self.files:
            for name, data in mcap.read_attachments(file.path).items() if file.path.is_file() else ():
                topic, _, base = name.removeprefix(ATTACHED).rpartition("/")
                known = Path(stated.get(topic, base))
                here = topic in stated and known.exists()
                if name.startswith(ATTACHED) and known.name == base and base.strip(".") and not here:
                    found[topic] = str(self._scratch.new() / base)
                    Path(found[topic]).write_bytes(data)
        return found

    def _open_folder(self, folder: Path) -> None:
        files = bag_files(folder)
        stated = self._config.dataset
        if (stated or not files) and self._open_dataset(folder, stated):
            return
        if not files:
            within = sorted(d.name for d in folder.iterdir() if d.is_dir() and bag_files(d))
            hint = f"; there are bags in its folders: {', '.join(within[:5])}" if within else ""
            if drives := [] if within else [d.name for d in sorted(folder.iterdir()) if find_loader(d)]:
                hint = f"; its folders that are one: {', '.join(drives[:5])}{' ...' if drives[5:] else ''}"
            hint += f"; {others}" if (others := describe_unread(folder)) else ""
            raise UserError(
                f"{folder}: a folder without a bag (no .mcap, .db3 or .bag file), and no data set that is "
                f"recognised (--dataset NAME){hint}"
            )
        metadata = self._read_metadata(folder)
        try:
            expected = int(metadata.get("message_count", 0))
            listed = {PurePath(p).name for p in metadata.get("relative_file_paths", ())}
        except (TypeError, ValueError):
            expected, listed = 0, set()
        files, unlisted, missing = _listed_files(files, listed)
        if unlisted:
            self._notes.append(
                f"{folder}: {_some(unlisted)} left out, which {METADATA} does not list; if it is no copy, "
                "open it by its name"
            )
        failed: list[UserError] = []
        before = len(self.files)
        for file in files:
            try:
                self.files.append(open_file(file, self._scratch, self._notes.append))
            except UserError as error:
                failed.append(error)
        if len(failed) == len(files):
            raise failed[0]
        self._notes += map(str, failed)
        if missing:
            self._notes.append(f"{folder}: {_some(missing)} of {METADATA} is missing: read without")
        self._leave_out_copies(folder, before)
        found = sum(c.msgcount for f in self.files[before:] for c in f.connections)
        if found < expected:
            self._notes.append(
                f"{folder}: {METADATA} counts {expected} messages, {found} were found: "
                f"{expected - found} are lost"
            )

    def _leave_out_copies(self, folder: Path, first: int) -> None:
        """Close each file of a folder that has the topics, counts and times of another one."""
        known, copies = dict[object, BagFile](), list[BagFile]()
        for file in self.files[first:]:
            counts = sorted((c.topic, c.msgcount) for c in file.connections if c.msgcount)
            if counts and known.setdefault((file.span, *counts), file) is not file:
                copies.append(file)
        for file in copies:
            self.files.remove(file)
            file.close()
        if copies:
            self._notes.append(
                f"{folder}: {_some([f.path.name for f in copies])} left out: a copy of another file"
            )

    def _open_dataset(self, folder: Path, name: str) -> bool:
        """Open a folder as a data set. Return False if it is none."""
        dataset = open_dataset(folder, name, self._config.sequence)
        if dataset is None:
            return False
        reader = DatasetReader(dataset)
        file = BagFile(folder, dataset.about, lambda: reader)
        self.files.append(file)
        self._datasets[file] = reader
        self.single_frames |= dataset.single_frames
        self.is_dataset = True
        self.sample_stamps |= dataset.sample_stamps
        self.folder = dataset.path
        self._aside |= reader.aside
        return True

    def _read_metadata(self, folder: Path) -> Mapping[str, Any]:
        path = folder / METADATA
        if not path.exists():
            if not any(f.suffix == ".bag" for f in bag_files(folder)):
                self._notes.append(
                    f"{folder}: {METADATA} is missing: read without ('ros2 bag reindex' makes one)"
                )
            return {}
        try:
            content = parse_yaml(read_text(path, CONFIG_LIMIT), str(path))["rosbag2_bagfile_information"]
            distro = content.get("ros_distro")
            if f"ros2_{distro}" in {s.value for s in Stores}:
                self.types.release = Stores(f"ros2_{distro}")
            return dict(content)
        except (UserError, KeyError, TypeError, AttributeError, ValueError):
            self._notes.append(f"{path}: not readable as {METADATA}: read without")
            return {}


def _listed_files(files: Sequence[Path], listed: Collection[str]) -> tuple[list[Path], list[str], list[str]]:
    """Choose the files of a folder that its metadata list.

    A file may have been packed or unpacked since: ``bag_0.db3.zstd`` is as good as ``bag_0.db3``.

    Returns:
        The files, the names of others in the folder, and the listed names that are missing. If none of the
        listed files exists, all files are chosen: the metadata are those of another bag.
    """
    by_name = {file.name: file for file in files}
    chosen, missing = list[Path](), list[str]()
    for name in sorted(listed):
        forms = (name, name.removesuffix(".zstd"), f"{name}.zstd")
        here = next((by_name[form] for form in forms if form in by_name), None)
        if here is None:
            missing.append(name)
        else:
            chosen.append(here)
    if not chosen:
        return list(files), [], missing
    return chosen, [name for name, file in by_name.items() if file not in chosen], missing


def _moved_by(shift: int, message: RawMessage) -> RawMessage:
    return replace(message, received=message.received + shift) if shift else message


def _some(names: Sequence[str]) -> str:
    return f"{', '.join(names[:MANY])}{' ...' if names[MANY:] else ''}"
