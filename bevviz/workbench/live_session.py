"""The workbench session of a running robot: its newest frames are kept and can be asked about."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import rerun as rr

from bevviz.config import Config, changed_config
from bevviz.errors import UserError
from bevviz.evaluate import Truth, truth_of
from bevviz.live.runtime import Live
from bevviz.live.thinning import chosen
from bevviz.model.frame import Scene
from bevviz.model.results import FrameResult
from bevviz.pipeline.perceive import add_explanations
from bevviz.pipeline.session import Session, Variants
from bevviz.recording import entities
from bevviz.recording.frame_logger import FrameLogger
from bevviz.recording.sinks import APPLICATION
from bevviz.support.contexts import Closable
from bevviz.why import Answer, FrameExplainer
from bevviz.why.log import mark_answers
from bevviz.why.pick import Pick, pick
from bevviz.why.pick_answers import selection_of, surroundings_of
from bevviz.workbench.finding_list import FindingList
from bevviz.workbench.findings import find_findings, with_reasons
from bevviz.workbench.live_buffer import LiveBuffer
from bevviz.workbench.trials import trial_effects

KEPT = 4  # held frames that are kept
TRIED = 2  # results of held frames with other values that are kept
LISTED = ("missed", "false", "contradicted", "lost", "unmatched", "unnamed")

Settings = tuple[str, ...]


class RobotDrive:
    """The parts of a drive that a page reads: scene, configuration and pipeline session."""

    def __init__(self, live: Live) -> None:
        self._live = live

    def __len__(self) -> int:
        return 0

    @property
    def scene(self) -> Scene:
        """Scene of the robot."""
        return self._live.scene

    @property
    def config(self) -> Config:
        """Configuration in force."""
        return self._live.config

    @property
    def session(self) -> Session:
        """Pipeline session of the live run."""
        return self._live.session


class LiveSession(Closable):
    """Workbench session of a running robot.

    Its newest frames can be asked about. Changed parameters are in force for all later frames. Ask
    questions from one thread only.

    Args:
        live: the live run, before it starts.

    Attributes:
        entries: findings in the frame that was held last.
    """

    def __init__(self, live: Live) -> None:
        self.live, self.drive = live, RobotDrive(live)
        self.film = LiveBuffer(live, live.config.live.output_queue)
        self.truth_of: Callable[..., Truth | None] | None = None
        self.opening: int | None = None  # None: the page opens at the newest frame.
        self.entries, self.notes_changed = FindingList(), -1
        self._newest: deque[FrameResult] = deque(maxlen=live.config.live.held)
        self._kept: OrderedDict[int, FrameResult] = OrderedDict()
        self._lock = threading.Lock()  # guards _newest and _kept
        self._tried_results: OrderedDict[tuple[int, Settings], FrameResult] = OrderedDict()
        self._settings: Settings = ()
        self._variants = Variants(live.session.loader)
        self._questioner: FrameExplainer | None = None
        self._listeners: list[Callable[[], None]] = []
        recording = rr.RecordingStream(APPLICATION, recording_id=live.encoder.recording_id)
        recording.set_log_time_enabled(False)
        self._marks = rr.binary_stream(recording)
        self._marker = FrameLogger(recording, live.config, live.scene)
        live.attach(self.film, self._see)

    def close(self) -> None:
        """Close the buffer of the pages."""
        self.film.close()

    def listen(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call the listener, from any thread, for each new frame. Return a function that ends this."""
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def quiet(self) -> AbstractContextManager[None]:
        """Return an empty context: a robot does not wait."""
        return nullcontext()

    def progress(self) -> dict[str, Any]:
        """Return the progress message for the page."""
        status = self.live.status
        drops = ", ".join(f"{count} {where}" for where, count in status.drops.items() if count)
        return {
            "type": "progress",
            "done": status.frames,
            "total": None,
            "over": True,
            "error": "",
            "reports": [],
            "trial": None,
            "warnings": [f"{1e3 * status.p50:.0f} ms", f"dropped: {drops or 'none'}"],
        }

    def _see(self, result: FrameResult) -> None:
        with self._lock:
            self._newest.append(result)
        if result.frame.truth is not None and self.truth_of is None:
            self.truth_of = _own_truth
        for listener in tuple(self._listeners):
            listener()

    # --- frames --------------------------------------------------------------------------------

    def number_at(self, stamp: int) -> int:
        """Return the number of the frame that a viewer shows at a stamp.

        Raises:
            UserError: the frame is no longer in memory.
        """
        frames = sorted((result.frame.stamp, result.frame.index) for result in self._held())
        if not frames:
            raise UserError("no frame has come yet")
        numbers = [index for frame_stamp, index in frames if frame_stamp <= stamp + entities.TIME_TOLERANCE]
        if not numbers:
            raise UserError(
                f"that frame is gone: the newest {self._newest.maxlen} can be asked about "
                "(live.held); hold one with H, and ask then"
            )
        return numbers[-1]

    def _held(self) -> list[FrameResult]:
        with self._lock:
            return [*self._kept.values(), *self._newest]

    def hold(self, stamp: int) -> FrameResult:
        """Keep the frame that a viewer shows, so that it can be asked about later.

        At most ``KEPT`` frames are kept. If the frame is gone because the viewer lags behind, the oldest
        frame in memory is held.

        Raises:
            UserError: no frame has come yet.
        """
        frames = sorted((held_result.frame.stamp, held_result.frame.index) for held_result in self._held())
        numbers = [index for frame_stamp, index in frames if frame_stamp <= stamp + entities.TIME_TOLERANCE]
        if not frames:
            raise UserError("no frame has come yet")
        result = self.look(numbers[-1] if numbers else frames[0][1])
        index = result.frame.index
        with self._lock:
            self._kept[index] = result
            self._kept.move_to_end(index)
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
        findings = find_findings(result, None if self.truth_of is None else self.truth_of(result.frame))
        self.entries.replace(LISTED)
        self.entries.add(with_reasons(findings, result, self._new_questioner(result)))
        for listener in tuple(self._listeners):
            listener()
        return result

    def look(self, number: int, settings: Settings = ()) -> FrameResult:
        """Return the result of a frame in memory, with other values if ``settings`` names some.

        Raises:
            UserError: the frame is gone, a parameter is unknown, or a value is wrong.
        """
        result = next((candidate for candidate in self._held() if candidate.frame.index == number), None)
        if result is None:
            raise UserError(f"frame {number} is gone: hold one with H, and ask then")
        if not settings:
            return result
        config = changed_config(self.live.config, settings)
        if config == result.config:
            return result
        key = number, settings
        if key not in self._tried_results:
            self._tried_results[key] = add_explanations(self._variants.perceive(result.frame, config))
            while len(self._tried_results) > TRIED:
                self._tried_results.popitem(last=False)
        return self._tried_results[key]

    # --- questions -----------------------------------------------------------------------------

    def picked(
        self, number: int, settings: Settings, path: str, instance: int | None, position: Sequence[float]
    ) -> Pick | None:
        """Return the pick of a click in a frame, see ``pick``."""
        result = self.look(number)
        points = result.config.live.viewer_points
        if instance is not None and points is not None and path == entities.points(result.frame.lidar):
            rows = chosen(len(result.frame.points), points, result.frame.index)
            instance = int(rows[instance]) if instance < len(rows) else None
        return pick(result, result.tracks, path, instance, position)

    def ask(self, number: int, settings: Settings, target: Pick) -> tuple[Answer, list[Answer]]:
        """Explain an object: why was it reported or not? The answer is marked in every view.

        Returns:
            The answer, and the answers about other subjects at the same place.

        Raises:
            UserError: there is no such object in the frame.
        """
        result = self.look(number, settings)
        questioner, candidates = self._candidates(result, target)
        answers = candidates or questioner.ask(selection_of(target))
        if not answers:
            raise UserError(f"there is nothing to say about {target}")
        answer = answers[0]
        if not candidates and (nearby := surroundings_of(target, answer)) is not None:
            candidates = questioner.candidates(nearby)
        mark_answers(self._marker, result.frame, [answer], result.config.bev)
        self.film.add(self._marks.read())
        return answer, [other for other in candidates if other.subject.key != answer.subject.key]

    def hints(self, number: int, settings: Settings, target: Pick) -> Answer:
        """Answer with hints: parameter changes that would change the verdict. This takes longer than ``ask``.

        Raises:
            UserError: as ``ask``.
        """
        questioner, candidates = self._candidates(self.look(number, settings), target)
        return questioner.with_hints((candidates or questioner.ask(selection_of(target)))[0])

    def _candidates(self, result: FrameResult, target: Pick) -> tuple[FrameExplainer, list[Answer]]:
        if self._questioner is None or self._questioner.traces.result is not result:
            self._questioner = self._new_questioner(result)
        candidates = self._questioner.candidates(selection_of(target)) if target.is_place else []
        return self._questioner, list(candidates)

    def _new_questioner(self, result: FrameResult) -> FrameExplainer:
        session = self.live.session
        return FrameExplainer(result, session.loader, session.stages.class_names)

    def go_on(self) -> None:
        """Do nothing: a robot does not wait for a page."""

    # --- commands ------------------------------------------------------------------------------

    @property
    def settings(self) -> Settings:
        """Settings that pages have changed."""
        return self._settings

    def configured(self, settings: Settings) -> Config:
        """Return the configuration of the running robot, which has taken on the settings."""
        return self.live.config

    def attempt(self, number: int, settings: Settings, target: Pick | None = None) -> dict[str, Any]:
        """Change parameters of the running robot, and return their effects on one frame.

        Raises:
            UserError: a parameter is unknown, or a value is wrong. Nothing is changed.
        """
        before = self.look(number)
        self.change(settings)
        after = add_explanations(self._variants.perceive(before.frame, self.live.config))
        truth_row = target.row if target is not None and target.kind == "truth" else -1
        truth = None if self.truth_of is None else self.truth_of(before.frame)
        return trial_effects(before, after, truth, truth_row)

    def change(self, settings: Settings) -> None:
        """Change parameters of the running robot.

        A parameter that a page changed before and that is not in ``settings`` gets its configured value back.

        Raises:
            UserError: a parameter is unknown, or a value is wrong. Nothing is changed.
        """
        if settings != self._settings:
            self.live.update(settings, without=self._settings)
        self._settings = settings

    def snap(self) -> str:
        """Save the flight recorder, and return the message for the user.

        Raises:
            UserError: the recorder is empty, or its file cannot be written.
        """
        return f"saved in {self.live.save()}"

    def mark(self, stamp: int, text: str) -> str:
        """Log a note at a frame, in every recording and on the terminal. Return the message for the user."""
        number = self.number_at(stamp)
        message = f"mark at frame {number}: {text.strip() or 'look here'}"
        self.live.notes.info(message)
        return message


def _own_truth(frame: Any) -> Truth | None:
    return None if frame.truth is None else truth_of(frame, frame.truth)
