"""Search of parameters that repair the drive of a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bevviz.errors import UserError
from bevviz.support.json_form import message_form
from bevviz.workbench.jobs import Job, Jobs

if TYPE_CHECKING:
    from bevviz.workbench.growing_drive import GrowingDrive


@message_form
@dataclass(slots=True)
class FixJob(Job):
    """Search of a fix. ``settings`` are those that repair the drive.

    Attributes:
        text: its result in words.
    """

    text: str = ""


class FixSearch(Jobs[FixJob]):
    """Searches of a fix for the missed and false objects of a recorded drive, as ``bevviz fix`` makes them.

    Args:
        source: the drive. Questions about it come first.
        paths: paths of its bag.
        truth: stated topic of the ground truth.
        labels: stated label files.
    """

    def __init__(
        self, source: GrowingDrive, paths: Sequence[Path], truth: str | None, labels: Path | None
    ) -> None:
        super().__init__("fix", source.news.tell)
        self._source, self._paths, self._truth, self._labels = source, tuple(paths), truth, labels

    def begin(self) -> None:
        """Start to search.

        Raises:
            UserError: a search is running, or there is no ground truth.
        """
        self.check_idle("a fix is being searched")
        if not self._source.has_truth:
            raise UserError("there is no ground truth, by which a fix is judged")
        self.start(FixJob(len(self.jobs)), self._search)

    def _search(self, job: FixJob) -> None:
        """Search the parameters that decide what is missed or false."""
        from bevviz.why.fix import TRIALS, DriveFrames, draw_samples, find_fix, keys_for, text_of

        def pause() -> None:
            """Tell the pages, and wait until no question is being answered."""
            self._source.news.tell()
            self._source.wait_for_quiet()
            job.check()

        def count(number: int) -> None:
            job.done = min(job.done + number, job.total)
            pause()

        config = self._source.pipeline.config
        drive = DriveFrames(self._paths, "drive", range(self._source.scans), frozenset())
        choosing, confirming, parts = draw_samples(
            [drive], config, truth=self._truth, kitti=self._labels, tick=lambda _: pause()
        )
        keys = keys_for(choosing.reasons(config), config)
        if not keys:
            job.text = "Nothing that a parameter decides is missed or false."
            return
        job.total = TRIALS
        fix = find_fix(config, keys, choosing, confirming, tick=count, parts=parts)
        job.settings = tuple(f"{key}={text_of(value)}" for key, value in fix.settings.items())
        job.text = "\n".join(line.strip() for line in fix.lines() if "--set" not in line)
