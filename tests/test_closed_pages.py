"""Pages that were closed: nothing of them is left in the server."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import cast

from starlette.websockets import WebSocket

import bevviz
from bevviz.bags.source import BagSource
from bevviz.workbench.page_connection import PageConnection
from bevviz.workbench.session import recorded_session
from tests.support import bags
from tests.support.waiting import until


class ClosedSocket:
    """Socket of a page that is closed at once."""

    async def send_text(self, text: str) -> None:
        pass

    async def receive(self) -> dict[str, str]:
        return {"type": "websocket.disconnect"}


def test_closed_pages_leave_no_threads(tmp_path: Path) -> None:
    """Count by the system: threads of Rerun's streams are no threads of Python."""
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=3))
    with (
        bevviz.open(bag) as drive,
        BagSource([bag], drive.config) as again,
        recorded_session(drive, again, [bag]) as session,
        ThreadPoolExecutor(1) as questions,
    ):

        async def visits(count: int) -> None:
            for _ in range(count):
                await PageConnection(session, cast(WebSocket, ClosedSocket()), questions, "run").stay()

        def threads() -> int:
            return len(list(Path("/proc/self/task").iterdir()))

        asyncio.run(visits(1))
        before = threads()
        asyncio.run(visits(20))
        until(lambda: threads() <= before, "the threads of closed pages end")
