"""Server of the page: reachable from this machine only, one origin, a token in the address."""

from __future__ import annotations

import importlib.util
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import uvicorn

from bevviz.errors import UserError
from bevviz.workbench.access import HOSTS, persistent_token
from bevviz.workbench.routes import VIEWER, Kind, Site

if TYPE_CHECKING:
    from starlette.types import ASGIApp

    from bevviz.workbench.session import WorkbenchSession

PORT = 9880  # The default is fixed, because browsers cache the compiled viewer by its address.
PATIENCE = 3.0  # seconds to wait for the thread of the server


@contextmanager
def page_server(
    make: Callable[[], WorkbenchSession],
    kind: Kind,
    port: int | None,
    ready: Callable[[str], None],
    drive: str = "",
) -> Iterator[threading.Thread]:
    """Serve a page until the context ends. Yield the thread of the server, which an error of ``make`` ends.

    Args:
        make: makes the workbench session in a further thread, while the page loads its viewer.
        kind: kind of page.
        port: port of the page. None: 9880, or a free one if that is in use.
        ready: called with the address of the page once it can be opened, before the session is made.
        drive: paths of the drive. A page reconnects after a crash if the server of the same drive starts
            again. Empty: it does not.

    Raises:
        UserError: the port is in use, the viewer is not installed, or ``make`` raises one.
    """
    viewer, reachable = viewer_folder(), threading.Event()
    session: Future[WorkbenchSession] = Future()
    session.set_running_or_notify_cancel()  # A page that no longer waits for it does not cancel it.

    def open_session() -> None:
        try:
            workbench = make()
            workbench.start()
        except BaseException as error:
            session.set_exception(error)
            server.end()
        else:
            session.set_result(workbench)

    with bound_socket(port) as listening, _token(listening.getsockname()[1], drive) as token:
        port = listening.getsockname()[1]
        site = Site(session, viewer, version("rerun-sdk"), token, port, kind)
        server = Server(site.application(), reachable.set)
        thread = threading.Thread(target=server.run, args=([listening],), name="page", daemon=True)
        thread.start()
        try:
            reachable.wait(PATIENCE)
            ready(f"http://{HOSTS[0]}:{port}/?token={token}")
            threading.Thread(target=open_session, name="opening", daemon=True).start()
            yield thread
        finally:
            server.end()
            thread.join(PATIENCE)
            session.add_done_callback(_close)  # now, or as soon as it is made
        if session.done():
            session.result()


def _close(session: Future[WorkbenchSession]) -> None:
    """Close a session, if it could be made."""
    if session.exception() is None:
        session.result().close()


def _token(port: int, drive: str) -> AbstractContextManager[str]:
    return persistent_token(port, drive) if drive else nullcontext(secrets.token_urlsafe(16))


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
