"""Start processes that work for this one."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess

SIGNALS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}


@dataclass
class WorkerProcess:
    """Process with the pipe to it."""

    process: SpawnProcess
    pipe: Connection

    def end(self) -> None:
        """End the process at once. Its results are complete, or not needed."""
        self.pipe.close()
        self.process.kill()
        self.process.join()

    def reason(self) -> str:
        """Return how the process ended. Call it when its pipe is closed."""
        self.process.join()
        code = self.process.exitcode or 0
        reason = f"by {signal.Signals(-code).name}" if code < 0 else f"with status {code}"
        return reason + ("; out of memory?" if code == -signal.SIGKILL else "")


def start_worker(target: Callable[..., None], *arguments: object, name: str, threads: int) -> WorkerProcess:
    """Start a process that calls ``target`` with its end of a pipe and the arguments.

    Args:
        target: function of a module. It has to end when the other end of the pipe is closed.
        arguments: further arguments. The standard pickle has to know them.
        name: name of the process.
        threads: threads of OpenBLAS and Open3D, which read the number when they are loaded.
    """
    context = get_context("spawn")  # A fork would copy threads of Rerun and onnxruntime amid their work.
    ours, theirs = context.Pipe()
    process = context.Process(target=target, args=(theirs, *arguments), name=name, daemon=True)
    # A worker looks for Python's own modules first, not for files of the working directory.
    variables = {"PYTHONSAFEPATH": "1", "OMP_NUM_THREADS": str(threads)}
    # The worker inherits the signal mask: this process alone handles signals of the terminal and ends its
    # workers. It must not be interrupted between the start of a worker and its storage.
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        with _environment(variables):
            process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)
    theirs.close()  # Without this, the pipe would not report the end of the process.
    return WorkerProcess(process, ours)


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables for the processes that start meanwhile."""
    previous = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in previous.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
