"""The kept drive as messages, for the robots of tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from bevviz.bags.source import BagSource
from bevviz.config import load
from bevviz.extras.demo.drive import START
from bevviz.messages.definitions import typestore
from tests.support.kept_drives import BAG
from tests.support.ros_player import PERIOD, Drive, Play, shifted

FRAMES = 3


@cache
def drive_of(play: Play) -> Drive:
    types, messages = _messages()
    frames: list[list[tuple[float, str, bytes]]] = [[] for _ in range(play.frames)]
    static = b""
    for topic, at, data in messages:
        if topic == "/tf_static":
            static = data
        elif at < play.frames * PERIOD:
            message = _changed(play, typestore().deserialize_cdr(data, types[topic]))
            changed = bytes(typestore().serialize_cdr(message, types[topic]))
            frames[at // PERIOD].append((at % PERIOD * 1e-9, topic, changed))
    return Drive(play, types, static, frames)


@cache
def _messages() -> tuple[dict[str, str], Sequence[tuple[str, int, bytes]]]:
    """Return the types by topic, and topic, nanoseconds since the begin and message, in order."""
    with BagSource([BAG], load()) as source:
        types = {topic.name: topic.type for topic in source.recording.topics}
        found = [
            (message.connection.topic, message.received, bytes(message.data))
            for message in source.recording.messages(list(types))
        ]
    return types, [(topic, at - START, data) for topic, at, data in found if at - START < FRAMES * PERIOD]


def _changed(play: Play, message: Any) -> Any:
    """Return a message with stamps from 0 on, and with the points and the focal length of the play."""
    if hasattr(message, "point_step"):
        points = message.data.reshape(-1, message.point_step)
        data = np.resize(points, (play.points, message.point_step)).ravel()
        message = replace(message, data=data, height=1, width=play.points, row_step=len(data))
    if hasattr(message, "distortion_model"):
        k, p = message.k.copy(), message.p.copy()
        k[[0, 4]] *= play.focal
        p[[0, 5]] *= play.focal
        message = replace(message, k=k, p=p)
    return shifted(message, -START)
