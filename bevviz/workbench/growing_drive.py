"""A drive that pages ask about. It grows: while a bag is run, or beside a robot."""

from __future__ import annotations

import bisect
import threading
from abc import abstractmethod
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from itertools import takewhile
from typing import Any, Literal, NotRequired

import numpy as np
from typing_extensions import TypedDict  # pydantic needs this one before Python 3.12

from bevviz.config import Config, changed_config
from bevviz.errors import UserError
from bevviz.evaluate import Truth, truth_of
from bevviz.evaluate.ground_truth import TruthLookup
from bevviz.findings.finding_list import FindingList
from bevviz.model.frame import F32, F64, Frame
from bevviz.model.results import FrameResult, Tracks
from bevviz.pipeline.perceive import add_explanations
from bevviz.pipeline.session import Session, Variants, check_same_frames
from bevviz.recording import entities
from bevviz.recording.addresses import EntityRows
from bevviz.support.contexts import Closable
from bevviz.why import Answer, FrameExplainer, Selection
from bevviz.why.click import select_click
from bevviz.why.robot_questions import RobotObject, RobotQuestions
from bevviz.workbench.buffers import News, PageState, Reader
from bevviz.workbench.page_overlay import Attempt, PageOverlay

Settings = tuple[str, ...]


class Span(TypedDict):
    """Frames from one stamp to another."""

    first: str
    last: str


class Problem(TypedDict):
    """Problem of the robot's data, and the seconds for which it has lasted."""

    text: str
    seconds: int


class RunProgress(TypedDict):
    """Progress of the source: ``phase`` of a drive, ``problems`` and ``held`` of a robot."""

    done: int
    total: int | None
    over: bool
    error: str
    warnings: list[str]
    phase: NotRequired[Literal["overview", "again", "run"]]
    problems: NotRequired[list[Problem]]
    held: NotRequired[list[str]]


RESULTS = 6  # results of frames that were asked about
READ = 4  # frames that are kept as they were read


