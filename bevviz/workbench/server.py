"""Server of the page: reachable from this machine only, one origin, a token in the address."""

from __future__ import annotations

import importlib.util
import secrets
import socket
import threading
from collections.abc import Callable
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import uvicorn

from bevviz.errors import UserError
from bevviz.support.contexts import Closable
from bevviz.support.freed_memory import return_freed_memory
from bevviz.workbench.access import HOSTS, persistent_token
from bevviz.workbench.routes import VIEWER, Kind, Site
from bevviz.workbench.startup import SessionStartup

if TYPE_CHECKING:
    from starlette.types import ASGIApp

    from bevviz.workbench.session import WorkbenchSession

PORT = 9880  # The default is fixed, because browsers cache the compiled viewer by its address.
PATIENCE = 3.0  # seconds to wait for the thread of the server


def serve(
    make: Callable[[], WorkbenchSession], drive: str, port: int | None, ready: Callable[[str], None]
) -> None:
    """Serve the page of a drive until an interrupt, see ``PageServer``.

    Args:
        make: makes the workbench session.
        drive: paths of the drive. A page reconnects after a crash if the server of the same drive starts
            again.
        port: port of the page.
        ready: called with the address.

    Raises:
        UserError: as ``PageServer``, or ``make`` raises one.
    """
    return_freed_memory()
    with PageServer(make, "page", port, ready, drive) as server:
        server.wait()


class PageServer(Closable):
    """Server of a page, in a thread of its own, until it is closed.

    Args:
        make: makes the workbench session in a further thread, while the page loads its viewer.
        kind: kind of page.
        port: port of the page. None: 9880, or a free one if that is in use.
        ready: called with the address of the page once it can be opened, before the session is made.
        drive: paths of the drive, whose token survives a crash. None: each server has a new token.

    Raises:
        UserError: the port is in use, or the viewer is not installed.
    """

    def __init__(
        self,
        make: Callable[[], WorkbenchSession],
        kind: Kind,
        port: int | None,
        ready: Callable[[str], None],
        drive: str | None = None,
    ) -> None:
        viewer, reachable = viewer_folder(), threading.Event()
        with ExitStack() as stack:
            listening = stack.enter_context(bound_socket(port))
            port = listening.getsockname()[1]
            token = secrets.token_urlsafe(16)
            if drive is not None:
                token = stack.enter_context(persistent_token(port, drive))
            self._startup = stack.enter_context(SessionStartup(make, lambda: self._server.end()))
            site = Site(self._startup, viewer, version("rerun-sdk"), token, port, kind)
            self._server = Server(site.application(), reachable.set)
            self._thread = threading.Thread(
                target=self._server.run, kwargs={"sockets": [listening]}, name="page", daemon=True
            )
            self._thread.start()
            stack.callback(self._end)
            reachable.wait(PATIENCE)
            ready(f"http://{HOSTS[0]}:{port}/?token={token}")
            self._startup.start()
            self._stack = stack.pop_all()

    def wait(self) -> None:
        """Wait until the server ends.

        Raises:
            BaseException: that of ``make``, which ends the server.
        """
        self._thread.join()
        if self._startup.error is not None:
            raise self._startup.error

    def close(self) -> None:
        """Stop the server, then close the workbench session."""
        self._stack.close()

    def _end(self) -> None:
        """Stop the server."""
        self._server.end()
        self._thread.join(PATIENCE)


def bound_socket(port: int | None) -> socket.socket:
    """Return a socket that is bound to a port of this machine only.

    Raises:
        UserError: the port is in use.
    """
    listening = socket.socket()
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    for candidate in (PORT, 0) if port is None else (port,):
        try:
            listening.bind((HOSTS[0], candidate))
            return listening
        except OSError as error:
            reason = error.strerror
    listening.close()
    raise UserError(f"--port {port}: {reason}; without --port a free one is taken")


class Server(uvicorn.Server):
    """Server that calls ``ready`` once it can be reached."""

    def __init__(self, app: ASGIApp, ready: Callable[[], None]) -> None:
        config = uvicorn.Config(
            app,
            log_level="warning",
            lifespan="off",
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=1,
        )
        super().__init__(config)
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to listen, then call ``ready``."""
        await super().startup(sockets)
        self._ready()

    def end(self) -> None:
        """Stop the server. Any thread may call this."""
        self.should_exit = True


def viewer_folder() -> Path:
    """Return the folder of Rerun's web viewer, in the version of the SDK. The notebook package contains it.

    Raises:
        UserError: the package is not installed, or has another version.
    """
    spec = importlib.util.find_spec("rerun_notebook")
    folder = Path(spec.origin).parent / "static" if spec is not None and spec.origin else None
    if folder is None or not all((folder / name).is_file() for name in VIEWER):
        raise UserError("the workbench needs Rerun's web viewer: pip install 'bevviz[workbench]'")
    installed, sdk = version("rerun-notebook"), version("rerun-sdk")
    if installed != sdk:
        raise UserError(
            f"rerun-notebook {installed} does not fit rerun-sdk {sdk}: pip install 'bevviz[workbench]'"
        )
    return folder
