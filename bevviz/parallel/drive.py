"""A drive in windows: they are made side by side, and what needs the order of frames as they come in."""

from __future__ import annotations

import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import closing
from functools import partial
from pathlib import Path
from threading import Event
from typing import TypeVar

from bevviz import remains
from bevviz.bags.source import BagSource
from bevviz.bags.state import Losses
from bevviz.closing import Closing
from bevviz.config import Config
from bevviz.engine.task import Engine, JobResult
from bevviz.errors import UserError
from bevviz.frame import Scene
from bevviz.logging.sinks import Sinks
from bevviz.parallel.work import Batched, WindowJob, results_in
from bevviz.protocols import Items, Observer
from bevviz.results import FrameResult
from bevviz.session import Session
from bevviz.stage_loader import Stages
from bevviz.stages.foreign import Foreign

LENGTH = 25  # frames of a window, at most
SHORTEST = 8  # each begins with a frame that is made for nothing
SHARE = 2  # windows that each process should have of what is left
AHEAD = 2  # windows that are cut before a process is free, and made before they are put in order
RETRIES = 2  # of a window whose process died

T = TypeVar("T")


def obstacle(frames: object, stages: Stages) -> str:
    """Why a drive cannot be cut, in one sentence; empty where it can."""
    if not isinstance(frames, BagSource):
        return "only the frames of a bag can be cut into windows"
    given = [f for f in (stages.ground, stages.clustering, stages.objects, stages.network) if f is not None]
    for stage in given:
        if isinstance(stage, Foreign):
            return f"{stage.name} may remember what it saw: no frame is sure without those before it"
    return ""


