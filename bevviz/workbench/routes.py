"""Routes of the workbench page: its files, the viewer's files, recordings, and questions."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections.abc import AsyncIterator
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
from bevviz.workbench.page_connection import Visit, listening
from bevviz.workbench.startup import Opening

if TYPE_CHECKING:
    from bevviz.workbench.session import Bench

Kind = Literal["page", "native", "live"]  # viewer in the page, native viewer, page of a running robot

PAGE = Path(__file__).parent / "page"
FILES = (
    "bench.css",
    "bench.js",
    "list.js",
    "live.js",
    "native.js",
    "rest.js",
    "state.js",
    "talk.js",
    "viewer.js",
    "work.js",
)
VIEWER = ("widget.js", "widget.css", "re_viewer_bg.wasm")
KINDS = {".js": "text/javascript", ".css": "text/css", ".wasm": "application/wasm"}
POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
AHEAD = 6  # pieces of the recording that may be sent before the page acknowledges the first of them


def application(
    opening: Opening, viewer: Path, version: str, token: str, port: int, kind: Kind = "page"
) -> ASGIApp:
    """Return the application that serves the page behind its access guard.

    Args:
        opening: start-up of the workbench session.
        viewer: folder of the viewer's files.
        version: version of the viewer.
        token: token that every request has to carry.
        port: port of the server.
        kind: kind of viewer.
    """
    site = Site(opening, viewer, version, token, port, kind)
    return Guard(Starlette(routes=routes_of(site)), token, port)


def routes_of(site: Site) -> list[BaseRoute]:
    """Return the routes of a site."""
    return [
        Route("/", site.page),
        Route("/page/{name}", site.file),
        Route(f"/viewer/{site.version}/{{name}}", site.viewer),
        Route("/config.yaml", site.config),
        Route("/report/{number:int}/{name}", site.report),
        WebSocketRoute("/film", site.film),
        WebSocketRoute("/talk", site.talk),
        WebSocketRoute("/native", site.native),
    ]


class Site:
    """Request handlers of the page."""

    def __init__(
        self, opening: Opening, viewer: Path, version: str, token: str, port: int, kind: Kind
    ) -> None:
        self._opening, self._viewer, self.version, self._kind = opening, viewer, version, kind
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
        from bevviz.config import dump, revised

        bench = await self._opening.bench()
        if bench is None:
            return PlainTextResponse("the drive cannot be opened\n", 503)
        try:
            text = dump(revised(bench.drive.config, request.query_params.getlist("set")))
        except UserError as error:
            return PlainTextResponse(str(error), 400)
        headers = {"Content-Disposition": 'attachment; filename="bevviz.yaml"'}
        return Response(text, media_type="application/yaml", headers=headers)

    async def report(self, request: Request) -> Response:
        """Return a file of a report that this server made."""
        bench, number = await self._opening.bench(), request.path_params["number"]
        made = [] if bench is None else bench.reports.made
        path = made[number].file(request.path_params["name"]) if number < len(made) else None
        if path is None:
            return PlainTextResponse("there is no such file\n", 404)
        if path.suffix == ".html":  # The HTML of a report states its own policy.
            return _File(path, media_type="text/html")
        return _File(path, filename=path.name, media_type="application/octet-stream")

    # --- recordings ----------------------------------------------------------------------------

    async def film(self, socket: WebSocket) -> None:
        """Send every piece of a recording from the requested one on, as the pieces are made.

        The page acknowledges each piece of the run with a message, and gets no more than ``AHEAD`` pieces in
        advance. If its message is a stamp instead, the frame of that stamp is sent next. Pieces of the lane
        ``desk`` (answers and tried results) are sent at once.
        """
        await socket.accept()
        bench = await self._opening.bench()
        if bench is None:
            await socket.close()
            return
        desk = socket.query_params.get("lane") == "desk"
        film, ahead = (bench.desk, None) if desk else (bench.film, AHEAD)
        text = socket.query_params.get("from", "0")
        row, early, count = int(text) if text.isdecimal() else 0, set[int](), 0

        async def put(number: int) -> None:
            nonlocal count
            count += 1
            await socket.send_bytes(await asyncio.to_thread(film.__getitem__, number))

        with listening(film.listen) as more, contextlib.suppress(WebSocketDisconnect, RuntimeError):
            async with heard_on(socket, more) as heard:
                while not heard.gone:
                    more.clear()
                    while heard.wanted:
                        wanted = bench.film_row(heard.wanted.pop())
                        if wanted is not None and wanted >= row and wanted not in early:
                            early.add(wanted)
                            await put(wanted)
                    if row < len(film) and (ahead is None or count < heard.count + ahead):
                        if row not in early:
                            await put(row)
                        row += 1
                    else:
                        await more.wait()

    # --- questions -----------------------------------------------------------------------------

    async def talk(self, socket: WebSocket) -> None:
        """Answer the questions of a page, and send it the progress of the run."""
        await socket.accept()
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            bench = await self._opening.bench()
            if bench is None:
                error = self._opening.error
                await socket.send_json({"type": "failed", "text": str(error)})
                return
            await self._visit(bench, socket).stay()

    def _visit(self, bench: Bench, socket: WebSocket) -> Visit:
        return Visit(bench, socket, self._desk, self._run)

    async def native(self, socket: WebSocket) -> None:
        """Connect the page with the native viewer beside it."""
        bench = await self._opening.bench()
        if bench is None or bench.native is None:
            await socket.close()
            return
        await bench.native.talk(socket)


class Heard:
    """State of a page, from its messages on one socket.

    Attributes:
        count: number of acknowledged pieces.
        gone: whether the socket is closed.
        hidden: whether the page is in the background.
        wanted: stamps of the frames that the page requests next, newest last.
    """

    def __init__(self) -> None:
        self.count, self.gone, self.hidden = 0, False, False
        self.wanted: list[int] = []


@contextlib.asynccontextmanager
async def heard_on(socket: WebSocket, more: asyncio.Event) -> AsyncIterator[Heard]:
    """Yield the state of a page, updated by its messages, and set ``more`` at each of them."""
    heard = Heard()

    async def listen() -> None:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            while True:
                text = await socket.receive_text()
                if text.isdecimal():
                    heard.wanted.append(int(text))
                elif text in ("hidden", "seen"):
                    heard.hidden = text == "hidden"
                else:
                    heard.count += 1
                more.set()
        heard.gone = True
        more.set()

    task = asyncio.ensure_future(listen())
    try:
        yield heard
    finally:
        task.cancel()


class _File(FileResponse):
    chunk_size = 4 * 2**20  # The viewer has 64 MB, and each chunk waits for a busy interpreter.


def _file(folder: Path, names: tuple[str, ...], name: str, cache: str) -> Response:
    if name not in names:
        return PlainTextResponse("there is no such file\n", 404)
    kind = KINDS[Path(name).suffix]
    return _File(folder / name, media_type=kind, headers={"Cache-Control": cache})
