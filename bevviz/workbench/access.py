"""Access to the page: a request needs the token and must not come from another site."""

from __future__ import annotations

import secrets
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs

from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Receive, Scope, Send

HOSTS = ("127.0.0.1", "localhost")


class Guard:
    """ASGI middleware that refuses requests without the token and requests from other sites.

    The host of a request has to be a name of this machine, so that another name that resolves to it (DNS
    rebinding) is refused. If the browser sends an origin, it has to be that of the page.
    """

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self._app, self._token, self._port = app, token, port
        self._hosts = {f"{host}:{port}" for host in HOSTS}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a refused request with status 403. Pass every other request to the application."""
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
