"""Routes of the workbench page: its files, the viewer's files, recordings, and questions."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections.abc import Container
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp
from starlette.websockets import WebSocket, WebSocketDisconnect

from bevviz.errors import UserError
from bevviz.support.colors import css_properties
from bevviz.workbench.access import SHARED, Guard, cookie_name
from bevviz.workbench.buffers import PageState
from bevviz.workbench.page_connection import PageConnection, news_event

if TYPE_CHECKING:
    from bevviz.workbench.session import WorkbenchSession

Kind = Literal["page", "live"]  # page of a drive, page of a running robot

PAGE = Path(__file__).parent / "page"
FILES = frozenset(path.name for path in PAGE.iterdir() if path.suffix in (".js", ".css"))
WIDGET = "\nvar ViewerWidget = class"  # in the script of Rerun 0.41
VIEWER = ("widget.js", "widget.css", "re_viewer_bg.wasm")
KINDS = {".js": "text/javascript", ".css": "text/css", ".wasm": "application/wasm"}
POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class Site:
    """Request handlers of the page.

    Args:
        session: the workbench session, once it is made.
        viewer: folder of the viewer's files.
        version: version of the viewer.
        token: token that every request has to carry.
        port: port of the server.
        kind: kind of page.
    """

    def __init__(
        self, session: Future[WorkbenchSession], viewer: Path, version: str, token: str, port: int, kind: Kind
    ) -> None:
        self._session, self._viewer, self._version, self._kind = session, viewer, version, kind
        self._token, self._port = token, port
        self._run = secrets.token_hex(4)  # A page that reconnects to another run reloads.
        self._questions = ThreadPoolExecutor(1, "questions")  # One thread answers all questions in turn.

    def application(self) -> ASGIApp:
        """Return the application that serves the page behind its access guard."""
        routes = [
            Route("/", self.page),
            Route(SHARED, self.shared),
            Route("/page/{name}", self.file),
            Route(f"/viewer/{self._version}/{{name}}", self.viewer),
            Route("/config.yaml", self.config),
            Route("/report/{number:int}/{name}", self.report),
            Route("/thumbnail/{number:int}", self.thumbnail),
            WebSocketRoute("/recording", self.recording),
            WebSocketRoute("/talk", self.talk),
        ]
        return Guard(Starlette(routes=routes), self._token, self._port)

    async def _workbench(self) -> WorkbenchSession | None:
        """Wait until the session is made, and return it. None: it could not be made."""
        with contextlib.suppress(Exception):
            return await asyncio.wrap_future(self._session)
        return None

    # --- files ---------------------------------------------------------------------------------

    async def page(self, request: Request) -> Response:
        """Return the HTML page, and set the cookie with the token."""
        text = (PAGE / "index.html").read_text().replace("VIEWER_VERSION", self._version)
        text = text.replace("VIEWER_KIND", self._kind)
        response = Response(text, media_type="text/html", headers={"Content-Security-Policy": POLICY})
        response.headers["Cache-Control"] = "no-store"
        response.headers["Referrer-Policy"] = "no-referrer"
        response.set_cookie(cookie_name(self._port), self._token, httponly=True, samesite="strict")
        return response

    async def shared(self, request: Request) -> Response:
        """Return the page behind a shared link. It has no data, so that it needs no token."""
        return _File(
            PAGE / "shared.html", media_type="text/html", headers={"Content-Security-Policy": POLICY}
        )

    async def file(self, request: Request) -> Response:
        """Return a script or style sheet of the page."""
        name = request.path_params["name"]
        if name == "page.css":
            text = css_properties() + (PAGE / name).read_text()
            return Response(text, media_type=KINDS[".css"], headers={"Cache-Control": "no-cache"})
        return _file(PAGE, FILES, name, "no-cache")

    async def viewer(self, request: Request) -> Response:
        """Return a file of Rerun's web viewer. Our form of its script also exports the widget."""
        name = request.path_params["name"]
        if name == "exported_widget.js":
            text = (self._viewer / "widget.js").read_text()
            text += "export { ViewerWidget };\n" if WIDGET in text else ""
            return Response(text, media_type=KINDS[".js"], headers={"Cache-Control": "no-cache"})
        return _file(self._viewer, VIEWER, name, "private, max-age=31536000, immutable")

    async def config(self, request: Request) -> Response:
        """Return the configuration with the tried settings as a YAML file."""
        from bevviz.config import changed_config, config_yaml

        workbench = await self._workbench()
        if workbench is None:
            return PlainTextResponse("the drive cannot be opened\n", 503)
        try:
            opened = workbench.source.pipeline.config
            text = config_yaml(changed_config(opened, request.query_params.getlist("set")))
        except UserError as error:
            return PlainTextResponse(str(error), 400)
        headers = {"Content-Disposition": 'attachment; filename="bevviz.yaml"'}
        return Response(text, media_type="application/yaml", headers=headers)

    async def report(self, request: Request) -> Response:
        """Return a file of a report that this server made."""
        workbench, number = await self._workbench(), request.path_params["number"]
        try:
            reports = [] if workbench is None else workbench.reports.jobs
        except UserError:  # the page of an artificial robot
            reports = []
        path = reports[number].file(request.path_params["name"]) if number < len(reports) else None
        if path is None:
            return PlainTextResponse("there is no such file\n", 404)
        if path.suffix == ".html":  # The HTML of a report states its own policy.
            return _File(path, media_type="text/html")
        return _File(path, filename=path.name, media_type="application/octet-stream")

    async def thumbnail(self, request: Request) -> Response:
        """Return a small image of the camera near a frame."""
        workbench = await self._workbench()
        picture = None if workbench is None else workbench.source.thumbnail(request.path_params["number"])
        if picture is None:
            return PlainTextResponse("there is no image of this frame yet\n", 404)
        return Response(picture, media_type="image/jpeg", headers={"Cache-Control": "no-store"})

    # --- recordings ----------------------------------------------------------------------------

    async def recording(self, socket: WebSocket) -> None:
        """Send every piece of a recording from the requested one on, as the pieces are made.

        The page acknowledges each piece with a message, and gets only a few pieces in advance. If its message
        is a stamp instead, the frame of that stamp is sent next.
        """
        await socket.accept()
        workbench = await self._workbench()
        if workbench is None:
            await socket.close()
            return
        lane, text = socket.query_params.get("lane", "recording"), socket.query_params.get("from", "0")
        state = PageState()
        with (
            contextlib.suppress(UserError, IndexError),  # The recording is not there, or no longer.
            workbench.source.reader(lane, int(text) if text.isdecimal() else 0, state) as reader,
            news_event(reader.news) as event,
            contextlib.suppress(WebSocketDisconnect, RuntimeError),
        ):
            listener = asyncio.ensure_future(_listen(socket, state, event))
            try:
                while not state.gone:
                    event.clear()
                    pieces = await asyncio.to_thread(reader.take)
                    for piece in pieces:
                        await (
                            socket.send_text(piece) if isinstance(piece, str) else socket.send_bytes(piece)
                        )
                    if not pieces:
                        await event.wait()
            finally:
                listener.cancel()
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # The page has closed it.
            await socket.close()

    # --- questions -----------------------------------------------------------------------------

    async def talk(self, socket: WebSocket) -> None:
        """Answer the questions of a page, and send it the progress of the run."""
        await socket.accept()
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            workbench = await self._workbench()
            if workbench is None:
                await socket.send_json({"type": "failed", "text": str(self._session.exception())})
                return
            await PageConnection(workbench, socket, self._questions, self._run).stay()


async def _listen(socket: WebSocket, state: PageState, event: asyncio.Event) -> None:
    """Update the state of a page with its messages, and set the event at each of them."""
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                break
            state.take(message.get("text") or "")
            event.set()
    state.gone = True
    event.set()


class _File(FileResponse):
    chunk_size = 4 * 2**20  # The viewer has 64 MB, and each chunk waits for a busy interpreter.


def _file(folder: Path, names: Container[str], name: str, cache: str) -> Response:
    if name not in names:
        return PlainTextResponse("there is no such file\n", 404)
    kind = KINDS[Path(name).suffix]
    return _File(folder / name, media_type=kind, headers={"Cache-Control": cache})
