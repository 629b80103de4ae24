"""Frames from a recorded bag: read once from front to back, so that its length costs no memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import numpy as np

from bevviz.bags.bag import Recording
from bevviz.bags.message import RawMessage
from bevviz.config import Config, stage_topics
from bevviz.errors import UserError
from bevviz.messages.decoding import MessageError
from bevviz.messages.guard import guard
from bevviz.messages.roles import find_roles
from bevviz.messages.transforms import decode_transforms
from bevviz.model.frame import F64, I64, Frame, Scene
from bevviz.support.contexts import Closing
from bevviz.sync.feed import Handler, make_handlers
from bevviz.sync.report import blindness
from bevviz.sync.synchronizer import Synchronizer
from bevviz.sync.unusable_messages import Damage

SECOND = 1_000_000_000
MARGIN = 2 * SECOND  # what else belongs to the first and the last cloud is looked for this far outside
MOST_HELD = 2000  # messages of a topic with transforms that are read to begin in the midst of a drive
EPOCH = 1e8  # a larger number of seconds is a date


@dataclass(frozen=True)
class FrameSelection:
    """Which frames of a bag, as in ``BagSource``."""

    start: str | None = None
    end: str | None = None
    every: int = 1
    frames: tuple[int | None, int | None] | None = None

    def source(self, paths: Sequence[Path], config: Config) -> BagSource:
        return BagSource(paths, config, start=self.start, end=self.end, every=self.every, frames=self.frames)


@dataclass(slots=True)
class ReadingState:
    """Position in a recording between two messages, and what the messages so far left behind.

    Attributes:
        sync: the synchroniser with its queues.
        stop: log time in nanoseconds at which reading ends; 0: not known yet.
        number: number of the last scan met, from the first that is read; -1: none.
        numbers: numbers of the scans that are not yet delivered, by time of receipt.
        damage: messages that could not be used.
    """

    sync: Synchronizer
    stop: int = 0
    number: int = -1
    numbers: dict[int, list[int]] = field(default_factory=dict)
    damage: Damage = field(default_factory=Damage)


class BagSource(Closing):
    """The frames of one recording, kept in one or several bags.

    Args:
        paths: bag files or folders.
        config: roles and synchronisation.
        start: first log time, see ``parse_time``.
        end: log time to stop at.
        every: only each N-th scan becomes a frame; the others are not decoded.
        frames: only scans A to B - 1 of those between ``start`` and ``end``, as in a Python slice.
        at: only the scan whose log time is nearest to this time, numbered as in the whole recording.

    Raises:
        UserError: no bag, nothing in it, no LiDAR, or nothing in the part asked for.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        config: Config,
        *,
        start: str | None = None,
        end: str | None = None,
        every: int = 1,
        frames: tuple[int | None, int | None] | None = None,
        at: str | None = None,
    ) -> None:
        self.config = config
        self.selection = FrameSelection(start, end, every, frames)
        self.recording = Recording(paths, config.source)
        try:
            self.roles = find_roles(self.recording.topics, config.source, stage_topics(config))
            self._driver = self._find_driver()
            self._low = self._time(start, self.recording.start)
            self._high = self._time(end, self.recording.end + 1)
            self._first = 0  # number of the first scan that is read
            if at is not None:
                self._narrow(self._time(at, 0))
            self._chosen = self._choose(every, frames or (None, None))
        except BaseException:
            self.close()
            raise
        self._state: ReadingState | None = None  # of the frames read last

    def close(self) -> None:
        self.recording.close()

    @property
    def scene(self) -> Scene:
        scene = self.roles.scene(self.recording.name)
        return replace(scene, bag=self.recording.paths, topics=self.roles.settings)

    @property
    def total(self) -> int:
        return len(self._chosen)

    @property
    def warnings(self) -> Sequence[str]:
        report = self._state.sync.report if self._state else None
        synced = report.warnings() if report else ()
        blind = blindness(self.config, self.roles, report)
        alone = [f"{self.roles.no_lidar}: the frames are {self._driver}'s"] if self.roles.no_lidar else []
        return [*self.recording.warnings, *alone, *self._damage, *blind, *synced]

    @property
    def _damage(self) -> Sequence[str]:
        """Messages that could not be used, a sentence for each topic."""
        return self._state.damage.sentences if self._state else ()

    @property
    def doubts(self) -> Sequence[str]:
        """What could not be used of the frames read so far, and what may make all of them wrong."""
        if self._state is None:
            return []
        report = self._state.sync.report
        return [*self._damage, *report.losses(), *report.doubts()]

    @property
    def span(self) -> tuple[int, int]:
        """Log times of the scans that are read: from the first, to before the second."""
        return self._low, self._high

    @property
    def tree(self) -> Mapping[str, str]:
        """Child to parent of the transforms met so far."""
        return self._state.sync.tf.tree() if self._state else {}

    def pose(self, frame: Frame, stamp: int) -> F64 | None:
        """(4, 4) fixed_from_points at a stamp near that of a frame that was read last or a little before.

        None: no fixed frame above the points, or the transforms read so far do not reach the stamp.
        """
        return self._state.sync.placing.pose(frame, stamp) if self._state else None

    @cached_property
    def scans(self) -> I64:
        """Log time of every scan of the recording in nanoseconds, in order; its place is its number."""
        return self.recording.scan_times(self._driver)

    def number_at(self, time: str | float) -> int:
        """Number of the scan that is nearest to a time, see ``parse_time``.

        Raises:
            UserError: no time, or one outside the recording.
        """
        if not len(self.scans):
            raise UserError(f"{self.recording.name}: {self._driver} has no scan that can be read")
        return int(np.abs(self.scans - self._time(str(time), 0)).argmin())

    def checked(self, number: int) -> int:
        """The number of a scan.

        Raises:
            UserError: there is none of that number.
        """
        if not 0 <= number < len(self.scans):
            raise UserError(
                f"frame {number}: {self.recording.name} has {len(self.scans)} scans, counted from 0"
            )
        return number

    def frame(self, number: int) -> Frame | None:
        """The frame of one scan of the recording, whichever were chosen; None where it cannot be read.

        Raises:
            UserError: there is no scan of that number.
        """
        low = int(self.scans[self.checked(number)])
        return next(self._frames(low, low + 1, number, range(1)), None)

    def __iter__(self) -> Iterator[Frame]:
        return self._frames(self._low, self._high, self._first, self._chosen)

    def _frames(self, low: int, high: int, first: int, chosen: range) -> Iterator[Frame]:
        """The chosen ones of the scans with low <= log time < high, the first of which is ``first``."""
        return self._deliver(self._begin(low), low, high, first, chosen)

    def _begin(self, low: int) -> ReadingState:
        sync = Synchronizer(self.roles, self.config)
        state = self._state = ReadingState(sync)
        self._hold_throughout(state, self._handlers(sync), low)
        return state

    def _handlers(self, sync: Synchronizer) -> dict[str, Handler[RawMessage]]:
        return make_handlers(sync, self.roles, self.recording.decode, self.recording.packets)

    def _deliver(
        self, state: ReadingState, low: int, high: int, first: int, chosen: range
    ) -> Iterator[Frame]:
        """Yield the frames; ``state`` follows the reading."""
        sync = state.sync
        handlers = self._handlers(sync)
        state.stop = high + MARGIN
        for message in self.recording.scans(handlers.keys(), low - MARGIN, high + MARGIN):
            if message.received > state.stop:
                break
            if message.topic == self._driver:
                if not low <= message.received < high:
                    continue
                state.number += 1
                if state.number not in chosen:
                    continue
                if state.number == chosen[-1]:
                    state.stop = message.received + MARGIN
                state.numbers.setdefault(message.received, []).append(first + state.number)
            elif message.topic in self.roles.lidars and not (
                state.number in chosen or state.number + 1 in chosen
            ):
                continue
            self._handle(handlers[message.topic], message, state)
            yield from self._numbered(sync.ready(message.received), state)
        yield from self._numbered(sync.flush(), state)

    def _numbered(self, frames: Iterator[Frame], state: ReadingState) -> Iterator[Frame]:
        """The frames, each with the number of its scan in the part of the recording that is read."""
        numbers = state.numbers
        for frame in frames:
            same = numbers.get(frame.received, ())
            yield replace(frame, index=same.pop(0) if same else frame.index)
            for received in [t for t in numbers if t < frame.received - 10 * MARGIN]:
                del numbers[received]  # of scans that were dropped

    def _handle(self, handler: Handler[RawMessage], message: RawMessage, state: ReadingState) -> None:
        try:
            handler(message)
        except MessageError as error:
            if message.data or not self.recording.is_dataset:  # of an empty one its file was told
                state.damage.add(message.topic, str(error))

    def _hold_throughout(
        self, state: ReadingState, handlers: Mapping[str, Handler[RawMessage]], low: int
    ) -> None:
        """Give what is published once to all frames, wherever in the bag it is.

        Of each static transform the last one before the start, else the first one after it; of transforms
        that hold until there are others, those before the start, or where they are many those of the first
        second.
        """
        counts = {topic.name: topic.count or 0 for topic in self.recording.topics}
        for name in self.roles.tf_held:
            few = counts[name] <= MOST_HELD
            stop = low - MARGIN if few else min(low - MARGIN, self.recording.start + SECOND)
            for message in self.recording.messages([name], None, stop):
                self._handle(handlers[name], message, state)
        static = {}
        for message in self.recording.messages(self.roles.tf_static):
            try:
                content = self.recording.decode(message)
                for transform in guard(message, decode_transforms, content, message.topic):
                    if message.received <= low or transform.child not in static:
                        static[transform.child] = transform
            except MessageError:
                continue  # counted when its turn comes
        for transform in static.values():
            state.sync.add_transform(transform, static=True)
        for topic in {camera.info_topic for camera in self.roles.cameras} - {""}:
            if (info := self.recording.first(topic)) is not None:
                with suppress(MessageError):  # counted when its turn comes
                    handlers[topic](info)

    def _find_driver(self) -> str:
        """The first LiDAR: its scans make the frames. Without one, the first camera."""
        driver = self.roles.driver
        if not driver:
            raise UserError(f"{self.recording.name}: {self.roles.no_lidar}")
        counts = {t.name: t.count for t in self.recording.topics if t.kind == "PointCloud2"}
        if self.roles.lidars and not counts[driver]:
            others = [name for name, count in counts.items() if count]
            helps = (
                f"choose another one: --set source.lidar_topics=[{others[0]}]"
                if others
                else "nor has any other"
            )
            raise UserError(f"{self.recording.name}: the LiDAR's topic {driver} has no messages; {helps}")
        return driver

    def _time(self, text: str | None, default: int) -> int:
        if text is None:
            return default
        if self.recording.single_frames:
            raise UserError(
                f"{text}: {self.recording.name} has single frames, which have no times; give a number "
                "(--frames, --at-frame)"
            )
        start, end = self.recording.start, self.recording.end
        time = parse_time(text, start)
        if not start - SECOND <= time <= end + SECOND:
            raise UserError(
                f"{text} is outside the recording, which has {(end - start) / SECOND:.1f} s from {iso(start)}"
            )
        return time

    def _narrow(self, time: int) -> None:
        """Read the scan nearest to ``time`` alone."""
        if not len(self.scans):
            return
        self._first = int(np.abs(self.scans - time).argmin())
        self._low = int(self.scans[self._first])
        self._high = self._low + 1

    def _choose(self, every: int, frames: tuple[int | None, int | None]) -> range:
        first, last = np.searchsorted(self.scans, [self._low, self._high])
        there = range(int(last - first))
        chosen = there[slice(*frames)][:: max(every, 1)]
        if not chosen:
            raise UserError(
                f"{self.recording.name}: {self._driver} has {len(there)} scans in the time asked for, "
                "and none of them is among --frames"
                if there
                else f"{self.recording.name}: {self._driver} has no scan in the time asked for"
            )
        return chosen


