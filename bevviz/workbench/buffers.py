"""Buffers with the recording of a drive, and the readers that hand their pieces to the pages."""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Callable, Sequence
from typing import Protocol

from bevviz.support.contexts import Closable
from bevviz.support.files import catch_full_disk

AHEAD = 6  # pieces of the run that may be sent before the page acknowledges the first of them


class News:
    """Callbacks that are called when there is news. Any thread may use it."""

    def __init__(self) -> None:
        self._listeners: list[Callable[[], None]] = []

    def listen(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call the listener, from any thread, at each ``tell``. Return a function that ends this."""
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def tell(self) -> None:
        """Call all listeners."""
        for listener in tuple(self._listeners):
            listener()


class PageState:
    """State of a page, from its messages on the socket of a recording.

    Attributes:
        count: number of acknowledged pieces.
        gone: whether the socket is closed.
        hidden: whether the page is in the background.
        requested: stamps of the frames that the page requests next, newest last.
    """

    def __init__(self) -> None:
        self.count, self.gone, self.hidden = 0, False, False
        self.requested: list[int] = []

    def take(self, text: str) -> None:
        """Update the state with a message: a stamp, ``hidden``, ``seen``, or an acknowledgement."""
        if text.isdecimal():
            self.requested.append(int(text))
        elif text in ("hidden", "seen"):
            self.hidden = text == "hidden"
        else:
            self.count += 1


class Reader(Protocol):
    """Reader of one page: it hands over the pieces of a recording that the page gets next."""

    @property
    def news(self) -> News:
        """Tells when there are new pieces."""

    def take(self) -> Sequence[bytes | str]:
        """Return the pieces to send now. Empty: wait for news of the recording or of the page.

        A text is the number of the frame that the next piece holds.
        """


def write_at(file: int, content: bytes, start: int) -> None:
    """Write all bytes at a position of a file."""
    view = memoryview(content)
    while view:
        written = os.pwrite(file, view, start)
        view, start = view[written:], start + written


class RecordingBuffer(Closable):
    """Pieces of a recording in the order of their creation. Each is a whole ``.rrd``. They are kept on disk.

    Any thread may call ``add``. Every reader has its own position.

    Attributes:
        news: tells of each new piece.

    Raises:
        UserError: the disk of the temporary folder is full.
    """

    def __init__(self) -> None:
        with catch_full_disk():
            self._file = tempfile.TemporaryFile(prefix="bevviz-")  # noqa: SIM115, the file stays open until the buffer is closed
        self._ends = [0]
        self._lock = threading.Lock()
        self.news = News()

    def close(self) -> None:
        """Delete the temporary file. Readers get no more pieces."""
        with self._lock:
            self._ends = [0]
            self._file.close()

    def __len__(self) -> int:
        return len(self._ends) - 1

    def add(self, piece: bytes | None) -> None:
        """Append a piece. None is ignored.

        Raises:
            UserError: the disk of the temporary folder is full. The earlier pieces stay.
        """
        if not piece:
            return
        with self._lock:
            with catch_full_disk():
                write_at(self._file.fileno(), piece, self._ends[-1])
            self._ends.append(self._ends[-1] + len(piece))
        self.news.tell()

    def __getitem__(self, row: int) -> bytes:
        with self._lock:
            if not 0 <= row < len(self):
                raise IndexError(row)
            start, end = self._ends[row], self._ends[row + 1]
            return os.pread(self._file.fileno(), end - start, start)


class BufferReader:
    """Reader of a buffer from one row on.

    Args:
        buffer: the buffer.
        first: row of the first piece.
        state: state of the page.
        row_of: returns the row of the frame at a stamp. A frame that the page requests comes next, and the
            page gets no more than ``AHEAD`` pieces in advance. None: every piece is sent at once.
    """

    def __init__(
        self,
        buffer: RecordingBuffer,
        first: int,
        state: PageState,
        row_of: Callable[[int], int | None] | None = None,
    ) -> None:
        self._buffer, self._next, self._state, self._row_of = buffer, first, state, row_of
        self._early: set[int] = set()  # rows that were sent out of order
        self._sent = 0
        self.news = buffer.news

    def take(self) -> Sequence[bytes | str]:
        """Return the next piece, if the page can take one now."""
        row = self._requested_row()
        if row is None and (self._row_of is None or self._sent < self._state.count + AHEAD):
            while self._next in self._early:
                self._next += 1
            if self._next < len(self._buffer):
                row = self._next
                self._next += 1
        if row is None:
            return ()
        self._sent += 1
        return self._pieces(row)

    def _pieces(self, row: int) -> Sequence[bytes | str]:
        """Return the piece of a row, and before it what the page has to know of it."""
        return (self._buffer[row],)

    def _requested_row(self) -> int | None:
        """Return the row of the frame that the page requests, unless the page has it already."""
        while self._row_of is not None and self._state.requested:
            row = self._row_of(self._state.requested.pop())
            if row is not None and row >= self._next and row not in self._early:
                self._early.add(row)
                return row
        return None
