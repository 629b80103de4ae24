"""Server of the results for Foxglove and other programs that speak its protocol.

The protocol is https://github.com/foxglove/ws-protocol (docs/spec.md). The server of the SDK of Foxglove
answers the pages of every web site, so this one takes its place.
"""

from __future__ import annotations

import json
import socket
import struct
import threading
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from bevviz.errors import UserError
from bevviz.live.companions import Companion
from bevviz.live.publish import TOPICS, Receiver
from bevviz.messages.definitions import definition
from bevviz.recording.ports import check_port
from bevviz.support.contexts import Closable
from bevviz.support.queues import NewestQueue

if TYPE_CHECKING:
    from websockets.http11 import Request, Response
    from websockets.sync.server import ServerConnection

    from bevviz.live.runtime import Live

HOST = "127.0.0.1"
PORT = 8765  # that of Foxglove's programs
ORIGINS = ("https://app.foxglove.dev",)  # web pages that may connect: Foxglove's own
PROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")  # names of one protocol, newest first
BACKLOG = 8  # messages that a slow client may be behind; then the oldest is dropped
MAX_CLIENTS = 16
MAX_MESSAGE = 1 << 16  # bytes of a message from a client
MAX_REFUSALS = 5  # refused web sites that are named
CHANNELS = dict(enumerate(TOPICS, 1))  # by number
_MESSAGE = struct.Struct("<BIQ")  # operation, subscription, stamp in nanoseconds
_MESSAGE_DATA = 1  # operation of a binary message with the data of a topic


