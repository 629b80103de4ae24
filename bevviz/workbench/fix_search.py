"""Search of parameters that repair the drive of a page, in a background thread."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bevviz.errors import UserError, first_line

if TYPE_CHECKING:
    from bevviz.fleet.fix import Fix
    from bevviz.workbench.source import Settings, Source


class FixSearch:
    """Search of a fix for the missed and false objects of a recorded drive, as ``bevviz fix`` makes it.

    Args:
        source: the drive. Questions about it come first.
        paths: paths of its bag.
        truth: stated topic of the ground truth.
        labels: stated label files.

    Attributes:
        state: empty before the first search; running, over, cancelled or failed.
    """

    def __init__(self, source: Source, paths: Sequence[Path], truth: str | None, labels: Path | None) -> None:
        self._source, self._paths, self._truth, self._labels = source, tuple(paths), truth, labels
        self._stop = threading.Event()
        self.state = ""
        self._done = self._total = 0
        self._text = ""
        self._settings: Settings = ()

    def begin(self) -> None:
        """Start to search.

        Raises:
            UserError: a search is running, or there is no ground truth.
        """
        if self.state == "running":
            raise UserError("a fix is being searched: wait for it, or cancel it")
        if self._source.truth_of is None:
            raise UserError("there is no ground truth, by which a fix is judged")
        self._stop.clear()
        self.state, self._done, self._total, self._text, self._settings = "running", 0, 0, "", ()
        threading.Thread(target=self._run, name="fix", daemon=True).start()
        self._source.news.tell()

    def end(self) -> None:
        """Cancel the search. It ends after the settings in progress."""
        self._stop.set()

    def as_dict(self) -> dict[str, Any]:
        """Return the search as JSON for the page."""
        return {
            "state": self.state,
            "done": self._done,
            "total": self._total,
            "text": self._text,
            "settings": list(self._settings),
        }

    def _run(self) -> None:
        from bevviz.fleet.fix import text_of

        try:
            fix = self._search()
            if fix is None:
                self._text = "Nothing that a parameter decides is missed or false."
            else:
                self._settings = tuple(f"{key}={text_of(value)}" for key, value in fix.settings.items())
                self._text = "\n".join(line.strip() for line in fix.lines() if "--set" not in line)
            self.state = "over"
        except _CancelledError:
            self.state = "cancelled"
        except Exception as error:
            self._text = str(error) if isinstance(error, UserError) else first_line(error)
            self.state = "failed"
        self._source.news.tell()

    def _search(self) -> Fix | None:
        """Return the fix. None: no parameter decides what is missed or false."""
        from bevviz.fleet.fix import TRIALS, DriveFrames, draw_samples, find_fix, keys_for

        config = self._source.pipeline.config
        drive = DriveFrames(self._paths, "drive", range(self._source.scans), frozenset())
        choosing, confirming, parts = draw_samples(
            [drive], config, truth=self._truth, kitti=self._labels, tick=lambda _: self._pause()
        )
        keys = keys_for(choosing.reasons(config), config)
        if not keys:
            return None
        self._total = TRIALS
        return find_fix(config, keys, choosing, confirming, tick=self._count, parts=parts)

    def _count(self, number: int) -> None:
        self._done = min(self._done + number, self._total)
        self._pause()

    def _pause(self) -> None:
        """Tell the pages, and wait until no question is being answered."""
        self._source.news.tell()
        self._source.wait_for_quiet()
        if self._stop.is_set():
            raise _CancelledError


class _CancelledError(Exception):
    """The search was cancelled."""
