"""Jobs in worker processes on this machine. A worker that dies costs no other job; its own is run again."""

from __future__ import annotations

import os
import signal
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait

import cv2

from bevviz.extras.batch.bag_job import run
from bevviz.extras.batch.jobs import Job, JobResult, JobResults
from bevviz.extras.batch.worker_processes import WorkerProcess, start_worker
from bevviz.support import progress
from bevviz.support.contexts import Closable

# concurrent.futures does not fit: a worker that dies breaks the pool and all its jobs.

TICK = 0.2  # seconds
_FRAME = "frame"  # message of a worker after each frame


@dataclass
class _Worker(WorkerProcess):
    """Worker process and its job."""

    job: Job | None = None


class Processes(Closable):
    """Worker processes, started at once.

    Args:
        count: number of processes that run at the same time.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._threads = max(1, (os.cpu_count() or 1) // max(count, 1))
        self._idle: list[_Worker] = []
        try:
            while len(self._idle) < count:
                self._idle.append(self._start(speaks=progress.has_receiver() and not self._idle))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the idle processes."""
        while self._idle:
            self._idle.pop().end()

    def run(
        self,
        jobs: Iterable[Job],
        retries: int,
        on_frame: Callable[[], None],
        tick: Callable[[], None] = lambda: None,
    ) -> JobResults:
        """Run each job once and yield its outcome as soon as it ends. Busy workers are ended at the end.

        Args:
            jobs: the jobs, in order. Each is taken when a worker is free, or nearly so.
            retries: how often a job is run again if its process died, or its input is not the cause of the
                failure.
            on_frame: called for each frame of any job.
            tick: called at least every ``TICK`` seconds. An exception in it ends the run.
        """
        pending = iter(jobs)
        to_retry: deque[Job] = deque()
        attempts: Counter[str] = Counter()
        busy: list[_Worker] = []

        def next_job() -> Job | None:
            return to_retry.popleft() if to_retry else next(pending, None)

        try:
            while len(busy) < self.count and (job := next_job()) is not None:
                busy.append(self._assign(self._idle.pop() if self._idle else self._start(), job))
            self.close()  # There are fewer jobs than processes.
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
                    ended_job = worker.job
                    assert ended_job is not None
                    retry, result = _judge(worker, ended_job, message)
                    retry = retry and attempts[ended_job.name] < retries
                    if retry:
                        attempts[ended_job.name] += 1
                        to_retry.append(ended_job)
                    if (job := next_job()) is not None:
                        busy.append(self._assign(worker, job))
                    else:
                        worker.end()
                    if not retry:
                        yield result
        finally:
            for worker in busy:
                worker.process.kill()
            for worker in busy:
                worker.end()
            self.close()

    def _start(self, *, speaks: bool = False) -> _Worker:
        started = start_worker(_work, self._threads, speaks, name="bevviz batch", threads=self._threads)
        return _Worker(started.process, started.pipe)

    def _assign(self, worker: _Worker, job: Job) -> _Worker:
        """Send a job to a worker. If its process has ended, send it to a new one."""
        if worker.process.exitcode is None:
            try:
                worker.pipe.send(job)
            except OSError:
                pass
            else:
                return _Worker(worker.process, worker.pipe, job)
        worker.end()
        fresh = self._start()
        fresh.pipe.send(job)
        return _Worker(fresh.process, fresh.pipe, job)


def _judge(worker: _Worker, job: Job, message: JobResult | str | None) -> tuple[bool, JobResult]:
    """Return whether to try a job again, and how it ended."""
    if isinstance(message, JobResult):
        return False, message
    return True, JobResult(job.name, error=message or f"its process ended {worker.reason()}")


def _work(pipe: Connection, threads: int, speaks: bool) -> None:
    """Run jobs in the worker process until the other end of the pipe is closed."""
    # Workers compile the stages at the same time. Only one of them reports it.
    progress.set_receiver(
        (lambda text: print(f"bevviz: {text}", file=sys.stderr)) if speaks else None, bars=False
    )
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    cv2.setNumThreads(threads)
    while True:
        try:
            job: Job = pipe.recv()
        except EOFError:
            return
        try:
            result: JobResult | str = run(job, threads, lambda: pipe.send(_FRAME))
        except BrokenPipeError:
            return  # The batch has ended.
        except Exception as error:
            result = f"{type(error).__name__}: {error}"
        pipe.send(result)
