"""What everything that logs frame after frame has in common: the clocks, and that nothing old stays."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence, Set

import numpy as np
import rerun as rr

from bevviz.model.frame import F64, I64, Clip, Codec
from bevviz.recording import entities
from bevviz.support.contexts import Closing

STAMPS = (entities.STAMP, entities.TRIED, entities.RECEIVED)  # timelines in nanoseconds; the others count
STEP = 1_000  # nanoseconds between two packets of video that belong to the same frame, at least
CODECS: Mapping[Codec, rr.VideoCodec] = {
    "h264": rr.VideoCodec.H264,
    "h265": rr.VideoCodec.H265,
    "av1": rr.VideoCodec.AV1,
    "vp8": rr.VideoCodec.VP8,
    "vp9": rr.VideoCodec.VP9,
}
WAIT = 1.0  # seconds, for a recording rather than for a robot's operator


class Writer(Closing):
    """Writes frames to a recording, on the timelines ``stamp``, ``frame`` and ``received``.

    The ``log_*`` functions of this folder, one for each kind of thing, write through one.

    Args:
        recording: where to; it may have any number of sinks.
        root: entity that everything goes under; empty: paths are as they are.
        wait: seconds that numbers to plot may wait for those of the next frames: sent together, as columns,
            they take a fraction of the time. Then close it, which sends the last of them.
        stamps: timelines of the sensor time. Without ``stamp`` among them, there are no others.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        root: str = "",
        wait: float = 0.0,
        stamps: Sequence[str] = (entities.STAMP,),
    ) -> None:
        self.recording = recording
        self.root = root
        self.sequences: Mapping[str, int] = {}  # further timelines, and where on them what comes next is
        self._wait, self._stamps = wait, stamps
        self._clock: dict[str, int] = {}  # timeline -> where on it this frame is
        self._scalars: dict[str, list[tuple[dict[str, int], float]]] = defaultdict(list)
        self._sent = time.monotonic()
        self._known: set[str] = set()  # entities that any frame had
        self._shown: set[str] = set()  # entities with something of the frame before
        self._now: set[str] = set()
        self.apart = False  # whether a frame may be looked at without those just before it
        self.streams_video = True  # else each picture as an image
        self._codecs: dict[str, Codec] = {}  # of entities that are video
        self._reached: dict[str, tuple[tuple[int, int], dict[str, int]]] = {}  # last packet of each, and when
        self._versions: dict[str, int] = {}  # entity -> what ``keep`` was last called with

    def begin(self, index: int, stamp: int, received: int) -> None:
        """Start a frame. Stamps in nanoseconds, ``received`` 0 where it is not known."""
        self._now = set()
        before = self._clock
        self.set_time(index, stamp, received)
        if before.keys() != self._clock.keys():
            self.flush()  # a column has the same timelines from end to end

    def end(self) -> None:
        """Clear what the frame before had, or any where they are looked at apart, and this one has not."""
        self._known |= self._now
        for path in (self._known if self.apart else self._shown) - self._now:
            self.write(path, rr.Clear(recursive=False))
        self._shown = self._now
        if time.monotonic() - self._sent >= self._wait:
            self.flush()

    def clear_at(self, index: int, stamp: int, received: int, paths: Set[str]) -> None:
        """Clear in another frame what was not known when that was written."""
        self.set_time(index, stamp, received)
        for path in paths:
            self.write(path, rr.Clear(recursive=False))

    def refresh(self, known: Set[str] = frozenset()) -> None:
        """Make the next frame whole without those before: what it lacks is cleared, nothing is kept.

        Args:
            known: further entities that may be there.
        """
        self._shown = self._known | known
        self._versions.clear()
        self._reached.clear()

    @property
    def known(self) -> frozenset[str]:
        """Entities that any frame had."""
        return frozenset(self._known)

    def flush(self) -> None:
        """Send what waits for more of its kind."""
        for path, rows in self._scalars.items():
            clocks, values = zip(*rows, strict=True)
            self._write_columns(path, clocks, rr.Scalars.columns(scalars=values))
        self._scalars.clear()
        self._sent = time.monotonic()

    def close(self) -> None:
        self.flush()

    # --- what is written -----------------------------------------------------------------------

    def static(self, path: str, *archetypes: rr.AsComponents) -> None:
        """Something that holds at all times."""
        for archetype in archetypes:
            self.recording.log(self.root + path, archetype, static=True)

    def put(self, path: str, *archetypes: rr.AsComponents) -> None:
        """Something of this frame alone: the next one that has nothing there clears it."""
        self.write(path, *archetypes)
        self._now.add(path)

    def video(self, path: str, clip: Clip) -> None:
        """The picture that a clip ends with, by those of its packets that are not there yet.

        What belongs to no frame is earlier on the timelines that count nanoseconds, as its stamps are. Of a
        clip that does not go on where the last one ended, all of it lies just before the frame.
        """
        if self._codecs.get(path) != clip.codec:
            self._codecs[path] = clip.codec
            self.static(path, rr.VideoStream(codec=CODECS[clip.codec]))
        reached, clock = self._reached.get(path, (None, {}))
        clock = clock if reached in clip.places else {}
        begin = clip.places.index(reached) + 1 if reached in clip.places else clip.key
        self._reached[path] = clip.places[-1], self._clock
        end = len(clip.places) - 1
        clocks = []
        for row in range(begin, end):
            early = clip.places[end][1] - clip.places[row][1] if clock else 0
            times = dict(self._clock)
            for name in self._clock.keys() & set(STAMPS):
                times[name] -= max(early, STEP * (end - row))
                if name in clock:
                    times[name] = max(times[name], clock[name] + STEP * (row - begin + 1))
            clocks.append(times)
        if clocks:
            self._write_columns(path, clocks, rr.VideoStream.columns(sample=clip.packets[begin:end]))
        if begin <= end:
            self.put(path, rr.VideoStream.from_fields(sample=clip.packets[end]))

    def keep(self, path: str, version: int) -> bool:
        """Keep what the frame before put there, if that was of this version; else False: put it anew."""
        kept = self._versions.get(path) == version and path in self._shown
        self._versions[path] = version
        self._now.add(path)
        return kept

    def write(self, path: str, *archetypes: rr.AsComponents) -> None:
        """Something that holds from this frame on, until there is more."""
        self.recording.log(self.root + path, *archetypes)

    def scalar(self, path: str, value: float) -> None:
        """A number to plot."""
        if self._wait > 0:
            self._scalars[path].append((self._clock, value))
        else:
            self.write(path, rr.Scalars(value))

    def samples(self, path: str, stamps: I64, received: I64, values: F64) -> None:
        """Numbers to plot that came between the frames, each row at its own time: (N, D)."""
        clocks = []
        for stamp, received_at in zip(stamps.tolist(), received.tolist(), strict=True):
            clock = self._clock | dict.fromkeys(self._stamps, stamp)
            if entities.RECEIVED in clock:
                clock[entities.RECEIVED] = received_at
            clocks.append(clock)
        columns = rr.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * len(values))
        self._write_columns(path, clocks, columns)

    def lines(self, path: str, lines: Sequence[tuple[str, str]]) -> None:
        """Lines of a log: level and text of each."""
        if lines:
            levels, texts = zip(*lines, strict=True)
            self._write_columns(
                path, [self._clock] * len(lines), rr.TextLog.columns(text=texts, level=levels)
            )

    def set_time(self, index: int, stamp: int, received: int) -> None:
        """Where on the timelines what comes next is, without a frame; see ``begin``."""
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
        """Several rows of one entity, each with its place on the timelines."""
        times = []
        for name in clocks[0]:
            numbers = [clock[name] for clock in clocks]
            if name in STAMPS:
                times.append(rr.TimeColumn(name, timestamp=np.array(numbers, "datetime64[ns]")))
            else:
                times.append(rr.TimeColumn(name, sequence=numbers))
        self.recording.send_columns(self.root + path, times, columns)
