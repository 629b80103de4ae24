"""A recording that is put together from finished parts, as they are: nothing is decoded and packed again."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import IO

import rerun as rr
from rerun.chunk import RrdReader

from bevviz import remains
from bevviz.closing import Closing
from bevviz.errors import UserError
from bevviz.logging import rerun_cli
from bevviz.logging.reading import readable

PIECE = 1 << 20  # bytes
AHEAD = 4  # parts that wait to be written, which takes no time of Python's


class PartsWriter(Closing):
    """Writes recordings of one store each to a file, one behind the other, as one with one index at its end.

    ``rerun rrd route`` does it, in a process of its own. It ends when its input does: the file gets its
    index whatever becomes of us.

    Args:
        file: it is there already.
    """

    def __init__(self, file: Path) -> None:
        self._failure = ""
        self._thread = ThreadPoolExecutor(1, "parts")
        self._coming: deque[Future[None]] = deque()
        self._said = tempfile.TemporaryFile()  # noqa: SIM115
        command = [rerun_cli.program(), "rrd", "route", "--output", str(file)]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._said,
            env={**rerun_cli.environment(), "RUST_LOG": "error"},
            start_new_session=True,  # Ctrl-C is for us alone
            pipesize=PIECE if sys.platform == "linux" else -1,
        )

    def add(self, part: Path) -> None:
        """The next part; it may be removed then. On a full disk it goes nowhere, see ``check``."""
        file = part.open("rb")
        while len(self._coming) >= AHEAD:
            self._coming.popleft().result()
        self._coming.append(self._thread.submit(self._write, file))

    def _write(self, file: IO[bytes]) -> None:
        assert self._process.stdin is not None
        with file, suppress(BrokenPipeError):
            _copy(file.fileno(), self._process.stdin.fileno())

    def check(self) -> None:
        """Raises UserError where the file cannot be written any more."""
        if not self._failure and self._process.poll() is not None and self._process.returncode:
            self._ended()
        if self._failure:
            raise UserError(f"the recording ends early: {self._failure}")

    def close(self) -> None:
        """When all is written. A second time it does nothing."""
        assert self._process.stdin is not None
        if self._process.stdin.closed:
            return
        self._thread.shutdown()
        self._process.stdin.close()
        if self._process.wait():
            self._ended()
        self._said.close()

    def _ended(self) -> None:
        self._process.wait()
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        self._failure = self._failure or f"rerun rrd route: {lines[-1] if lines else 'it ended'}"


def _copy(source: int, target: int) -> None:
    """All of a file into a pipe."""
    if sys.platform == "linux":
        while os.sendfile(target, source, None, PIECE):
            pass
    else:
        while piece := os.read(source, PIECE):
            with memoryview(piece) as left:
                done = 0
                while done < len(left):
                    done += os.write(target, left[done:])


class Parts(Closing):
    """What is logged to a recording becomes parts between those that other processes have made of it.

    Args:
        recording: its sinks are replaced.
        writer: of the file that the parts go to; None: to none.
        shown: the same recording at viewers; None: at none.
        place: folder for the part at hand.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        writer: PartsWriter | None,
        shown: rr.RecordingStream | None,
        place: Path | None,
    ) -> None:
        self._recording, self._writer, self._shown = recording, writer, shown
        self.folder = Path(tempfile.mkdtemp(prefix=".bevviz-parts-", dir=place)).resolve()
        remains.remember(self, partial(shutil.rmtree, self.folder, ignore_errors=True))
        self._number = 0
        recording.set_sinks(rr.FileSink(self._own))

    @property
    def _own(self) -> Path:
        """What is logged now."""
        return self.folder / f"{self._number:08}.rrd"

    def add(self, part: Path) -> None:
        """A part of others, behind all that was logged.

        Raises:
            UserError: it cannot be read.
        """
        logged = self._own
        self._number += 1
        self._recording.set_sinks(rr.FileSink(self._own))  # the one before is whole with that
        self._give(logged)
        self._give(part)
        logged.unlink()

    def close(self) -> None:
        """When the recording is disconnected: what was logged last. A second time it does nothing."""
        try:
            if self._own.exists():
                self._give(self._own)
        finally:
            shutil.rmtree(self.folder, ignore_errors=True)
            remains.forget(self)

    def _give(self, part: Path) -> None:
        if self._writer is not None:
            self._writer.add(part)
        if self._shown is not None:
            with readable(part), suppress(EOFError):
                rr.send_chunks(RrdReader(part).stream(), recording=self._shown)