class GrowingDrive(Closable):
    """Drive that pages ask about, with the frames that exist now.

    Subclasses differ in where a frame comes from: a bag on demand, or the held seconds of a robot.

    Args:
        title: name of the drive or the robot.
        pipeline: pipeline session with the configuration in force and the loaded networks.

    Attributes:
        has_truth: whether frames carry ground truth.
        scans: number of scans. 0 for a robot.
        single_frames: the frames are unrelated, and their stamps are made up.
        findings: findings, grouped over frames.
        news: tells of each new frame and of all other news for the page.
        first: stamp that the page counts seconds from.
        kept_labels: returns the labels of a frame that the user keeps.
        opening: stamp of the frame that a page opens at. None: no frame is shown yet, or the newest one.
        commands: further messages of the page by type, each with the function that returns the reply.
    """

    def __init__(self, title: str, pipeline: Session) -> None:
        self.title, self.pipeline, self.has_truth = title, pipeline, False
        self.scans, self.single_frames = 0, False
        self.findings, self.news = FindingList(), News()
        self.opening: int | None = None
        self.kept_labels: TruthLookup = lambda frame: None
        self._remarks: dict[tuple[int, str], Answer] = {}  # by frame and text of the selection
        self._remarking = threading.Lock()
        self.following = threading.Lock()  # guards the bag that the robot's chain is read from
        self._aside: FrameExplainer | None = None
        self.first = 0
        self.commands: Mapping[str, Callable[[Any], Mapping[str, Any]]] = {}
        self._results: OrderedDict[tuple[int, Settings], FrameResult] = OrderedDict()
        self._stamps: dict[int, int] = {}  # of each known frame, by number, the newest known last
        self._times: list[tuple[int, int]] = []  # stamp and number of each known frame, sorted
        self._lock = threading.Lock()  # guards the results and stamps. Nobody computes with it
        self._frames: OrderedDict[int, Frame] = OrderedDict()  # frames as read, by number
        self._reading = threading.RLock()  # guards the reading of frames
        self._making: defaultdict[tuple[int, Settings], threading.Lock] = defaultdict(threading.Lock)
        self._variants = Variants(pipeline.loader)

    # --- frames --------------------------------------------------------------------------------

    def know(self, frame: Frame) -> None:
        """Keep the stamp of a frame that can be asked about."""
        with self._lock:
            if frame.index not in self._stamps:
                self._stamps[frame.index] = frame.stamp
                bisect.insort(self._times, (frame.stamp, frame.index))

    def frame_times(self) -> list[tuple[int, int]]:
        """Return stamp and number of each frame that a page can show."""
        with self._lock:
            return list(self._times)

    def unsent_frames(self, sent_numbers: set[int]) -> list[tuple[int, int]]:
        """Return stamp and number of each frame that a page does not have. Add them to its numbers."""
        with self._lock:
            new = [*takewhile(lambda number: number not in sent_numbers, reversed(self._stamps))]
            sent_numbers.update(new)
            if len(sent_numbers) > len(self._stamps):  # Frames of a robot are forgotten.
                sent_numbers.intersection_update(self._stamps)
            return sorted((self._stamps[number], number) for number in new)

    def shown_at(self, stamp: int) -> tuple[int, int] | None:
        """Return stamp and number of the known frame that a viewer shows at a stamp. None: there is none."""
        times = self.frame_times()
        row = bisect.bisect_right(times, (stamp + entities.TIME_TOLERANCE, 2**62))
        return times[row - 1] if row else None

    @abstractmethod
    def tracks(self, number: int) -> Tracks | None:
        """Return the tracks of the run in a frame, without their trails. None: the run has not reached it."""

    def look(self, number: int, settings: Settings = ()) -> FrameResult:
        """Return the result of a frame, with other values if ``settings`` names some.

        Raises:
            UserError: there is no such frame, a parameter is unknown, or a value is wrong.
        """
        key = number, settings
        with self._lock:
            making = self._making[key]
        with making:
            if (known := self._known(number, settings)) is not None:
                return known
            config = self._config_of(number, settings)
            if settings and config == self._config_of(number, ()):
                return self.look(number)
            result = self._perceived(self._frame(number), config)
            with self._lock:
                self._results[key] = result
                self._making.pop(key, None)
                while len(self._results) > RESULTS:
                    self._results.popitem(last=False)
        return result

    def look_aside(self, number: int) -> FrameResult:
        """Return the result of a frame for background work. A question waits at most until it is read."""
        known = self._known(number, ())
        return self.pipeline.run_single(self._frame(number)) if known is None else known

    def _known(self, number: int, settings: Settings) -> FrameResult | None:
        """Return the result of a frame, if it is in memory."""
        with self._lock:
            if (number, settings) in self._results:
                self._results.move_to_end((number, settings))
                return self._results[number, settings]
            return None if settings else self._shown_results().get(number)

    def _shown_results(self) -> Mapping[int, FrameResult]:
        """Return further results as shown that are in memory, by number."""
        return {}

    def configured(self, settings: Settings) -> Config:
        """Return the configuration that ``try_values`` puts in force.

        Raises:
            UserError: a parameter is unknown, or a value is wrong.
        """
        return changed_config(self.pipeline.config, settings) if settings else self.pipeline.config

    def _config_of(self, number: int, settings: Settings) -> Config:
        """Return the configuration of a frame as shown, or with other values.

        Raises:
            UserError: a parameter is unknown, or a value is wrong.
        """
        if settings:
            config = changed_config(self.pipeline.config, settings)
            check_same_frames({"the drive": self.pipeline.config, "what is tried": config})
            return config
        return self.pipeline.config

    def _perceived(self, frame: Frame, config: Config) -> FrameResult:
        """Return the result of a frame."""
        return add_explanations(self._variants.perceive(frame, config))

    def _frame(self, number: int) -> Frame:
        """Return a frame before any stage.

        Raises:
            UserError: there is no such frame, or it cannot be read.
        """
        with self._reading:
            with self._lock:
                known = [result.frame for (n, _), result in self._results.items() if n == number]
                known += [result.frame for n, result in self._shown_results().items() if n == number]
                known += [self._frames[number]] if number in self._frames else []
            if known:
                return known[0]
            frame = self.read(number)
            with self._lock:
                self._frames[number] = frame
                while len(self._frames) > READ:
                    self._frames.popitem(last=False)
        return frame

    @abstractmethod
    def read(self, number: int) -> Frame:
        """Read a frame from the messages. It is called by one thread at a time.

        Raises:
            UserError: there is no such frame, or it cannot be read.
        """

    @abstractmethod
    def number_at(self, stamp: int) -> int:
        """Return the number of the frame that a viewer shows at a stamp.

        Raises:
            UserError: there is no such frame.
        """

    # --- questions -----------------------------------------------------------------------------

    def truth(self, frame: Frame) -> Truth | None:
        """Return the ground truth of a frame, if there is any."""
        return None if frame.truth is None else truth_of(frame, frame.truth)

    def explainer(self, result: FrameResult) -> FrameExplainer:
        """Return an explainer of a result, for the list and for questions."""
        names, number = self.pipeline.stages.class_names, result.frame.index
        labels = self.kept_labels(result.frame)
        return FrameExplainer(
            result, self.pipeline.loader, names, neighbours=lambda: [*self._beside(number)], labels=labels
        )

    def _beside(self, number: int) -> Iterator[Frame]:
        """Yield the frames before and after one, as far as they can be read."""
        for beside in (number - 1, number + 1):
            with suppress(UserError):
                yield self._frame(beside)

    def start(self) -> None:
        """Start to make frames, if they are not made already."""

    def go_on(self) -> None:
        """Continue, if the run waits until a page shows the first frame."""

    def quiet(self) -> AbstractContextManager[None]:
        """Return a context in which background work pauses, if it can."""
        return nullcontext()

    def wait_for_quiet(self) -> None:
        """Wait until no question is being answered, if background work can wait."""

    def remark(self, number: int, pick: str) -> Answer:
        """Return the answer about a finding, with hints. They are searched once.

        Raises:
            UserError: there is no such frame or object.
        """
        with self._remarking:
            if (number, pick) not in self._remarks:
                if self._aside is None or self._aside.traces.result.frame.index != number:
                    self._aside = self.explainer(self.look_aside(number))
                answer = self._aside.about(Selection.parse(pick))
                self._remarks[number, pick] = self._aside.with_hints(answer)
            return self._remarks[number, pick]

    def forget_remarks(self) -> None:
        """Forget the answers about findings, which a label has changed."""
        with self._remarking:
            self._aside = None
            self._remarks.clear()

    def robot_questions(self, number: int) -> RobotQuestions | None:
        """Return the questions about the robot's own chain. None: the robot has not two topics of objects.

        Call it with ``following``.

        Raises:
            UserError: the chain cannot be told.
        """
        return None

    def follow_robot(self, number: int, place: F32 | F64 | None) -> RobotObject | None:
        """Follow the object at a place in the frame of the points through the robot's own chain.

        Raises:
            UserError: it cannot be told.
        """
        with self.following:
            questions = self.robot_questions(number)
            if questions is None:
                return None
            if place is None:
                raise UserError("where the object is in space is unknown")
            return questions.at(np.asarray(place, np.float64))

    def select(
        self, number: int, settings: Settings, path: str, instance: int | None, position: Sequence[float]
    ) -> Selection | None:
        """Return the selection of a click in a frame, see ``bevviz.why.click.select_click``."""
        result, tracks = self.look(number, settings), self.tracks(number)
        rows = self.entity_rows(number, settings)
        return select_click(result, tracks, rows, path, instance, position)

    @abstractmethod
    def entity_rows(self, number: int, settings: Settings) -> EntityRows:
        """Return the rows behind the entities of a frame as it was drawn."""

    @abstractmethod
    def mark(self, result: FrameResult, answer: Answer, overlay: PageOverlay | None) -> None:
        """Mark the object of an answer in every view of the page of an overlay."""

    # --- pages ---------------------------------------------------------------------------------

    @property
    def on_demand(self) -> bool:
        """Whether a page gets a frame of the recording only when it looks at it."""
        return False

    def thumbnail(self, number: int) -> bytes | None:
        """Return a small image of the camera near a frame as JPEG. None: there is none."""
        return None

    @abstractmethod
    def progress(self) -> RunProgress:
        """Return the progress of the run for the page."""

    @abstractmethod
    def reader(self, lane: str, first: int, state: PageState) -> AbstractContextManager[Reader]:
        """Return a context in which a page reads the recording.

        Args:
            lane: ``recording`` for the run, ``overlay`` for answers and tried results.
            first: number of pieces that the page has.
            state: state of the page.
        """

    def open_overlay(self) -> PageOverlay | None:
        """Return a new overlay for a page. None: all pages share one recording."""
        return None

    def close_overlay(self, overlay: PageOverlay) -> None:
        """Remove an overlay whose page is closed."""

    def asked_settings(self, settings: Settings, again: bool) -> Settings:
        """Return the settings that a question is about.

        Args:
            settings: settings that the page shows.
            again: the question selects an object by its name, not by a click on the shown frame.
        """
        return settings

    @abstractmethod
    def try_values(
        self, number: int, settings: Settings, attempt: Attempt | None = None
    ) -> tuple[FrameResult, FrameResult]:
        """Show a frame with other values to the page of an attempt. Return its result before and after.

        Raises:
            UserError: as ``look``, or the attempt was stopped.
        """