def parse_time(text: str, origin: int) -> int:
    """Nanoseconds since 1970 of ``12.5`` (seconds after ``origin``), ``1700000000.0`` or an ISO 8601 date.

    A date without a zone is in UTC.

    Raises:
        UserError: none of the three.
    """
    try:
        seconds = float(text)
    except ValueError:
        try:
            date = datetime.fromisoformat(text)
        except ValueError:
            raise UserError(
                f"'{text}' is no time: expected seconds from the start (12.5), seconds since 1970 "
                "(1700000000.0) or ISO 8601 (2026-11-21T10:00:00)"
            ) from None
        date = date if date.tzinfo else date.replace(tzinfo=UTC)
        return round(date.timestamp() * 1e6) * 1000
    if not np.isfinite(seconds) or seconds < 0:
        raise UserError(f"'{text}' is no time: expected seconds, zero or more")
    return round(seconds * SECOND) + (origin if seconds < EPOCH else 0)


def iso(nanoseconds: int) -> str:
    """A time in UTC to the millisecond: ``2026-11-21T10:00:00.500Z``."""
    date = datetime.fromtimestamp(nanoseconds // SECOND, UTC)
    return f"{date:%Y-%m-%dT%H:%M:%S}.{nanoseconds % SECOND // 1_000_000:03d}Z"
