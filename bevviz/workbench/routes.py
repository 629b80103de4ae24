"""Routes of the workbench page: its files, the viewer's files, recordings, and questions."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections.abc import AsyncIterator, Container
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.types import ASGIApp
from starlette.websockets import WebSocket, WebSocketDisconnect

from bevviz.errors import UserError
from bevviz.workbench.access import Guard, cookie_name
from bevviz.workbench.page_connection import PageConnection, news_event
from bevviz.workbench.startup import SessionStartup

if TYPE_CHECKING:
    from bevviz.workbench.session import WorkbenchSession

Kind = Literal["page", "live"]  # page of a drive, page of a running robot

PAGE = Path(__file__).parent / "page"
FILES = frozenset(path.name for path in PAGE.iterdir() if path.suffix in (".js", ".css"))
VIEWER = ("widget.js", "widget.css", "re_viewer_bg.wasm")
KINDS = {".js": "text/javascript", ".css": "text/css", ".wasm": "application/wasm"}
POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
AHEAD = 6  # pieces of the recording that may be sent before the page acknowledges the first of them


def application(
    startup: SessionStartup, viewer: Path, version: str, token: str, port: int, kind: Kind = "page"
) -> ASGIApp:
    """Return the application that serves the page behind its access guard.

    Args:
        startup: start-up of the workbench session.
        viewer: folder of the viewer's files.
        version: version of the viewer.
        token: token that every request has to carry.
        port: port of the server.
        kind: kind of viewer.
    """
    site = Site(startup, viewer, version, token, port, kind)
    return Guard(Starlette(routes=site_routes(site)), token, port)


def site_routes(site: Site) -> list[BaseRoute]:
    """Return the routes of a site."""
    return [
        Route("/", site.page),
        Route("/page/{name}", site.file),
        Route(f"/viewer/{site.version}/{{name}}", site.viewer),
        Route("/config.yaml", site.config),
        Route("/report/{number:int}/{name}", site.report),
        WebSocketRoute("/film", site.recording),
        WebSocketRoute("/talk", site.talk),
    ]


class Site:
    """Request handlers of the page."""

    def __init__(
        self, startup: SessionStartup, viewer: Path, version: str, token: str, port: int, kind: Kind
    ) -> None:
        self._startup, self._viewer, self.version, self._kind = startup, viewer, version, kind
        self._token, self._port = token, port
        self._run = secrets.token_hex(4)  # A page that reconnects to another run reloads.
        self._desk = ThreadPoolExecutor(1, "desk")  # One thread answers all questions in turn.

    # --- files ---------------------------------------------------------------------------------

    async def page(self, request: Request) -> Response:
        """Return the HTML page, and set the cookie with the token."""
        text = (PAGE / "index.html").read_text().replace("VIEWER_VERSION", self.version)
        text = text.replace("VIEWER_KIND", self._kind)
        response = Response(text, media_type="text/html", headers={"Content-Security-Policy": POLICY})
        response.headers["Cache-Control"] = "no-store"
        response.headers["Referrer-Policy"] = "no-referrer"
        response.set_cookie(cookie_name(self._port), self._token, httponly=True, samesite="strict")
        return response

    async def file(self, request: Request) -> Response:
        """Return a script or style sheet of the page."""
        return _file(PAGE, FILES, request.path_params["name"], "no-cache")

    async def viewer(self, request: Request) -> Response:
        """Return a file of Rerun's web viewer."""
        return _file(
            self._viewer, VIEWER, request.path_params["name"], "private, max-age=31536000, immutable"
        )

    async def config(self, request: Request) -> Response:
        """Return the configuration with the tried settings as a YAML file."""
        from bevviz.config import changed_config, config_yaml

        workbench = await self._startup.session()
        if workbench is None:
            return PlainTextResponse("the drive cannot be opened\n", 503)
        try:
            text = config_yaml(changed_config(workbench.drive.config, request.query_params.getlist("set")))
        except UserError as error:
            return PlainTextResponse(str(error), 400)
        headers = {"Content-Disposition": 'attachment; filename="bevviz.yaml"'}
        return Response(text, media_type="application/yaml", headers=headers)

    async def report(self, request: Request) -> Response:
        """Return a file of a report that this server made."""
        workbench, number = await self._startup.session(), request.path_params["number"]
        reports = [] if workbench is None else workbench.reports.made
        path = reports[number].file(request.path_params["name"]) if number < len(reports) else None
        if path is None:
            return PlainTextResponse("there is no such file\n", 404)
        if path.suffix == ".html":  # The HTML of a report states its own policy.
            return _File(path, media_type="text/html")
        return _File(path, filename=path.name, media_type="application/octet-stream")

    # --- recordings ----------------------------------------------------------------------------

    async def recording(self, socket: WebSocket) -> None:
        """Send every piece of a recording from the requested one on, as the pieces are made.

        The page acknowledges each piece of the run with a message, and gets no more than ``AHEAD`` pieces in
        advance. If its message is a stamp instead, the frame of that stamp is sent next. Pieces of the lane
        ``desk`` (answers and tried results) are sent at once.
        """
        await socket.accept()
        workbench = await self._startup.session()
        if workbench is None:
            await socket.close()
            return
        desk = socket.query_params.get("lane") == "desk"
        buffer, ahead = (workbench.desk, None) if desk else (workbench.film, AHEAD)
        text = socket.query_params.get("from", "0")
        row, sent_early, count = int(text) if text.isdecimal() else 0, set[int](), 0

        async def send(number: int) -> None:
            nonlocal count
            count += 1
            await socket.send_bytes(await asyncio.to_thread(buffer.__getitem__, number))

        with news_event(buffer.listen) as news, contextlib.suppress(WebSocketDisconnect, RuntimeError):
            async with page_state(socket, news) as state:
                while not state.gone:
                    news.clear()
                    while state.requested:
                        requested_row = workbench.film_row(state.requested.pop())
                        if (
                            requested_row is not None
                            and requested_row >= row
                            and requested_row not in sent_early
                        ):
                            sent_early.add(requested_row)
                            await send(requested_row)
                    if row < len(buffer) and (ahead is None or count < state.count + ahead):
                        if row not in sent_early:
                            await send(row)
                        row += 1
                    else:
                        await news.wait()

    # --- questions -----------------------------------------------------------------------------

    async def talk(self, socket: WebSocket) -> None:
        """Answer the questions of a page, and send it the progress of the run."""
        await socket.accept()
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            workbench = await self._startup.session()
            if workbench is None:
                error = self._startup.error
                await socket.send_json({"type": "failed", "text": str(error)})
                return
            await self._visit(workbench, socket).stay()

    def _visit(self, workbench: WorkbenchSession, socket: WebSocket) -> PageConnection:
        return PageConnection(workbench, socket, self._desk, self._run)


