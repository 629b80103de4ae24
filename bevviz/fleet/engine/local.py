"""Worker processes on this machine. One that dies takes no other job with it, and its own is run again."""

from __future__ import annotations

import os
import signal
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess

from bevviz.fleet.engine.task import JobResult, JobResults, Task
from bevviz.support import progress
from bevviz.support.contexts import Closing

# concurrent.futures is of no use here: a worker that dies breaks the pool and every job that was on its way.

SIGNALS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
TICK = 0.2  # seconds
SAFE_PATH = "PYTHONSAFEPATH"  # variable of Python itself


@dataclass
class _Worker:
    process: SpawnProcess
    pipe: Connection
    job: Task | None = None


class Processes(Closing):
    """Worker processes, which start at once.

    Args:
        count: number of processes that run at the same time.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._threads = max(1, (os.cpu_count() or 1) // max(count, 1))
        self._idle: list[_Worker] = []
        try:
            while len(self._idle) < count:
                self._idle.append(self._start(speaks=progress.heard() and not self._idle))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Those without a job end."""
        while self._idle:
            _end(self._idle.pop())

    def run(
        self,
        jobs: Iterable[Task],
        retries: int,
        on_frame: Callable[[], None],
        tick: Callable[[], None] = lambda: None,
    ) -> JobResults:
        """See ``Engine.run``; a job whose process died is run again, too, and whoever is left is ended.

        ``tick`` is called every ``TICK`` seconds and oftener.
        """
        coming = iter(jobs)
        again: deque[Task] = deque()
        attempts: Counter[str] = Counter()
        busy: list[_Worker] = []

        def following() -> Task | None:
            return again.popleft() if again else next(coming, None)

        try:
            while len(busy) < self.count and (job := following()) is not None:
                busy.append(self._given(self._idle.pop() if self._idle else self._start(), job))
            self.close()  # there are fewer jobs than processes
            while busy:
                ready = wait([worker.pipe for worker in busy], TICK)
                tick()
                for worker in [w for w in busy if w.pipe in ready]:
                    try:
                        message = worker.pipe.recv()
                    except (EOFError, OSError):
                        message = None
                    if message == _FRAME:
                        on_frame()
                        continue
                    busy.remove(worker)
                    done = worker.job
                    assert done is not None
                    retry, result = _judge(worker.process, done, message)
                    retry = retry and attempts[done.name] < retries
                    if retry:
                        attempts[done.name] += 1
                        again.append(done)
                    if (job := following()) is not None:
                        busy.append(self._given(worker, job))
                    else:
                        _end(worker)
                    if not retry:
                        yield result
        finally:
            for worker in busy:
                worker.process.kill()
            for worker in busy:
                _end(worker)
            self.close()

    def _start(self, *, speaks: bool = False) -> _Worker:
        context = get_context("spawn")  # a fork would copy threads of Rerun and onnxruntime in midst of work
        ours, theirs = context.Pipe()
        given = (theirs, self._threads, speaks)
        process = context.Process(target=_work, args=given, name="bevviz batch", daemon=True)
        # Inherited: signals of the terminal are for the batch alone, which ends its workers. It must not be
        # interrupted itself between a worker's start and its name.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        try:
            with _safe_path():
                process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()  # so that its end is seen as soon as the process has gone
        return _Worker(process, ours)

    def _given(self, worker: _Worker, job: Task) -> _Worker:
        """The same process with a job; a new one where it has gone."""
        if worker.process.exitcode is None:
            try:
                worker.pipe.send(job)
            except OSError:
                pass
            else:
                return _Worker(worker.process, worker.pipe, job)
        _end(worker)
        fresh = self._start()
        fresh.pipe.send(job)
        return _Worker(fresh.process, fresh.pipe, job)


@contextmanager
def _safe_path() -> Iterator[None]:
    """Let a new process look for Python's own modules where they are, not in the working directory first."""
    before = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[SAFE_PATH]
        else:
            os.environ[SAFE_PATH] = before


_FRAME = "frame"


def _judge(process: SpawnProcess, job: Task, message: JobResult | str | None) -> tuple[bool, JobResult]:
    """Whether a job may go better another time, and how it ended."""
    if isinstance(message, JobResult):
        return False, message
    if message is not None:
        return True, JobResult(job.name, error=message)
    process.join()
    code = process.exitcode or 0
    why = f"by {signal.Signals(-code).name}" if code < 0 else f"with status {code}"
    hint = "; out of memory?" if code == -signal.SIGKILL else ""
    return True, JobResult(job.name, error=f"its process ended {why}{hint}")


def _end(worker: _Worker) -> None:
    """At once: what it was to make is made, or not wanted."""
    worker.pipe.close()
    worker.process.kill()
    worker.process.join()


def _work(pipe: Connection, threads: int, speaks: bool) -> None:
    """The process: one job after another, until the other end of the pipe is closed."""
    # Of all that compile the stages at the same time one says so.
    progress.to((lambda text: print(f"bevviz: {text}", file=sys.stderr)) if speaks else None, bars=False)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    os.environ["OMP_NUM_THREADS"] = str(threads)  # before Open3D is loaded
    import cv2

    cv2.setNumThreads(threads)
    while True:
        try:
            job: Task = pipe.recv()
        except EOFError:
            return
        try:
            result: JobResult | str = job.run(threads, lambda: pipe.send(_FRAME))
        except BrokenPipeError:
            return  # the batch has gone
        except Exception as error:
            result = f"{type(error).__name__}: {error}"
        pipe.send(result)
