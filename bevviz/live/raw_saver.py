"""``--save FILE.mcap``: the messages on disk as they come, in parts that each run on their own."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from pathlib import Path

from bevviz.bags.mcap_writer import CHUNK_SIZE, McapWriter
from bevviz.config import LiveConfig
from bevviz.errors import UserError
from bevviz.live.files import MEGABYTE
from bevviz.live.notes import Notes
from bevviz.live.raw_recorder import RawMessage, RawRecorder, define
from bevviz.support.contexts import Closing

WAITING = 200 * MEGABYTE  # of messages that wait for a slow disk


class RawSaver(Closing):
    """Writes every message, from those that are held already.

    A part that is being written is NAME.partial-XXXXXXXX.mcap. It begins with what holds from before and with
    the last seconds of the part before it, so that its first scan has what belongs to it. A full disk is
    said once and ends the saving, nothing else; what is on it is a whole file. Messages that a disk is too
    slow for are left out and counted. No existing file is overwritten.

    Args:
        path: the .mcap file; with a limit of size or time it is numbered.
        config: the limits.
        raw: where the messages come from.
        notes: what has to be said.
        follows: a new part begins with ``next_part`` alone, as where parts of an .rrd file lead.

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
        self._queue: deque[RawMessage | Sequence[RawMessage]] = deque()  # a sequence begins a part
        self._waiting = 0  # bytes of messages
        self._changed = threading.Condition()
        self._ended = False
        self._part: McapWriter | None = self._open()
        self._thread = threading.Thread(target=self._run, name="raw", daemon=True)
        raw.attach(self._put, self._begin)
        self._thread.start()

    def close(self) -> None:
        """Write what waits, and end."""
        self._raw.detach(self._put)
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join()

    def next_part(self) -> None:
        """From any thread."""
        if not self._ended:
            self._raw.begin_again(self._begin)

    def _begin(self, messages: Sequence[RawMessage]) -> None:
        with self._changed:
            self._queue.append(messages)
            self._changed.notify()

    def _put(self, message: RawMessage) -> None:
        with self._changed:
            if self._ended or self._waiting + len(message.data) > WAITING:
                self.dropped += not self._ended
                return
            self._waiting += len(message.data)
            self._queue.append(message)
            self._changed.notify()

    def _open(self) -> McapWriter:
        number = f"_{len(self.paths):03d}" if self._numbered else ""
        # As `ros2 bag record` does by itself: what is saved must not take the CPU from what it is saved for.
        path = self._path.with_stem(f"{self._path.stem}{number}")
        part = McapWriter(path, define, compress=False, replace=False)
        part.__enter__()
        self.paths.append(path)
        return part

    def _run(self) -> None:
        try:
            self._write()
        except UserError as error:
            self._notes.warn(f"saving of the messages ends here, the rest goes on: {error}")
            self._raw.detach(self._put)
            with self._changed:
                self._ended = True
                self._queue.clear()
        try:
            self._finish()
        except UserError as error:
            self._notes.warn(str(error))

    def _write(self) -> None:
        begun, asked = 0, False  # when the part began, and whether the next one was asked for
        while (item := self._take()) is not None:
            if isinstance(item, RawMessage):
                self._append(item)
                complete = self._time is not None and item.received - begun >= self._time
                if self._size is not None and self._part is not None:
                    complete |= self._part.size + CHUNK_SIZE > self._size
                if complete and not asked:
                    asked = True
                    self.next_part()
                continue
            if begun:
                self._finish()
                self._part = self._open()
            for message in item:
                self._append(message)
            begun, asked = item[-1].received if item else 1, False

    def _take(self) -> RawMessage | Sequence[RawMessage] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._ended)
            if not self._queue:
                return None
            item = self._queue.popleft()
            if isinstance(item, RawMessage):
                self._waiting -= len(item.data)
            return item

    def _append(self, message: RawMessage) -> None:
        assert self._part is not None
        self._part.write(message.connection, message.received, message.data, message.sent)

    def _finish(self) -> None:
        part, self._part = self._part, None
        if part is not None:
            part.__exit__(None, None, None)
