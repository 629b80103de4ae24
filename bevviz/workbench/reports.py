"""Bug reports that the page requests."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from bevviz.bags.remote import beside
from bevviz.config import Config
from bevviz.model.protocols import Items, Observer
from bevviz.model.results import FrameResult
from bevviz.support.json_form import message_form
from bevviz.workbench.jobs import Job, Jobs

if TYPE_CHECKING:
    from bevviz.report.make import ReportRequest
    from bevviz.workbench.growing_drive import Settings

LONGEST = 600.0  # seconds before or after the frame, at most


@dataclass(frozen=True, slots=True)
class ReportFile:
    """File of a report."""

    name: str
    megabytes: float


@message_form
@dataclass(slots=True)
class ReportJob(Job):
    """A finished report, or the one in progress. ``settings`` are the tried values that it tells of.

    Attributes:
        name: file name without suffix. Its number is in the address of its files.
        files: its files.
        folder: path of their folder.
    """

    name: str = ""
    files: list[ReportFile] = field(default_factory=list)
    folder: str = ""

    def file(self, name: str) -> Path | None:
        """Return the path of a file by its name, if it exists."""
        path = Path(self.folder, name)
        return path if name in [file.name for file in self.files] and path.is_file() else None


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


def folder_beside(paths: Sequence[Path]) -> Path:
    """Return the folder of a bag, or the working directory if that is read-only."""
    folder = beside(paths[0]).parent
    return folder if os.access(folder, os.W_OK | os.X_OK) else Path.cwd()


class ReportMaker(Jobs[ReportJob]):
    """Reports of a workbench session.

    Args:
        tell: tells the pages about progress.
        bag_of: returns the bag that has a frame.
        folder: folder of the reports.
    """

    def __init__(self, tell: Callable[[], None], bag_of: Callable[[int], ReportedBag], folder: Path) -> None:
        super().__init__("report", tell)
        self.bag_of, self._folder = bag_of, folder

    def output(self, bag: ReportedBag, received: int) -> Path:
        """Return the path of the next report about a frame."""
        seconds = (received - bag.start) / 1e9
        return _free(self._folder, f"{beside(bag.paths[0]).stem}-{seconds:.1f}s")

    def begin(self, request: ReportRequest, settings: Settings) -> ReportJob:
        """Start to make a report. It tells of what the settings change."""
        report = ReportJob(len(self.jobs), settings, name=request.output.stem)
        self.start(report, partial(self._make, request))
        return report

    def _make(self, request: ReportRequest, report: ReportJob) -> None:
        from bevviz.report.make import make

        paths = make(request, [_ReportProgress(report, self._tell)], report.stop).files
        report.files = [ReportFile(path.name, path.stat().st_size / 1e6) for path in paths]
        report.folder = str(request.output.parent)


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
