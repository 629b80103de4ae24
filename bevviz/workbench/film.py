"""What the viewers of a page are shown: pieces of a recording, from the first for whoever joins late."""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Callable

from bevviz.closing import Closing


class Film(Closing):
    """Pieces in the order in which they were made, each a whole ``.rrd``, on disk rather than in memory.

    ``add`` may be called from any thread; every reader goes on at its own pace.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(prefix="bevviz-")  # noqa: SIM115, it lives as long as the film
        self._ends = [0]
        self._lock = threading.Lock()
        self._listeners: list[Callable[[], None]] = []

    def close(self) -> None:
        self._file.close()

    def __len__(self) -> int:
        return len(self._ends) - 1

    def add(self, piece: bytes | None) -> None:
        """None is nothing."""
        if not piece:
            return
        with self._lock:
            view, end = memoryview(piece), self._ends[-1]
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
        """Call it, from some thread, whenever there is more. Returns what ends that."""
        with self._lock:
            self._listeners.append(listener)

        def end() -> None:
            with self._lock:
                self._listeners.remove(listener)

        return end
