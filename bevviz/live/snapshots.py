"""Snapshots of the flight recorder: NAME.rrd, and its messages as NAME.mcap."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from bevviz.errors import UserError
from bevviz.live.encoder import Packet
from bevviz.live.flight_recorder import FlightRecorder
from bevviz.live.health import give_way
from bevviz.live.notes import Notes
from bevviz.live.raw_recorder import RawMessage, RawRecorder, write_bag
from bevviz.recording import entities
from bevviz.support.contexts import Closable


class Snapshots(Closable):
    """Writer of snapshots. ``save`` waits for the disk; ``save_soon`` uses its own thread.

    Args:
        flight: recorder of the frames.
        raw: recorder of their messages. None: there are no messages, as in a synthetic drive.
        notes: takes a report of each snapshot.
    """

    def __init__(self, flight: FlightRecorder, raw: RawRecorder | None, notes: Notes) -> None:
        self._flight, self._raw, self._notes = flight, raw, notes
        self._worker = ThreadPoolExecutor(1, "save", initializer=give_way)
        self._waiting: list[threading.Thread] = []  # each saves after the delay of a trigger
        self._closing = threading.Event()

    def close(self) -> None:
        """Save the delayed snapshots now."""
        self._closing.set()
        for thread in self._waiting:
            thread.join()
        self._worker.shutdown()

    @property
    def scalars(self) -> dict[str, float]:
        """Size of the buffers, by entity path, for the health."""
        held = {entities.process("flight_mb"): self._flight.size / 1e6}
        if self._raw is not None:
            held[entities.process("raw_mb")] = self._raw.size / 1e6
            held[entities.process("raw_s")] = self._raw.seconds
        return held

    def save(self, path: Path | None = None, reason: str = "") -> Path:
        """Save frames and messages as they are now, and report it.

        Args:
            path: .rrd file. None: named by the time, in ``live.flight_folder``.
            reason: reason for the report.

        Returns:
            The .rrd file. The .mcap file is beside it.

        Raises:
            UserError: there is no frame yet, or the .rrd file cannot be written. A failure of the .mcap
                file is only reported.
        """
        raw = self._raw
        messages = raw.held() if raw is not None and raw.config.raw_size > 0 else []
        return self._worker.submit(self._write, path, reason, self._flight.held(), messages).result()

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

        self._waiting = [thread for thread in self._waiting if thread.is_alive()]
        self._waiting.append(threading.Thread(target=save, name="save soon", daemon=True))
        self._waiting[-1].start()

    def _write(
        self, path: Path | None, reason: str, packets: list[Packet], messages: list[RawMessage]
    ) -> Path:
        """Write both files and report it."""
        saved = self._flight.save(path, packets)
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
