"""Common base of writers that log frame after frame: timelines, and clearing of old data."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Hashable, Mapping, Sequence, Set

import numpy as np
import rerun as rr

from bevviz.model.frame import F64, I64, Codec, VideoClip
from bevviz.recording import entities
from bevviz.recording.addresses import EntityRows, Rows
from bevviz.recording.components import Components
from bevviz.support.contexts import Closable

STAMPS = (entities.STAMP, entities.TRIED, entities.RECEIVED)  # in nanoseconds; the others are sequences
VIDEO_PACKET_STEP = 1_000  # nanoseconds between two video packets of a frame, at least
CODECS: Mapping[Codec, rr.VideoCodec] = {
    "h264": rr.VideoCodec.H264,
    "h265": rr.VideoCodec.H265,
    "av1": rr.VideoCodec.AV1,
    "vp8": rr.VideoCodec.VP8,
    "vp9": rr.VideoCodec.VP9,
}
SCALAR_WAIT = 1.0  # seconds; suits a recording, but not a robot's operator


class Writer(Closable):
    """Writer of frames to a recording, on the timelines ``stamp``, ``frame`` and ``received``.

    The ``log_*`` functions of this folder write through a Writer.

    Args:
        recording: recording stream, with any number of sinks.
        root: entity above all others; empty: paths stay unchanged.
        wait: seconds that scalars may wait for those of later frames. As columns they take a fraction of the
            time. The caller must close the writer, which sends the last scalars.
        stamps: timelines of the sensor time. Without ``stamp`` among them, there are no other timelines.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        root: str = "",
        wait: float = 0.0,
        stamps: Sequence[str] = (entities.STAMP,),
    ) -> None:
        self.recording = self.styles = recording  # ``styles``: stream of ``static_once``
        self.root = root
        self.sequences: Mapping[str, int] = {}  # further timelines, and the position on each
        self._wait, self._stamps = wait, stamps
        self._clock: dict[str, int] = {}  # timeline -> position of this frame
        self._scalars: dict[str, list[tuple[dict[str, int], float]]] = defaultdict(list)
        self._flushed_at = time.monotonic()
        self._all_entities: set[str] = set()  # entities that any frame had
        self._previous_entities: set[str] = set()  # entities with data of the previous frame
        self._frame_entities: set[str] = set()
        self._rows: dict[str, Rows] = {}
        self.apart = False  # whether frames may be viewed without their previous frames
        self.streams_video = True  # False: each video picture is logged as an image
        self._codecs: dict[str, Codec] = {}  # codec of entities that are video
        self._last_packets: dict[str, tuple[tuple[int, int], dict[str, int]]] = {}  # last packet and its time
        self._logged_once: set[tuple[Hashable, ...]] = set()  # keys of ``static_once``
        self._versions: dict[str, int] = {}  # entity -> version in the last ``keep``

    def begin(self, index: int, stamp: int, received: int) -> None:
        """Start a frame. Stamps are in nanoseconds; ``received`` is 0 if it is unknown."""
        self._frame_entities, self._rows = set(), {}
        clock = self._clock
        self.set_time(index, stamp, received)
        if clock.keys() != self._clock.keys():
            self.flush()  # all rows of a column have the same timelines

    def end(self) -> None:
        """Clear entities that the previous frame had and this frame has not.

        If frames are viewed apart, clear entities that any earlier frame had.
        """
        self._all_entities |= self._frame_entities
        for path in (self._all_entities if self.apart else self._previous_entities) - self._frame_entities:
            self.write(path, rr.Clear(recursive=False))
        self._previous_entities = self._frame_entities
        if time.monotonic() - self._flushed_at >= self._wait:
            self.flush()

    def clear_at(self, index: int, stamp: int, received: int, paths: Set[str]) -> None:
        """Clear entities in another frame. They were not known when it was written."""
        self.set_time(index, stamp, received)
        for path in paths:
            self.write(path, rr.Clear(recursive=False))

    def refresh(self, known: Set[str] = frozenset()) -> None:
        """Make the next frame complete without earlier frames: clear what it lacks, and keep nothing.

        Args:
            known: further entities that may exist.
        """
        self._previous_entities = self._all_entities | known
        self._versions.clear()
        if self.styles is self.recording:  # the owner of a separate stream repeats its bytes
            self._logged_once.clear()
        self._last_packets.clear()

    @property
    def known(self) -> frozenset[str]:
        """Entities that any frame had."""
        return frozenset(self._all_entities)

    def flush(self) -> None:
        """Send scalars that wait."""
        for path, rows in self._scalars.items():
            clocks, values = zip(*rows, strict=True)
            self._write_columns(path, clocks, rr.Scalars.columns(scalars=values))
        self._scalars.clear()
        self._flushed_at = time.monotonic()

    def close(self) -> None:
        """Send scalars that wait."""
        self.flush()

    @property
    def rows(self) -> EntityRows:
        """Rows behind the items of each entity of this frame, or of the last one after ``end``."""
        return self._rows

    def note_rows(self, path: str, rows: Rows) -> None:
        """Note the rows that the items of an entity show."""
        self._rows[path] = rows

    # --- logging -------------------------------------------------------------------------------

    def static(self, path: str, *archetypes: rr.AsComponents) -> None:
        """Log data that holds at all times."""
        for archetype in archetypes:
            self.recording.log(self.root + path, archetype, static=True)

    def static_once(self, path: str, make: Callable[[], rr.AsComponents], *key: Hashable) -> None:
        """Log static data of an entity, unless it was logged with this key before.

        After ``refresh`` it is logged again, because a viewer may lack what was logged before.
        """
        if (path, *key) not in self._logged_once:
            self._logged_once.add((path, *key))
            self.styles.log(self.root + path, make(), static=True)

    def put(self, path: str, *archetypes: rr.AsComponents) -> None:
        """Log data of this frame alone. The next frame without data for the entity clears it."""
        self.write(path, *archetypes)
        self._frame_entities.add(path)

    def video(self, path: str, clip: VideoClip) -> None:
        """Log the last image of a clip, with those packets of the clip that are not logged yet.

        Packets that belong to no frame get earlier times on the nanosecond timelines, from their stamps. If a
        clip does not continue the previous one, all its packets lie just before the frame.
        """
        if self._codecs.get(path) != clip.codec:
            self._codecs[path] = clip.codec
            self.static(path, rr.VideoStream(codec=CODECS[clip.codec]))
        last_packet, clock = self._last_packets.get(path, (None, {}))
        clock = clock if last_packet in clip.places else {}
        begin = clip.places.index(last_packet) + 1 if last_packet in clip.places else clip.key
        self._last_packets[path] = clip.places[-1], self._clock
        end = len(clip.places) - 1
        clocks = []
        for row in range(begin, end):
            offset = clip.places[end][1] - clip.places[row][1] if clock else 0
            times = dict(self._clock)
            for name in self._clock.keys() & set(STAMPS):
                times[name] -= max(offset, VIDEO_PACKET_STEP * (end - row))
                if name in clock:
                    times[name] = max(times[name], clock[name] + VIDEO_PACKET_STEP * (row - begin + 1))
            clocks.append(times)
        if clocks:
            self._write_columns(path, clocks, rr.VideoStream.columns(sample=clip.packets[begin:end]))
        if begin <= end:
            self.put(path, rr.VideoStream.from_fields(sample=clip.packets[end]))

    def keep(self, path: str, version: int) -> bool:
        """Keep the previous frame's data if it has this version. Return whether it is kept.

        If it is not kept, the caller must log the data.
        """
        is_kept = self._versions.get(path) == version and path in self._previous_entities
        self._versions[path] = version
        self._frame_entities.add(path)
        return is_kept

    def write(self, path: str, *archetypes: rr.AsComponents) -> None:
        """Log data that holds from this frame on, until newer data."""
        rr.log(self.root + path, *archetypes, recording=self.recording)  # has less overhead than its method

    def scalar(self, path: str, value: float) -> None:
        """Log a number for a plot."""
        if self._wait > 0:
            self._scalars[path].append((self._clock, value))
        else:
            self.write(path, Components(rr.Scalars, {"scalars": [value]}))

    def samples(self, path: str, stamps: I64, received: I64, values: F64) -> None:
        """Log (N, D) numbers for a plot, each row at its own time between the frames."""
        clocks = []
        for stamp, received_at in zip(stamps.tolist(), received.tolist(), strict=True):
            clock = self._clock | dict.fromkeys(self._stamps, stamp)
            if entities.RECEIVED in clock:
                clock[entities.RECEIVED] = received_at
            clocks.append(clock)
        columns = rr.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * len(values))
        self._write_columns(path, clocks, columns)

    def lines(self, path: str, lines: Sequence[tuple[str, str]]) -> None:
        """Log lines of a log: level and text of each."""
        if lines:
            levels, texts = zip(*lines, strict=True)
            self._write_columns(
                path, [self._clock] * len(lines), rr.TextLog.columns(text=texts, level=levels)
            )

    def set_time(self, index: int, stamp: int, received: int) -> None:
        """Set the position on the timelines for the data that follows, without a frame; see ``begin``."""
        self._clock = dict.fromkeys(self._stamps, stamp)
        if entities.STAMP in self._stamps:
            self._clock[entities.FRAME] = index
            if received:
                self._clock[entities.RECEIVED] = received
        self._clock |= self.sequences
        self.recording.reset_time()
        for name, number in self._clock.items():
            if name in STAMPS:
                self.recording.set_time(name, timestamp=np.datetime64(number, "ns"))
            else:
                self.recording.set_time(name, sequence=number)

    def _write_columns(
        self, path: str, clocks: Sequence[dict[str, int]], columns: rr.ComponentColumnList
    ) -> None:
        """Log several rows of an entity, each at its own position on the timelines."""
        times = []
        for name in clocks[0]:
            numbers = [clock[name] for clock in clocks]
            if name in STAMPS:
                times.append(rr.TimeColumn(name, timestamp=np.array(numbers, "datetime64[ns]")))
            else:
                times.append(rr.TimeColumn(name, sequence=numbers))
        self.recording.send_columns(self.root + path, times, columns)
