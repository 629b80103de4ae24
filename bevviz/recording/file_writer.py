"""A recording's way into its file, which tells when the disk takes no more."""

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
from bevviz.support.contexts import Closing
from bevviz.support.files import write_all

PIECE = 1 << 20  # bytes
HEAD = 12  # bytes at the beginning of a recording: magic, version, options
MESSAGE = struct.Struct("<QQ")  # kind and length of what follows


class FileWriter(Closing):
    """Writes what Rerun logs to a file.

    Rerun's own writer ends at the first error, without a word to us; whoever waits for it then waits for
    ever. So it writes into a pipe, and a thread takes what comes to the file, or nowhere once that failed.
    Messages go there whole: a file that ends early, for whatever reason, can be read up to its end.

    Args:
        file: it is there already.
    """

    def __init__(self, file: Path) -> None:
        self._failure: OSError | None = None
        self._written = 0  # bytes
        self._handle = os.open(file, os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        self._out, self._in = os.pipe()
        if sys.platform == "linux":
            with suppress(OSError):
                fcntl.fcntl(self._out, fcntl.F_SETPIPE_SZ, PIECE)
        self.sink = rr.FileSink(f"/dev/fd/{self._in}")
        self._thread = threading.Thread(target=self._run, name="file", daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """Rerun has opened the sink: the pipe ends with it."""
        os.close(self._in)
        self._in = -1

    def check(self) -> None:
        """Raises UserError where the file cannot be written any more."""
        if self._failure is not None:
            raise UserError(f"the recording ends early, its disk takes no more: {self._failure.strerror}")

    def close(self) -> None:
        """When Rerun is done with the sink, until all is written. A second time it does nothing."""
        if self._handle < 0:
            return
        if self._in >= 0:
            self.begin()
        self._thread.join()
        os.close(self._handle)
        os.close(self._out)
        self._handle = -1

    def _run(self) -> None:
        waiting = bytearray()
        expected = HEAD  # bytes up to the end of the last message that has begun
        while piece := os.read(self._out, PIECE):
            waiting += piece
            whole = 0
            while len(waiting) >= expected:
                whole = expected
                if len(waiting) < whole + MESSAGE.size:
                    break
                _, length = MESSAGE.unpack_from(waiting, whole)
                expected = whole + MESSAGE.size + length
            with memoryview(waiting) as view, view[:whole] as part:
                self._write(part)
            del waiting[:whole]
            expected -= whole
        with memoryview(waiting) as view:
            self._write(view)  # the end of the file is no message

    def _write(self, data: memoryview) -> None:
        """All of it or nothing."""
        if self._failure is not None:
            return
        try:
            write_all(self._handle, data)
        except OSError as error:
            self._failure = error
            with suppress(OSError):
                os.ftruncate(self._handle, self._written)
        self._written += len(data)