class FoxgloveServer(Companion, Receiver):
    """Server of the topics of ``--publish``, and of the pose of the robot, as ROS 2 messages.

    It listens on this machine alone, and takes nothing from its clients. The protocol has no password. A
    browser tells which site a page is of (``Origin``) and under which name it looked this machine up
    (``Host``): a page of another site is refused, also one whose own name leads to this machine.

    Args:
        port: port of the server.
        origins: further sites whose pages may connect.
        tell: called from a thread with one sentence for each refused site.

    Raises:
        UserError: the package is not installed, or the port is in use.
    """

    def __init__(
        self,
        port: int,
        origins: Collection[str] = (),
        tell: Callable[[str], object] = lambda text: None,
    ) -> None:
        try:
            from websockets.sync.server import serve
        except ImportError:
            raise UserError("--foxglove needs a further package: pip install 'bevviz[foxglove]'") from None
        self._origins, self._tell = {*ORIGINS, *origins}, tell
        self._refused: set[str] = set()
        self._clients: set[_Client] = set()
        self._lock = threading.Lock()
        try:
            self._server = serve(
                self._stay,
                HOST,
                port,
                subprotocols=PROTOCOLS,  # type: ignore[arg-type]
                compression=None,
                process_request=self._check,
                ping_interval=None,
                max_size=MAX_MESSAGE,
            )
        except OSError as error:
            check_port(port, "--foxglove")
            raise UserError(f"--foxglove {port}: cannot listen: {error.strerror}") from None
        self._port: int = self._server.socket.getsockname()[1]
        self._thread = threading.Thread(target=self._server.serve_forever, name="foxglove", daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """Address for Foxglove's "open connection"."""
        return f"ws://{HOST}:{self._port}"

    def close(self) -> None:
        """Stop the server."""
        with self._lock:
            clients = tuple(self._clients)
        for client in clients:
            client.close()
        self._server.shutdown()
        self._thread.join()

    def begin(self, live: Live) -> None:
        """Take the results of the run."""
        live.receivers.append(self)

    def wants(self, topic: str) -> bool:
        """Return whether a client is subscribed to a topic."""
        with self._lock:
            return any(topic in client.subscriptions for client in self._clients)

    def send(self, topic: str, data: bytes, stamp: int) -> None:
        """Send a message to the clients that are subscribed to its topic."""
        with self._lock:
            clients = tuple(self._clients)
        for client in clients:
            if (number := client.subscriptions.get(topic)) is not None:
                client.put(_MESSAGE.pack(_MESSAGE_DATA, number, stamp) + data)

    def _check(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the refusal of a request. None: it is allowed."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if hosts not in ([f"{HOST}:{self._port}"], [f"localhost:{self._port}"]):
            return connection.respond(403, f"bevviz: this server is at {HOST} alone\n")
        if not {*origins} <= self._origins:
            self._name_refused(", ".join(origins))
            return connection.respond(403, "bevviz: another site's page may not connect\n")
        with self._lock:
            if len(self._clients) >= MAX_CLIENTS:
                return connection.respond(503, f"bevviz: {MAX_CLIENTS} clients are connected already\n")
        return None

    def _name_refused(self, origin: str) -> None:
        """Tell once that a site was refused."""
        with self._lock:
            if origin in self._refused or len(self._refused) == MAX_REFUSALS:
                return
            self._refused.add(origin)
        self._tell(
            f"a page of {origin} asked for the results and was refused; if that is your viewer: "
            f"--foxglove-origin {origin}"
        )

    def _stay(self, connection: ServerConnection) -> None:
        """Serve a client until it disconnects."""
        from websockets.exceptions import ConnectionClosed

        client = _Client(connection)
        with self._lock:
            self._clients.add(client)
        try:
            with suppress(ConnectionClosed, OSError):
                client.stay()
        finally:
            with self._lock:
                self._clients.discard(client)
            client.close()


class _Client(Closable):
    """One client. A thread sends its messages, so that a slow client delays nobody else.

    Attributes:
        subscriptions: number that the client gave to each topic it is subscribed to.
    """

    def __init__(self, connection: ServerConnection) -> None:
        self.subscriptions: dict[str, int] = {}
        self._connection = connection
        self._waiting = NewestQueue[bytes](BACKLOG)

    def stay(self) -> None:
        """Send what there is to subscribe to, and handle the messages of the client until it disconnects."""
        session = {"name": "bevviz", "capabilities": [], "sessionId": str(time.time_ns())}
        self._send({"op": "serverInfo", **session})
        self._send({"op": "advertise", "channels": [*map(_channel, CHANNELS)]})
        sender = threading.Thread(target=self._send_waiting, name="foxglove client", daemon=True)
        sender.start()
        for text in self._connection:
            try:
                self._take(json.loads(text))
            except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
                self._send({"op": "status", "level": 2, "message": "that message cannot be understood"})

    def close(self) -> None:
        """Disconnect the client, even if it does not read what it is sent."""
        self._waiting.close()
        with suppress(OSError):
            self._connection.socket.shutdown(socket.SHUT_RDWR)

    def put(self, message: bytes) -> None:
        """Let the thread send a message."""
        self._waiting.put(message)

    def _take(self, message: dict[str, Any]) -> None:
        """Handle a message of the client."""
        if message["op"] == "subscribe":
            for wanted in message["subscriptions"]:
                number = int(wanted["id"])
                if not 0 <= number < 1 << 32:
                    raise ValueError(number)
                self.subscriptions[CHANNELS[wanted["channelId"]]] = number
        elif message["op"] == "unsubscribe":
            ended = set(message["subscriptionIds"])
            for topic, number in tuple(self.subscriptions.items()):
                if number in ended:
                    del self.subscriptions[topic]

    def _send(self, message: dict[str, Any]) -> None:
        self._connection.send(json.dumps(message))

    def _send_waiting(self) -> None:
        """Send the messages of the subscribed topics as they come."""
        from websockets.exceptions import ConnectionClosed

        with suppress(ConnectionClosed, OSError):
            for message in self._waiting:
                self._connection.send(message)


def _channel(number: int) -> dict[str, Any]:
    """Return the description of a topic in the protocol."""
    topic = CHANNELS[number]
    kind = TOPICS[topic]
    schema = {"schemaName": kind, "schemaEncoding": "ros2msg", "schema": definition(kind) or ""}
    return {"id": number, "topic": topic, "encoding": "cdr", **schema}
