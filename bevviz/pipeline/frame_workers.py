"""Worker processes that run the networks on frames ahead of a run. Their results are kept in the store.

The run goes on in order, and its networks find these results. A worker that fails costs only time: the run
computes what is missing.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from multiprocessing.connection import Connection, wait
from typing import Protocol, TypeVar

import cv2

from bevviz.config import Config
from bevviz.errors import first_line
from bevviz.model.frame import Frame
from bevviz.pipeline.perceive import run_networks
from bevviz.pipeline.stage_loader import StageLoader, Stages
from bevviz.support import progress
from bevviz.support.contexts import Closable
from bevviz.support.worker_processes import WorkerProcess, start_worker

R = TypeVar("R")

CHUNK = 8  # frames that a worker takes at once: to begin in the middle of a bag costs about one frame
WAITING = 2  # chunks that a worker has, so that it never waits for the next one


class FrameParts(Protocol):
    """Source whose frames can be read in parts."""

    @property
    def numbers(self) -> range:
        """Numbers of the selected frames."""

    def part(self, first: int, stop: int) -> Iterator[Frame]:
        """Yield a part of the selected frames, counted from 0."""

    @property
    def opener(self) -> Callable[[], FrameParts]:
        """Function that opens the same frames again. The standard pickle has to know it."""

    def close(self) -> None:
        """Release the files."""


def with_threads(config: Config, threads: int) -> Config:
    """Return a configuration whose networks have this number of threads, unless it states another one."""
    detector = config.detector
    detector = detector.model_copy(update={"threads": detector.threads or threads})
    return config.model_copy(update={"detector": detector})


def run_ahead(
    source: FrameParts, networks: Sequence[tuple[Config, Stages]], first: int, stop: int
) -> Iterator[Frame]:
    """Run the networks on each frame of a part, then yield the frame."""
    for frame in source.part(first, stop):
        for config, stages in networks:
            run_networks(frame, config, stages)
        yield frame


class FrameWorkers(Closable):
    """Worker processes that run networks on the frames of a drive, part by part.

    Args:
        source: source of the run.
        configs: configurations with networks.
        count: number of processes.
    """

    def __init__(self, source: FrameParts, configs: Sequence[Config], count: int) -> None:
        self._numbers = numbers = source.numbers
        chunks = range(-(-len(numbers) // CHUNK))
        self._chunks = iter(chunks)
        self._done: dict[int, int] = {}  # by begun chunk, the place after its last finished frame
        self._workers: dict[Connection, WorkerProcess] = {}
        self._assigned: dict[Connection, list[int]] = {}
        threads = max(1, (os.cpu_count() or 1) // count)
        configs = [with_threads(config, threads) for config in configs]
        try:
            for _ in chunks[:count]:
                worker = start_worker(
                    _work, source.opener, configs, threads, name="bevviz frames", threads=threads
                )
                self._workers[worker.pipe], self._assigned[worker.pipe] = worker, []
            for pipe in [*self._workers] * WAITING:
                self._assign(pipe)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the processes."""
        while self._workers:
            self._workers.popitem()[1].end()

    def wait_for(self, number: int) -> None:
        """Wait while a worker is busy with the part of a frame, and has not finished the frame."""
        if number not in self._numbers:
            return
        place = self._numbers.index(number)
        self._listen(0)
        while self._done.get(place // CHUNK, place + 1) <= place:
            self._listen(None)

    def _listen(self, timeout: float | None) -> None:
        """Take the messages of the workers. ``timeout`` is the time in seconds to wait for the first one."""
        while ready := wait(list(self._workers), timeout):
            for pipe in ready:
                assert isinstance(pipe, Connection)
                try:
                    message = pipe.recv()
                except (EOFError, OSError):
                    message = self._workers[pipe].reason()
                if isinstance(message, str):
                    self._lose(pipe, message)
                else:
                    self._progress(pipe, message)
            timeout = 0

    def _progress(self, pipe: Connection, place: int) -> None:
        """Keep how far a worker is. Give it another part when it has finished one."""
        chunks = self._assigned[pipe]
        self._done[chunks[0]] = place
        if place >= self._stop(chunks[0]):
            del chunks[0]
            self._assign(pipe)

    def _assign(self, pipe: Connection) -> None:
        """Give a worker the next part, if there is one."""
        if (chunk := next(self._chunks, None)) is not None:
            self._assigned[pipe].append(chunk)
            with suppress(OSError):  # The end of a worker is noticed when it is listened to.
                pipe.send((chunk * CHUNK, self._stop(chunk)))

    def _lose(self, pipe: Connection, reason: str) -> None:
        """End a worker that failed. The run computes its parts."""
        for chunk in self._assigned.pop(pipe):
            self._done[chunk] = self._stop(chunk)
        self._workers.pop(pipe).end()
        progress.say(f"--jobs: a worker process ended ({reason}); the run goes on without it")

    def _stop(self, chunk: int) -> int:
        """Return the place after the last frame of a part."""
        return min((chunk + 1) * CHUNK, len(self._numbers))


def _work(
    pipe: Connection, open_source: Callable[[], FrameParts], configs: Sequence[Config], threads: int
) -> None:
    """Run networks on parts of a drive, in the worker process, until the other end of the pipe is closed."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    cv2.setNumThreads(threads)
    try:
        loader = StageLoader()
        networks = [(config, loader.load_networks(config)) for config in configs]
        with closing(open_source()) as source:
            numbers = source.numbers
            while True:
                first, stop = pipe.recv()
                pipe.send(first)
                for frame in run_ahead(source, networks, first, stop):
                    if frame.index in numbers:
                        pipe.send(min(numbers.index(frame.index) + 1, stop - 1))
                pipe.send(stop)
    except (EOFError, BrokenPipeError):
        return
    except Exception as error:
        with suppress(OSError):
            pipe.send(first_line(error))
