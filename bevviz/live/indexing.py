"""Indexes of finished recordings, made by a process that outlives the run.

Run as ``python -m bevviz.live.indexing FILE.rrd ...``.
"""

from __future__ import annotations

import os
import secrets
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

from bevviz.errors import UserError
from bevviz.recording import rerun_cli
from bevviz.support.files import create_file, lock_file

INDEX = ".bevviz-index-"  # followed by eight hex digits: suffix of a file while its index is made
INDEXED = 1_000_000_000  # bytes; the index is made in memory, so a larger file gets none


class Indexer:
    """Worker that gives finished recordings an index and merges their small chunks.

    It is a process of lowest priority that nobody waits for. A recording without an index opens too, but
    slowly. If the work fails, the file stays as it is.
    """

    def __init__(self) -> None:
        self._paths: list[Path] = []  # files that no process has begun
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()

    def add(self, path: Path) -> None:
        """Queue a file, unless it is too large. Any thread may call it."""
        if path.stat().st_size <= INDEXED:
            with self._lock:
                self._paths.append(path.absolute())
                if self._process is None or self._process.poll() is not None:
                    self._start()

    def close(self) -> bool:
        """Leave the queued files to a process. Return whether one is at work."""
        with self._lock:
            if self._paths:
                self._start()
            return self._process is not None and self._process.poll() is None

    def _start(self) -> None:
        command = [sys.executable, "-P", "-m", __name__, *map(str, self._paths)]
        self._paths = []
        with suppress(OSError):  # without the process the files stay as they are
            self._process = rerun_cli.spawn(["nice", "-n", "19", *command], subprocess.DEVNULL)


def add_index(path: Path) -> None:
    """Replace a recording by one with an index, if that succeeds.

    Raises:
        OSError: its folder cannot be written.
    """
    indexed = path.with_name(f"{path.stem}{INDEX}{secrets.token_hex(4)}")
    handle = create_file(indexed)
    try:
        with suppress(
            UserError
        ):  # A run that removes leftovers has it for a moment, and its file is made again.
            lock_file(handle, "")
        optimize = [rerun_cli.rerun_program(), "rrd", "optimize", str(path), "-o", str(indexed)]
        done = subprocess.run(
            rerun_cli.ending_with_parent(optimize),
            capture_output=True,
            check=False,
            env=rerun_cli.environment(),
        )
        if done.returncode == 0 and indexed.stat().st_size:
            indexed.replace(path)
        else:
            indexed.unlink(missing_ok=True)
    finally:
        os.close(handle)


def remove_leftovers(folder: Path) -> None:
    """Delete unfinished index files of ended processes. Their recordings are complete without them."""
    for path in folder.glob(f"*{INDEX}????????"):
        with suppress(OSError, UserError):
            handle = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                lock_file(handle, "")
                path.unlink()
            finally:
                os.close(handle)


if __name__ == "__main__":
    for name in sys.argv[1:]:
        with suppress(OSError, UserError):
            add_index(Path(name))
