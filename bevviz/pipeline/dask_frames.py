"""Dask clusters that share the file system with this machine. They run networks on frames ahead of a run.

The results come through the store, whose folder has the same path everywhere.
"""

from __future__ import annotations

import os
import pickle
import threading
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit
from uuid import uuid4

from bevviz.config import Config
from bevviz.errors import UserError, first_line
from bevviz.pipeline.frame_workers import FrameParts, run_ahead, with_threads
from bevviz.pipeline.result_store import FOLDER_VARIABLE, ResultStore
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.recording.ports import is_listening
from bevviz.recording.provenance import with_absolute_files
from bevviz.support import progress
from bevviz.support.contexts import Closable

if TYPE_CHECKING:
    from distributed import Client

CHUNK = 16  # frames of a task: a worker opens the drive once
RETRIES = 2  # of a task whose worker died


def connect(address: str) -> Client:
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


class ClusterFrames(Closable):
    """Cluster that runs networks on the frames of a drive, part by part.

    Args:
        source: source of the run.
        configs: configurations with networks.
        store: store of the run.
        address: of the scheduler.

    Raises:
        UserError: no scheduler answers at the address.
    """

    def __init__(
        self, source: FrameParts, configs: Sequence[Config], store: ResultStore, address: str
    ) -> None:
        self._numbers, self._failed = source.numbers, False
        self._client = connect(address)
        work = pickle.dumps((source.opener, [with_absolute_files(config) for config in configs]))
        run, count = uuid4().hex, len(self._numbers)
        self._parts = [
            self._client.submit(
                partial(_run_part, run, work, store.path.parent.resolve()),
                first,
                min(first + CHUNK, count),
                key=f"bevviz-{run}-{first}",
                retries=RETRIES,
                priority=-first,  # the first frames first
            )
            for first in range(0, count, CHUNK)
        ]

    def close(self) -> None:
        """Cancel what has not begun, and disconnect."""
        self._client.cancel(self._parts)
        self._client.close()

    def wait_for(self, number: int) -> None:
        """Wait until the part of a frame is done. If the cluster fails, the run goes on without it."""
        if number not in self._numbers or self._failed:
            return
        try:
            self._parts[self._numbers.index(number) // CHUNK].result()
        except Exception as error:  # of any kind, from another machine
            self._failed = True
            progress.say(f"--dask: the cluster failed ({first_line(error)}); the run goes on without it")


def _run_part(run: str, work: bytes, folder: Path, first: int, stop: int) -> int:
    """Run networks on a part of a drive, on a worker of the cluster. Return the number of frames."""
    from distributed import get_worker

    if not folder.is_dir():
        raise UserError(f"{folder}, the folder of the store, is not there on {get_worker().address}")
    os.environ[FOLDER_VARIABLE] = str(folder)
    source, networks = _opened(run, threading.get_ident(), work, get_worker().state.nthreads)
    return sum(1 for _ in run_ahead(source, networks, first, stop))


@lru_cache(maxsize=1)
def _opened(run: str, thread: int, work: bytes, threads: int) -> tuple[FrameParts, list[Any]]:
    """Open the drive of a run and load its networks, once for each thread of a worker."""
    opener: Callable[[], FrameParts]
    opener, configs = pickle.loads(work)
    loader = StageLoader()
    configs = [with_threads(config, threads) for config in configs]
    return opener(), [(config, loader.load_networks(config)) for config in configs]
