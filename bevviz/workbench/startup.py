"""Start-up of a workbench session. The page is served meanwhile and loads its viewer."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from bevviz.support.contexts import Closable

if TYPE_CHECKING:
    from bevviz.workbench.session import WorkbenchSession


class SessionStartup(Closable):
    """Start-up that makes the workbench session in a thread of its own.

    Args:
        make: makes the session.
        failed: called from that thread if ``make`` raises.
    """

    def __init__(self, make: Callable[[], WorkbenchSession], failed: Callable[[], None]) -> None:
        self._make, self._failed = make, failed
        self._workbench: WorkbenchSession | None = None
        self._over = threading.Event()
        self._closed = False
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._open, name="opening", daemon=True)
        self.error: BaseException | None = None

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def _open(self) -> None:
        try:
            workbench = self._make()
        except BaseException as error:
            self.error = error
            self._over.set()
            self._failed()
            return
        with self._lock:
            self._workbench = workbench
            if self._closed:
                workbench.close()
                return
            workbench.start()
        self._over.set()

    async def session(self) -> WorkbenchSession | None:
        """Wait until the session is made, and return it. None: it could not be made."""
        while not self._over.is_set():
            await asyncio.sleep(0.02)
        return self._workbench

    def close(self) -> None:
        """Close the session, now or as soon as it is made."""
        with self._lock:
            self._closed = True
            if self._workbench is not None:
                self._workbench.close()
