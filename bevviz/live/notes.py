"""Messages to the user during a live run: on the terminal and in the recording."""

from __future__ import annotations

import threading
from collections.abc import Callable


class Notes:
    """Collector of messages to the user, one sentence each. Any thread may use it.

    Args:
        say: prints a line.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._lock = threading.Lock()
        self._waiting: list[tuple[str, str]] = []

    def info(self, text: str) -> None:
        """Print and record a sentence."""
        self._add("INFO", text, text)

    def warn(self, text: str) -> None:
        """Print and record a warning."""
        self._add("WARN", text, f"warning: {text}")

    def take(self) -> list[tuple[str, str]]:
        """Return level and text of the messages since the last call."""
        with self._lock:
            taken, self._waiting = self._waiting, []
        return taken

    def _add(self, level: str, text: str, line: str) -> None:
        with self._lock:
            self._waiting.append((level, text))
            del self._waiting[:-100]  # keeps the list short while no frame takes the messages
        self._say(line)
