"""Recordings on disk: written as they come, in parts that each open on their own, until the disk is full."""

from __future__ import annotations

import os
import re
import secrets
import subprocess
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

from bevviz.bags.mcap_writer import complete
from bevviz.config import LiveConfig
from bevviz.errors import UserError
from bevviz.live.encoder import Encoder, Packet
from bevviz.live.notes import Notes
from bevviz.live.output import Output
from bevviz.recording import rerun_cli
from bevviz.support.files import create, is_locked, lock, rename_new, write_all

MEGABYTE = 1_000_000
INDEX = ".bevviz-index-"  # and eight digits: how a file ends while its index is made
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
        indexed = path.with_name(f"{path.stem}{INDEX}{secrets.token_hex(4)}")
        optimize = ["nice", "-n", "19", rerun_cli.program(), "rrd", "optimize", str(path), "-o", str(indexed)]
        handle = create(indexed)
        try:
            lock(handle, f"{indexed}: another process is writing it")
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
    """Delete indexes that no process is making any more. Their recordings are there without them."""
    for path in folder.glob(f"*{INDEX}????????"):
        with suppress(OSError, UserError):
            handle = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                lock(handle, "")
                path.unlink()
            finally:
                os.close(handle)


def unused_names(*paths: Path) -> list[Path]:
    """Return free names for the files of a run: those asked for, or all with the same number.

    A name is taken by a recording, a bag, a part or an unfinished file. So drive-2.rrd and drive-2.mcap
    belong to one run, and no run writes over another one's files.
    """
    number = max((_runs(path) for path in paths), default=0) + 1
    return [path if number == 1 else path.with_stem(f"{path.stem}-{number}") for path in paths]


def _runs(path: Path) -> int:
    """Return the number of the last run that has files of this name, 0 where the name is free."""
    if path.exists() and not path.is_file():
        return 0  # a device
    name = re.compile(
        re.escape(path.stem)
        + r"(?:-(?P<run>[1-9]\d{0,5}))?(?:_\d{3,})?(?:\.partial-[0-9a-f]{8})?\.(?:rrd|mcap)"
    )
    runs = [found["run"] for file in path.parent.iterdir() if (found := name.fullmatch(file.name))]
    return max(int(run or 1) for run in runs) if None in runs else 0


def complete_leftovers(path: Path, notes: Notes) -> None:
    """Complete the bags that killed runs with the same ``--save FILE.mcap`` have left, and say so.

    Each gets the name that it would have had, or its unfinished name without ".partial" where that is taken.
    """
    name = re.compile(re.escape(path.stem) + r"(?:-[1-9]\d{0,5})?(?:_\d{3,})?\.partial-[0-9a-f]{8}\.mcap")
    for left in sorted(path.parent.iterdir()):
        if not name.fullmatch(left.name) or left.is_symlink() or is_locked(left):
            continue
        try:
            count = complete(left)
            whole = _give_name(left)
        except (OSError, UserError) as error:
            notes.warn(f"{left.name}: left by a run that was killed; it stays as it is ({error})")
        else:
            notes.info(f"{whole}: {count} messages of a run that was killed, completed")


def _give_name(left: Path) -> Path:
    stem, _, key = left.stem.rpartition(".partial-")
    for whole in (left.with_stem(stem), left.with_stem(f"{stem}-{key}")):
        with suppress(FileExistsError):
            rename_new(left, whole)
            return whole
    raise UserError(f"{left}: its name is taken")


class Saver(Output):
    """Writes every packet to ``path``, or with a limit of size or time to ``path`` numbered.

    No existing file is overwritten; ``unused_names`` gives names that are free.

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
        except FileExistsError:
            raise UserError(f"{self._next}: is already there") from None
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
        if path.exists() and not path.is_file():
            self._file = os.open(path, os.O_WRONLY | os.O_CLOEXEC)  # a device
        else:
            self._file = create(path)
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
