"""The results for Foxglove: a client that knows the protocol alone, and messages read by rosbags."""

from __future__ import annotations

import json
import re
import signal
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from bevviz.recording.ports import free_port
from tests.support.commands import environment
from tests.support.waiting import PATIENCE

pytest.importorskip("foxglove", reason="needs foxglove-sdk: pip install 'bevviz[foxglove]'")
WANTED = {"/detection/fused_3d", "/lidar/points_no_ground", "/visualization/tracks", "/tf"}


def test_a_foreign_client_reads_the_results(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "bevviz.cli", "live", "--synthetic", "4", "--model", "demo"]
    command += ["--foxglove", str(free_port(18765)), "--set", "live.flight_time=0"]
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
