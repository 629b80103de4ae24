"""Flight recorder: buffer of the last seconds in memory, saved on request."""

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
    """Buffer of the packets of the last ``live.flight_time``, limited by ``live.flight_size``.

    ``save`` writes the packets. It removes none and does not delay the run.
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
        """Bytes in the buffer."""
        with self._held:
            return self._size

    def put(self, packet: Packet) -> None:
        """Add a packet and drop old ones."""
        with self._held:
            if self.config.flight_time == 0 or not (self._packets or packet.whole):
                return
            self._packets.append(replace(packet, thinned=None))
            self._size += len(packet.data)
            self._forget(packet.time - self.config.flight_time)

    def _forget(self, before: float) -> None:
        """Drop packets that are too old or too many. The first one left is a whole packet."""
        limit = self.config.flight_size * MEGABYTE
        while self._packets and (
            self._packets[0].time < before or self._size > limit or not self._packets[0].whole
        ):
            self._size -= len(self._packets.popleft().data)

    def held(self) -> list[Packet]:
        """Return the packets, oldest first."""
        with self._held:
            return list(self._packets)

    def save(self, path: Path | None = None, packets: list[Packet] | None = None) -> Path:
        """Write the packets as a complete recording. Any thread may call it.

        Args:
            path: .rrd file, not overwritten. None: named by the time, in ``live.flight_folder``.
            packets: earlier result of ``held``. None: the packets held now.

        Raises:
            UserError: there is no packet yet, or the file cannot be written.
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
        """Write a prelude and the packets."""
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
    """Return a free path in a folder, named by the time. If that name is taken, it gets a number."""
    stem = time.strftime("flight_%Y%m%dT%H%M%S")
    names = (folder / f"{stem}{suffix}.rrd" for suffix in ("", *(f"_{n}" for n in range(1, 1000))))
    return next(path for path in names if not (path.exists() or path.with_suffix(".mcap").exists()))
