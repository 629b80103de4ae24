"""The page's server: this machine alone, one origin, a token in the address."""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import json
import secrets
import socket
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import rerun as rr
import uvicorn
from starlette.applications import Starlette
from starlette.requests import HTTPConnection, Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from bevviz.config import dump, revised
from bevviz.errors import UserError, first_line
from bevviz.loggers import logger
from bevviz.workbench.bench import Bench, Settings
from bevviz.workbench.native import NativeViewer
from bevviz.workbench.parameters import controls
from bevviz.workbench.pick import Pick

PAGE = Path(__file__).parent / "page"
FILES = ("bench.css", "bench.js", "native.js", "live.js")
VIEWER = ("widget.js", "widget.css", "re_viewer_bg.wasm")
KINDS = {".js": "text/javascript", ".css": "text/css", ".wasm": "application/wasm"}
HOSTS = ("127.0.0.1", "localhost")
POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)

SERVER: dict[str, Any] = {
    "log_level": "warning",
    "lifespan": "off",
    "ws_per_message_deflate": False,
    "timeout_graceful_shutdown": 1,
}

_log = logger(__name__)


def serve(
    bench: Bench, port: int | None, ready: Callable[[str], None], native: NativeViewer | None = None
) -> None:
    """Run the drive and serve its page until an interrupt.

    Args:
        bench: the drive.
        port: of the page; None: one that is free.
        ready: called with the address when it can be opened.
        native: the viewer beside which the page is the panel alone; None: the page has one of its own.

    Raises:
        UserError: the port is in use, or the viewer is not installed.
    """
    viewer = viewer_folder()
    with bound(port) as listening:
        port = listening.getsockname()[1]
        token = secrets.token_urlsafe(16)
        app = application(bench, viewer, token, port, native)
        server = _Server(
            uvicorn.Config(app, **SERVER), lambda: ready(f"http://{HOSTS[0]}:{port}/?token={token}")
        )
        bench.start()
        server.run(sockets=[listening])


def bound(port: int | None) -> socket.socket:
    """A socket of this machine alone; None: at a port that is free.

    Raises:
        UserError: the port is in use.
    """
    found = socket.socket()
    found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        found.bind((HOSTS[0], port or 0))
    except OSError as error:
        found.close()
        raise UserError(f"port {port}: {error.strerror}; without a number a free one is taken") from None
    return found


