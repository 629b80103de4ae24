"""Description of a running graph: topics, sensors, transforms, and gaps for a full run."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from bevviz.config import Config, stated_lines
from bevviz.live.graph import PublishedTopic, describe_qos
from bevviz.live.source import LiveSource
from bevviz.model.frame import Frame
from bevviz.pipeline.bag_info import (
    CameraInfo,
    TopicContents,
    TopicInfo,
    find_missing,
    network_providers,
    render_contents,
    render_missing,
)
from bevviz.support import progress
from bevviz.support.json_form import json_form

LISTEN = 3.0  # seconds
PATIENCE = 10.0  # seconds until the topics found so far are shown


@json_form
@dataclass(frozen=True, slots=True, kw_only=True)
class LiveInfo(TopicContents):
    """Content of ``bevviz info --live``."""

    domain: int
    """ROS domain; --live"""
    middleware: str
    """RMW; --live"""
    seconds: float
    """time of listening; --live"""


def describe(
    config: Config, arguments: Sequence[str] = (), seconds: float = LISTEN, patience: float = PATIENCE
) -> LiveInfo:
    """Listen to the graph for ``seconds``, counted from when the topics have their roles. Ctrl-C ends it.

    After ``patience`` seconds without all roles, the topics found so far are described.

    Raises:
        UserError: rclpy does not work, or refuses the arguments.
    """
    # A separate node name, so that the topics of another bevviz are shown too.
    with LiveSource(config, arguments=arguments, name="bevviz_info") as source:
        with suppress(KeyboardInterrupt):
            source.wait_aloud(
                lambda missing: progress.say(f"waiting {patience:.0f} s at most: {missing}"), patience
            )
        watch = source.watch
        before, volume = watch.received.copy(), watch.volume.copy()
        start = time.monotonic()
        frame = _last_frame(source, seconds)
        seconds = time.monotonic() - start
        counts, volume = watch.received - before, watch.volume - volume
        absent = source.missing
        missing = [absent] if absent else find_missing(source.roles, frame, config)
        networks, lacking = network_providers(config)
        missing += lacking
        return LiveInfo(
            domain=source.nodes.domain,
            middleware=source.nodes.middleware,
            seconds=seconds,
            topics=tuple(
                _topic(topic, source, counts[topic.name], volume[topic.name], seconds)
                for topic in sorted(source.topics.values(), key=lambda t: t.name)
            ),
            lidars=source.roles.lidar_names,
            cameras=[*map(CameraInfo.of, frame.cameras)] if frame else (),
            transforms=dict(source.inputs.sync.tf.tree()),
            points_frame=frame.points_frame if frame else "",
            world_frame=frame.world_frame if frame and frame.world_from_points is not None else "",
            network=networks["detector"],
            object_network=networks["objects"],
            configured=tuple(stated_lines(config)),
            missing=tuple(missing),
            warnings=(*map(str, source.problems.all.values()), *source.warnings),
        )


def _last_frame(source: LiveSource, seconds: float) -> Frame | None:
    """Receive frames for ``seconds`` and return the last one."""
    timer = threading.Timer(seconds, source.stop)
    timer.start()
    last: deque[Frame] = deque(maxlen=1)
    try:
        last.extend(source)
    except KeyboardInterrupt:
        source.stop()
    timer.cancel()
    timer.join()
    return last[0] if last else None


def _topic(topic: PublishedTopic, source: LiveSource, count: int, volume: int, seconds: float) -> TopicInfo:
    heard = topic.name in source.watch.received
    stream = heard and topic.name not in source.roles.tf_static
    role = source.roles.notes.get(topic.name, "")
    return TopicInfo(
        name=topic.name,
        type=topic.type,
        count=count if heard else None,
        frame_id=source.inputs.frame_ids.get(topic.name, ""),
        rate=count / seconds if stream else None,
        size=volume / count if count else None,
        delay=source.inputs.sync.clocks.lag(topic.name) if stream else None,
        role=f"{role}; {describe_qos(topic)}" if role else "",
    )


def render(info: LiveInfo) -> str:
    """Return the description as text for a terminal of 100 columns."""
    about = {
        "graph": f"ROS_DOMAIN_ID {info.domain}, {info.middleware}",
        "time": f"{info.seconds:.1f} s listened, {sum(t.count or 0 for t in info.topics)} messages",
    }
    return f"{render_contents(about, info)}\n{render_missing(info)}"
