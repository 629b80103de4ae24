"""Server of the page: reachable from this machine only, one origin, a token in the address."""

from __future__ import annotations

import importlib.util
import secrets
import socket
import threading
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import uvicorn

from bevviz.errors import UserError
from bevviz.support.contexts import Closable
from bevviz.support.freed_memory import return_freed_memory
from bevviz.workbench.access import HOSTS, persistent_token
from bevviz.workbench.routes import VIEWER, Site
from bevviz.workbench.startup import SessionStartup

if TYPE_CHECKING:
    from starlette.types import ASGIApp

    from bevviz.workbench.session import WorkbenchSession

PORT = 9880  # The default is fixed, because browsers cache the compiled viewer by its address.
PATIENCE = 3.0  # seconds that the page of a robot waits for its thread


def serve(
    make: Callable[[], WorkbenchSession], drive: str, port: int | None, ready: Callable[[str], None]
) -> None:
    """Serve the page of a drive until an interrupt. The drive is opened and run in the background.

    Args:
        make: makes the workbench session, while the page loads its viewer.
        drive: paths of the drive. A page reconnects after a crash if the server of the same drive starts
            again.
        port: port of the page. None: 9880, or a free one if that is in use.
        ready: called with the address once it can be opened.

    Raises:
        UserError: the port is in use, the viewer is not installed, or ``make`` raises one.
    """
    viewer = viewer_folder()
    return_freed_memory()
    with bound_socket(port) as listening:
        port = listening.getsockname()[1]
        with persistent_token(port, drive) as token, SessionStartup(make, lambda: server.end()) as startup:
            site = Site(startup, viewer, version("rerun-sdk"), token, port, "page")

            def begin() -> None:
                ready(_address(port, token))
                startup.start()

            server = Server(site.application(), begin)
            server.run(sockets=[listening])
        if startup.error is not None:
            raise startup.error


class LivePage(Closable):
    """Server of the page of a robot, in a thread of its own, until it is closed.

    Args:
        workbench: the workbench session of the robot.
        port: port of the page. None: 9880, or a free one if that is in use.

    Raises:
        UserError: the port is in use, or the viewer is not installed.

    Attributes:
        address: address of the page, with its token.
    """

    def __init__(self, workbench: WorkbenchSession, port: int | None) -> None:
        viewer, token = viewer_folder(), secrets.token_urlsafe(16)
        self._listening = bound_socket(port)
        port = self._listening.getsockname()[1]
        self.address = _address(port, token)
        self._startup = SessionStartup(lambda: workbench, lambda: None)
        self._startup.start()
        ready = threading.Event()
        site = Site(self._startup, viewer, version("rerun-sdk"), token, port, "live")
        self._server = Server(site.application(), ready.set)
        self._thread = threading.Thread(
            target=lambda: self._server.run(sockets=[self._listening]), name="page", daemon=True
        )
        self._thread.start()
        ready.wait(PATIENCE)

    def close(self) -> None:
        """Stop the server, then close the workbench session."""
        self._server.end()
        self._thread.join(PATIENCE)
        self._listening.close()
        self._startup.close()


def _address(port: int, token: str) -> str:
    return f"http://{HOSTS[0]}:{port}/?token={token}"


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
