"""Worker processes on this machine. One that dies takes no other job with it, and its own is run again."""

from __future__ import annotations

import os
import signal
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sized
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess

from bevviz.batch.task import JobResult, JobResults, Task

# concurrent.futures is of no use here: a worker that dies breaks the pool and every job that was on its way.

SIGNALS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}


@dataclass
class _Worker:
    process: SpawnProcess
    pipe: Connection
    job: Task


def run_local(jobs: Iterable[Task], workers: int, retries: int, on_frame: Callable[[], None]) -> JobResults:
    """Run the jobs, each once, and yield how they ended, as they end.

    Args:
        jobs: what to do; the first ones first. Each is asked for when a worker is free.
        workers: processes at the same time.
        retries: how often a job is run again whose process died, or that failed for no fault of its bag.
        on_frame: called for each frame of any of them.
    """
    if isinstance(jobs, Sized):
        workers = min(workers, len(jobs))
    threads = max(1, (os.cpu_count() or 1) // max(workers, 1))
    coming = iter(jobs)
    again: deque[Task] = deque()
    attempts: Counter[str] = Counter()
    busy: list[_Worker] = []

    def following() -> Task | None:
        return again.popleft() if again else next(coming, None)

    try:
        while len(busy) < workers and (job := following()) is not None:
            busy.append(_start(job, threads))
        while busy:
            ready = wait([worker.pipe for worker in busy])
            for worker in [w for w in busy if w.pipe in ready]:
                try:
                    message = worker.pipe.recv()
                except (EOFError, OSError):
                    message = None
                if message == _FRAME:
                    on_frame()
                    continue
                busy.remove(worker)
                retry, result = _judge(worker, message)
                retry = retry and attempts[worker.job.name] < retries
                if retry:
                    attempts[worker.job.name] += 1
                    again.append(worker.job)
                if (job := following()) is not None:
                    busy.append(_next(worker, job, threads))
                else:
                    _end(worker)
                if not retry:
                    yield result
    finally:
        for worker in busy:
            worker.process.terminate()
        for worker in busy:
            _end(worker)


_FRAME = "frame"


def _judge(worker: _Worker, message: JobResult | str | None) -> tuple[bool, JobResult]:
    """Whether the job may go better another time, and how it ended."""
    if isinstance(message, JobResult):
        return False, message
    if message is not None:
        return True, JobResult(worker.job.name, error=message)
    worker.process.join()
    code = worker.process.exitcode or 0
    why = f"by {signal.Signals(-code).name}" if code < 0 else f"with status {code}"
    hint = "; out of memory?" if code == -signal.SIGKILL else ""
    return True, JobResult(worker.job.name, error=f"its process ended {why}{hint}")


def _start(job: Task, threads: int) -> _Worker:
    context = get_context("spawn")  # a fork would copy threads of Rerun and onnxruntime in the midst of work
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, threads), name="bevviz batch", daemon=True)
    # Inherited: signals of the terminal are for the batch alone, which ends its workers. It must not be
    # interrupted itself between a worker's start and its name.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    theirs.close()  # so that its end is seen as soon as the process has gone
    ours.send(job)
    return _Worker(process, ours, job)


def _next(worker: _Worker, job: Task, threads: int) -> _Worker:
    """The same process goes on with another job; a new one where it has gone."""
    if worker.process.exitcode is None:
        try:
            worker.pipe.send(job)
        except OSError:
            pass
        else:
            return _Worker(worker.process, worker.pipe, job)
    _end(worker)
    return _start(job, threads)


def _end(worker: _Worker) -> None:
    worker.pipe.close()  # it ends when there is nothing more to receive
    worker.process.join(10)
    if worker.process.exitcode is None:
        worker.process.kill()
        worker.process.join()


def _work(pipe: Connection, threads: int) -> None:
    """The process: one job after another, until the other end of the pipe is closed."""
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
