"""Overlay of a page: the marks of its answers and its tried results, over the recording of the drive."""

from __future__ import annotations

import bisect
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from bevviz.errors import UserError
from bevviz.recording import entities
from bevviz.recording.focus import Focus
from bevviz.recording.frame_logger import FrameLogger
from bevviz.support.contexts import Closable
from bevviz.workbench.buffers import RecordingBuffer

if TYPE_CHECKING:
    import rerun as rr

    from bevviz.model.results import FrameResult
    from bevviz.why import Answer

NewLogger = Callable[[], tuple[FrameLogger, "rr.BinaryStream"]]  # a logger into the recording, and its stream


class Attempt:
    """One try of other values. A newer try of the page, or its user, stops it.

    Args:
        overlay: overlay of the page.
        logger: logger of the tried results.
        stream: stream of the logger.
    """

    def __init__(self, overlay: PageOverlay, logger: FrameLogger, stream: rr.BinaryStream) -> None:
        self.overlay, self.logger, self.stream = overlay, logger, stream
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
        marker: returns the logger of the marks of answers.
        tried: returns a logger of tried results.

    Attributes:
        buffer: pieces of the recording for this page.
        known: entities that tried results of this page had.
        marked: result and answer that were marked last. None: none yet.
        marks: number of marks until now.
        marking: guards the marker, ``marked`` and ``marks``.
    """

    def __init__(self, lane: str, marker: NewLogger, tried: NewLogger) -> None:
        self.lane, self.buffer, self._tried = lane, RecordingBuffer(), tried
        self.marker, self._marks = marker()
        self._attempt = Attempt(self, *tried())
        self.known: frozenset[str] = frozenset()
        self.marked: tuple[FrameResult, Answer] | None = None
        self.marks = 0
        self.marking = threading.Lock()
        self._focuses: list[tuple[int, Focus]] = []  # by stamp, sorted
        self._lock = threading.Lock()

    def close(self) -> None:
        """Stop the try in progress and delete the buffer."""
        with self._lock:
            self._attempt.stop.set()
            for stream in (self._marks, self._attempt.stream):
                stream.read()  # Rerun warns about a binary stream with unread data.
            self.buffer.close()
            # Rerun keeps the threads of a stream as long as a reference to it exists.
            del self.marker, self._marks, self._attempt

    def keep_focus(self, stamp: int, focus: Focus) -> None:
        """Keep where the views of the page look from a stamp on."""
        with self._lock:
            self._focuses = [one for one in self._focuses if one[0] != stamp]
            bisect.insort(self._focuses, (stamp, focus), key=lambda one: one[0])

    def focus_at(self, stamp: int) -> Focus | None:
        """Return where the views of the page look at a stamp. None: nothing was marked until then."""
        with self._lock:
            row = bisect.bisect_right(self._focuses, stamp + entities.TIME_TOLERANCE, key=lambda one: one[0])
            return self._focuses[row - 1][1] if row else None

    def attempt(self) -> Attempt:
        """Return the attempt of the next try. It has a new logger if the last try was stopped."""
        with self._lock:
            if self._attempt.stop.is_set():
                self._attempt = Attempt(self, *self._tried())
            return self._attempt

    def stop(self) -> None:
        """Stop the try in progress. Nothing of it is shown."""
        with self._lock:
            self._attempt.stop.set()

    def add_marks(self) -> None:
        """Hand the marks that were logged to the page."""
        self.buffer.add(self._marks.read())

    def add_tried(self, attempt: Attempt) -> None:
        """Hand the tried results that were logged to the page.

        Raises:
            UserError: the try was stopped.
        """
        piece = attempt.stream.read()
        with self._lock:
            attempt.check()
            self.known |= attempt.logger.known
            self.buffer.add(piece)
