"""A running robot as the source of a page: every frame of the held seconds can be asked about.

The results of the newest frames are in memory. Earlier ones are made again from the messages.
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict, deque
from collections.abc import Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.findings.frame_findings import KINDS, find_findings
from bevviz.live.encoder import sample_rows
from bevviz.live.runtime import Live, ObservingSession
from bevviz.live.status import give_way
from bevviz.model.frame import Frame
from bevviz.model.results import FrameResult, Tracks
from bevviz.recording import entities
from bevviz.recording.addresses import EntityRows
from bevviz.recording.frame_logger import logged_rows
from bevviz.why import Answer, Selection
from bevviz.why.log import dim_others, mark_answers
from bevviz.why.robot_questions import RobotQuestions
from bevviz.workbench.buffers import PageState, Reader
from bevviz.workbench.growing_drive import GrowingDrive, RunProgress, Settings
from bevviz.workbench.held_seconds import FrameFacts, HeldSeconds
from bevviz.workbench.jobs import Job, Jobs
from bevviz.workbench.live_buffer import LiveBuffer
from bevviz.workbench.page_overlay import Attempt, PageOverlay
from bevviz.workbench.piece_logger import PieceLogger
from bevviz.workbench.reports import ReportedBag, ReportMaker
from bevviz.workbench.session import WorkbenchSession

if TYPE_CHECKING:
    from bevviz.workbench.page_types import Held, Hold, ListHeld, Mark, Said, Snap

KEPT = 4  # held frames that are kept
BEFORE = 500_000_000  # nanoseconds of messages before a scan that its frame needs
AFTER = 1_000_000_000  # nanoseconds after a scan in which the robot's last node has made something of it
BAGS = 2  # bags of held seconds that are kept: a report may be cut from the one before the newest
LISTED_FRAMES = 64  # frames of the held seconds that are listed
LISTED = tuple(KINDS)


def robot_session(live: Live) -> WorkbenchSession:
    """Return the workbench session of a live run that has not started."""
    robot = RunningRobot(live)
    folder = Path(live.config.live.flight_folder).absolute()
    reports = None if live.source.raw is None else ReportMaker(robot.news.tell, robot.bag_of, folder)
    return WorkbenchSession(robot, reports)


class RunningRobot(GrowingDrive):
    """Running robot as the source of a page.

    Changed parameters are in force for all later frames.

    Args:
        live: the live run, before it starts.

    Attributes:
        recording: buffer with the newest pieces of the recording.
        findings: findings in the frame that was held last.
    """

    def __init__(self, live: Live) -> None:
        super().__init__(live.scene.name, live.session)
        self.live = live
        self._newest: deque[FrameResult] = deque(maxlen=live.config.live.held)
        self._held: OrderedDict[int, FrameResult] = OrderedDict()  # results that stay, by number
        self._facts: dict[int, FrameFacts] = {}  # of the frames that can be asked about, by number
        self.recording = LiveBuffer(live, live.config.live.output_queue)
        self.commands = {"hold": self._hold, "list": self._list, "snap": self._snap, "mark": self._mark}
        self._start = 0  # first stamp of the held seconds; frames that are kept from earlier do not count
        self._bags: deque[HeldSeconds] = deque()  # guarded by _reading
        self._whole: set[int] = set()  # frames that pages got again, with all points
        self._listing: Jobs[Job] = Jobs("list", self.news.tell)
        self._settings: Settings = ()  # settings that pages have changed
        encoder = live.encoder
        self._marker = PieceLogger(encoder.application, encoder.recording_id, live.config, live.scene)
        live.outputs.attach(self.recording)
        live.watchers.append(self.observe)
        self.recording.news.listen(self.news.tell)  # There is news while no frame comes, too.

    def close(self) -> None:
        """Close the buffer of the pages, and delete the bags."""
        self._listing.end()
        self.recording.close()
        with self._reading:
            while self._bags:
                self._bags.pop().close()

    def progress(self) -> RunProgress:
        """Return the progress of the run for the page."""
        live = self.live
        drops = ", ".join(f"{count} {where}" for where, count in live.drops.items() if count)
        return {
            "done": live.frames,
            "total": None,
            "over": True,
            "error": self.live.silence,
            "warnings": [f"{1e3 * live.health.percentile(50):.0f} ms", f"dropped: {drops or 'none'}"],
            "problems": [
                {"text": str(problem), "seconds": max(0, round(time.time() - problem.since))}
                for problem in self.live.problems.current
            ],
            # Frames that are kept from before the held seconds, and the first frame of these.
            "held": [str(stamp) for stamp, _ in self.frame_times() if stamp <= self._start],
        }

    def observe(self, result: FrameResult) -> None:
        """Keep a new frame."""
        self.know(result.frame)
        with self._lock:
            self._newest.append(result)
            self._facts[result.frame.index] = FrameFacts.of(result)
        self._forget_gone()
        self.has_truth |= result.frame.truth is not None
        self.news.tell()

    def reader(self, lane: str, first: int, state: PageState) -> AbstractContextManager[Reader]:
        """Return a context in which a page reads the newest pieces. Marks of answers are among them."""
        return self.recording.shown(state)

    # --- frames --------------------------------------------------------------------------------

    def tracks(self, number: int) -> Tracks | None:
        """Return the tracks of the live run in a frame. None: the frame is gone."""
        facts = self._facts.get(number)
        return None if facts is None else facts.tracks

    def _shown_results(self) -> dict[int, FrameResult]:
        """Return the results of the held frames and of the newest ones."""
        return {result.frame.index: result for result in (*self._held.values(), *self._newest)}

    def _config_of(self, number: int, settings: Settings) -> Config:
        """Return the configuration of a frame as shown: parameters may have changed since."""
        facts = self._facts.get(number)
        return super()._config_of(number, settings) if settings or facts is None else facts.config

    def _forget_gone(self) -> None:
        """Forget the frames whose messages and results are gone, and find the first of the others."""
        raw = self.live.source.raw
        oldest = math.inf if raw is None else raw.since + BEFORE
        with self._lock:
            newest = {result.frame.index for result in self._newest}
            stamps = []
            for number, facts in list(self._facts.items()):
                if facts.received >= oldest or number in newest:
                    stamps.append(facts.stamp)
                elif number not in self._held:
                    del self._facts[number]
                    self._times.remove((self._stamps.pop(number), number))
                    self._whole.discard(number)
            self._start = min(stamps, default=0)

    def _shown_at(self, stamp: int) -> tuple[int | None, int]:
        """Return the numbers of the frame that a viewer shows and of the first of the held seconds.

        The first number is None if the frame is gone. The frames between a kept one and the held seconds are.

        Raises:
            UserError: no frame has come yet.
        """
        times, start = self.frame_times(), self._start
        if not times:
            raise UserError("no frame has come yet")
        first = next((number for at, number in times if at >= start), times[-1][1])
        at, shown = self.shown_at(stamp) or (0, None)
        is_gone = at < start and stamp > at + entities.TIME_TOLERANCE
        return None if is_gone else shown, first

    def number_at(self, stamp: int) -> int:
        """Return the number of the frame that a viewer shows at a stamp.

        Raises:
            UserError: the frame is no longer in memory.
        """
        number, _ = self._shown_at(stamp)
        if number is None:
            seconds = (self.frame_times()[-1][0] - self._start) / 1e9
            raise UserError(
                f"that frame is gone: the last {seconds:.0f} s can be asked about "
                "(live.flight_time, live.raw_size); hold a frame with H to keep it"
            )
        return number

    def hold(self, stamp: int) -> FrameResult:
        """Keep the frame that a viewer shows, so that it can be asked about later.

        At most ``KEPT`` frames are kept. If the frame is gone because the viewer lags behind, the oldest
        frame in memory is held.

        Raises:
            UserError: no frame has come yet, or it cannot be made again.
        """
        self._listing.end()
        shown, oldest = self._shown_at(stamp)
        number = oldest if shown is None else shown
        self._show_again(number)
        result = self.look(number)
        index = result.frame.index
        with self._lock:
            self._held[index] = result
            self._held.move_to_end(index)
            while len(self._held) > KEPT:
                self._held.popitem(last=False)
        self._forget_gone()
        self.findings.replace(LISTED)
        self.findings.add(find_findings(self.explainer(result)))
        self.news.tell()
        return result

    def _show_again(self, number: int) -> None:
        """Send a frame again from the flight recorder, if a page was opened after it."""
        delivered = self._facts.get(number)
        if delivered is None or self.recording.opened < delivered.logged or number in self._whole:
            return
        packets = [packet for packet in self.live.flight.packets() if packet.time <= delivered.logged]
        start = max((row for row, packet in enumerate(packets) if packet.whole), default=len(packets))
        for packet in packets[start:]:
            self.recording.add(self.live.encoder.header + packet.data)
        if start < len(packets):
            first = packets[start].time
            with self._lock:
                again = self._facts.items()
                self._whole.update(n for n, one in again if first <= one.logged <= delivered.logged)

    def read(self, number: int) -> Frame:
        """Make a frame again from the messages.

        Raises:
            UserError: the frame is gone, or cannot be made again.
        """
        bag, facts = self._bag(number)
        return bag.frame(facts)

    def look_aside(self, number: int) -> FrameResult:
        """Return the result of a frame for background work. The pipeline itself is busy with the robot."""
        return self.look(number)

    def _perceived(self, frame: Frame, config: Config) -> FrameResult:
        """Return the result of a frame. One with the values of the live run has the tracks of it."""
        facts = self._facts.get(frame.index)
        if isinstance(self.live.session, ObservingSession):
            result = FrameResult.unprocessed(frame, config)
        else:
            result = super()._perceived(frame, config)
        return result if facts is None or config != facts.config else replace(result, tracks=facts.tracks)

    def _bag(self, number: int, end: int = 0) -> tuple[HeldSeconds, FrameFacts]:
        """Return the bag that has a frame, which is made if no bag has it, and facts about the frame.

        Args:
            number: number of the frame.
            end: time up to which the bag must have messages, in nanoseconds.
        """
        for bag in reversed(self._bags):
            if number in bag.frames and bag.made >= end:
                return bag, bag.frames[number]
        with self._lock:
            frames = {n: facts for n, facts in self._facts.items() if facts.stamp >= self._start}
        raw = self.live.source.raw
        if raw is None or number not in frames:
            raise UserError(f"frame {number} is gone: hold one with H, and ask then")
        self._bags.append(HeldSeconds(raw.messages(), frames))
        while len(self._bags) > BAGS:
            self._bags.popleft().close()
        return self._bags[-1], frames[number]

    def bag_of(self, number: int) -> ReportedBag:
        """Return the bag of a frame for a report.

        Raises:
            UserError: the frame is gone, or the bag cannot be written.
        """
        with self._reading:
            bag, delivered = self._bag(number)
            return ReportedBag([bag.path], delivered.config, bag.start(delivered))

    # --- questions -----------------------------------------------------------------------------

    def robot_questions(self, number: int) -> RobotQuestions | None:
        """Return the questions about the robot's chain in the held seconds, see ``GrowingDrive``."""
        if self.live.source.raw is None or len(self.live.source.raw.object_topics) < 2:
            return None
        frame = self.look(number).frame
        end = frame.received + AFTER
        time.sleep(min(max(0, end - time.time_ns()), AFTER) * 1e-9)
        with self._reading:
            bag, delivered = self._bag(number, end)
            return bag.robot_questions(delivered, frame)

    def asked_settings(self, settings: Settings, again: bool) -> Settings:
        """Return the settings that a question is about.

        A click is about the frame as it was shown. A question that selects an object by its name is about the
        settings in force.
        """
        return self._settings if again else ()

    def select(
        self, number: int, settings: Settings, path: str, instance: int | None, position: Sequence[float]
    ) -> Selection | None:
        """Return the selection of a click in a frame, see ``select_click``."""
        result = self.look(number)
        points = None if number in self._whole else result.config.live.viewer_points
        if instance is not None and points is not None and path == entities.POINTS.path(result.frame.lidar):
            rows = sample_rows(len(result.frame.points), points, result.frame.index)
            instance = int(rows[instance]) if instance < len(rows) else None
        return super().select(number, settings, path, instance, position)

    def entity_rows(self, number: int, settings: Settings) -> EntityRows:
        """Return the rows behind the entities of a frame as it was drawn."""
        return self.live.encoder.rows.get(number) or logged_rows(self.look(number))

    def mark(self, result: FrameResult, answer: Answer, overlay: PageOverlay | None = None) -> None:
        """Mark the object of an answer in every view of all pages."""
        mark_answers(self._marker, result.frame, [answer], result.config.bev)
        dim_others(self._marker, result, answer)
        self.recording.add(self._marker.piece())

    def try_values(
        self, number: int, settings: Settings, attempt: Attempt | None = None
    ) -> tuple[FrameResult, FrameResult]:
        """Change parameters of the running robot. Return the result of one frame before and after.

        A parameter that a page changed before and that is not in ``settings`` gets its configured value back.

        Raises:
            UserError: a parameter is unknown, or a value is wrong. Nothing is changed.
        """
        before = self.look(number)
        if settings != self._settings:
            self.live.settings.take(settings, without=self._settings)
        self._settings = settings
        return before, self._perceived(before.frame, self.live.config)

    def configured(self, settings: Settings) -> Config:
        """Return the configuration in force, which has taken on the settings."""
        return self.live.config

    # --- commands of the page ------------------------------------------------------------------

    def _hold(self, message: Hold) -> Held:
        """Hold the shown frame."""
        frame = self.hold(round(message["time"])).frame
        return {"type": "held", "frame": frame.index, "stamp": str(frame.stamp)}

    def _list(self, message: ListHeld) -> Said:
        """Begin to list the findings of the held seconds, frame by frame, at the lowest priority."""
        self._listing.end()
        numbers = [number for _, number in self.frame_times()]
        step = -(-len(numbers) // LISTED_FRAMES)
        self.findings.replace(LISTED)
        self._listing.start(Job(0), partial(self._list_frames, numbers[::step]))
        every = "frame" if step == 1 else f"{step} frames"
        return {"type": "said", "text": f"Listing the held seconds, each {every} ..."}

    def _list_frames(self, numbers: Sequence[int], job: Job) -> None:
        give_way()
        for number in numbers:
            start = time.monotonic()
            with suppress(UserError):  # The frame is gone meanwhile.
                findings = find_findings(self.explainer(self.look(number)))
                job.check()
                self.findings.add(findings)
                self.news.tell()
            job.stop.wait(time.monotonic() - start)  # The run gets at least half of the time.
            job.check()

    def _snap(self, message: Snap) -> Said:
        """Save the flight recorder."""
        return {"type": "said", "text": f"saved in {self.live.flight.save()}"}

    def _mark(self, message: Mark) -> Said:
        """Mark the shown frame, as a message on the robot's topic of marks does, and on the terminal."""
        number = self.number_at(round(message["time"]))
        text = message["text"].strip() or "look here"
        self.live.source.mark(f"{text} (frame {number})")
        text = f"mark at frame {number}: {text}"
        self.live.notes.info(text)
        return {"type": "said", "text": text}
