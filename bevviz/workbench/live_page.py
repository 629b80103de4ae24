"""The workbench page of a running robot, served by the live process."""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
import threading
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from bevviz.errors import UserError
from bevviz.support.contexts import Closing
from bevviz.workbench.access import HOSTS, Guard
from bevviz.workbench.live_session import LiveBench
from bevviz.workbench.page_connection import Visit, listening
from bevviz.workbench.routes import Site, heard_on, routes_of
from bevviz.workbench.server import Server, bound, viewer_folder

if TYPE_CHECKING:
    from bevviz.workbench.session import Bench
    from bevviz.workbench.startup import Opening

PATIENCE = 3.0  # seconds that close() waits for the threads of the page


class LivePage(Closing):
    """Server of the page, in threads of its own, until it is closed.

    Args:
        bench: the workbench session of the robot.
        port: port of the page. None: a free one.

    Raises:
        UserError: the port is in use, or the viewer is not installed.

    Attributes:
        address: address of the page, with its token.
    """

    def __init__(self, bench: LiveBench, port: int | None) -> None:
        self._bench = bench
        viewer, token = viewer_folder(), secrets.token_urlsafe(16)
        listening = bound(port)
        port = listening.getsockname()[1]
        site = LiveSite(bench, viewer, version("rerun-sdk"), token, port)
        routes = [*routes_of(site), WebSocketRoute("/live", site.orders)]
        self.address = f"http://{HOSTS[0]}:{port}/?token={token}"
        ready = threading.Event()
        self._server = Server(Guard(Starlette(routes=routes), token, port), ready.set)
        self._listening = listening
        self._thread = threading.Thread(
            target=lambda: self._server.run(sockets=[listening]), name="page", daemon=True
        )
        self._thread.start()
        ready.wait(PATIENCE)

    def close(self) -> None:
        """Stop the server, then close the workbench session."""
        self._server.end()
        self._thread.join(PATIENCE)
        self._listening.close()
        self._bench.close()


class _Open:
    """Start-up of a workbench session that exists already."""

    error = None

    def __init__(self, bench: LiveBench) -> None:
        self._bench = bench

    async def bench(self) -> LiveBench:
        """Return the workbench session."""
        return self._bench


class LiveVisit(Visit):
    """Connection to one page of a running robot."""

    def __init__(self, bench: LiveBench, socket: WebSocket, desk: ThreadPoolExecutor, run: str) -> None:
        super().__init__(cast("Bench", bench), socket, desk, run)  # It has every method that is called below.
        self._live = bench
        for name in ("drive", "cancel", "report", "note", "unnote"):
            self._handlers[name] = self._refuse

    async def _refuse(self, number: int, message: dict[str, Any]) -> None:
        """Raise a UserError: the request is only possible for a recorded drive."""
        raise UserError("that is for a drive that is over: save what was seen, and open the recording's bag")

    async def _ask(self, number: int, message: dict[str, Any]) -> None:
        """Answer a click about the shown frame, and a repeated question with the current settings."""
        again = list(self._live.settings) if "pick" in message else []
        await super()._ask(number, {**message, "set": again})

    async def _settle(self, number: int, message: dict[str, Any]) -> None:
        """Do nothing: the next frame comes at once, so there is no time to prepare an answer."""


class LiveSite(Site):
    """Request handlers of the page of a running robot."""

    def __init__(self, bench: LiveBench, viewer: Path, version: str, token: str, port: int) -> None:
        super().__init__(cast("Opening", _Open(bench)), viewer, version, token, port, "live")
        self._live = bench

    def _visit(self, bench: Bench, socket: WebSocket) -> Visit:
        return LiveVisit(self._live, socket, self._desk, self._run)

    async def page(self, request: Request) -> Response:
        """Return the HTML page with the script of the robot's panel."""
        response = await super().page(request)
        script = b'<script type="module" src="/page/live.js"></script>\n</body>'
        response.body = bytes(response.body).replace(b"</body>", script)
        response.headers["Content-Length"] = str(len(response.body))
        return response

    async def film(self, socket: WebSocket) -> None:
        """Send the newest pieces of the recording as they are made. Marks of answers are among them."""
        await socket.accept()
        film, number = self._live.film, None
        if socket.query_params.get("lane") == "desk":
            with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                await socket.receive_text()
            return
        with (
            contextlib.ExitStack() as there,
            listening(film.listen) as more,
            contextlib.suppress(WebSocketDisconnect, RuntimeError),
        ):
            async with heard_on(socket, more) as heard:
                page = there.enter_context(film.shown(heard))
                while not heard.gone:
                    more.clear()
                    if not page.ready:
                        await more.wait()
                        continue
                    pieces, following = await asyncio.to_thread(film.since, number)
                    number = None if following < 0 else following
                    for piece in pieces:
                        page.send()
                        await socket.send_bytes(piece)
                    await more.wait()

    async def orders(self, socket: WebSocket) -> None:
        """Execute the commands hold, snap and mark."""
        await socket.accept()
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            while True:
                text = await socket.receive_text()
                try:
                    said = await asyncio.to_thread(self._order, json.loads(text))
                except UserError as error:
                    said = {"type": "said", "text": str(error), "wrong": True}
                except (ValueError, KeyError, TypeError, AttributeError):
                    said = {"type": "said", "text": "that message cannot be understood", "wrong": True}
                await socket.send_text(json.dumps(said))

    def _order(self, message: dict[str, Any]) -> dict[str, Any]:
        what = message["type"]
        if what == "snap":
            return {"type": "said", "text": self._live.snap()}
        stamp = round(float(message["time"]))
        if what == "hold":
            frame = self._live.hold(stamp).frame
            return {"type": "held", "frame": frame.index, "stamp": str(frame.stamp)}
        if what == "mark":
            return {"type": "said", "text": self._live.mark(stamp, str(message.get("text", "")))}
        raise ValueError(what)
