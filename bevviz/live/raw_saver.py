"""Output of ``--save FILE.mcap``: writes the messages as they come, in parts that run on their own."""

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
from bevviz.support.contexts import Closable

WAITING = 200 * MEGABYTE  # bytes of messages that may wait for a slow disk


class RawSaver(Closable):
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
        self._queue: deque[RawMessage | Sequence[RawMessage]] = deque()  # a sequence begins a part
        self._waiting = 0  # bytes of messages
        self._changed = threading.Condition()
        self._ended = False
        self._part: McapWriter | None = self._open()
        self._thread = threading.Thread(target=self._run, name="raw", daemon=True)
        raw.attach(self._put, self._begin)
        self._thread.start()

    def close(self) -> None:
        """Write the waiting messages and end."""
        self._raw.detach(self._put)
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join()

    def next_part(self) -> None:
        """Begin a new part. Any thread may call it."""
        if not self._ended:
            self._raw.begin_again(self._begin)

    def _begin(self, messages: Sequence[RawMessage]) -> None:
        """Queue the beginning of a part."""
        with self._changed:
            self._queue.append(messages)
            self._changed.notify()

    def _put(self, message: RawMessage) -> None:
        """Queue a message, or drop it if too many bytes wait."""
        with self._changed:
            if self._ended or self._waiting + len(message.data) > WAITING:
                self.dropped += not self._ended
                return
            self._waiting += len(message.data)
            self._queue.append(message)
            self._changed.notify()

    def _open(self) -> McapWriter:
        """Open the next part."""
        number = f"_{len(self.paths):03d}" if self._numbered else ""
        # No compression, as with `ros2 bag record`. It would take CPU time from the robot.
        path = self._path.with_stem(f"{self._path.stem}{number}")
        part = McapWriter(path, define, compress=False, replace=False)
        part.__enter__()
        self.paths.append(path)
        return part

    def _run(self) -> None:
        """Write until closed. Report an error and end the saving."""
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
        """Write the queued messages. Ask for a new part when the current one is complete."""
        begun, asked = 0, False  # start of the part, and whether the next was requested
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
        """Return the next queue item, or None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._ended)
            if not self._queue:
                return None
            item = self._queue.popleft()
            if isinstance(item, RawMessage):
                self._waiting -= len(item.data)
            return item

    def _append(self, message: RawMessage) -> None:
        """Write one message to the current part."""
        assert self._part is not None
        self._part.write(message.connection, message.received, message.data, message.sent)

    def _finish(self) -> None:
        """Close the current part."""
        part, self._part = self._part, None
        if part is not None:
            part.__exit__(None, None, None)
