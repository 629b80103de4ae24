"""Options of ``bevviz live`` for the server for Foxglove."""

from __future__ import annotations

import argparse
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from bevviz.cli.command import option
from bevviz.cli.options import WHAT_TO_RUN
from bevviz.cli.outputs import say
from bevviz.cli.values import port
from bevviz.errors import UserError

if TYPE_CHECKING:
    from bevviz.extras.foxglove.server import FoxgloveServer


def _web_origin(text: str) -> str:
    """Return the origin of a web site that an option names."""
    if not re.fullmatch(r"[a-z][a-z0-9+.-]*://[^/?#\s]*", text):
        raise argparse.ArgumentTypeError(f"{text!r} is no origin, such as http://localhost:8080")
    return text


@dataclass(frozen=True, kw_only=True)
class FoxgloveOptions:
    """Options for the server for Foxglove."""

    group: ClassVar = WHAT_TO_RUN

    foxglove: int | None = option(
        "PORT", "serve the results to Foxglove on this machine (default: 8765)", parse=port, const=8765
    )
    foxglove_origin: tuple[str, ...] = option(
        "ORIGIN",
        "further web site whose pages may connect to --foxglove, as http://localhost:8080",
        parse=_web_origin,
        repeat=True,
    )


OPTIONS = FoxgloveOptions


def open(options: FoxgloveOptions, *, observe: bool) -> FoxgloveServer | None:
    """Start the server, if it is requested.

    Raises:
        UserError: a package is missing, the port is in use, or there are no results to serve.
    """
    if options.foxglove is None:
        return None
    if observe:
        raise UserError("--observe makes no results that --foxglove could serve: leave one of them out")
    from bevviz.extras.foxglove.server import FoxgloveServer

    server = FoxgloveServer(options.foxglove, options.foxglove_origin, say)
    say(f"Foxglove: open the connection {server.address}", always=True)
    return server
