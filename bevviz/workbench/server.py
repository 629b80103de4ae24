"""Server of the page: reachable from this machine only, one origin, a token in the address."""

from __future__ import annotations

import importlib.util
import socket
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import uvicorn

from bevviz.errors import UserError
from bevviz.workbench.access import HOSTS
from bevviz.workbench.routes import VIEWER, Kind, application
from bevviz.workbench.startup import SessionStartup
from bevviz.workbench.token import persistent_token

if TYPE_CHECKING:
    from starlette.types import ASGIApp

    from bevviz.workbench.session import WorkbenchSession

PORT = 9880  # The default is fixed, because browsers cache the compiled viewer by its address.


def serve(
    make: Callable[[], WorkbenchSession],
    drive: str,
    port: int | None,
    ready: Callable[[str], None],
    kind: Kind = "page",
) -> None:
    """Serve the page of a drive until an interrupt. The drive is opened and run in the background.

    Args:
        make: makes the workbench session, while the page loads its viewer.
        drive: paths of the drive. A page reconnects after a crash if the server of the same drive starts
            again.
        port: port of the page. None: 9880, or a free one if that is in use.
        ready: called with the address once it can be opened.
        kind: kind of viewer.

    Raises:
        UserError: the port is in use, the viewer is not installed, or ``make`` raises one.
    """
    viewer = viewer_folder()
    with bound_socket(port) as listening:
        port = listening.getsockname()[1]
        with persistent_token(port, drive) as token, SessionStartup(make, lambda: server.end()) as startup:
            app = application(startup, viewer, version("rerun-sdk"), token, port, kind)

            def begin() -> None:
                ready(f"http://{HOSTS[0]}:{port}/?token={token}")
                startup.start()

            server = Server(app, begin)
            server.run(sockets=[listening])
        if startup.error is not None:
            raise startup.error


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
