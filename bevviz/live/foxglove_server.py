"""Server of the results for Foxglove and other programs that speak its protocol."""

from __future__ import annotations

import logging

from bevviz.errors import UserError
from bevviz.live.publish import TOPICS
from bevviz.messages.definitions import definition
from bevviz.support.contexts import Closable

HOST = "127.0.0.1"
PORT = 8765  # that of Foxglove's programs
BACKLOG = 8  # messages that a slow client may be behind; then the oldest is dropped


class FoxgloveServer(Closable):
    """Server of the topics of ``--publish``, and of the pose of the robot, as ROS 2 messages.

    It listens on this machine alone, and takes nothing from its clients. The protocol has no password.

    Args:
        port: port of the server.

    Raises:
        UserError: the package is not installed, or the port is in use.
    """

    def __init__(self, port: int) -> None:
        try:
            import foxglove
        except ImportError:
            raise UserError("--foxglove needs a further package: pip install 'bevviz[foxglove]'") from None
        logging.getLogger("foxglove").setLevel(logging.ERROR)
        self._context = context = foxglove.Context()  # Its channels end with it.
        self._channels = {
            topic: foxglove.Channel(
                topic,
                schema=foxglove.Schema(name=kind, encoding="ros2msg", data=(definition(kind) or "").encode()),
                message_encoding="cdr",
                context=context,
            )
            for topic, kind in TOPICS.items()
        }
        try:
            self._server = foxglove.start_server(
                name="bevviz", host=HOST, port=port, context=context, message_backlog_size=BACKLOG
            )
        except Exception as error:  # The package raises a RuntimeError, or an error of its own.
            raise UserError(f"--foxglove {port}: cannot listen: {error}") from None

    @property
    def address(self) -> str:
        """Address for Foxglove's "open connection"."""
        return f"ws://{HOST}:{self._server.port}"

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()

    def wants(self, topic: str) -> bool:
        """Return whether a client is subscribed to a topic."""
        return self._channels[topic].has_sinks()

    def send(self, topic: str, data: bytes, stamp: int) -> None:
        """Send a message to the clients that are subscribed to its topic."""
        self._channels[topic].log(data, log_time=stamp)
