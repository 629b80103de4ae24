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
from bevviz.support.contexts import Closable
from bevviz.workbench.access import HOSTS, Guard
from bevviz.workbench.live_session import LiveSession
from bevviz.workbench.page_connection import PageConnection, news_event
from bevviz.workbench.routes import Site, page_state, site_routes
from bevviz.workbench.server import Server, bound_socket, viewer_folder

if TYPE_CHECKING:
    from bevviz.workbench.session import WorkbenchSession
    from bevviz.workbench.startup import SessionStartup

PATIENCE = 3.0  # seconds that close() waits for the threads of the page


class LivePage(Closable):
    """Server of the page, in threads of its own, until it is closed.

    Args:
        workbench: the workbench session of the robot.
        port: port of the page. None: a free one.

    Raises:
        UserError: the port is in use, or the viewer is not installed.

    Attributes:
        address: address of the page, with its token.
    """

    def __init__(self, workbench: LiveSession, port: int | None) -> None:
        self._workbench = workbench
        viewer, token = viewer_folder(), secrets.token_urlsafe(16)
        news_event = bound_socket(port)
        port = news_event.getsockname()[1]
        site = LiveSite(workbench, viewer, version("rerun-sdk"), token, port)
        routes = [*site_routes(site), WebSocketRoute("/live", site.orders)]
        self.address = f"http://{HOSTS[0]}:{port}/?token={token}"
        ready = threading.Event()
        self._server = Server(Guard(Starlette(routes=routes), token, port), ready.set)
        self._listening = news_event
        self._thread = threading.Thread(
            target=lambda: self._server.run(sockets=[news_event]), name="page", daemon=True
        )
        self._thread.start()
        ready.wait(PATIENCE)

    def close(self) -> None:
        """Stop the server, then close the workbench session."""
        self._server.end()
        self._thread.join(PATIENCE)
        self._listening.close()
        self._workbench.close()


class _OpenSession:
    """Start-up of a workbench session that exists already."""

    error = None

    def __init__(self, workbench: LiveSession) -> None:
        self._workbench = workbench

    async def session(self) -> LiveSession:
        """Return the workbench session."""
        return self._workbench


class LivePageConnection(PageConnection):
    """Connection to one page of a running robot."""

    def __init__(self, workbench: LiveSession, socket: WebSocket, desk: ThreadPoolExecutor, run: str) -> None:
        # A live session has every method that is called below.
        super().__init__(cast(Any, workbench), socket, desk, run)
        self._live = workbench
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

    def __init__(self, workbench: LiveSession, viewer: Path, version: str, token: str, port: int) -> None:
        super().__init__(
            cast("SessionStartup", _OpenSession(workbench)), viewer, version, token, port, "live"
        )
        self._live = workbench

    def _visit(self, workbench: WorkbenchSession, socket: WebSocket) -> PageConnection:
        return LivePageConnection(self._live, socket, self._desk, self._run)

    async def page(self, request: Request) -> Response:
        """Return the HTML page with the script of the robot's panel."""
        response = await super().page(request)
        script = b'<script type="module" src="/page/robot.js"></script>\n</body>'
        response.body = bytes(response.body).replace(b"</body>", script)
        response.headers["Content-Length"] = str(len(response.body))
        return response

    async def recording(self, socket: WebSocket) -> None:
        """Send the newest pieces of the recording as they are made. Marks of answers are among them."""
        await socket.accept()
        buffer, number = self._live.film, None
        if socket.query_params.get("lane") == "desk":
            with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                await socket.receive_text()
            return
        with (
            contextlib.ExitStack() as stack,
            news_event(buffer.listen) as news,
            contextlib.suppress(WebSocketDisconnect, RuntimeError),
        ):
            async with page_state(socket, news) as state:
                page = stack.enter_context(buffer.shown(state))
                while not state.gone:
                    news.clear()
                    if not page.ready:
                        await news.wait()
                        continue
                    pieces, following = await asyncio.to_thread(buffer.since, number)
                    number = None if following < 0 else following
                    for piece in pieces:
                        page.send()
                        await socket.send_bytes(piece)
                    await news.wait()

    async def orders(self, socket: WebSocket) -> None:
        """Execute the commands hold, snap and mark."""
        await socket.accept()
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            while True:
                text = await socket.receive_text()
                try:
                    reply = await asyncio.to_thread(self._order, json.loads(text))
                except UserError as error:
                    reply = {"type": "said", "text": str(error), "wrong": True}
                except (ValueError, KeyError, TypeError, AttributeError):
                    reply = {"type": "said", "text": "that message cannot be understood", "wrong": True}
                await socket.send_text(json.dumps(reply))

    def _order(self, message: dict[str, Any]) -> dict[str, Any]:
        command = message["type"]
        if command == "snap":
            return {"type": "said", "text": self._live.snap()}
        stamp = round(float(message["time"]))
        if command == "hold":
            frame = self._live.hold(stamp).frame
            return {"type": "held", "frame": frame.index, "stamp": str(frame.stamp)}
        if command == "mark":
            return {"type": "said", "text": self._live.mark(stamp, str(message.get("text", "")))}
        raise ValueError(command)
