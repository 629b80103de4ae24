"""Recordings on disk: written as they come, in parts that each open on their own, until the disk is full."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

from bevviz.config import LiveConfig
from bevviz.errors import UserError
from bevviz.files import lock, write_all
from bevviz.live.encoder import Encoder, Packet
from bevviz.live.notes import Notes
from bevviz.live.output import Output
from bevviz.logging import rerun_cli

MEGABYTE = 1_000_000
PART = ".rrd.part"  # suffix of a file while its index is made
INDEXED = 1000 * MEGABYTE  # the index is made in memory; a larger file stays without


class Indexer:
    """Gives finished recordings their index and merges their many small chunks, in the background.

    Without it they open as well, but slowly. Where it cannot be done, the file stays as it is. The work ends
    with this process; what one that was killed has left is removed by the next one beside it.
    """

    def __init__(self) -> None:
        self._worker = ThreadPoolExecutor(1, "index")
        self._waiting = 0

    @property
    def waiting(self) -> int:
        """Files that are not done."""
        return self._waiting

    def add(self, path: Path) -> None:
        if path.stat().st_size <= INDEXED:
            with suppress(RuntimeError):  # closed already: it stays as it is
                self._worker.submit(self._index, path)
                self._waiting += 1

    def close(self) -> None:
        """Finish what is waiting."""
        self._worker.shutdown()

    def _index(self, path: Path) -> None:
        indexed = path.with_suffix(PART)
        optimize = ["nice", "-n", "19", rerun_cli.program(), "rrd", "optimize", str(path), "-o", str(indexed)]
        handle = os.open(indexed, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            lock(handle, f"{indexed}: another process is writing it")
            os.ftruncate(handle, 0)
            done = subprocess.run(
                rerun_cli.tied(optimize),
                capture_output=True,
                check=False,
                env=rerun_cli.environment(),
                start_new_session=True,
            )
            if done.returncode == 0 and indexed.stat().st_size:
                indexed.replace(path)
            else:
                indexed.unlink(missing_ok=True)
        finally:
            os.close(handle)
            self._waiting -= 1


def check_name(path: Path, *suffixes: str) -> None:
    """Raises UserError where nothing is to be written: a slip must not overwrite something else."""
    if path.suffix not in suffixes:
        raise UserError(f"--save {path}: expected a file name that ends in {' or '.join(suffixes)}")
    if not path.absolute().parent.is_dir():
        raise UserError(f"--save {path}: there is no folder {path.parent}")


def remove_leftovers(folder: Path) -> None:
    """Indexes that nobody is making any more."""
    for path in folder.glob(f"*{PART}"):
        with suppress(OSError, UserError):
            handle = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                lock(handle, "")
                path.unlink()
            finally:
                os.close(handle)


class Saver(Output):
    """Writes every packet to ``path``, or with a limit of size or time to ``path`` numbered.

    A full disk is said once and ends the saving, nothing else; what is on it is cut to whole frames.

    Raises:
        UserError: the name does not end in .rrd, or the file cannot be written.
    """

    def __init__(
        self, path: Path, config: LiveConfig, encoder: Encoder, indexer: Indexer, notes: Notes
    ) -> None:
        super().__init__("file", config.output_queue)
        check_name(path, ".rrd")
        remove_leftovers(path.parent)
        self.paths: list[Path] = []
        self.on_part: Callable[[], None] = lambda: None  # called when a further one begins
        self._path = path
        self._size = config.split_size and config.split_size * MEGABYTE
        self._time = config.split_time
        self._encoder, self._indexer, self._notes = encoder, indexer, notes
        self._written = self._whole = 0  # bytes of this part, and up to its last whole packet
        self._started = 0.0
        self._file = -1
        try:
            self._open()
        except OSError as error:
            raise UserError(f"{self._next}: cannot write the recording: {error.strerror}") from None
        self._thread.start()

    def close(self) -> None:
        self._packets.close()
        self._thread.join()
        if not self._ended.is_set():
            self._finish()

    def _take(self, packet: Packet, fresh: bool) -> bool:
        try:
            if packet.whole and self._is_complete(packet):
                self._finish()
                self._open()
                self.on_part()
            if not self._written:
                self._started = packet.time
                self._write(self._encoder.prelude(packet.context))
            if packet.whole:
                self._whole = self._written
            self._write(packet.data)
        except OSError as error:
            self._notes.warn(f"{self._path}: saving ends here, the rest goes on: {error.strerror}")
            self._end()
        return True

    @property
    def _next(self) -> Path:
        if self._size is None and self._time is None:
            return self._path
        return self._path.with_stem(f"{self._path.stem}_{len(self.paths):03d}")

    def _is_complete(self, packet: Packet) -> bool:
        if not self._written:
            return False
        # As much again will come before the next chance to end the part.
        large = self._size is not None and 2 * self._written - self._whole > self._size
        return large or (self._time is not None and packet.time - self._started >= self._time)

    def _open(self) -> None:
        path = self._next
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            lock(self._file, f"{path}: another process is writing it")
        except UserError:
            os.close(self._file)
            raise
        with suppress(OSError):  # no file but a device
            os.ftruncate(self._file, 0)
        self.paths.append(path)
        self._written = self._whole = 0

    def _write(self, data: bytes) -> None:
        try:
            write_all(self._file, data)
        except OSError:
            with suppress(OSError):  # no file but a device
                os.ftruncate(self._file, self._written)
            os.close(self._file)
            raise
        self._written += len(data)

    def _finish(self) -> None:
        if self._written:
            os.close(self._file)
            self._indexer.add(self.paths[-1])
            return
        if self.paths[-1].is_file():  # and no device
            path = self.paths.pop()
            with suppress(OSError):
                path.unlink()
            self._notes.info(f"{path}: no frame came, so there is no recording")
        os.close(self._file)
