"""Saves what the flight recorder holds: NAME.rrd, and the messages that it was made of as NAME.mcap."""

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
from bevviz.support.contexts import Closing


class Snapshots(Closing):
    """``save`` waits for the disk; ``save_soon`` does it in a thread of its own.

    Args:
        flight: the frames.
        raw: their messages; None: there are none, as in a synthetic drive.
        notes: where is said what was saved.
    """

    def __init__(self, flight: FlightRecorder, raw: RawRecorder | None, notes: Notes) -> None:
        self._flight, self._raw, self._notes = flight, raw, notes
        self._worker = ThreadPoolExecutor(1, "save", initializer=give_way)
        self._waiting: list[threading.Thread] = []  # for what comes after a trigger
        self._closing = threading.Event()

    def close(self) -> None:
        """What waits for its time is saved now."""
        self._closing.set()
        for thread in self._waiting:
            thread.join()
        self._worker.shutdown()

    @property
    def scalars(self) -> dict[str, float]:
        """What is held in memory, for the health."""
        held = {entities.process("flight_mb"): self._flight.size / 1e6}
        if self._raw is not None:
            held[entities.process("raw_mb")] = self._raw.size / 1e6
            held[entities.process("raw_s")] = self._raw.seconds
        return held

    def save(self, path: Path | None = None, reason: str = "") -> Path:
        """Save both as they are now, and say so.

        Args:
            path: .rrd file; None: named by the time, in ``live.flight_folder``.
            reason: that it is saved for.

        Returns:
            The .rrd file; the .mcap file is beside it.

        Raises:
            UserError: nothing is held yet, or the .rrd file cannot be written. Of the .mcap file it is told.
        """
        raw = self._raw
        messages = raw.held() if raw is not None and raw.config.raw_size > 0 else []
        return self._worker.submit(self._write, path, reason, self._flight.held(), messages).result()

    def save_soon(self, reason: str, after: float = 0.0) -> None:
        """Nothing waits for it.

        Args:
            reason: that it is saved for.
            after: seconds that still belong to it; less where the run ends.
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
