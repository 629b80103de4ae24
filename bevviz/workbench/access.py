"""Access to the page: a request needs the token and must not come from another site.

A file keeps the token while the server runs, so that pages survive a crash of the server.
"""

from __future__ import annotations

import asyncio
import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from urllib.parse import parse_qs

from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Receive, Scope, Send

HOSTS = ("127.0.0.1", "localhost")
SHARED = "/shared"  # page behind a shared link, which needs no token


class Guard:
    """ASGI middleware that refuses requests without the token and requests from other sites.

    The host of a request has to be a name of this machine, so that another name that resolves to it (DNS
    rebinding) is refused. If the browser sends an origin, it has to be that of the page.
    """

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self._app, self._token, self._port = app, token, port
        self._hosts = {f"{host}:{port}" for host in HOSTS}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a refused request with status 403. Pass every other request to the application.

        A server that stops cancels the requests that are still waiting, which is no error.
        """
        if scope["type"] in ("http", "websocket"):
            refusal = self._refusal(HTTPConnection(scope))
            if refusal and scope["type"] == "websocket":
                await receive()
                await send(
                    {"type": "websocket.close", "code": 1008, "reason": refusal}
                )  # before accept: status 403
                return
            if refusal:
                await PlainTextResponse(f"bevviz: {refusal}\n", 403)(scope, receive, send)
                return
        with suppress(asyncio.CancelledError):
            await self._app(scope, receive, send)

    def _refusal(self, request: HTTPConnection) -> str:
        """Return the reason to refuse a request. Empty: it is allowed."""
        host, origin = request.headers.get("host", ""), request.headers.get("origin")
        if host not in self._hosts:
            return "this page is at 127.0.0.1 alone"
        if origin is not None and origin != f"http://{host}":
            return "another site's page may not ask here"
        if request.scope["type"] == "websocket" and origin is None:
            return "only the page itself may ask here"
        if request.url.path == SHARED:
            return ""
        tokens = (*parse_qs(request.url.query).get("token", ()), _cookie(request, cookie_name(self._port)))
        if not any(secrets.compare_digest(candidate.encode(), self._token.encode()) for candidate in tokens):
            return "wrong or no token: open the address that was printed"
        return ""


def cookie_name(port: int) -> str:
    """Return the name of the cookie. Cookies do not distinguish ports, so each server has its own name."""
    return f"bevviz_{port}"


def _cookie(request: HTTPConnection, name: str) -> str:
    """Return the value of a cookie, or an empty text."""
    try:
        cookie = SimpleCookie(request.headers.get("cookie", "")).get(name)
    except CookieError:
        return ""
    return cookie.value if cookie is not None else ""


@contextmanager
def persistent_token(port: int, drive: str) -> Iterator[str]:
    """Yield the token for the server of a drive at a port.

    A token that a killed server of the same drive left at the same port is used again. Otherwise the token is
    new. Only this user can read its file. If the file cannot be written, every start makes a new token.

    Args:
        port: port of the server, which listens there already. So no other server uses the file.
        drive: paths of the drive.
    """
    path = _token_folder() / f"workbench-{port}.json"
    token = _leftover_token(path, drive) or secrets.token_urlsafe(16)
    with suppress(OSError):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            json.dump({"drive": drive, "token": token}, file)
    try:
        yield token
    finally:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _token_folder() -> Path:
    """Return the folder of the token files."""
    runtime = os.environ.get("XDG_RUNTIME_DIR") or os.environ.get("XDG_CACHE_HOME")
    return Path(runtime or Path.home() / ".cache") / "bevviz"


def _leftover_token(path: Path, drive: str) -> str:
    """Return the token that a killed server left. Empty: there is none that can be used."""
    try:
        status = path.lstat()
        if status.st_uid != os.getuid() or status.st_mode & 0o077:
            return ""
        content = json.loads(path.read_text())
        return str(content["token"]) if content["drive"] == drive and len(content["token"]) >= 16 else ""
    except (OSError, ValueError, KeyError, TypeError):
        return ""
