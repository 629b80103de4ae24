"""Files of a run: recordings and bags, written as frames and messages come, in parts."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from operator import attrgetter
from pathlib import Path
from queue import SimpleQueue

from bevviz.bags.completion import CHUNK_SIZE, complete
from bevviz.bags.mcap_writer import McapWriter
from bevviz.config import LiveConfig
from bevviz.errors import UserError
from bevviz.live.encoder import Encoder, Packet
from bevviz.live.indexing import Indexer, remove_leftovers
from bevviz.live.outputs import Output
from bevviz.live.raw_recorder import LEAD, MEGABYTE, RawMessage, RawRecorder
from bevviz.live.status import Notes
from bevviz.support.contexts import Closable
from bevviz.support.files import create_file, is_locked, rename_new, write_all

WAITING = 200 * MEGABYTE  # bytes of messages that may wait for a slow disk


# --- names -------------------------------------------------------------------------------------


def check_name(path: Path, *suffixes: str) -> None:
    """Check the name of a file to write. A slip must not overwrite another file.

    Raises:
        UserError: the suffix is wrong, or the folder does not exist.
    """
    if path.suffix not in suffixes:
        raise UserError(f"--save {path}: expected a file name that ends in {' or '.join(suffixes)}")
    if not path.absolute().parent.is_dir():
        raise UserError(f"--save {path}: there is no folder {path.parent}")


def free_names(save: Path | None, raw: Path | None, notes: Notes) -> tuple[Path | None, Path | None]:
    """Return free names for the recording and the bag. Complete the bags that killed runs left.

    Raises:
        UserError: a name cannot be used.
    """
    asked = [path for path in (save, raw) if path is not None]
    if save is not None:
        check_name(save, ".rrd")
    if raw is not None:
        check_name(raw, ".mcap")
        complete_leftovers(raw, notes)
    free = unused_names(*asked)
    if free != asked:
        taken, new = (" and ".join(map(str, paths)) for paths in (asked, free))
        notes.info(f"an earlier run is saved in {taken}: this one goes to {new}")
    names = dict(zip(asked, free, strict=True))
    return save and names[save], raw and names[raw]


def unused_names(*paths: Path) -> list[Path]:
    """Return free names for the files of a run. All get the same number, or none.

    A name is taken by a recording, a bag, a part or an unfinished file. So drive-2.rrd and drive-2.mcap
    belong to one run, and no run overwrites the files of another.
    """
    number = max((_runs(path) for path in paths), default=0) + 1
    return [path if number == 1 else path.with_stem(f"{path.stem}-{number}") for path in paths]


def _runs(path: Path) -> int:
    """Return the number of the last run with files of this name, or 0 if the name is free."""
    if path.exists() and not path.is_file():
        return 0  # a device
    runs = [match["run"] for match in _written(path)]
    return max(int(run or 1) for run in runs) if None in runs else 0


def _written(path: Path) -> Iterator[re.Match[str]]:
    """Yield a match of the name of each file that runs with this path have written, also unfinished ones."""
    name = re.compile(
        re.escape(path.stem)
        + r"(?:-(?P<run>[1-9]\d{0,5}))?(?:_\d{3,})?(?P<partial>\.partial-[0-9a-f]{8})?\.(?:rrd|mcap)"
    )
    yield from filter(None, (name.fullmatch(file.name) for file in sorted(path.parent.iterdir())))


# --- recordings --------------------------------------------------------------------------------


class RecordingSaver(Output):
    """Output that writes every packet to ``path``. With a limit of size or time, ``path`` is numbered.

    No existing file is overwritten. ``free_names`` gives free names. A full disk is reported once and ends
    the saving only. The file is then truncated to whole frames.

    Raises:
        UserError: the file cannot be written.
    """

    def __init__(
        self, path: Path, config: LiveConfig, encoder: Encoder, indexer: Indexer, notes: Notes
    ) -> None:
        super().__init__("file", config.output_queue)
        remove_leftovers(path.parent)
        self.paths: list[Path] = []
        self.on_part: Callable[[], None] = lambda: None  # called when a further part begins
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
        """Write the waiting packets and finish the last part."""
        self._packets.close()
        self._thread.join()
        if not self._ended.is_set():
            self._finish()

    def _take(self, packet: Packet, fresh: bool) -> bool:
        """Write a packet. Begin a new part first if the current one is complete."""
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
        """Return whether the part has reached its limit of size or time."""
        if not self._written:
            return False
        # The part can end next after about as many bytes again.
        large = self._size is not None and 2 * self._written - self._whole > self._size
        return large or (self._time is not None and packet.time - self._started >= self._time)

    def _open(self) -> None:
        path = self._next
        if path.exists() and not path.is_file():
            self._file = os.open(path, os.O_WRONLY | os.O_CLOEXEC)  # a device
        else:
            self._file = create_file(path)
        self.paths.append(path)
        self._written = self._whole = 0

    def _write(self, data: bytes) -> None:
        """Write bytes. On an error, truncate the file to its last complete write."""
        try:
            write_all(self._file, data)
        except OSError:
            with suppress(OSError):  # a device cannot be truncated
                os.ftruncate(self._file, self._written)
            os.close(self._file)
            raise
        self._written += len(data)

    def _finish(self) -> None:
        """Close the part and queue its index. Delete the file if it is empty."""
        if self._written:
            os.close(self._file)
            self._indexer.add(self.paths[-1])
            return
        if self.paths[-1].is_file():  # a device is not removed
            path = self.paths.pop()
            with suppress(OSError):
                path.unlink()
            self._notes.info(f"{path}: no frame came, so there is no recording")
        os.close(self._file)


# --- bags --------------------------------------------------------------------------------------


class BagSaver(Closable):
    """Writer of every message to a bag. It begins with the messages that the recorder holds.

    A part in progress is NAME.partial-XXXXXXXX.mcap. It begins with the earlier messages that are still valid
    and with the last seconds of the part before, so that its first scan is complete. A full disk is reported
    once and ends the saving only. The file is then complete. Messages that a slow disk cannot take are
    dropped and counted. No existing file is overwritten.

    Args:
        path: the .mcap file. With a limit of size or time it is numbered.
        config: the limits.
        raw: source of the messages.
        notes: takes messages to the user.
        follows: a new part begins only with ``next_part``. It is used beside an .rrd file, whose parts lead.

    Raises:
        UserError: the file cannot be written.
    """

    name = "messages"

    def __init__(
        self, path: Path, config: LiveConfig, raw: RawRecorder, notes: Notes, *, follows: bool = False
    ) -> None:
        self.paths: list[Path] = []
        self.dropped = 0  # messages
        self._path, self._raw, self._notes = path, raw, notes
        self._size = config.split_size and config.split_size * MEGABYTE
        self._time = config.split_time and config.split_time * 1e9
        self._numbered = self._size is not None or self._time is not None
        if follows:
            self._size = self._time = None
        # A list begins a part, None ends the last one.
        self._queue: SimpleQueue[RawMessage | list[RawMessage] | None] = SimpleQueue()
        self._queued = self._taken = 0  # bytes of messages; each number is changed by one thread only
        self._ended = False
        self._part: McapWriter | None = self._open()
        self._thread = threading.Thread(target=self._run, name="raw", daemon=True)
        raw.attach(self._put, self._queue.put)
        self._thread.start()

    def close(self) -> None:
        """Write the waiting messages and end."""
        self._raw.detach()
        self._ended = True
        self._queue.put(None)
        self._thread.join()

    def next_part(self) -> None:
        """Begin a new part. Any thread may call it."""
        if not self._ended:
            self._raw.attach(self._put, self._queue.put, LEAD)

    def _put(self, message: RawMessage) -> None:
        """Queue a message, or drop it if too many bytes wait."""
        if self._ended or self._queued - self._taken + len(message.data) > WAITING:
            self.dropped += not self._ended
            return
        self._queued += len(message.data)
        self._queue.put(message)

    def _open(self) -> McapWriter:
        number = f"_{len(self.paths):03d}" if self._numbered else ""
        # No compression, as with `ros2 bag record`. It would take CPU time from the robot.
        path = self._path.with_stem(f"{self._path.stem}{number}")
        part = McapWriter(path, attrgetter("msgdef"), compress=False, replace=False)
        part.__enter__()
        self.paths.append(path)
        return part

    def _run(self) -> None:
        """Write until closed. Report an error and end the saving."""
        try:
            self._write()
        except UserError as error:
            self._notes.warn(f"saving of the messages ends here, the rest goes on: {error}")
            self._ended = True
            self._raw.detach()
            self._queue = SimpleQueue()  # frees the messages that wait
        try:
            self._finish()
        except UserError as error:
            self._notes.warn(str(error))

    def _write(self) -> None:
        """Write the queued messages. Ask for a new part when the current one is complete."""
        begun, asked = 0, False  # start of the part, and whether the next was requested
        while (item := self._queue.get()) is not None:
            if isinstance(item, list):
                if begun:
                    self._finish()
                    self._part = self._open()
                for message in item:
                    self._append(message)
                begun, asked = item[-1].received if item else 1, False
                continue
            self._taken += len(item.data)
            self._append(item)
            complete = self._time is not None and item.received - begun >= self._time
            if self._size is not None and self._part is not None:
                complete |= self._part.size + CHUNK_SIZE > self._size
            if complete and not asked:
                asked = True
                self.next_part()

    def _append(self, message: RawMessage) -> None:
        assert self._part is not None
        self._part.write(message.connection, message.received, message.data, message.sent)

    def _finish(self) -> None:
        part, self._part = self._part, None
        if part is not None:
            part.__exit__(None, None, None)


def write_bag(path: Path, messages: Sequence[RawMessage], *, compress: bool = True) -> None:
    """Write messages as an MCAP file, compressed or not. The file appears when it is complete.

    Raises:
        UserError: the file exists already, or cannot be written.
    """
    if path.exists():
        raise UserError(f"{path}: is already there")
    with McapWriter(path, attrgetter("msgdef"), compress=compress, replace=False) as bag:
        for message in messages:
            bag.write(message.connection, message.received, message.data, message.sent)


def complete_leftovers(path: Path, notes: Notes) -> None:
    """Complete the bags that killed runs with the same ``--save FILE.mcap`` left, and report each.

    Each gets its final name. If that is taken, it gets its unfinished name without ".partial".
    """
    for left in [path.with_name(match[0]) for match in _written(path) if match["partial"]]:
        if left.suffix != ".mcap" or left.is_symlink() or is_locked(left):
            continue
        try:
            count = complete(left)
            whole = _give_name(left)
        except (OSError, UserError) as error:
            notes.warn(f"{left.name}: left by a run that was killed; it stays as it is ({error})")
        else:
            notes.info(f"{whole}: {count} messages of a run that was killed, completed")


def _give_name(left: Path) -> Path:
    """Rename a completed bag and return its new path."""
    stem, _, key = left.stem.rpartition(".partial-")
    for whole in (left.with_stem(stem), left.with_stem(f"{stem}-{key}")):
        with suppress(FileExistsError):
            rename_new(left, whole)
            return whole
    raise UserError(f"{left}: its name is taken")
