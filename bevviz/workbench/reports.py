"""Bug reports that the page requests. A background thread makes them."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bevviz.bags.source import iso
from bevviz.config import revised
from bevviz.errors import UserError, first_line
from bevviz.model.protocols import Items, Observer
from bevviz.model.results import FrameResult

if TYPE_CHECKING:
    from bevviz.workbench.session import Bench, Settings

LONGEST = 600.0  # seconds before or after the frame, at most


@dataclass(slots=True)
class Report:
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
            "files": [{"name": path.name, "megabytes": path.stat().st_size / 1e6} for path in self._there()],
            "folder": str(self.files[0].parent) if self.files else "",
        }

    def _there(self) -> Sequence[Path]:
        """Return its files that exist."""
        return [path for path in self.files if path.is_file()]

    def file(self, name: str) -> Path | None:
        """Return the path of a file by its name, if it exists."""
        return next((path for path in self._there() if path.name == name), None)


class Reports:
    """Reports of a workbench session, made one at a time.

    Args:
        bench: the workbench session.
        news: called when the state of a report has changed.
        folder: output folder, see ``folder_of``.
    """

    def __init__(self, bench: Bench, news: Callable[[], None], folder: Path) -> None:
        self._bench, self._news, self._folder = bench, news, folder
        self._thread: threading.Thread | None = None
        self.made: list[Report] = []

    def begin(self, number: int, settings: Settings, before: float, after: float, note: str) -> Report:
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
        bench = self._bench
        received = bench.look(number, settings).frame.received
        seconds = (received - int(bench.drive.frames.scans[0])) / 1e9
        output = _free(self._folder, f"{bench.paths[0].resolve().stem}-{seconds:.1f}s")
        low, high = received - round(before * 1e9), received + round(after * 1e9)
        request = ReportRequest(
            paths=bench.paths,
            config=revised(bench.drive.config, settings),
            at=iso(received),
            before=before,
            after=after,
            output=output,
            note=note.strip(),
            asked=bench.asked_within(low, high, settings),
            asked_before=bench.asked_within(low, high) if settings else (),
            notes=list(bench.notes),
        )
        report = Report(len(self.made), output.stem, settings)
        self.made.append(report)
        self._thread = threading.Thread(target=self._make, args=(report, request), name="report", daemon=True)
        self._thread.start()
        self._news()
        return report

    def end(self) -> None:
        """Cancel the report in progress. It keeps the frames until then."""
        if self.made:
            self.made[-1].stop.set()
        if self._thread is not None:
            self._thread.join()

    def _make(self, report: Report, request: Any) -> None:
        from bevviz.report.make import make

        try:
            written = make(request, [_Counting(report, self._news)], report.stop)
            report.files = written.files
            report.state = "cancelled" if written.interrupted else "over"
        except Exception as error:
            report.error = str(error) if isinstance(error, UserError) else first_line(error)
            report.state = "failed"
        self._news()


class _Counting(Observer[FrameResult]):
    """Observer that counts the finished frames of a report."""

    def __init__(self, report: Report, news: Callable[[], None]) -> None:
        self._report, self._news = report, news

    def begin(self, items: Items[object]) -> None:
        self._report.total = items.total or 0

    def see(self, result: FrameResult) -> None:
        self._report.done += 1
        self._news()


def folder_of(paths: Sequence[Path]) -> Path:
    """Return the folder of the bag, or the working directory if that folder is read-only."""
    beside = paths[0].resolve().parent
    return beside if os.access(beside, os.W_OK | os.X_OK) else Path.cwd()


def _free(folder: Path, stem: str) -> Path:
    """Return a path that no report has yet."""
    number = 1
    while True:
        path = folder / f"{stem}{f'-{number}' if number > 1 else ''}.rrd"
        if not any(path.with_suffix(suffix).exists() for suffix in (".rrd", ".html", ".mcap")):
            return path
        number += 1
