"""Source of the frames that a page asks about."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np

from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.evaluate import Truth
from bevviz.evaluate.ground_truth import TruthLookup
from bevviz.findings.finding_list import FindingList
from bevviz.model.frame import F32, F64, Frame
from bevviz.model.results import FrameResult, Tracks
from bevviz.pipeline.session import Session
from bevviz.support.contexts import Closable
from bevviz.why import Answer, FrameExplainer, Selection
from bevviz.why.robot_questions import RobotObject, RobotQuestions
from bevviz.workbench.buffers import News, PageState, Reader
from bevviz.workbench.page_overlay import Attempt, PageOverlay

Settings = tuple[str, ...]
Message = Mapping[str, Any]  # message from the page


class Source(Closable):
    """Base class of the sources of a page: a recorded drive and a running robot.

    Args:
        title: name of the drive or the robot.
        pipeline: pipeline session with the configuration in force and the loaded networks.
        truth_of: returns the ground truth of a frame. None: there is none.

    Attributes:
        scans: number of scans. 0 for a robot.
        findings: findings, grouped over frames.
        news: tells of each new frame and of all other news for the page.
        first: stamp that the page counts seconds from.
        opening: stamp of the frame that a page opens at. None: no frame is shown yet, or the newest one.
        commands: further messages of the page by type, each with the function that returns the reply.
    """

    def __init__(self, title: str, pipeline: Session, truth_of: TruthLookup | None = None) -> None:
        self.title, self.pipeline, self.truth_of = title, pipeline, truth_of
        self.scans = 0
        self.findings, self.news = FindingList(), News()
        self.opening: int | None = None
        self._remarks: dict[tuple[int, str], str] = {}  # by frame and text of the selection
        self._remarking = threading.Lock()
        self.following = threading.Lock()  # guards the bag that the robot's chain is read from
        self._aside: FrameExplainer | None = None
        self.first = 0
        self.commands: Mapping[str, Callable[[Message], dict[str, Any]]] = {}

    def truth(self, frame: Frame) -> Truth | None:
        """Return the ground truth of a frame, if there is any."""
        return None if self.truth_of is None else self.truth_of(frame)

    def explainer(self, result: FrameResult) -> FrameExplainer:
        """Return an explainer of a result, for the list and for questions."""
        return FrameExplainer(result, self.pipeline.loader, self.pipeline.stages.class_names)

    def start(self) -> None:
        """Start to make frames, if they are not made already."""

    def go_on(self) -> None:
        """Continue, if the run waits until a page shows the first frame."""

    def quiet(self) -> AbstractContextManager[None]:
        """Return a context in which background work pauses, if it can."""
        return nullcontext()

    def wait_for_quiet(self) -> None:
        """Wait until no question is being answered, if background work can wait."""

    def look_aside(self, number: int) -> FrameResult:
        """Return the result of a frame for background work, without keeping a question from its own."""
        return self.look(number)

    def remark(self, number: int, pick: str) -> str:
        """Return the sentence about the hints for a finding. Each is searched once.

        Raises:
            UserError: there is no such frame or object.
        """
        with self._remarking:
            if (number, pick) not in self._remarks:
                if self._aside is None or self._aside.traces.result.frame.index != number:
                    self._aside = self.explainer(self.look_aside(number))
                answer = self._aside.about(Selection.parse(pick))
                self._remarks[number, pick] = self._aside.with_hints(answer).remark
            return self._remarks[number, pick]

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

    @property
    def on_demand(self) -> bool:
        """Whether a page gets a frame of the recording only when it looks at it."""
        return False

    def thumbnail(self, number: int) -> bytes | None:
        """Return a small image of the camera near a frame as JPEG. None: there is none."""
        return None

    @abstractmethod
    def progress(self) -> dict[str, Any]:
        """Return the progress of the run for the page."""

    @abstractmethod
    def reader(self, lane: str, first: int, state: PageState) -> AbstractContextManager[Reader]:
        """Return a context in which a page reads the recording.

        Args:
            lane: ``recording`` for the run, ``overlay`` for answers and tried results.
            first: number of pieces that the page has.
            state: state of the page.
        """

    @abstractmethod
    def number_at(self, stamp: int) -> int:
        """Return the number of the frame that a viewer shows at a stamp.

        Raises:
            UserError: there is no such frame.
        """

    @abstractmethod
    def look(self, number: int, settings: Settings = ()) -> FrameResult:
        """Return the result of a frame, with other values if ``settings`` names some.

        Raises:
            UserError: there is no such frame, a parameter is unknown, or a value is wrong.
        """

    @abstractmethod
    def tracks(self, number: int) -> Tracks | None:
        """Return the tracks of the run in a frame. None: the run has not reached it."""

    @abstractmethod
    def frame_times(self) -> list[tuple[int, int]]:
        """Return stamp and number of each frame that a page can show."""

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
    def select(
        self, number: int, settings: Settings, path: str, instance: int | None, position: Sequence[float]
    ) -> Selection | None:
        """Return the selection of a click in a frame, see ``bevviz.why.click.select_click``."""

    @abstractmethod
    def mark(self, result: FrameResult, answer: Answer, overlay: PageOverlay | None) -> None:
        """Mark the object of an answer in every view of the page of an overlay."""

    @abstractmethod
    def try_values(
        self, number: int, settings: Settings, attempt: Attempt | None = None
    ) -> tuple[FrameResult, FrameResult]:
        """Show a frame with other values to the page of an attempt. Return its result before and after.

        Raises:
            UserError: as ``look``, or the attempt was stopped.
        """

    @abstractmethod
    def configured(self, settings: Settings) -> Config:
        """Return the configuration that ``try_values`` puts in force.

        Raises:
            UserError: a parameter is unknown, or a value is wrong.
        """
