"""The flight recorder: the last seconds stay in memory, to be saved when something has gone wrong."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from dataclasses import replace
from pathlib import Path

from bevviz.config import LiveConfig
from bevviz.errors import UserError
from bevviz.live.encoder import Encoder, Packet
from bevviz.live.files import MEGABYTE, Indexer, remove_leftovers
from bevviz.support.files import write_all


class FlightRecorder:
    """Holds the packets of the last ``live.flight_time``, within ``live.flight_size``; ``save`` writes them.

    Saving takes no packet away and holds nothing up.
    """

    def __init__(self, config: LiveConfig, encoder: Encoder, indexer: Indexer) -> None:
        self.config = config
        self._encoder, self._indexer = encoder, indexer
        self._packets: deque[Packet] = deque()
        self._size = 0
        self._held = threading.Lock()
        self._saving = threading.Lock()

    @property
    def size(self) -> int:
        """Bytes held."""
        with self._held:
            return self._size

    def put(self, packet: Packet) -> None:
        with self._held:
            if self.config.flight_time == 0 or not (self._packets or packet.whole):
                return
            self._packets.append(replace(packet, thinned=None))
            self._size += len(packet.data)
            self._forget(packet.time - self.config.flight_time)

    def _forget(self, before: float) -> None:
        """Drop what is too old or too much, up to a packet that needs none before it."""
        limit = self.config.flight_size * MEGABYTE
        while self._packets and (
            self._packets[0].time < before or self._size > limit or not self._packets[0].whole
        ):
            self._size -= len(self._packets.popleft().data)

    def held(self) -> list[Packet]:
        """The packets, oldest first."""
        with self._held:
            return list(self._packets)

    def save(self, path: Path | None = None, packets: list[Packet] | None = None) -> Path:
        """Write what is held as a complete recording; from any thread.

        Args:
            path: .rrd file, not overwritten; None: named by the time, in ``live.flight_folder``.
            packets: that ``held`` gave earlier; None: now.

        Raises:
            UserError: nothing is held yet, or the file cannot be written.
        """
        packets = self.held() if packets is None else packets
        if not packets:
            off = "; it is off (live.flight_time is 0)" if self.config.flight_time == 0 else " yet"
            raise UserError(f"the flight recorder holds no frame{off}")
        with self._saving:
            target = _unused(Path(self.config.flight_folder)) if path is None else path
            if target.suffix != ".rrd":
                raise UserError(f"{target}: expected a file name that ends in .rrd")
            try:
                self._write(target, packets)
            except FileExistsError:
                raise UserError(f"{target}: is already there") from None
            except OSError as error:
                raise UserError(f"{target}: cannot be saved: {error.strerror}") from None
        remove_leftovers(target.parent)
        self._indexer.add(target)
        return target

    def _write(self, target: Path, packets: list[Packet]) -> None:
        file = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        try:
            write_all(file, self._encoder.prelude(packets[0].context))
            for packet in packets:
                write_all(file, packet.data)
        except OSError:
            target.unlink()
            raise
        finally:
            os.close(file)


def _unused(folder: Path) -> Path:
    """Named by the time; with a number where that is taken."""
    stem = time.strftime("flight_%Y%m%dT%H%M%S")
    names = (folder / f"{stem}{suffix}.rrd" for suffix in ("", *(f"_{n}" for n in range(1, 1000))))
    return next(path for path in names if not (path.exists() or path.with_suffix(".mcap").exists()))
