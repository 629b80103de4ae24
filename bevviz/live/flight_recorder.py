"""Flight recorder: the last seconds in memory, saved on request or by a trigger as NAME.rrd and NAME.mcap."""

from __future__ import annotations

import math
import os
import threading
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from bevviz.anomalies import Onsets
from bevviz.config import LiveConfig
from bevviz.config.reloading import ReloadableConfig
from bevviz.errors import UserError
from bevviz.live.encoder import Encoder, Packet
from bevviz.live.files import write_bag
from bevviz.live.indexing import Indexer, remove_leftovers
from bevviz.live.raw_recorder import MEGABYTE, RawMessage, RawRecorder
from bevviz.live.status import Notes, give_way
from bevviz.model.results import FrameResult
from bevviz.recording import entities
from bevviz.support.contexts import Closable
from bevviz.support.files import claim_target, rename_new, write_all


class FlightRecorder(Closable):
    """Buffer of the packets of the last ``live.flight_time``, limited by ``live.flight_size``.

    ``save`` writes the packets as a recording, and their messages as a bag beside it. It removes none and
    does not delay the run. Any thread may call it.

    Args:
        settings: limits of the buffer.
        encoder: makes the beginning of a recording.
        indexer: gives saved recordings an index.
        notes: takes a report of each snapshot.
        raw: recorder of the messages. None: there are no messages.
    """

    def __init__(
        self,
        settings: ReloadableConfig,
        encoder: Encoder,
        indexer: Indexer,
        notes: Notes,
        raw: RawRecorder | None = None,
    ) -> None:
        self._settings = settings
        self._encoder, self._indexer, self._notes, self._raw = encoder, indexer, notes, raw
        self._packets: deque[Packet] = deque()
        self._size = 0
        self._lock = threading.Lock()
        self._worker = ThreadPoolExecutor(1, "save", initializer=give_way)
        self._delayed: list[threading.Thread] = []  # each saves after the delay of a trigger
        self._closing = threading.Event()

    def close(self) -> None:
        """Save the delayed snapshots now."""
        self._closing.set()
        for thread in self._delayed:
            thread.join()
        self._worker.shutdown()

    @property
    def _limits(self) -> LiveConfig:
        return self._settings.config.live

    @property
    def size(self) -> int:
        """Bytes in the buffer."""
        with self._lock:
            return self._size

    @property
    def scalars(self) -> dict[str, float]:
        """Size of the buffers, by entity path, for the health."""
        scalars = {entities.PROCESS.path("flight_mb"): self.size / 1e6}
        if self._raw is not None:
            scalars[entities.PROCESS.path("raw_mb")] = self._raw.size / 1e6
            scalars[entities.PROCESS.path("raw_s")] = self._raw.seconds
        return scalars

    def put(self, packet: Packet) -> None:
        """Add a packet and drop old ones."""
        with self._lock:
            if self._limits.flight_time == 0 or not (self._packets or packet.whole):
                return
            self._packets.append(replace(packet, thinned=None))
            self._size += len(packet.data)
            self._forget(packet.time - self._limits.flight_time)

    def _forget(self, before: float) -> None:
        """Drop packets that are too old or too many. The first one left is a whole packet."""
        limit = self._limits.flight_size * MEGABYTE
        while self._packets and (
            self._packets[0].time < before or self._size > limit or not self._packets[0].whole
        ):
            self._size -= len(self._packets.popleft().data)

    def packets(self) -> list[Packet]:
        """Return the packets, oldest first."""
        with self._lock:
            return list(self._packets)

    def save(self, path: Path | None = None, reason: str = "") -> Path:
        """Save frames and messages as they are now, and report it. Wait for the disk.

        Args:
            path: .rrd file, not overwritten. None: named by the time, in ``live.flight_folder``.
            reason: reason for the report.

        Returns:
            The .rrd file. The .mcap file is beside it.

        Raises:
            UserError: there is no frame yet, or the .rrd file cannot be written. A failure of the .mcap
                file is only reported.
        """
        messages = self._raw.messages() if self._raw is not None and self._limits.raw_size > 0 else []
        return self._worker.submit(self._write, path, reason, self.packets(), messages).result()

    def save_soon(self, reason: str, after: float = 0.0) -> None:
        """Save in a thread of its own, without waiting.

        Args:
            reason: reason for the report.
            after: seconds to record before saving. The end of the run shortens them.
        """

        def save() -> None:
            self._closing.wait(after)
            try:
                self.save(reason=reason)
            except UserError as error:
                self._notes.warn(f"flight recorder not saved ({reason}): {error}")

        self._delayed = [thread for thread in self._delayed if thread.is_alive()]
        self._delayed.append(threading.Thread(target=save, name="save soon", daemon=True))
        self._delayed[-1].start()

    def _write(
        self, path: Path | None, reason: str, packets: list[Packet], messages: list[RawMessage]
    ) -> Path:
        """Write both files and report it."""
        if not packets:
            off = "; it is off (live.flight_time is 0)" if self._limits.flight_time == 0 else " yet"
            raise UserError(f"the flight recorder holds no frame{off}")
        saved = _unused(Path(self._limits.flight_folder)) if path is None else path
        self._write_recording(saved, packets)
        about, why = str(saved), f" ({reason})" if reason else ""
        if messages:
            bag = saved.with_suffix(".mcap")
            try:
                write_bag(bag, messages)
                span = (messages[-1].received - messages[0].received) / 1e9
                about += f" and {bag.name}, {len(messages)} messages of {span:.0f} s"
            except UserError as error:
                self._notes.warn(f"the messages of {saved} are not saved: {error}")
        self._notes.info(f"flight recorder saved in {about}{why}")
        left_out = self._raw.left_out if self._raw is not None and messages else {}
        if left_out:
            left = "; ".join(f"{topic} ({reason})" for topic, reason in sorted(left_out.items()))
            self._notes.info(f"not in {saved.stem}.mcap: {left}")
        return saved

    def _write_recording(self, target: Path, packets: list[Packet]) -> None:
        if target.suffix != ".rrd":
            raise UserError(f"{target}: expected a file name that ends in .rrd")
        if os.path.lexists(target):
            raise UserError(f"{target}: is already there")
        unfinished = claim_target(target, "recording")
        try:
            write_all(unfinished.handle, self._encoder.prelude(packets[0].context))
            for packet in packets:
                write_all(unfinished.handle, packet.data)
            rename_new(unfinished.path, target)
        except FileExistsError:
            raise UserError(f"{target}: is already there") from None
        except OSError as error:
            raise UserError(f"{target}: cannot be saved: {error.strerror}") from None
        finally:
            unfinished.discard()
        remove_leftovers(target.parent)
        self._indexer.add(target)


def _unused(folder: Path) -> Path:
    """Return a free path in a folder, named by the time. If that name is taken, it gets a number."""
    stem = time.strftime("flight_%Y%m%dT%H%M%S")
    names = (folder / f"{stem}{suffix}.rrd" for suffix in ("", *(f"_{n}" for n in range(1, 1000))))
    return next(path for path in names if not (path.exists() or path.with_suffix(".mcap").exists()))


class Triggers:
    """Trigger on anomalies of the kinds in ``live.triggers``.

    ``check`` returns a reason to save at most once in ``live.trigger_pause``.
    """

    def __init__(self) -> None:
        self._onsets = Onsets()
        self._fired = -math.inf

    def check(self, result: FrameResult) -> str | None:
        """Return the reason to save, or None."""
        # Called for every result, so that old anomalies do not count as new.
        onsets, config = self._onsets.of(result.anomalies), result.config.live
        reasons = [anomaly.text for anomaly in onsets if anomaly.kind in config.triggers]
        now = time.monotonic()
        if not reasons or now - self._fired < config.trigger_pause:
            return None
        self._fired = now
        return "; ".join(reasons)
