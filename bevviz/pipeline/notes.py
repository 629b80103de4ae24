"""Notes of a user about a drive and its findings, in a file beside the bag: ``drive.mcap.notes.json``.

Where the folder of the bag is read-only, the file is in the folder of the user's data.
"""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import PlainSerializer, TypeAdapter

from bevviz.bags.remote import beside
from bevviz.errors import UserError
from bevviz.support.files import atomic_write, data_folder, read_text
from bevviz.support.json_form import message_form

SUFFIX = ".notes.json"
LONGEST = 2000  # most characters of a note
STATES = ("done", "ignored")  # of a finding that the user has dealt with


# Nanoseconds. A message to the page has them as text, because JavaScript numbers cannot hold them.
Stamp = Annotated[int, PlainSerializer(str, when_used="json")]


@message_form
@dataclass(frozen=True, slots=True, order=True)
class Note:
    """One note.

    Attributes:
        stamp: sensor time of its frame, in nanoseconds.
        received: log time of its frame, 0 if unknown.
        text: text of the user.
        about: the object in words. Empty: the note is about the frame.
        pick: query parameter that selects the object in the workbench.
        end: sensor time of the last frame of the span that it is about, in nanoseconds. 0: a single frame.
        label: class of an object that is there, which the user has drawn a box of. Empty: it is a remark.
        box: centre x, y, z, length, width, height and yaw of that box in the frame of the points.
        points_frame: name of that frame.
    """

    stamp: Stamp
    received: Stamp
    text: str
    about: str = ""
    pick: str = ""
    end: Stamp = 0
    label: str = ""
    box: tuple[float, ...] = ()
    points_frame: str = ""

    def __str__(self) -> str:
        return f"{self.about}: {self.text}" if self.about else self.text


@message_form
@dataclass(frozen=True, slots=True)
class HandledFinding:
    """A finding of the workbench that the user has dealt with.

    Attributes:
        stamp: sensor time of its frame, in nanoseconds.
        what: kind of the finding.
        name: its class.
        pick: text of the selection of its object in that frame.
        distance: distance of the object in metres. None: unknown.
        state: done or ignored.
        text: reason of the user.
    """

    stamp: Stamp
    what: str
    name: str
    pick: str
    distance: float | None
    state: str
    text: str = ""

    @property
    def key(self) -> tuple[int, str, str, str]:
        """Values that tell the finding from others."""
        return self.stamp, self.what, self.name, self.pick


@dataclass(frozen=True, slots=True)
class _Content:
    """Content of the file."""

    notes: list[Note]
    findings: list[HandledFinding] = field(default_factory=list)


_CONTENT = TypeAdapter(_Content)


class Notes:
    """Notes of one drive, in order of time. The file exists as long as there are notes or handled findings.

    Args:
        paths: paths of the drive. The file lies beside the first.

    Raises:
        UserError: the folder is read-only, and the user has no home folder.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.path = _path_for(beside(paths[0]))
        self._lock = threading.Lock()

    def __iter__(self) -> Iterator[Note]:
        """Iterate over the notes.

        Raises:
            UserError: the file cannot be read.
        """
        return iter(self._read()[0])

    def handled(self) -> list[HandledFinding]:
        """Return the findings that the user has dealt with.

        Raises:
            UserError: the file cannot be read.
        """
        return self._read()[1]

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
            notes, findings = self._read()
            self._write(sorted([*notes, note]), findings)

    def remove(self, note: Note) -> None:
        """Remove a note.

        Raises:
            UserError: the file cannot be read or written.
        """
        with self._lock:
            notes, findings = self._read()
            self._write([other for other in notes if other != note], findings)

    def handle(self, finding: HandledFinding) -> None:
        """Keep that a finding is done or ignored. An empty state lists it again.

        Raises:
            UserError: the state is unknown, the text is too long, or the file cannot be read or written.
        """
        if finding.state not in ("", *STATES):
            raise UserError(f"a finding is {' or '.join(STATES)}, not '{finding.state}'")
        if len(finding.text) > LONGEST:
            raise UserError(f"a note has 1 to {LONGEST:,} characters, this one has {len(finding.text):,}")
        with self._lock:
            notes, findings = self._read()
            others = [other for other in findings if other.key != finding.key]
            self._write(notes, [*others, finding] if finding.state else others)

    def _read(self) -> tuple[list[Note], list[HandledFinding]]:
        """Read the file."""
        if not self.path.exists():
            return [], []
        try:
            content = _CONTENT.validate_json(read_text(self.path))
            return sorted(content.notes), content.findings
        except ValueError:
            raise UserError(f"{self.path}: holds no notes as bevviz writes them; move it away") from None

    def _write(self, notes: Sequence[Note], findings: Sequence[HandledFinding]) -> None:
        """Write the file, or delete it if nothing is in it."""
        if not notes and not findings:
            self.path.unlink(missing_ok=True)
            return
        content = _CONTENT.dump_python(_Content(list(notes), list(findings)))
        text = json.dumps(content, indent=1, ensure_ascii=False)
        with atomic_write(self.path, "notes") as file:
            try:
                file.path.write_bytes(f"{text}\n".encode(errors="replace"))
            except OSError as error:
                raise UserError(f"{self.path}: cannot write the notes: {error.strerror}") from None


def _path_for(bag: Path) -> Path:
    """Return the path of the notes of a bag."""
    file = bag.with_name(bag.name + SUFFIX)
    if file.exists() or not file.parent.is_dir() or os.access(file.parent, os.W_OK):
        return file
    folder, place = data_folder("the notes") / "notes", hashlib.sha256(os.fsencode(bag)).hexdigest()[:8]
    with suppress(OSError):  # The first note says so.
        folder.mkdir(parents=True, exist_ok=True)
    return folder / f"{bag.name}.{place}{SUFFIX}"
