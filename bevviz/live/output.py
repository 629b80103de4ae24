"""Base class of the outputs. Each has its own thread, so that a slow one delays no other."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod

from bevviz.live.encoder import Packet
from bevviz.support.queues import NewestQueue


class Output(ABC):
    """Consumer of packets. Packets that overflow its queue are dropped and counted.

    After a gap it continues at a whole packet.

    Args:
        name: name in the health of the run.
        queue: most packets that may wait.
    """

    def __init__(self, name: str, queue: int) -> None:
        self.name = name
        self._packets: NewestQueue[Packet] = NewestQueue(queue)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @property
    def dropped(self) -> int:
        """Packets dropped so far."""
        return self._packets.dropped

    @property
    def lag(self) -> float | None:
        """Seconds that the viewer is behind. None: there is no viewer, or its lag is unknown."""
        return None

    def put(self, packet: Packet) -> None:
        """Queue a packet. It never waits."""
        self._packets.put(packet)

    @abstractmethod
    def close(self) -> None:
        """Write the waiting packets and end."""

    @abstractmethod
    def _take(self, packet: Packet, fresh: bool) -> bool:
        """Write a packet. Return False if that failed; the output then continues at a whole packet.

        ``fresh``: the packet is the first after a gap.
        """

    def _end(self) -> None:
        """Accept no more packets."""
        self._ended.set()
        self._packets.close()

    def _run(self) -> None:
        """Write the queued packets until the queue is closed."""
        dropped, in_step = 0, False
        for packet in self._packets:
            if self._ended.is_set():
                return
            in_step = in_step and dropped == self.dropped
            dropped = self.dropped
            if in_step or packet.whole:
                in_step = self._take(packet, fresh=not in_step)
