"""Options of ``bevviz live`` for the server for Foxglove."""

from __future__ import annotations

import argparse
import re
from typing import TYPE_CHECKING

from bevviz.cli.options import port
from bevviz.cli.outputs import say
from bevviz.errors import UserError

if TYPE_CHECKING:
    from bevviz.extras.foxglove.server import FoxgloveServer


def add_options(group: argparse._ArgumentGroup) -> None:
    """Add ``--foxglove`` and ``--foxglove-origin``."""
    group.add_argument(
        "--foxglove",
        nargs="?",
        type=port,
        const=8765,
        metavar="PORT",
        help="serve the results to Foxglove on this machine (default: 8765)",
    )
    group.add_argument(
        "--foxglove-origin",
        action="append",
        type=_web_origin,
        default=[],
        metavar="ORIGIN",
        help="further web site whose pages may connect to --foxglove, as http://localhost:8080",
    )


def open_sink(options: argparse.Namespace) -> FoxgloveServer | None:
    """Start the server, if it is requested.

    Raises:
        UserError: a package is missing, the port is in use, or there are no results to serve.
    """
    if options.foxglove is None:
        return None
    if options.observe:
        raise UserError("--observe makes no results that --foxglove could serve: leave one of them out")
    from bevviz.extras.foxglove.server import FoxgloveServer

    server = FoxgloveServer(options.foxglove, options.foxglove_origin, say)
    say(f"Foxglove: open the connection {server.address}", always=True)
    return server


def _web_origin(text: str) -> str:
    """Return the origin of a web site that an option names."""
    if not re.fullmatch(r"[a-z][a-z0-9+.-]*://[^/?#\s]*", text):
        raise argparse.ArgumentTypeError(f"{text!r} is no origin, such as http://localhost:8080")
    return text
