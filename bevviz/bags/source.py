"""Frames from a recorded bag. It is read once from front to back, so memory does not grow with its length."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bevviz.bags.bag import Recording
from bevviz.bags.message import RawMessage
from bevviz.bags.remote import address_of
from bevviz.config import Config, stage_topics
from bevviz.datasets.dataset import NOT_AS_DOCUMENTED, describe_error
from bevviz.errors import UserError
from bevviz.messages.decoders import MessageError
from bevviz.messages.guard import guard
from bevviz.messages.roles import find_roles
from bevviz.messages.topics import CLOUDS
from bevviz.messages.transforms import StampedTransform, decode_transforms
from bevviz.model.frame import F64, I64, Frame, LabelledBoxes3D, Scene
from bevviz.support.contexts import Closable
from bevviz.support.limits import MAX_LATCHED
from bevviz.sync.clocks import LATENCY
from bevviz.sync.feed import Handler, make_handlers
from bevviz.sync.report import LARGE_LOSS, why_no_images
from bevviz.sync.synchronizer import Synchronizer

if TYPE_CHECKING:
    from bevviz.datasets.result_files import ResultFile

SECOND = 1_000_000_000
MARGIN = 2 * SECOND  # search range in nanoseconds for data of the first and the last cloud, at least
NEAR = SECOND // 2  # the same for clouds and images before a single cloud
WHOLE_IMAGES = ("Image", "CompressedImage")  # kinds that are decoded without the images before
HISTORY = 30 * SECOND  # nanoseconds of transforms that a run has
EPOCH = 1e8  # seconds; a larger number is a date since 1970


@dataclass(frozen=True)
class FrameSelection:
    """Selection of frames of a bag, with the options of ``BagSource``."""

    start: str | None = None
    end: str | None = None
    every: int = 1
    frames: tuple[int | None, int | None] | None = None

    def source(self, paths: Sequence[Path], config: Config) -> BagSource:
        """Open the bag with this selection."""
        return BagSource(paths, config, start=self.start, end=self.end, every=self.every, frames=self.frames)


class BagSource(Closable):
    """Frames of one recording, which may consist of several bags.

    Args:
        paths: bag files or folders.
        config: topic roles and synchronisation.
        start: first log time, see ``parse_time``.
        end: log time to stop at.
        every: use only each N-th scan; the others are not decoded.
        frames: use only the scans A to B - 1 between ``start`` and ``end``, as in a Python slice.
        at: use only the scan nearest to this log time. It keeps its number of the whole recording.

    Raises:
        UserError: no bag, an empty bag, no LiDAR, or no scan in the selected part.
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
        self.recording = Recording(paths, config.source)
        try:
            self.results = self._open_results()
            topics = [*self.recording.topics, *(file.described for file in self.results)]
            self.roles = find_roles(topics, config.source, stage_topics(config))
            self._driver = self._find_driver()
            self._low = self._time(start, self.recording.start)
            self._high = self._time(end, self.recording.end + 1)
            self._skipped = 0  # scans before that with the number zero
            self._chosen = self._choose(at, every, frames or (None, None))
        except BaseException:
            self.close()
            raise
        self._sync: Synchronizer | None = None  # that of the latest read
        self._checked: set[str] = set()  # see VerticalEstimate; for single frames

    def close(self) -> None:
        """Close the recording."""
        self.recording.close()

    @property
    def scene(self) -> Scene:
        """Static scene with the bag paths and the topics in use."""
        scene = self.roles.scene(self.recording.name)
        # An address may hold a signature, and a recording is handed on.
        local_paths = tuple(path for path in self.recording.paths if not address_of(path))
        return replace(scene, bag=local_paths, topics=self.roles.settings)

    @property
    def total(self) -> int:
        """Number of selected frames."""
        return len(self._chosen)

    @property
    def warnings(self) -> Sequence[str]:
        """All warnings about the recording and the frames read so far."""
        report = self._sync.report if self._sync else None
        synced = report.warnings() if report else ()
        blind = why_no_images(self.config, self.roles, report)
        alone = [f"{self.roles.no_lidar}: the frames are {self._driver}'s"] if self.roles.no_lidar else []
        robots = [self.roles.robots] if self.roles.robots else []
        return [*self.recording.warnings, *robots, *alone, *self._damage, *blind, *synced]

    @property
    def _damage(self) -> Sequence[str]:
        """Unusable messages, one sentence for each topic."""
        return self._sync.report.unusable.sentences if self._sync else ()

    @property
    def noun(self) -> str:
        """Name of a message that makes a frame: a scan, or an image without a LiDAR."""
        return "scan" if self.roles.lidars else "image"

    def large_losses(self) -> Iterator[str]:
        """Yield a sentence for each large loss among the messages read so far that should make frames."""
        if self._sync is None:
            return
        report, damaged = self._sync.report, self._sync.report.unusable.counts[self._driver]
        read = report.queued + damaged
        heard = f"of the first {read} {self.noun}s"
        if report.stale > LARGE_LOSS * read:
            helps = ": --set sync.by=received" if report.receipt_helps() else ""
            yield f"a run drops {report.stale} {heard}, whose stamps repeat or go back{helps}"
        if damaged > LARGE_LOSS * read:
            yield f"a run cannot use {damaged} {heard}, see the warnings"

    @property
    def doubts(self) -> Sequence[str]:
        """Unusable data of the frames read so far, and problems that may affect all frames."""
        if self._sync is None:
            return []
        report = self._sync.report
        robots = [self.roles.robots] if self.roles.robots else []
        return [*robots, *self._damage, *map(str, [*report.losses(), *report.doubts()])]

    @property
    def span(self) -> tuple[int, int]:
        """Log times of the selected part: start <= time < stop."""
        return self._low, self._high

    @property
    def tree(self) -> Mapping[str, str]:
        """Transforms met so far: parent by child."""
        return self._sync.tf.tree() if self._sync else {}

    def pose(self, frame: Frame, stamp: int) -> F64 | None:
        """Return (4, 4) fixed_from_points at a stamp close to that of a recent frame.

        None: there is no fixed frame above the points, or the transforms read so far do not reach the stamp.
        """
        return self._sync.placing.pose(frame, stamp) if self._sync else None

    @cached_property
    def scans(self) -> I64:
        """Log times of all scans of the recording in nanoseconds. The index of a scan is its frame number."""
        return self.recording.scan_times(self._driver)

    def number_at(self, time: str | float) -> int:
        """Return the number of the scan nearest to a time, see ``parse_time``.

        Raises:
            UserError: the text is no time, or the time is outside the recording.
        """
        if not len(self.scans):
            raise UserError(f"{self.recording.name}: {self._driver} has no {self.noun} that can be read")
        return int(np.abs(self.scans - self._time(str(time), 0)).argmin())

    def checked(self, number: int) -> int:
        """Return the number of a scan if the scan exists.

        Raises:
            UserError: there is no scan with this number.
        """
        if not 0 <= number < len(self.scans):
            raise UserError(
                f"frame {number}: {self.recording.name} has {len(self.scans)} {self.noun}s, counted from 0"
            )
        return number

    def frame(self, number: int) -> Frame | None:
        """Read the frame of one scan of the recording, selected or not; None if it cannot be read.

        It is the frame that a run over all scans makes of the scan.

        Raises:
            UserError: there is no scan with this number.
        """
        only = range(self.checked(number), number + 1)
        return next(self._frames(only, self._checked), None)

    @property
    def numbers(self) -> range:
        """Numbers of the selected frames."""
        chosen = self._chosen
        return range(chosen.start - self._skipped, chosen.stop - self._skipped, chosen.step)

    def __iter__(self) -> Iterator[Frame]:
        return (
            replace(frame, index=frame.index - self._skipped) if self._skipped else frame
            for frame in self._frames(self._chosen)
        )

    def _frames(self, chosen: range, checked: set[str] | None = None) -> Iterator[Frame]:
        """Yield the frames of some scans. Their numbers are those of the whole recording.

        A single frame reads few old images, which are most of a drive. If its images are older, as with a
        LiDAR that is received late, more of them are read.
        """
        reach, alone = self._near if len(chosen) == 1 else self._reach, False
        late = 0
        while True:
            sync = self._sync = Synchronizer(self.roles, self.config)
            sync.upright.checked = checked
            sync.absent = frozenset(file.topic for file in self.results)  # No message comes on these topics.
            frames = self._read(sync, chosen, reach, late, alone)
            if len(chosen) > 1 or alone:
                break
            single = next(frames, None)
            frames = iter(() if single is None else (single,))
            if single is None:  # A run drops it, since another scan has its stamp or a later one.
                alone = True
                continue
            late_now = self._lateness(sync, single)
            if late >= late_now and (reach == self._reach or sync.reaches(single.stamp, self._silent)):
                break
            reach, late = min(4 * reach, self._reach), max(late, late_now)
        # Result files number the scans of the whole recording.
        yield from map(self._with_results, frames) if self.results else frames

    def _read(self, sync: Synchronizer, chosen: range, reach: int, late: int, alone: bool) -> Iterator[Frame]:
        """Yield the frames of some scans.

        Args:
            sync: new synchroniser.
            chosen: numbers of the scans.
            reach: nanoseconds before the first scan from which on images and clouds are read.
            late: nanoseconds by which clouds are received later than transforms.
            alone: whether a single scan is read as if there were no others.
        """
        stop = int(self.scans[chosen[-1]]) + self._after + 1
        handlers = make_handlers(sync, self.roles, self.recording.decode, self.recording.packets)
        low = int(self.scans[chosen[0]])
        if len(chosen) > 1 and chosen[0] == 0:
            reach = max(reach, low - self.recording.start)
        self._feed_latched(sync, handlers, low)
        light = handlers.keys() - self._heavy
        before = self.recording.messages(light, low - max(MARGIN, reach) - late, low - reach, few=True)
        buffered = self._buffered(low, reach) if reach >= self._reach else ()
        number, received = -1, -1
        for message in chain(buffered, before, self.recording.scans(handlers.keys(), low - reach, stop)):
            if message.topic == self._driver:
                # Scans may have equal log times: they count on from the first of them.
                again = message.received == received
                number = number + 1 if again else int(np.searchsorted(self.scans, message.received))
                sync.number = number
                received = message.received
                if number not in chosen:
                    if len(chosen) == 1 and not alone:
                        self._feed_neighbour(message, sync)
                        yield from sync.ready(message.received)
                    continue
            elif message.topic in self.roles.lidars and not (number in chosen or number + 1 in chosen):
                continue
            self._handle(handlers[message.topic], message, sync)
            yield from sync.ready(message.received)
        yield from sync.flush()

    def _lateness(self, sync: Synchronizer, frame: Frame) -> int:
        """Return how much later than transforms a scan was received, nanoseconds; 0 if that is usual."""
        usual = [lag for topic in self.roles.tf if (lag := sync.clocks.lag(topic)) is not None]
        late = frame.received - frame.stamp - round(min(usual, default=0.0) * SECOND)
        return late if MARGIN // 2 < late < HISTORY else 0

    def _buffered(self, low: int, reach: int) -> Iterator[RawMessage]:
        """Yield the older images and clouds that a run still has when a scan is received.

        A buffer keeps messages that are not older than the newest one by ``reach``, and one more.
        """
        for topic in sorted(self._heavy - {self._driver}):
            times = self.recording.scan_times(topic)
            times = times[: np.searchsorted(times, low, "right")]
            if len(times):
                first = max(0, int(np.searchsorted(times, times[-1] - reach)) - 1)
                yield from self.recording.scans([topic], int(times[first]), low - reach)

    def _feed_neighbour(self, message: RawMessage, sync: Synchronizer) -> None:
        """Feed the stamp of a scan next to a single one. So the single frame takes what it takes in a run."""
        with suppress(MessageError):  # A data set and single packets have no header: their stamps agree.
            stamp, frame_id = message.header()
            sync.add_neighbour(message.topic, stamp, frame_id, message.received)

    @cached_property
    def _heavy(self) -> set[str]:
        """Topics with clouds and with whole images."""
        images = {topic.name for topic in self.recording.topics if topic.kind in WHOLE_IMAGES}
        return {
            *self.roles.lidars,
            *(camera.topic for camera in self.roles.cameras if camera.topic in images),
        }

    @cached_property
    def _silent(self) -> set[str]:
        """Topics without messages."""
        return {topic.name for topic in self.recording.topics if not topic.count}

    @cached_property
    def _near(self) -> int:
        """Nanoseconds before a cloud in which the cloud before it and an image of each camera are, mostly."""
        rates = [topic.rate or 0.0 for topic in self.recording.topics if topic.name in self._heavy]
        slowest = min(rates, default=0.0)
        nearest = max(NEAR, 2 * round(self.config.sync.tolerance * SECOND))
        return min(self._reach, max(nearest, round(3 * SECOND / slowest))) if slowest else self._reach

    @cached_property
    def _reach(self) -> int:
        """Nanoseconds before a cloud in which all messages are that its frame may take."""
        sync = self.config.sync
        return max(MARGIN, round((sync.max_wait + sync.tolerance + LATENCY) * SECOND))

    @cached_property
    def _after(self) -> int:
        """Nanoseconds after a cloud in which all messages are that its frame may take."""
        return max(MARGIN, round(self.config.sync.max_wait * SECOND))

    def _handle(self, handler: Handler[RawMessage], message: RawMessage, sync: Synchronizer) -> None:
        try:
            handler(message)
        except MessageError as error:
            # An empty message of a data set has a warning already.
            if message.data or not self.recording.is_dataset:
                sync.report.unusable.add(message.topic, str(error))

    def _feed_latched(
        self, sync: Synchronizer, handlers: Mapping[str, Handler[RawMessage]], low: int
    ) -> None:
        """Feed data that is published once, such as static transforms, before the first frame.

        Each static transform is the last one before the start, or else the first one after it. Latched
        transforms are those before the start, or only those of the first second if there are too many.
        """
        for name, few, messages in self._held:
            stop = low - MARGIN if few else min(low - MARGIN, self.recording.start + SECOND)
            for message in messages:
                if message.received < stop:
                    self._handle(handlers[name], message, sync)
        known = set[str]()
        for received, topic, transform in self._static:
            if received <= low or transform.child not in known:
                known.add(transform.child)
                sync.add_transform(transform, static=True, topic=topic)
        for info in self._infos:
            with suppress(MessageError):  # The error is counted when the message itself is handled.
                handlers[info.topic](info)
        sync.report.unstamped.clear()  # So are missing stamps.

    # Every read begins with these messages. To find them takes time that grows with the length of the drive.

    @cached_property
    def _held(self) -> list[tuple[str, bool, list[RawMessage]]]:
        """Latched transforms by topic, and whether these are all of it or those of the first second."""
        counts = {topic.name: topic.count or 0 for topic in self.recording.topics}
        few = {name: counts[name] <= MAX_LATCHED for name in self.roles.tf_held}
        stops = {name: None if all_ else self.recording.start + SECOND for name, all_ in few.items()}
        return [
            (name, few[name], [*map(_copied, self.recording.messages([name], None, stop))])
            for name, stop in stops.items()
        ]

    @cached_property
    def _static(self) -> list[tuple[int, str, StampedTransform]]:
        """Static transforms that differ from the one before, with the times of receipt and the topics."""
        transforms, last = list[tuple[int, str, StampedTransform]](), dict[str, StampedTransform]()
        for message in self.recording.messages(self.roles.tf_static):
            with suppress(MessageError):  # The error is counted when the message itself is handled.
                content = self.recording.decode(message)
                for transform in guard(message, decode_transforms, content, message.topic):
                    former = last.get(transform.child)
                    if former is None or not _same_edge(former, transform):
                        transforms.append((message.received, message.topic, transform))
                    last[transform.child] = transform
        return transforms

    @cached_property
    def _infos(self) -> list[RawMessage]:
        """First calibration of each camera."""
        topics = sorted({camera.info_topic for camera in self.roles.cameras} - {""})
        first = (self.recording.first(topic) for topic in topics)
        return [_copied(message) for message in first if message is not None]

    def _open_results(self) -> list[ResultFile]:
        """Open the result files that the configuration names."""
        results = self.config.source.results
        if not results:
            return []
        from bevviz.datasets.result_files import open_results

        driver = find_roles(self.recording.topics, self.config.source).driver
        scans = len(self.recording.scan_times(driver)) if driver else 0
        samples, tell = self.recording.sample_stamps, self.recording.note
        return open_results(results, self.recording.folder, scans, samples, tell)

    def _with_results(self, frame: Frame) -> Frame:
        """Return a frame with the boxes of the result files."""
        boxes, detections, problems = [*frame.robot_boxes], [*frame.robot_detections], [*frame.problems]
        for file in self.results:
            try:
                labelled = file.of(frame)
            except UserError as error:
                problems.append(str(error))
                continue
            except NOT_AS_DOCUMENTED as error:
                problems.append(f"{file.path}: not as documented ({describe_error(error)})")
                continue
            if labelled is not None and self._sync is not None:
                self._sync.report.note_boxes(labelled)
            if isinstance(labelled, LabelledBoxes3D):
                boxes.append(labelled)
            elif labelled is not None:
                detections.append(labelled)
        return replace(
            frame, robot_boxes=tuple(boxes), robot_detections=tuple(detections), problems=tuple(problems)
        )

    def _find_driver(self) -> str:
        """Return the first LiDAR topic, or else the first camera topic. Its messages make the frames."""
        driver = self.roles.driver
        if not driver:
            raise UserError(f"{self.recording.name}: {self.roles.no_lidar}")
        counts = {t.name: t.count for t in self.recording.topics if t.kind in CLOUDS}
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

    def _choose(self, at: str | None, every: int, frames: tuple[int | None, int | None]) -> range:
        """Return the numbers of the selected scans in the whole recording."""
        if at is not None and len(self.scans):
            number = self.number_at(at)
            self._low = int(self.scans[number])
            self._high = self._low + 1
            return range(number, number + 1)
        first, last = map(int, np.searchsorted(self.scans, [self._low, self._high]))
        self._skipped = first
        chosen = range(first, last)[slice(*frames)][:: max(every, 1)]
        if not chosen:
            raise UserError(
                f"{self.recording.name}: {self._driver} has {last - first} {self.noun}s in the time asked "
                "for, and none of them is among --frames"
                if last > first
                else f"{self.recording.name}: {self._driver} has no {self.noun} in the time asked for"
            )
        return chosen


def _same_edge(a: StampedTransform, b: StampedTransform) -> bool:
    return a.parent == b.parent and np.array_equal(a.parent_from_child, b.parent_from_child)


def _copied(message: RawMessage) -> RawMessage:
    """Return a message that does not hold the memory of its chunk."""
    return replace(message, data=bytes(message.data))


def parse_time(text: str, origin: int) -> int:
    """Parse a time to nanoseconds since 1970.

    Accepted are seconds after ``origin`` (``12.5``), seconds since 1970 (``1700000000.0``) and ISO 8601.
    A date without a zone is in UTC.

    Raises:
        UserError: the text has none of these forms.
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
    """Format a time in UTC to the millisecond: ``2026-11-21T10:00:00.500Z``."""
    date = datetime.fromtimestamp(nanoseconds // SECOND, UTC)
    return f"{date:%Y-%m-%dT%H:%M:%S}.{nanoseconds % SECOND // 1_000_000:03d}Z"
