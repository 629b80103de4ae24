"""The results for Foxglove: a client that knows the protocol alone, and messages read by rosbags."""

from __future__ import annotations

import json
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from bevviz.errors import UserError
from bevviz.extras.foxglove.server import FoxgloveServer
from bevviz.recording.ports import free_port
from tests.support import replay
from tests.support.commands import environment
from tests.support.waiting import PATIENCE, until

FIRST = "/detection/fused_3d"
WANTED = {"/detection/fused_3d", "/lidar/points_no_ground", "/visualization/tracks", "/tf"}


@pytest.mark.long
def test_a_foreign_client_reads_the_results(tmp_path: Path) -> None:
    command = [sys.executable, replay.__file__, "4", "live", "--model", "demo"]
    command += ["--foxglove", str(free_port(18765)), "--set", "live.flight_time=0"]
    # A busy machine makes less than a frame a second, and a track that is unseen for so long ends.
    command += ["--set", "tracking.min_hits=1", "--set", "live.points=20000"]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=environment()
    ) as live:
        try:
            assert live.stderr is not None
            line = next(line for line in live.stderr if "open the connection" in line)
            address = re.search(r"ws://127\.0\.0\.1:\d+", line)
            assert address is not None
            messages = received(address[0])
        finally:
            live.send_signal(signal.SIGINT)
            live.communicate(timeout=PATIENCE)
    objects, cloud = messages["/detection/fused_3d"], messages["/lidar/points_no_ground"]
    assert objects.header.frame_id == cloud.header.frame_id == "rslidar"
    names = {result.hypothesis.class_id for one in objects.detections for result in one.results[1:]}
    assert names & {"car", "person", "cyclist"}
    assert cloud.width * cloud.height > 1000
    (pose,) = messages["/tf"].transforms
    assert (pose.header.frame_id, pose.child_frame_id) == ("map", "rslidar")
    assert messages["/visualization/tracks"].markers


@pytest.fixture
def told() -> list[str]:
    return []


@pytest.fixture
def server(told: list[str]) -> Iterator[FoxgloveServer]:
    with FoxgloveServer(0, ["http://localhost:8080"], told.append) as server:
        yield server


def status(server: FoxgloveServer, *, host: str = "", origin: str | None = None) -> int:
    """Return the status of the answer to a browser's request, written by hand."""
    where = server.address.removeprefix("ws://")
    name, _, port = where.partition(":")
    lines = [f"GET / HTTP/1.1\r\nHost: {host or where}", "Upgrade: websocket", "Connection: Upgrade"]
    lines += ["Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Version: 13"]
    lines += ["Sec-WebSocket-Protocol: foxglove.sdk.v1", *([f"Origin: {origin}"] if origin else []), "\r\n"]
    with socket.create_connection((name, int(port)), timeout=PATIENCE) as connection:
        connection.sendall("\r\n".join(lines).encode())
        return int(connection.recv(4096).split()[1])


@pytest.mark.parametrize(
    "origin",
    ["https://evil.example", "null", "https://app.foxglove.dev.evil.example", "http://app.foxglove.dev"],
)
def test_pages_of_other_sites_are_refused(server: FoxgloveServer, told: list[str], origin: str) -> None:
    assert status(server, origin=origin) == status(server, origin=origin) == 403
    (line,) = told
    assert line.endswith(f"--foxglove-origin {origin}")


def test_names_of_other_sites_for_this_machine_are_refused(server: FoxgloveServer) -> None:
    port = server.address.rpartition(":")[2]
    assert status(server, host=f"evil.example:{port}") == 403
    assert status(server, host=f"evil.example:{port}", origin="https://app.foxglove.dev") == 403


def test_foxglove_and_programs_are_answered(server: FoxgloveServer, told: list[str]) -> None:
    for origin in (None, "https://app.foxglove.dev", "http://localhost:8080"):
        assert status(server, origin=origin) == 101
    assert not told


def test_a_client_gets_what_it_subscribes_to(server: FoxgloveServer) -> None:
    with connect(server.address, subprotocols=[Subprotocol("foxglove.sdk.v1")]) as client:
        assert json.loads(client.recv(timeout=PATIENCE))["op"] == "serverInfo"
        channels = json.loads(client.recv(timeout=PATIENCE))["channels"]
        (number,) = [channel["id"] for channel in channels if channel["topic"] == FIRST]
        for wrong in ("{", "[]", '{"op": "subscribe", "subscriptions": [{"id": -1, "channelId": 1}]}'):
            client.send(wrong)
            assert json.loads(client.recv(timeout=PATIENCE))["op"] == "status"
        client.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 77, "channelId": number}]}))
        until(lambda: server.wants(FIRST))
        assert not server.wants("/tf")
        server.send("/tf", b"other", 1)
        server.send(FIRST, b"data", 123)
        assert client.recv(timeout=PATIENCE) == struct.pack("<BIQ", 1, 77, 123) + b"data"
        client.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [77]}))
        until(lambda: not server.wants(FIRST))


@pytest.mark.long
def test_a_client_that_reads_nothing_delays_nobody() -> None:
    before = threading.active_count()
    with (
        FoxgloveServer(0) as server,
        connect(server.address, subprotocols=[Subprotocol("foxglove.sdk.v1")], max_queue=1) as client,
    ):
        client.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 5}]}))
        until(lambda: server.wants(FIRST))
        for _ in range(40):
            server.send(FIRST, bytes(1 << 20), 1)
        server.close()
    until(lambda: threading.active_count() <= before)  # threads of other tests may end meanwhile


def received(address: str) -> dict[str, Any]:
    """Return a message of each wanted topic, that of the tracks with tracks in it."""
    store, found = get_typestore(Stores.ROS2_JAZZY), dict[str, Any]()
    with connect(address, subprotocols=[Subprotocol("foxglove.sdk.v1")], max_size=None) as socket:
        types: dict[int, tuple[str, str]] = {}
        while set(found) != WANTED or not found["/visualization/tracks"].markers:
            data = socket.recv(timeout=PATIENCE)
            if isinstance(data, str):
                message = json.loads(data)
                channels = message["channels"] if message["op"] == "advertise" else []
                for channel in channels:
                    assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
                    if channel["topic"] not in WANTED:
                        continue
                    kind = channel["schemaName"]
                    parsed = get_types_from_msg(channel["schema"], kind)
                    store.register({name: one for name, one in parsed.items() if name not in store.types})
                    types[channel["id"]] = channel["topic"], kind
                wanted = [{"id": number, "channelId": number} for number in types]
                if channels:
                    socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
                continue
            operation, number, _ = struct.unpack_from("<BIQ", data)
            if operation == 1:
                topic, kind = types[number]
                found[topic] = store.deserialize_cdr(data[13:], kind)
    return found


def test_a_taken_port_is_named_with_a_free_one() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(UserError, match=rf"--foxglove {port}: the port is in use; another one: --fox"):
            FoxgloveServer(port)
