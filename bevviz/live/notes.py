"""What has to be said while a robot is watched: on the terminal, and in the recording beside the frames."""

from __future__ import annotations

import threading
from collections.abc import Callable


class Notes:
    """One sentence each, from any thread.

    Args:
        say: prints a line.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._lock = threading.Lock()
        self._waiting: list[tuple[str, str]] = []

    def info(self, text: str) -> None:
        self._add("INFO", text, text)

    def warn(self, text: str) -> None:
        self._add("WARN", text, f"warning: {text}")

    def take(self) -> list[tuple[str, str]]:
        """Level and text of what was said since the last call."""
        with self._lock:
            taken, self._waiting = self._waiting, []
        return taken

    def _add(self, level: str, text: str, line: str) -> None:
        with self._lock:
            self._waiting.append((level, text))
            del self._waiting[:-100]  # nobody takes them while no frame comes
        self._say(line)
