"""Bug reports that the page requests."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from bevviz.bags.remote import beside
from bevviz.bags.source import iso
from bevviz.config import Config, changed_config
from bevviz.errors import UserError
from bevviz.model.protocols import Items, Observer
from bevviz.model.results import FrameResult
from bevviz.workbench.jobs import Job, Jobs

if TYPE_CHECKING:
    from bevviz.pipeline.notes import Note
    from bevviz.report.make import ReportRequest
    from bevviz.report.report_subject import TriedValues
    from bevviz.why import Answer
    from bevviz.why.identity import Identity
    from bevviz.workbench.growing_drive import GrowingDrive, Settings
    from bevviz.workbench.page_types import ReportEntry

LONGEST = 600.0  # seconds before or after the frame, at most


@dataclass(slots=True)
class ReportJob(Job):
    """A finished report, or the one in progress. ``settings`` are the tried values that it tells of.

    Attributes:
        name: file name without suffix. Its number is in the address of its files.
        files: paths of its files.
    """

    name: str = ""
    files: list[Path] = field(default_factory=list)

    def as_dict(self) -> ReportEntry:
        """Return the report as JSON for the page."""
        return {
            **Job.as_dict(self),
            "name": self.name,
            "files": [
                {"name": path.name, "megabytes": path.stat().st_size / 1e6} for path in self._existing_files()
            ],
            "folder": str(self.files[0].parent) if self.files else "",
        }

    def _existing_files(self) -> Sequence[Path]:
        """Return its files that exist."""
        return [path for path in self.files if path.is_file()]

    def file(self, name: str) -> Path | None:
        """Return the path of a file by its name, if it exists."""
        return next((path for path in self._existing_files() if path.name == name), None)


@dataclass(frozen=True, slots=True)
class ReportedBag:
    """Bag that a report is cut from.

    Attributes:
        paths: its paths.
        config: configuration of the report.
        start: log time of its first scan, in nanoseconds.
    """

    paths: Sequence[Path]
    config: Config
    start: int


class QuestionLog(Protocol):
    """Answers and notes of a workbench session, which a report quotes."""

    source: GrowingDrive

    def notes(self) -> list[Note]:
        """Return the notes."""

    def about(self, number: int, identity: Identity) -> Answer:
        """Return the answer about an object in a frame of the drive as opened."""

    def asked_within(self, low: int, high: int) -> list[tuple[int, Answer]]:
        """Return number of the frame and answer of each question in a range of log times, newest first."""

    def tried_on(self, number: int, settings: Settings, answer: Answer | None) -> TriedValues:
        """Return what other values do to the object of an answer, to its frame, and to the drive."""


def folder_beside(paths: Sequence[Path]) -> Path:
    """Return the folder of a bag, or the working directory if that is read-only."""
    folder = beside(paths[0]).parent
    return folder if os.access(folder, os.W_OK | os.X_OK) else Path.cwd()


class ReportMaker(Jobs[ReportJob]):
    """Reports of a workbench session.

    Args:
        session: the workbench session.
        bag_of: returns the bag that has a frame.
        folder: folder of the reports.
    """

    def __init__(self, session: QuestionLog, bag_of: Callable[[int], ReportedBag], folder: Path) -> None:
        super().__init__("report", session.source.news.tell)
        self._session, self._bag_of, self._folder = session, bag_of, folder

    def begin(
        self,
        number: int,
        settings: Settings,
        before: float,
        after: float,
        note: str,
        identity: Identity | None = None,
    ) -> ReportJob:
        """Start to make a report.

        Args:
            number: number of the frame that it is about.
            settings: values that are tried. The report is of the drive as opened, and says what they change.
            before: seconds before the frame.
            after: seconds after the frame.
            note: what went wrong, in the user's words.
            identity: the object that the page shows. None: the report is about the worst of the frame.

        Raises:
            UserError: a report is in progress, there is no such frame, the object is not in it, the range is
                too long, or a value is wrong.
        """
        from bevviz.report.make import ReportRequest

        self.check_idle("a report is being made")
        if not (0 <= before <= LONGEST and 0 <= after <= LONGEST):
            raise UserError(f"a report is of up to {LONGEST:g} seconds before and after")
        session, bag = self._session, self._bag_of(number)
        received = session.source.look(number, settings).frame.received
        seconds = (received - bag.start) / 1e9
        output = _free(self._folder, f"{beside(bag.paths[0]).stem}-{seconds:.1f}s")
        low, high = received - round(before * 1e9), received + round(after * 1e9)
        about = None if identity is None else session.about(number, identity)
        changed_config(bag.config, settings)  # Wrong values are told before the report is begun.
        request = ReportRequest(
            paths=bag.paths,
            config=bag.config,
            at=iso(received),
            before=before,
            after=after,
            output=output,
            note=note.strip(),
            answers=[] if about is None else [about],
            result=session.source.look(number),
            asked=[answer for frame, answer in session.asked_within(low, high) if frame != number],
            tried=session.tried_on(number, settings, about) if settings else None,
            notes=session.notes(),
        )
        report = ReportJob(len(self.jobs), settings, name=output.stem)
        self.start(report, partial(self._make, request))
        return report

    def _make(self, request: ReportRequest, report: ReportJob) -> None:
        from bevviz.report.make import make

        report.files = make(request, [_ReportProgress(report, self._tell)], report.stop).files


class _ReportProgress(Observer[FrameResult]):
    """Observer that counts the finished frames of a report."""

    def __init__(self, report: ReportJob, tell: Callable[[], None]) -> None:
        self._report, self._tell = report, tell

    def begin(self, items: Items[object]) -> None:
        self._report.total = items.total or 0

    def observe(self, result: FrameResult) -> None:
        self._report.done += 1
        self._tell()


def _free(folder: Path, stem: str) -> Path:
    """Return a path that no report has yet."""
    number = 1
    while True:
        path = folder / f"{stem}{f'-{number}' if number > 1 else ''}.rrd"
        if not any(path.with_suffix(suffix).exists() for suffix in (".rrd", ".html", ".mcap")):
            return path
        number += 1
