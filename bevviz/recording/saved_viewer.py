"""Show a saved recording in a viewer on this machine or in a browser."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bevviz.recording import rerun_cli
from bevviz.recording.ports import (
    FIRST_DATA_PORT,
    LOOPBACK,
    check_port,
    free_port,
    viewer_address,
)
from bevviz.recording.sinks import SERVER_MEMORY

WEB_VIEWER_BYTES = 2.3e9  # bytes that fit into the web viewer, as WebAssembly has 4 GiB of memory


def too_large_for_web(recording: Path, size: int) -> str:
    """Return a warning if a browser cannot show the whole recording, else "". ``size`` is in bytes."""
    if size <= WEB_VIEWER_BYTES:
        return ""
    limit = f"{WEB_VIEWER_BYTES / 1e9:.1f} GB"
    return (
        f"{recording.name} has {size / 1e9:.1f} GB, and a browser's viewer can hold {limit}: its beginning "
        f"is missing; Rerun's own viewer reads what it shows from the file (rerun {recording}); --keep "
        "inspect saves a fifth"
    )


def open_in_viewer(recording: Path) -> None:
    """Open the recording in a viewer, which stays open after this process.

    Raises:
        UserError: the viewer does not start.
    """
    port = free_port(FIRST_DATA_PORT)
    arguments = [str(recording), "--bind", LOOPBACK, "--port", str(port), "--hide-welcome-screen"]
    rerun_cli.start(arguments, LOOPBACK, port, lasting=True)


@contextmanager
def serve_in_browser(recording: Path, port: int | None = None) -> Iterator[str]:
    """Serve the recording to browsers of this machine while the context is open. Yield the page's address.

    Args:
        recording: .rrd file.
        port: port of the page; None: the first free one from 9090.

    Raises:
        UserError: the port is in use, or the viewer does not start.
    """
    if port is not None:
        check_port(port, "--port")
    page_port = port or free_port(9090)
    data_port = free_port(FIRST_DATA_PORT, but=page_port)
    arguments = [str(recording), "--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(page_port)]
    arguments += ["--port", str(data_port), "--server-memory-limit", SERVER_MEMORY]
    process = rerun_cli.start(arguments, LOOPBACK, page_port)
    try:
        yield viewer_address("localhost", page_port, data_port)
    finally:
        rerun_cli.stop(process)