class Windows(Closing):
    """The windows of a drive: cut here, made elsewhere, and put in order here.

    Args:
        source: is read for it, without making frames.
        config: how they are made.
        recording_id: of the recording that they become part of.
        workers: windows that are made at the same time.
        place: folder for what is on its way.
        batch: what is made of them beside, where the drive is one of many.
    """

    def __init__(
        self,
        source: BagSource,
        config: Config,
        recording_id: str,
        workers: int,
        place: Path | None = None,
        batch: Batched | None = None,
    ) -> None:
        self._source, self._config, self._id = source, config, recording_id
        self._workers, self._batch = workers, batch
        self._waiting: deque[WindowJob] = deque()
        self._made: set[str] = set()
        self._folder = Path(tempfile.mkdtemp(prefix=".bevviz-windows-", dir=place)).resolve()
        remains.remember(self, partial(shutil.rmtree, self._folder, ignore_errors=True))

    def close(self) -> None:
        """Whatever is left of what was on its way goes."""
        shutil.rmtree(self._folder, ignore_errors=True)
        remains.forget(self)

    @property
    def scene(self) -> Scene:
        return self._source.scene

    @property
    def total(self) -> int:
        return self._source.total

    @property
    def warnings(self) -> Sequence[str]:
        return self._source.warnings

    def add_losses(self, losses: Losses) -> None:
        """What the frames of a window lacked, for the warnings."""
        self._source.add_losses(losses)

    def _length(self, left: int) -> int:
        """Long windows first, short ones in the end, so that no process waits long for the last: guided
        self-scheduling (Polychronopoulos and Kuck 1987)."""
        return min(LENGTH, max(SHORTEST, -(-left // (SHARE * self._workers))))

    def jobs(self) -> Generator[WindowJob, None, None]:
        """What is to be made."""
        paths = tuple(path.resolve() for path in self._source.recording.paths)
        with closing(ahead(self._source.windows(self._length), AHEAD)) as windows:
            for window in windows:
                job = WindowJob(
                    window, paths, self._config, self._source.selection, self._folder, self._id, self._batch
                )
                self._waiting.append(job)
                yield job

    def ended(self, end: JobResult) -> Iterator[WindowJob]:
        """The windows that are in order now that one of them has ended. Whoever takes one removes its files.

        Raises:
            UserError: it could not be made.
        """
        if end.error:
            raise UserError(f"{end.name}: {end.error}")
        self._made.add(end.name)
        while self._waiting and self._waiting[0].name in self._made:
            job = self._waiting.popleft()
            self._made.remove(job.name)
            yield job

    @property
    def on_their_way(self) -> int:
        """Windows that were given out and did not come back in order."""
        return len(self._waiting)


class MadeWindows:
    """The windows of one drive, in order, each when it and all before it are made. Items of a run.

    Args:
        windows: of the drive.
        engine: what makes them.
        on_frame: called for each frame that is made, in the order in which they are.
    """

    def __init__(self, windows: Windows, engine: Engine, on_frame: Callable[[], None] = lambda: None) -> None:
        self._windows, self._engine, self._on_frame = windows, engine, on_frame
        self._stopped = Event()

    @property
    def scene(self) -> Scene:
        return self._windows.scene

    @property
    def total(self) -> int:
        return self._windows.total

    @property
    def warnings(self) -> Sequence[str]:
        return self._windows.warnings

    def stop(self) -> None:
        """At once, but for the window at hand."""
        self._stopped.set()

    def __iter__(self) -> Iterator[WindowJob]:
        # Workers get their next window while others are put in order.
        with closing(self._in_order()) as windows, closing(ahead(windows, AHEAD)) as drawn:
            try:
                yield from drawn
            except _StoppedError:
                return
            finally:
                self._stopped.set()

    def _in_order(self) -> Generator[WindowJob, None, None]:
        def tick() -> None:
            if self._stopped.is_set():
                raise _StoppedError

        with (
            closing(self._windows.jobs()) as jobs,
            closing(self._engine.run(jobs, RETRIES, self._on_frame, tick)) as ends,
        ):
            for end in ends:
                yield from self._windows.ended(end)


class AsTheyAre:
    """Processor of items that are made already."""

    def perceive(self, item: WindowJob, network: Executor | None = None, /) -> WindowJob:
        return item

    def finish(self, item: WindowJob, /) -> WindowJob:
        return item


class InOrder(Observer[WindowJob]):
    """Makes of each window what needs the frames before it, and shows its results to others.

    Args:
        windows: where they come from.
        session: remembers the drive.
        sinks: where the part of the recording goes that each window has made.
        observers: of the results, which lack what only their frame needs: the points' fields, images, voxels.

    Attributes:
        extras: what a batch has of the frame that the observers see.
    """

    def __init__(
        self,
        windows: Windows,
        session: Session,
        sinks: Sinks,
        observers: Sequence[Observer[FrameResult]],
    ) -> None:
        self.frames = 0
        self.extras: Mapping[str, bytes] = {}
        self._windows, self._session, self._sinks, self._observers = windows, session, sinks, observers
        self._begun: list[Observer[FrameResult]] = []

    def begin(self, items: Items[object]) -> None:
        for observer in self._observers:
            observer.begin(items)
            self._begun.append(observer)

    def see(self, result: WindowJob) -> None:
        self._sinks.add(result.recording)
        for found in results_in(result.results, self._session.config):
            if isinstance(found, Losses):
                self._windows.add_losses(found)
                continue
            self.extras = found.extras
            tracked = self._session.track(found.result)
            if len(tracked.failures) > len(found.result.failures):
                tracked = found.explained(tracked)
            whole = self._session.watch(tracked)
            for observer in self._observers:
                observer.see(whole)
            self.frames += 1
        for path in (result.recording, result.results):
            path.unlink(missing_ok=True)

    def end(self) -> None:
        for observer in self._begun:
            observer.end()


class _StoppedError(Exception):
    """The rest is not wanted."""


def ahead(items: Iterable[T], count: int) -> Generator[T, None, None]:
    """The items, so many of them drawn before they are asked for, in a thread of its own."""
    source = iter(items)
    waiting: deque[Future[T | None]] = deque()
    drawer = ThreadPoolExecutor(1, "windows")
    try:
        waiting.extend(drawer.submit(next, source, None) for _ in range(count))
        while (item := waiting.popleft().result()) is not None:
            waiting.append(drawer.submit(next, source, None))
            yield item
    finally:
        drawer.shutdown(cancel_futures=True)
