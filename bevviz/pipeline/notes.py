"""What a user has noted of a drive, in a small file beside the bag: ``drive.mcap.notes.json``."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from bevviz.errors import UserError
from bevviz.support.files import read_text, written

SUFFIX = ".notes.json"
LONGEST = 2000  # characters of a note


@dataclass(frozen=True, slots=True, order=True)
class Note:
    """One of them.

    Attributes:
        stamp: sensor time of the frame that it is of, in nanoseconds.
        received: log time of that, 0 where it is not known.
        text: what was noted.
        about: the object, in words; empty: the frame.
        pick: that asks about it in the workbench.
    """

    stamp: int
    received: int
    text: str
    about: str = ""
    pick: str = ""

    def __str__(self) -> str:
        return f"{self.about}: {self.text}" if self.about else self.text


class Notes:
    """Those of one drive, in order of time. The file is there as long as there are any.

    Args:
        paths: of the drive; the file is beside the first.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        bag = paths[0].resolve()
        self.path = bag.with_name(bag.name + SUFFIX)
        self._lock = threading.Lock()

    def __iter__(self) -> Iterator[Note]:
        """Raises UserError where the file cannot be read."""
        return iter(self._read())

    def between(self, low: int, high: int) -> list[Note]:
        """Those whose log time is in [low, high) nanoseconds.

        Raises:
            UserError: the file cannot be read.
        """
        return [note for note in self if low <= note.received < high]

    def add(self, note: Note) -> None:
        """Raises UserError where the file cannot be read or written; nothing is lost then."""
        text = note.text.strip()
        if not text or len(text) > LONGEST:
            raise UserError(f"a note has 1 to {LONGEST:,} characters, this one has {len(text):,}")
        with self._lock:
            self._write(sorted([*self._read(), note]))

    def remove(self, note: Note) -> None:
        """Raises UserError where the file cannot be read or written."""
        with self._lock:
            self._write([other for other in self._read() if other != note])

    def _read(self) -> list[Note]:
        if not self.path.exists():
            return []
        try:
            values = json.loads(read_text(self.path))
            return sorted(Note(**value) for value in values["notes"])
        except (ValueError, KeyError, TypeError, RecursionError):
            raise UserError(f"{self.path}: holds no notes as bevviz writes them; move it away") from None

    def _write(self, notes: Sequence[Note]) -> None:
        if not notes:
            self.path.unlink(missing_ok=True)
            return
        text = json.dumps({"notes": [asdict(note) for note in notes]}, indent=1, ensure_ascii=False)
        with written(self.path, "notes") as given:
            try:
                given.path.write_bytes(f"{text}\n".encode(errors="replace"))
            except OSError as error:
                raise UserError(f"{self.path}: cannot write the notes: {error.strerror}") from None
