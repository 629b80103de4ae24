"""Types made without a compiler, beside compiled ones, over DDS on this machine."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")

from bevviz.extras.fast_dds.typesupport import message_type
from bevviz.live.node import Node
from bevviz.messages.definitions import typestore
from bevviz.messages.encode import encode_camera_info
from tests.support import kept_drives
from tests.support.ros_graphs import own_graph
from tests.support.waiting import until


@pytest.fixture(autouse=True)
def domain() -> Iterator[None]:
    with own_graph():
        yield


@pytest.fixture
def pair() -> Iterator[tuple[Node, Node]]:
    """Two participants."""
    with Node(name="one") as one, Node(name="two") as two:
        one.start()
        two.start()
        yield one, two


def test_generated_types_match_compiled_ones(pair: tuple[Node, Node]) -> None:
    from sensor_msgs.msg import CameraInfo

    kind = "sensor_msgs/msg/CameraInfo"
    made = message_type(kind)
    compiled: list[Any] = []
    raw: list[bytes] = []
    one, two = (session.node for session in pair)
    one.create_subscription(CameraInfo, "/made", compiled.append, 10)
    one.create_subscription(made, "/compiled", raw.append, 10, raw=True)
    from_made, from_compiled = (
        two.create_publisher(made, "/made", 10),
        two.create_publisher(CameraInfo, "/compiled", 10),
    )
    until(lambda: from_made.get_subscription_count() and from_compiled.get_subscription_count(), "a match")

    camera = kept_drives.frame(0).cameras[0]
    assert camera.image is not None and camera.intrinsics is not None
    sent = encode_camera_info(camera.image, camera.intrinsics)
    from_made.publish(bytes(typestore().serialize_cdr(sent, kind)))
    until(lambda: compiled, "a message of the made type")
    message = compiled[0]
    assert (message.width, message.header.frame_id) == (640, camera.image.frame_id)
    np.testing.assert_array_equal(message.k, sent.k)

    from_compiled.publish(message)
    until(lambda: raw, "a message of the compiled type")
    back: Any = typestore().deserialize_cdr(raw[0], kind)
    assert back.header == sent.header and back.roi == sent.roi
    np.testing.assert_array_equal(back.p, sent.p)

    hashes = {
        bytes(info.topic_type_hash.value)
        for topic in ("/made", "/compiled")
        for info in [*one.get_publishers_info_by_topic(topic), *one.get_subscriptions_info_by_topic(topic)]
    }
    assert len(hashes) == 1, "type hashes differ"