class PageState:
    """State of a page, from its messages on one socket.

    Attributes:
        count: number of acknowledged pieces.
        gone: whether the socket is closed.
        hidden: whether the page is in the background.
        requested: stamps of the frames that the page requests next, newest last.
    """

    def __init__(self) -> None:
        self.count, self.gone, self.hidden = 0, False, False
        self.requested: list[int] = []


@contextlib.asynccontextmanager
async def page_state(socket: WebSocket, news: asyncio.Event) -> AsyncIterator[PageState]:
    """Yield the state of a page, updated by its messages, and set ``more`` at each of them."""
    state = PageState()

    async def listen() -> None:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            while True:
                text = await socket.receive_text()
                if text.isdecimal():
                    state.requested.append(int(text))
                elif text in ("hidden", "seen"):
                    state.hidden = text == "hidden"
                else:
                    state.count += 1
                news.set()
        state.gone = True
        news.set()

    task = asyncio.ensure_future(listen())
    try:
        yield state
    finally:
        task.cancel()


class _File(FileResponse):
    chunk_size = 4 * 2**20  # The viewer has 64 MB, and each chunk waits for a busy interpreter.


def _file(folder: Path, names: Container[str], name: str, cache: str) -> Response:
    if name not in names:
        return PlainTextResponse("there is no such file\n", 404)
    kind = KINDS[Path(name).suffix]
    return _File(folder / name, media_type=kind, headers={"Cache-Control": cache})
