"""Buffer of the recording that the viewers show. A viewer that connects late reads it from the start."""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Callable

from bevviz.support.contexts import Closable
from bevviz.support.files import catch_full_disk


class RecordingBuffer(Closable):
    """Pieces of a recording in the order of their creation. Each is a whole ``.rrd``. They are kept on disk.

    Any thread may call ``add``. Every reader has its own position.

    Raises:
        UserError: the disk of the temporary folder is full.
    """

    def __init__(self) -> None:
        with catch_full_disk():
            self._file = tempfile.TemporaryFile(prefix="bevviz-")  # noqa: SIM115, the file stays open until the buffer is closed
        self._ends = [0]
        self._lock = threading.Lock()
        self._listeners: list[Callable[[], None]] = []

    def close(self) -> None:
        """Delete the temporary file."""
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
            view, end = memoryview(piece), self._ends[-1]
            with catch_full_disk():
                while view:
                    written = os.pwrite(self._file.fileno(), view, end)
                    view, end = view[written:], end + written
            self._ends.append(end)
            listeners = tuple(self._listeners)
        for listener in listeners:
            listener()

    def __getitem__(self, row: int) -> bytes:
        if not 0 <= row < len(self):
            raise IndexError(row)
        start, end = self._ends[row], self._ends[row + 1]
        return os.pread(self._file.fileno(), end - start, start)

    def listen(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call the listener, from any thread, for each new piece. Return a function that ends this."""
        with self._lock:
            self._listeners.append(listener)

        def end() -> None:
            with self._lock:
                self._listeners.remove(listener)

        return end
