"""A running robot as the source of a page: its newest frames are kept and can be asked about."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import rerun as rr

from bevviz.config import Config, changed_config
from bevviz.errors import UserError
from bevviz.evaluate import Truth, truth_of
from bevviz.live.encoder import sample_rows
from bevviz.live.runtime import Live
from bevviz.model.frame import Frame
from bevviz.model.results import FrameResult, Tracks
from bevviz.pipeline.perceive import add_explanations
from bevviz.pipeline.session import Variants
from bevviz.recording import entities
from bevviz.recording.frame_logger import FrameLogger
from bevviz.recording.sinks import APPLICATION
from bevviz.why import Answer, Selection
from bevviz.why.click import select_click
from bevviz.why.log import mark_answers
from bevviz.workbench.buffers import PageState, Reader
from bevviz.workbench.findings import find_findings
from bevviz.workbench.live_buffer import LiveBuffer
from bevviz.workbench.source import Message, Settings, Source

KEPT = 4  # held frames that are kept
TRIED = 2  # results of held frames with other values that are kept
LISTED = ("missed", "false", "doubtful", "contradicted", "lost", "unmatched", "unnamed")


class RunningRobot(Source):
    """Running robot as the source of a page.

    Its newest frames can be asked about. Changed parameters are in force for all later frames.

    Args:
        live: the live run, before it starts.

    Attributes:
        film: buffer with the newest pieces of the recording.
        findings: findings in the frame that was held last.
    """

    def __init__(self, live: Live) -> None:
        super().__init__(live.scene.name, live.session)
        self.live = live
        self.film = LiveBuffer(live, live.config.live.output_queue)
        self.commands = {"hold": self._hold, "snap": self._snap, "mark": self._mark}
        self._newest: deque[FrameResult] = deque(maxlen=live.config.live.held)
        self._kept: OrderedDict[int, FrameResult] = OrderedDict()
        self._lock = threading.Lock()  # guards _newest and _kept
        self._tried_results: OrderedDict[tuple[int, Settings], FrameResult] = OrderedDict()
        self._settings: Settings = ()  # settings that pages have changed
        self._variants = Variants(live.session.loader)
        recording = rr.RecordingStream(APPLICATION, recording_id=live.encoder.recording_id)
        recording.set_log_time_enabled(False)
        self._marks = rr.binary_stream(recording)
        self._marker = FrameLogger(recording, live.config, live.scene)
        live.attach(self.film, self.observe)

    def close(self) -> None:
        """Close the buffer of the pages."""
        self.film.close()

    def progress(self) -> dict[str, Any]:
        """Return the progress of the run for the page."""
        status = self.live.status
        drops = ", ".join(f"{count} {where}" for where, count in status.drops.items() if count)
        return {
            "done": status.frames,
            "total": None,
            "over": True,
            "error": "",
            "warnings": [f"{1e3 * status.p50:.0f} ms", f"dropped: {drops or 'none'}"],
        }

    def observe(self, result: FrameResult) -> None:
        """Keep a new frame."""
        with self._lock:
            self._newest.append(result)
        if result.frame.truth is not None and self.truth_of is None:
            self.truth_of = _truth_in_frame
        self.news.tell()

    @contextmanager
    def reader(self, lane: str, first: int, state: PageState) -> Iterator[Reader]:
        """Return a context in which a page reads the newest pieces. Marks of answers are among them."""
        with self.film.shown(state) as page:
            yield page

    # --- frames --------------------------------------------------------------------------------

    def _held(self) -> list[FrameResult]:
        with self._lock:
            return [*self._kept.values(), *self._newest]

    def _shown_at(self, stamp: int) -> tuple[FrameResult | None, FrameResult]:
        """Return the frame that a viewer shows at a stamp, None if it is gone, and the oldest frame.

        Raises:
            UserError: no frame has come yet.
        """
        results = sorted(self._held(), key=lambda result: (result.frame.stamp, result.frame.index))
        if not results:
            raise UserError("no frame has come yet")
        earlier = [result for result in results if result.frame.stamp <= stamp + entities.TIME_TOLERANCE]
        return earlier[-1] if earlier else None, results[0]

    def number_at(self, stamp: int) -> int:
        """Return the number of the frame that a viewer shows at a stamp.

        Raises:
            UserError: the frame is no longer in memory.
        """
        result, _ = self._shown_at(stamp)
        if result is None:
            raise UserError(
                f"that frame is gone: the newest {self._newest.maxlen} can be asked about "
                "(live.held); hold one with H, and ask then"
            )
        return result.frame.index

    def hold(self, stamp: int) -> FrameResult:
        """Keep the frame that a viewer shows, so that it can be asked about later.

        At most ``KEPT`` frames are kept. If the frame is gone because the viewer lags behind, the oldest
        frame in memory is held.

        Raises:
            UserError: no frame has come yet.
        """
        shown, oldest = self._shown_at(stamp)
        result = self.look((shown or oldest).frame.index)
        index = result.frame.index
        with self._lock:
            self._kept[index] = result
            self._kept.move_to_end(index)
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
        self.findings.replace(LISTED)
        self.findings.add(find_findings(self.explainer(result)))
        self.news.tell()
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

    def tracks(self, number: int) -> Tracks | None:
        """Return the tracks in a frame."""
        return self.look(number).tracks

    def frame_times(self) -> list[tuple[int, int]]:
        """Return stamp and number of each frame in memory."""
        return [(result.frame.stamp, result.frame.index) for result in self._held()]

    # --- questions -----------------------------------------------------------------------------

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
        points = result.config.live.viewer_points
        if instance is not None and points is not None and path == entities.points(result.frame.lidar):
            rows = sample_rows(len(result.frame.points), points, result.frame.index)
            instance = int(rows[instance]) if instance < len(rows) else None
        return select_click(result, result.tracks, path, instance, position)

    def mark(self, result: FrameResult, answer: Answer) -> None:
        """Mark the object of an answer in every view."""
        mark_answers(self._marker, result.frame, [answer], result.config.bev)
        self.film.add(self._marks.read())

    def try_values(self, number: int, settings: Settings) -> tuple[FrameResult, FrameResult]:
        """Change parameters of the running robot. Return the result of one frame before and after.

        A parameter that a page changed before and that is not in ``settings`` gets its configured value back.

        Raises:
            UserError: a parameter is unknown, or a value is wrong. Nothing is changed.
        """
        before = self.look(number)
        if settings != self._settings:
            self.live.update(settings, without=self._settings)
        self._settings = settings
        return before, add_explanations(self._variants.perceive(before.frame, self.live.config))

    def configured(self, settings: Settings) -> Config:
        """Return the configuration in force, which has taken on the settings."""
        return self.live.config

    # --- commands of the page ------------------------------------------------------------------

    def _hold(self, message: Message) -> dict[str, Any]:
        """Hold the shown frame."""
        frame = self.hold(round(float(message["time"]))).frame
        return {"type": "held", "frame": frame.index, "stamp": str(frame.stamp)}

    def _snap(self, message: Message) -> dict[str, Any]:
        """Save the flight recorder."""
        return {"type": "said", "text": f"saved in {self.live.save()}"}

    def _mark(self, message: Message) -> dict[str, Any]:
        """Log a note at the shown frame, in every recording and on the terminal."""
        number = self.number_at(round(float(message["time"])))
        text = f"mark at frame {number}: {str(message.get('text', '')).strip() or 'look here'}"
        self.live.notes.info(text)
        return {"type": "said", "text": text}


def _truth_in_frame(frame: Frame) -> Truth | None:
    """Return the ground truth that a frame carries, if there is any."""
    return None if frame.truth is None else truth_of(frame, frame.truth)
