"""Report of the damage of a file, and the interface of readers of damaged files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from bevviz.bags.reader import Reader, megabytes

REPAIR = "'bevviz recover' writes a sound copy"


@dataclass
class DamageReport:
    """Counts of the messages that were read and lost. All reading of a file adds to it."""

    read: int | None = None  # messages that a scan of the file found; None: no scan was necessary
    rescued: int = 0  # messages of these in a last chunk whose end is missing
    cut: int = 0  # bytes of this last chunk
    chunks: dict[int, str] = field(default_factory=dict)  # damage by number of the chunk
    missing: int = 0  # messages that an index lists and that are lost
    doubtful: int = 0  # messages read from damaged chunks
    undescribed: int = 0  # messages of topics without a description
    incomplete: int = 0  # messages without their end
    unread: int = 0  # messages that could no longer be read after the scan
    broken: int = 0  # places without a sound record
    passed: int = 0  # bytes passed over in these places
    log_pages: int = 0  # pages of a database's log with a wrong checksum
    stated: int | None = None  # messages by the statistics of the file

    @property
    def lost(self) -> int:
        """Number of messages that are known to be lost."""
        counted = self.missing + self.undescribed + self.incomplete + self.unread
        return max(counted, (self.stated or 0) - self.read) if self.read is not None else counted

    @property
    def sentences(self) -> list[str]:
        """Rescued and lost messages, one sentence each."""
        notes = []
        if self.read is not None:
            last = (
                f", {self.rescued} of them from the incomplete last {megabytes(self.cut)}" if self.cut else ""
            )
            notes.append(f"read {self.read} messages{last}; {REPAIR}")
        if self.chunks:
            ((why, _),) = Counter(self.chunks.values()).most_common(1)
            doubt = f", {self.doubtful} that were kept may be wrong" if self.doubtful else ""
            notes.append(f"{len(self.chunks)} damaged chunk(s), {why}: {self.missing} messages lost{doubt}")
        elif self.missing:
            notes.append(f"{self.missing} messages that the index of a chunk lists are not there: lost")
        if self.incomplete:
            notes.append(f"{self.incomplete} more are incomplete: lost")
        if self.undescribed:
            notes.append(f"{self.undescribed} messages are of topics that nothing describes: lost")
        if self.broken:
            size = f", {megabytes(self.passed)}" if self.passed else ""
            notes.append(f"{self.broken} broken place(s){size}, passed over")
        if self.log_pages:
            notes.append(f"{self.log_pages} page(s) of the log do not fit their checksum")
        if self.unread:
            notes.append(f"{self.unread} messages could no longer be read: lost")
        if self.read is not None and self.stated is not None and self.stated > self.read:
            notes.append(f"its statistics count {self.stated} messages: {self.stated - self.read} are lost")
        return notes


class DamagedReader(Reader, Protocol):
    """Reader of a damaged file. It reads around damage and never raises DamageError."""

    report: DamageReport

    @property
    def warnings(self) -> Sequence[str]:
        """Sentences of the report."""
        return self.report.sentences
