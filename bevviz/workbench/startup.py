"""The bench while it is being made: the page is served meanwhile, and its viewer loads."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from bevviz.support.contexts import Closing

if TYPE_CHECKING:
    from bevviz.workbench.session import Bench


class Opening(Closing):
    """Makes the bench in a thread of its own.

    Args:
        make: makes it.
        failed: called, from that thread, where it cannot be made.
    """

    def __init__(self, make: Callable[[], Bench], failed: Callable[[], None]) -> None:
        self._make, self._failed = make, failed
        self._bench: Bench | None = None
        self._over = threading.Event()
        self._closed = False
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._open, name="opening", daemon=True)
        self.error: BaseException | None = None

    def start(self) -> None:
        self._thread.start()

    def _open(self) -> None:
        try:
            bench = self._make()
        except BaseException as error:
            self.error = error
            self._over.set()
            self._failed()
            return
        with self._lock:
            self._bench = bench
            if self._closed:
                bench.close()
                return
            bench.start()
        self._over.set()

    async def bench(self) -> Bench | None:
        """Once it is there; None: it cannot be made."""
        while not self._over.is_set():
            await asyncio.sleep(0.02)
        return self._bench

    def close(self) -> None:
        with self._lock:
            self._closed = True
            if self._bench is not None:
                self._bench.close()
