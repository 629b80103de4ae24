"""Notes that a user took about a drive, in a small file beside the bag: ``drive.mcap.notes.json``."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from bevviz.errors import UserError
from bevviz.support.files import atomic_write, read_text

SUFFIX = ".notes.json"
LONGEST = 2000  # most characters of a note


@dataclass(frozen=True, slots=True, order=True)
class Note:
    """One note.

    Attributes:
        stamp: sensor time of its frame, in nanoseconds.
        received: log time of its frame, 0 if unknown.
        text: text of the user.
        about: the object in words. Empty: the note is about the frame.
        pick: query parameter that selects the object in the workbench.
    """

    stamp: int
    received: int
    text: str
    about: str = ""
    pick: str = ""

    def __str__(self) -> str:
        return f"{self.about}: {self.text}" if self.about else self.text


class Notes:
    """Notes of one drive, in order of time. The file exists as long as there are notes.

    Args:
        paths: paths of the drive. The file lies beside the first.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        bag = paths[0].resolve()
        self.path = bag.with_name(bag.name + SUFFIX)
        self._lock = threading.Lock()

    def __iter__(self) -> Iterator[Note]:
        """Iterate over the notes.

        Raises:
            UserError: the file cannot be read.
        """
        return iter(self._read())

    def between(self, low: int, high: int) -> list[Note]:
        """Return the notes whose log time is in [low, high) nanoseconds.

        Raises:
            UserError: the file cannot be read.
        """
        return [note for note in self if low <= note.received < high]

    def add(self, note: Note) -> None:
        """Add a note.

        Raises:
            UserError: the file cannot be read or written. No note is lost.
        """
        text = note.text.strip()
        if not text or len(text) > LONGEST:
            raise UserError(f"a note has 1 to {LONGEST:,} characters, this one has {len(text):,}")
        with self._lock:
            self._write(sorted([*self._read(), note]))

    def remove(self, note: Note) -> None:
        """Remove a note.

        Raises:
            UserError: the file cannot be read or written.
        """
        with self._lock:
            self._write([other for other in self._read() if other != note])

    def _read(self) -> list[Note]:
        """Read the file."""
        if not self.path.exists():
            return []
        try:
            values = json.loads(read_text(self.path))
            return sorted(Note(**value) for value in values["notes"])
        except (ValueError, KeyError, TypeError, RecursionError):
            raise UserError(f"{self.path}: holds no notes as bevviz writes them; move it away") from None

    def _write(self, notes: Sequence[Note]) -> None:
        """Write the file, or delete it without notes."""
        if not notes:
            self.path.unlink(missing_ok=True)
            return
        text = json.dumps({"notes": [asdict(note) for note in notes]}, indent=1, ensure_ascii=False)
        with atomic_write(self.path, "notes") as file:
            try:
                file.path.write_bytes(f"{text}\n".encode(errors="replace"))
            except OSError as error:
                raise UserError(f"{self.path}: cannot write the notes: {error.strerror}") from None
