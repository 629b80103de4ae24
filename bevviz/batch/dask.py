"""Workers of a Dask cluster, which share the file system with this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sized
from itertools import islice
from typing import Any
from urllib.parse import urlsplit

from bevviz.batch.task import JobResult, JobResults, Task
from bevviz.errors import UserError, first_line
from bevviz.logging.ports import answers

WAITING = 2  # jobs for each thread of the cluster, so that none waits for us


def run_dask(jobs: Iterable[Task], address: str, retries: int, on_frame: Callable[[], None]) -> JobResults:
    """Run the jobs on a cluster, each once, and yield how they ended, as they end.

    A job whose worker dies is run again on another one, as often as the cluster's setting
    ``distributed.scheduler.allowed-failures`` has it.

    Args:
        jobs: what to do; the first ones first. Each is asked for when a worker is nearly free.
        address: of the scheduler, tcp://host:8786.
        retries: how often a job is run again that failed for no fault of its bag.
        on_frame: called for each frame of a job when it has ended.

    Raises:
        UserError: Dask is not installed, or nobody answers at the address.
    """
    if isinstance(jobs, Sized) and not len(jobs):
        return
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise UserError("--dask needs Dask: pip install 'bevviz[dask]'") from None
    where = urlsplit(address)
    if where.hostname and where.port and not answers(where.hostname, where.port):
        raise UserError(f"--dask {address}: nobody answers there; 'dask scheduler' starts one")
    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError, TimeoutError) as error:
        raise UserError(f"--dask {address}: no scheduler answers there ({first_line(error)})") from None
    with client:
        coming, running = iter(jobs), dict[Any, Task]()
        ended = as_completed()

        def submit(count: int) -> None:
            # The scheduler runs nothing twice that has the same key, not even for two clients.
            for job in islice(coming, count):
                future = client.submit(_work, job, key=f"bevviz-{job.identity}", retries=retries)
                running[future] = job
                ended.add(future)

        try:
            threads = sum(client.nthreads().values())
            submit(WAITING * max(threads, 1))
            for future in ended:
                submit(1)
                result = _result(running.pop(future), future)
                for _ in range(result.frames):
                    on_frame()
                future.release()
                yield result
        finally:
            client.cancel(list(running))


def _result(job: Task, future: Any) -> JobResult:
    if future.status == "finished":
        result: JobResult = future.result()
        return result
    error = future.exception() if future.status == "error" else None
    if type(error).__name__ == "KilledWorker":
        return JobResult(job.name, error="the workers that ran it died; out of memory?")
    return JobResult(job.name, error=f"{type(error).__name__}: {error}" if error else "cancelled")


def _work(job: Task) -> JobResult:
    """On the worker."""
    from distributed import get_worker

    return job.run(get_worker().state.nthreads, lambda: None)
