"""The synthetic drive as messages, for the robots of tests."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from bevviz.messages.definitions import typestore
from bevviz.model.frame import Frame
from bevviz.synthetic import SyntheticSource
from bevviz.synthetic.bag import TOPICS, messages, mounting
from bevviz.synthetic.drive import START
from tests.support.ros_player import Drive, Play, shifted


@cache
def drive_of(play: Play) -> Drive:
    source = _source()
    static = typestore().serialize_cdr(mounting(source), TOPICS["/tf_static"])
    frames = [_messages(play, index) for index in range(play.frames)]
    return Drive(play, TOPICS, bytes(static), frames)


@cache
def _source() -> SyntheticSource:
    return SyntheticSource(frames=3)


@cache
def _frame(index: int) -> Frame:
    return _source().snapshot(index).frame


def _messages(play: Play, index: int) -> list[tuple[float, str, bytes]]:
    """Return the messages of one frame."""
    frame = _frame(index)
    cloud, camera = frame.clouds[0], frame.cameras[0]
    rows = np.resize(np.arange(len(cloud.xyz)), play.points)
    fields = {name: values[rows] for name, values in cloud.fields.items()}
    assert camera.intrinsics is not None
    K = camera.intrinsics.K * np.array([[play.focal], [play.focal], [1.0]])
    frame = replace(
        frame,
        clouds=(replace(cloud, xyz=cloud.xyz[rows], fields=fields),),
        cameras=(replace(camera, intrinsics=replace(camera.intrinsics, K=K)),),
    )
    return [
        ((at - frame.stamp) * 1e-9, topic, bytes(typestore().serialize_cdr(shifted(one, -START), kind)))
        for topic, at, one in messages(_source(), frame)
        for kind in [TOPICS[topic]]
    ]