class _Server(uvicorn.Server):
    """Says when it can be reached."""

    def __init__(self, config: uvicorn.Config, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self._ready()


def viewer_folder() -> Path:
    """Where Rerun's web viewer is, of the very version of the SDK: it comes with its notebook package.

    Raises:
        UserError: it is not installed, or of another version.
    """
    spec = importlib.util.find_spec("rerun_notebook")
    folder = Path(spec.origin).parent / "static" if spec is not None and spec.origin else None
    if folder is None or not all((folder / name).is_file() for name in VIEWER):
        raise UserError("the workbench needs Rerun's web viewer: pip install 'bevviz[workbench]'")
    from importlib.metadata import version

    if version("rerun-notebook") != rr.__version__:
        raise UserError(
            f"rerun-notebook {version('rerun-notebook')} does not fit rerun-sdk {rr.__version__}: "
            "pip install 'bevviz[workbench]'"
        )
    return folder


def application(
    bench: Bench, viewer: Path, token: str, port: int, native: NativeViewer | None = None
) -> ASGIApp:
    """Everything that the page asks for, behind its guard."""
    site = _Site(bench, viewer, token, port, native is not None)
    routes = _routes(site)
    if native is not None:
        routes.append(WebSocketRoute("/native", native.talk))
    return _Guard(Starlette(routes=routes), token, port)


def _routes(site: _Site) -> list[BaseRoute]:
    return [
        Route("/", site.page),
        Route("/page/{name}", site.file),
        Route(f"/viewer/{rr.__version__}/{{name}}", site.viewer),
        Route("/config.yaml", site.config),
        WebSocketRoute("/film", site.film),
        WebSocketRoute("/talk", site.talk),
    ]


class _Guard:
    """Lets nobody in who has not the token, or whom another site sent.

    The host has to be this machine's own name: another one that leads here is a trick. The origin, where the
    browser states one, has to be the page's.
    """

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self._app, self._token, self._port = app, token, port
        self._hosts = {f"{host}:{port}" for host in HOSTS}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] in ("http", "websocket"):
            refusal = self._refusal(HTTPConnection(scope))
            if refusal and scope["type"] == "websocket":
                await receive()
                await send({"type": "websocket.close", "code": 1008, "reason": refusal})  # before accept: 403
                return
            if refusal:
                await PlainTextResponse(f"bevviz: {refusal}\n", 403)(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _refusal(self, asked: HTTPConnection) -> str:
        """Why nothing is answered; empty: it is."""
        host, origin = asked.headers.get("host", ""), asked.headers.get("origin")
        if host not in self._hosts:
            return "this page is at 127.0.0.1 alone"
        if origin is not None and origin != f"http://{host}":
            return "another site's page may not ask here"
        if asked.scope["type"] == "websocket" and origin is None:
            return "only the page itself may ask here"
        given = (*parse_qs(asked.url.query).get("token", ()), _cookie(asked, cookie_name(self._port)))
        if not any(secrets.compare_digest(one.encode(), self._token.encode()) for one in given):
            return "wrong or no token: open the address that was printed"
        return ""


def cookie_name(port: int) -> str:
    """Cookies know no ports: each server has its own."""
    return f"bevviz_{port}"


def _cookie(asked: HTTPConnection, name: str) -> str:
    try:
        found = SimpleCookie(asked.headers.get("cookie", "")).get(name)
    except CookieError:
        return ""
    return found.value if found is not None else ""


class _Site:
    def __init__(self, bench: Bench, viewer: Path, token: str, port: int, native: bool) -> None:
        self._bench, self._viewer, self._token, self._port = bench, viewer, token, port
        self._native = native
        self._run = secrets.token_hex(4)  # a page that finds another one starts anew
        self._desk = ThreadPoolExecutor(1, "desk")  # answers one question after the other

    # --- files ---------------------------------------------------------------------------------

    async def page(self, request: Request) -> Response:
        text = (PAGE / "index.html").read_text().replace("VIEWER_VERSION", rr.__version__)
        text = text.replace("NATIVE_VIEWER", str(self._native).lower())
        response = Response(text, media_type="text/html", headers={"Content-Security-Policy": POLICY})
        response.headers["Cache-Control"] = "no-store"
        response.headers["Referrer-Policy"] = "no-referrer"
        response.set_cookie(cookie_name(self._port), self._token, httponly=True, samesite="strict")
        return response

    async def file(self, request: Request) -> Response:
        return _file(PAGE, FILES, request.path_params["name"], "no-cache")

    async def viewer(self, request: Request) -> Response:
        return _file(
            self._viewer, VIEWER, request.path_params["name"], "private, max-age=31536000, immutable"
        )

    async def config(self, request: Request) -> Response:
        """The configuration with what is being tried, as a file."""
        try:
            text = dump(revised(self._bench.drive.config, request.query_params.getlist("set")))
        except UserError as error:
            return PlainTextResponse(str(error), 400)
        headers = {"Content-Disposition": 'attachment; filename="bevviz.yaml"'}
        return Response(text, media_type="application/yaml", headers=headers)

    # --- what is shown -------------------------------------------------------------------------

    async def film(self, socket: WebSocket) -> None:
        """Every piece from the one that is asked for on, as they are made."""
        await socket.accept()
        text = socket.query_params.get("from", "0")
        row, film = int(text) if text.isdecimal() else 0, self._bench.film
        with _listening(film.listen) as more, contextlib.suppress(WebSocketDisconnect, RuntimeError):
            gone = asyncio.ensure_future(_until_gone(socket))
            try:
                while not gone.done():
                    more.clear()
                    while row < len(film) and not gone.done():
                        await socket.send_bytes(await asyncio.to_thread(film.__getitem__, row))
                        row += 1
                    waiting = asyncio.ensure_future(more.wait())
                    await asyncio.wait({waiting, gone}, return_when=asyncio.FIRST_COMPLETED)
                    waiting.cancel()
            finally:
                gone.cancel()

    # --- what is asked -------------------------------------------------------------------------

    async def talk(self, socket: WebSocket) -> None:
        """Questions and answers, and how far the run is."""
        await socket.accept()
        bench, scene = self._bench, self._bench.drive.scene
        visit = _Visit(bench, socket, self._desk)
        welcome = {
            "type": "welcome",
            "run": self._run,
            "bag": scene.name,
            "scans": len(bench.drive),
            "truth": bench.truth_of is not None,
            "detector": bool(bench.drive.config.detector.model),
            "controls": controls(bench.drive.config),
            "set": [f"{key}={value}" for key, value in _given(bench).items()],
        }
        with _listening(bench.listen) as more, contextlib.suppress(WebSocketDisconnect, RuntimeError):
            await visit.send(welcome)
            news = asyncio.ensure_future(visit.tell(more))
            try:
                while True:
                    visit.take(await socket.receive_text())
            finally:
                news.cancel()
                visit.end()


def _given(bench: Bench) -> dict[str, Any]:
    """What the drive was opened with, where it is not the preset's own."""
    from bevviz.config import changes, load

    config = bench.drive.config
    return {key: change.after for key, change in changes(load(preset=config.preset), config).items()}


class _Visit:
    """One page that is open."""

    def __init__(self, bench: Bench, socket: WebSocket, desk: ThreadPoolExecutor) -> None:
        self._bench, self._socket, self._desk = bench, socket, desk
        self._sending = asyncio.Lock()
        self._tasks: set[asyncio.Task[None]] = set()
        self._newest = 0

    async def send(self, message: dict[str, Any]) -> None:
        async with self._sending:
            await self._socket.send_text(json.dumps(message))

    async def tell(self, more: asyncio.Event) -> None:
        """What is new of the run, whenever there is something."""
        told, opened = 0, False
        while True:
            more.clear()
            if not opened and self._bench.opening is not None:
                opened = True
                await self.send({"type": "opening", "stamp": str(self._bench.opening)})
            if new := self._bench.found[told:]:
                told += len(new)
                await self.send({"type": "found", "found": [find.as_dict() for find in new]})
            await self.send(self._bench.progress())
            await more.wait()
            await asyncio.sleep(0.05)  # several frames at once

    def take(self, text: str) -> None:
        """Answer a message of the page, beside those that come next."""
        task = asyncio.ensure_future(self._handle(text))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def end(self) -> None:
        for task in self._tasks:
            task.cancel()

    async def _handle(self, text: str) -> None:
        number: Any = None
        try:
            message = json.loads(text)
            number = message.get("id")
            self._newest = max(self._newest, int(number))
            answers = {"ask": self._ask, "try": self._try, "settle": self._settle}
            await answers[message["type"]](int(number), message)
        except (WebSocketDisconnect, RuntimeError):
            return
        except UserError as error:
            await self.send({"type": "error", "id": number, "text": str(error)})
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            _log.debug("a message that cannot be used", exc_info=error)
            await self.send({"type": "error", "id": number, "text": "that message cannot be understood"})
        except Exception as error:
            _log.error("a question that failed", exc_info=error)
            what = f"error of bevviz itself: {type(error).__name__}: {first_line(error)}"
            await self.send({"type": "error", "id": number, "text": what})

    async def _at_desk(self, number: int, work: Callable[[], Any], *, idle: bool = False) -> Any:
        """Done in its turn; what is idle only if nothing newer was asked meanwhile."""

        def job() -> Any:
            if idle and number != self._newest:
                return None
            with self._bench.quiet():
                return work()

        return await asyncio.get_running_loop().run_in_executor(self._desk, job)

    async def _ask(self, number: int, message: dict[str, Any]) -> None:
        bench, settings = self._bench, _settings(message)
        frame = bench.number_at(round(float(message["time"])))

        def what() -> Pick | None:
            if "pick" in message:
                return Pick.parse(str(message["pick"]))
            position = tuple(float(v) for v in message.get("position") or () if v is not None)
            instance = message.get("instance")
            path = str(message["entity"])
            return bench.picked(frame, settings, path, None if instance is None else int(instance), position)

        def work() -> dict[str, Any] | None:
            picked = what()
            if picked is None:
                return None
            return {"pick": str(picked), **bench.ask(frame, settings, picked).as_dict()}

        answer = await self._at_desk(number, work)
        head = {"id": number, "frame": frame}
        if answer is None:
            await self.send({"type": "nothing", **head, "entity": str(message.get("entity", ""))})
            return
        await self.send({"type": "answer", **head, **answer})
        pick = Pick.parse(answer["pick"])
        hints = await self._at_desk(number, lambda: bench.ask(frame, settings, pick, hints=True), idle=True)
        if hints is not None:
            await self.send({"type": "hints", **head, "hints": hints.as_dict()["hints"]})

    async def _try(self, number: int, message: dict[str, Any]) -> None:
        settings = _settings(message)
        frame = self._bench.number_at(round(float(message["time"])))
        told = await self._at_desk(number, lambda: self._bench.attempt(frame, settings))
        await self.send({"type": "tried", "id": number, "frame": frame, **told})

    async def _settle(self, number: int, message: dict[str, Any]) -> None:
        """The page shows this frame for a while: questions about it are to come."""
        with contextlib.suppress(UserError):  # nobody has asked yet
            frame = self._bench.number_at(round(float(message["time"])))
            await self._at_desk(number, lambda: self._bench.look(frame, _settings(message)), idle=True)


def _settings(message: dict[str, Any]) -> Settings:
    return tuple(str(setting) for setting in message.get("set") or ())


async def _until_gone(socket: WebSocket) -> None:
    with contextlib.suppress(WebSocketDisconnect):
        while True:
            await socket.receive_text()


@contextlib.contextmanager
def _listening(listen: Callable[[Callable[[], None]], Callable[[], None]]) -> Any:
    """An event that is set whenever there is more, from whatever thread that is told."""
    more, loop = asyncio.Event(), asyncio.get_running_loop()

    def tell() -> None:
        with contextlib.suppress(RuntimeError):  # the server has ended
            loop.call_soon_threadsafe(more.set)

    end = listen(tell)
    try:
        yield more
    finally:
        end()


def _file(folder: Path, names: tuple[str, ...], name: str, cache: str) -> Response:
    if name not in names:
        return PlainTextResponse("there is no such file\n", 404)
    kind = KINDS[Path(name).suffix]
    return FileResponse(folder / name, media_type=kind, headers={"Cache-Control": cache})
