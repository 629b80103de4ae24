"""What takes the packets: each output in a thread of its own, so that a slow one holds nobody up."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod

from bevviz.live.encoder import Packet
from bevviz.support.queues import NewestQueue


class Output(ABC):
    """Packets that it is too slow for are left out and counted; after a gap it goes on at a whole one.

    Args:
        name: for the health of the run.
        queue: packets that may wait.
    """

    def __init__(self, name: str, queue: int) -> None:
        self.name = name
        self._packets: NewestQueue[Packet] = NewestQueue(queue)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @property
    def dropped(self) -> int:
        return self._packets.dropped

    @property
    def lag(self) -> float | None:
        """Seconds that who watches is behind; None: nobody does, or there is no way to know."""
        return None

    def put(self, packet: Packet) -> None:
        """Never waits."""
        self._packets.put(packet)

    @abstractmethod
    def close(self) -> None:
        """Hand over what waits, and end."""

    @abstractmethod
    def _take(self, packet: Packet, fresh: bool) -> bool:
        """Write a packet, ``fresh`` after a gap. False: that failed, go on at a whole one."""

    def _end(self) -> None:
        """Take nothing more."""
        self._ended.set()
        self._packets.close()

    def _run(self) -> None:
        dropped, in_step = 0, False
        for packet in self._packets:
            if self._ended.is_set():
                return
            in_step = in_step and dropped == self.dropped
            dropped = self.dropped
            if in_step or packet.whole:
                in_step = self._take(packet, fresh=not in_step)
