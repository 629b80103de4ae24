"""A writer of recording files that detects a full disk."""

from __future__ import annotations

import fcntl
import os
import struct
import sys
import threading
from contextlib import suppress
from pathlib import Path

import rerun as rr

from bevviz.errors import UserError
from bevviz.support.contexts import Closable
from bevviz.support.files import write_all

PIPE_BYTES = 1 << 20
BUFFER_BYTES = 4 << 20  # grows for longer messages
HEADER_BYTES = 12  # bytes of a recording's header: magic, version, options
MESSAGE_HEADER = struct.Struct("<QQ")  # kind and length of the message that follows


class FileWriter(Closable):
    """Writer of Rerun's log data to a file.

    Rerun's own writer ends silently at the first error, and the next flush then waits for ever. Here Rerun
    writes into a pipe. A thread copies the pipe to the file. After a write error it discards the data.
    The thread writes whole messages only, so a file that ends early can be read up to its end.

    Args:
        file: existing file.
    """

    def __init__(self, file: Path) -> None:
        self._failure: OSError | None = None
        self._written = 0  # bytes
        self._handle = os.open(file, os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        self._read_end, self._write_end = os.pipe()
        if sys.platform == "linux":
            with suppress(OSError):
                fcntl.fcntl(self._read_end, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self.sink = rr.FileSink(f"/dev/fd/{self._write_end}")
        self._thread = threading.Thread(target=self._run, name="file", daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """Close our end of the pipe, so that the pipe ends with the sink.

        Call it when Rerun has opened the sink.
        """
        os.close(self._write_end)
        self._write_end = -1

    def check(self) -> None:
        """Raise UserError if the file can no longer be written."""
        if self._failure is not None:
            raise UserError(f"the recording ends early, its disk takes no more: {self._failure.strerror}")

    def close(self) -> None:
        """Wait until everything is written. A second call does nothing.

        Call it when Rerun has closed the sink.
        """
        if self._handle < 0:
            return
        if self._write_end >= 0:
            self.begin()
        self._thread.join()
        os.close(self._handle)
        os.close(self._read_end)
        self._handle = -1

    def _run(self) -> None:
        buffer = memoryview(bytearray(BUFFER_BYTES))
        size, message_end = 0, HEADER_BYTES  # bytes in the buffer; end of its last whole message
        while count := os.readv(self._read_end, [buffer[size:]]):
            size += count
            complete = 0
            while size >= message_end:
                complete = message_end
                if size < complete + MESSAGE_HEADER.size:
                    break
                _, length = MESSAGE_HEADER.unpack_from(buffer, complete)
                message_end = complete + MESSAGE_HEADER.size + length
            self._write(buffer[:complete])
            rest = bytes(buffer[complete:size])
            size, message_end = len(rest), message_end - complete
            if size + PIPE_BYTES > len(buffer):
                buffer = memoryview(bytearray(2 * len(buffer)))
            buffer[:size] = rest
        self._write(buffer[:size])  # the footer is no message

    def _write(self, data: memoryview) -> None:
        """Write all of the data. After an error, cut the file back to its last whole write."""
        if self._failure is not None:
            return
        try:
            write_all(self._handle, data)
        except OSError as error:
            self._failure = error
            with suppress(OSError):
                os.ftruncate(self._handle, self._written)
        self._written += len(data)
