"""Jobs on a Dask cluster that shares the file system with this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import islice
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from bevviz.errors import UserError, first_line
from bevviz.extras.batch.bag_job import run
from bevviz.extras.batch.jobs import Job, JobResult, JobResults
from bevviz.recording.ports import is_listening
from bevviz.support.contexts import Closable

if TYPE_CHECKING:
    from distributed import Client

WAITING = 2  # jobs for each thread of the cluster, so that no thread has to wait for the next one
TICK = 0.2  # seconds


class Cluster(Closable):
    """Existing Dask cluster.

    If a worker dies, the cluster runs its job again on another one. Its setting
    ``distributed.scheduler.allowed-failures`` limits how often.

    Args:
        address: of the scheduler, tcp://host:8786.

    Raises:
        UserError: Dask is not installed, or no scheduler answers at the address.
    """

    def __init__(self, address: str) -> None:
        self._client = _connect(address)

    def close(self) -> None:
        """Disconnect from the cluster."""
        self._client.close()

    @property
    def count(self) -> int:
        """Number of threads of the current workers."""
        return max(1, sum(map(int, self._client.nthreads().values())))

    def run(
        self,
        jobs: Iterable[Job],
        retries: int,
        on_frame: Callable[[], None],
        tick: Callable[[], None] = lambda: None,
    ) -> JobResults:
        """Run jobs as ``Processes.run`` does. The frames of a job are reported when it has ended."""
        from distributed import wait

        pending, running = iter(jobs), dict[Any, Job]()

        def submit(count: int) -> None:
            # The scheduler runs a key once, even if two clients submit it.
            for job in islice(pending, count):
                key = f"bevviz-{job.identity}"
                running[self._client.submit(_work, job, key=key, retries=retries)] = job

        try:
            submit(WAITING * self.count)
            while running:
                try:
                    ended = wait(list(running), timeout=TICK, return_when="FIRST_COMPLETED").done
                except TimeoutError:
                    ended = set()
                tick()
                for future in ended:
                    job = running.pop(future)
                    submit(1)
                    result = _result(job, future)
                    for _ in range(result.frames):
                        on_frame()
                    future.release()
                    yield result
        finally:
            self._client.cancel(list(running))


def _connect(address: str) -> Client:
    """Return a client of a cluster.

    Args:
        address: of the scheduler, tcp://host:8786.

    Raises:
        UserError: Dask is not installed, or no scheduler answers at the address.
    """
    try:
        from distributed import Client
    except ImportError:
        raise UserError("--dask needs Dask: pip install 'bevviz[dask]'") from None
    url = urlsplit(address)
    if url.hostname and url.port and not is_listening(url.hostname, url.port):
        raise UserError(f"--dask {address}: nobody answers there; 'dask scheduler' starts one")
    try:
        return Client(address, timeout="10s")
    except (OSError, ValueError, TimeoutError) as error:
        raise UserError(f"--dask {address}: no scheduler answers there ({first_line(error)})") from None


def _result(job: Job, future: Any) -> JobResult:
    if future.status == "finished":
        result: JobResult = future.result()
        return result
    error = future.exception() if future.status == "error" else None
    if type(error).__name__ == "KilledWorker":
        return JobResult(job.name, error="the workers that ran it died; out of memory?")
    return JobResult(job.name, error=f"{type(error).__name__}: {error}" if error else "cancelled")


def _work(job: Job) -> JobResult:
    """Run a job on the worker."""
    from distributed import get_worker

    return run(job, get_worker().state.nthreads)
