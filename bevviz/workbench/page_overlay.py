"""Overlay of a page: the marks of its answers and its tried results, over the recording of the drive."""

from __future__ import annotations

import bisect
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING

from bevviz.errors import UserError
from bevviz.recording import entities
from bevviz.recording.focus import Focus
from bevviz.support.contexts import Closable
from bevviz.why.log import focus_answer, mark_answers
from bevviz.workbench.buffers import RecordingBuffer

if TYPE_CHECKING:
    from bevviz.config import Config
    from bevviz.model.results import FrameResult
    from bevviz.why import Answer
    from bevviz.workbench.drive_recording import DriveRecording
    from bevviz.workbench.piece_logger import PieceLogger


class Attempt:
    """One try of other values. A newer try of the page, or its user, stops it.

    Args:
        overlay: overlay of the page.
        logger: logger of the tried results.
    """

    def __init__(self, overlay: PageOverlay, logger: PieceLogger) -> None:
        self.overlay, self.logger = overlay, logger
        self.stop = threading.Event()

    def check(self) -> None:
        """Check that the try goes on.

        Raises:
            UserError: it was stopped.
        """
        if self.stop.is_set():
            raise UserError("the try was cancelled")


class PageOverlay(Closable):
    """Overlay of one page.

    Args:
        lane: name by which the page requests the buffer.
        recording: recording of the drive.
        config: configuration of the drive.

    Attributes:
        buffer: pieces of the recording for this page.
        known: entities that tried results of this page had.
        marked: result and answer that were marked last. None: none yet.
    """

    def __init__(self, lane: str, recording: DriveRecording, config: Config) -> None:
        self.lane, self.buffer, self._recording = lane, RecordingBuffer(), recording
        self._marker, self._attempt = recording.logger(config), Attempt(self, recording.tried_logger())
        self.known: frozenset[str] = frozenset()
        self.marked: tuple[FrameResult, Answer] | None = None
        self._marks = 0  # number of marks until now
        self._marking = threading.Lock()  # guards the marker and the marks
        self._focuses: list[tuple[int, Focus]] = []  # by stamp, sorted
        self._lock = threading.Lock()

    def close(self) -> None:
        """Stop the try in progress and delete the buffer."""
        with self._lock:
            self._attempt.stop.set()
            self._marker.close()
            self._attempt.logger.close()
            self.buffer.close()
            # Rerun keeps the threads of a stream as long as a reference to it exists.
            del self._marker, self._attempt

    def mark(self, result: FrameResult, answer: Answer) -> None:
        """Mark the object of an answer in every view of the page, which goes to the object."""
        with self._marking:
            self.marked, self._marks = (result, answer), self._marks + 1
            mark_answers(self._marker, result.frame, [answer], result.config.bev)
            if self._recording.scene.moving:
                stamp, focus = result.frame.stamp, focus_answer(self._marker, result, answer, self._marks)
                with self._lock:
                    self._focuses = [one for one in self._focuses if one[0] != stamp]
                    bisect.insort(self._focuses, (stamp, focus), key=lambda one: one[0])
            self.buffer.add(self._marker.piece())

    def position(self, stamp: int, view: str, position: Sequence[float]) -> Sequence[float]:
        """Return a position in a view at a stamp among the points or in the image, see ``Focus.position``."""
        with self._lock:
            row = bisect.bisect_right(self._focuses, stamp + entities.TIME_TOLERANCE, key=lambda one: one[0])
            focus = self._focuses[row - 1][1] if row else self._recording.usual_focus
        return position if focus is None else focus.position(view, position)

    def attempt(self) -> Attempt:
        """Return the attempt of the next try. It has a new logger if the last try was stopped."""
        with self._lock:
            if self._attempt.stop.is_set():
                self._attempt = Attempt(self, self._recording.tried_logger())
            return self._attempt

    def stop(self) -> None:
        """Stop the try in progress. Nothing of it is shown."""
        with self._lock:
            self._attempt.stop.set()

    def add_tried(self, attempt: Attempt) -> None:
        """Hand the tried results that were logged to the page.

        Raises:
            UserError: the try was stopped.
        """
        piece = attempt.logger.piece()
        with self._lock:
            attempt.check()
            self.known |= attempt.logger.known
            self.buffer.add(piece)
