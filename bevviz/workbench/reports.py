"""Bug reports that the page requests. A background thread makes them."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bevviz.bags.source import iso
from bevviz.config import changed_config
from bevviz.errors import UserError, first_line
from bevviz.model.protocols import Items, Observer
from bevviz.model.results import FrameResult

if TYPE_CHECKING:
    from bevviz.drive import Drive
    from bevviz.report.make import ReportRequest
    from bevviz.workbench.session import WorkbenchSession
    from bevviz.workbench.source import Settings

LONGEST = 600.0  # seconds before or after the frame, at most


@dataclass(slots=True)
class ReportJob:
    """A finished report, or the one in progress.

    Attributes:
        number: number in the address of its files.
        name: file name without suffix.
        settings: the settings that differ from those the drive was opened with.
        state: running, over, cancelled or failed.
        error: reason of the failure.
        done: number of finished frames.
        total: number of frames.
        files: paths of its files.
        stop: cancels the report when it is set.
    """

    number: int
    name: str
    settings: Settings = ()
    state: str = "running"
    error: str = ""
    done: int = 0
    total: int = 0
    files: list[Path] = field(default_factory=list)
    stop: threading.Event = field(default_factory=threading.Event)

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON for the page."""
        return {
            "number": self.number,
            "name": self.name,
            "settings": list(self.settings),
            "state": self.state,
            "error": self.error,
            "done": self.done,
            "total": self.total,
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


class ReportMaker:
    """Reports of a workbench session, made one at a time.

    Args:
        session: the workbench session.
        drive: its drive.
        paths: paths of the bag. The reports lie beside it, or in the working directory if its folder is
            read-only.

    Attributes:
        made: the reports, the newest last.
    """

    def __init__(self, session: WorkbenchSession, drive: Drive, paths: Sequence[Path]) -> None:
        self._session, self._drive, self._paths = session, drive, paths
        folder = paths[0].resolve().parent
        self._folder = folder if os.access(folder, os.W_OK | os.X_OK) else Path.cwd()
        self._tell = session.source.news.tell
        self._thread: threading.Thread | None = None
        self.made: list[ReportJob] = []

    def begin(self, number: int, settings: Settings, before: float, after: float, note: str) -> ReportJob:
        """Start to make a report.

        Args:
            number: number of the frame that it is about.
            settings: settings to make it with.
            before: seconds before the frame.
            after: seconds after the frame.
            note: what went wrong, in the user's words.

        Raises:
            UserError: a report is in progress, there is no such frame, the range is too long, or a value is
                wrong.
        """
        from bevviz.report.make import ReportRequest

        if self.made and self.made[-1].state == "running":
            raise UserError("a report is being made: wait for it, or cancel it")
        if not (0 <= before <= LONGEST and 0 <= after <= LONGEST):
            raise UserError(f"a report is of up to {LONGEST:g} seconds before and after")
        session, paths = self._session, self._paths
        received = session.source.look(number, settings).frame.received
        seconds = (received - int(self._drive.frames.scans[0])) / 1e9
        output = _free(self._folder, f"{paths[0].resolve().stem}-{seconds:.1f}s")
        low, high = received - round(before * 1e9), received + round(after * 1e9)
        request = ReportRequest(
            paths=paths,
            config=changed_config(self._drive.config, settings),
            at=iso(received),
            before=before,
            after=after,
            output=output,
            note=note.strip(),
            asked=session.asked_within(low, high, settings),
            asked_before=session.asked_within(low, high) if settings else (),
            notes=list(session.tools.notes),
        )
        report = ReportJob(len(self.made), output.stem, settings)
        self.made.append(report)
        self._thread = threading.Thread(target=self._make, args=(report, request), name="report", daemon=True)
        self._thread.start()
        self._tell()
        return report

    def end(self) -> None:
        """Cancel the report in progress. It keeps the frames until then."""
        if self.made:
            self.made[-1].stop.set()
        if self._thread is not None:
            self._thread.join()

    def _make(self, report: ReportJob, request: ReportRequest) -> None:
        from bevviz.report.make import make

        try:
            written = make(request, [_ReportProgress(report, self._tell)], report.stop)
            report.files = written.files
            report.state = "cancelled" if written.interrupted else "over"
        except Exception as error:
            report.error = str(error) if isinstance(error, UserError) else first_line(error)
            report.state = "failed"
        self._tell()


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
