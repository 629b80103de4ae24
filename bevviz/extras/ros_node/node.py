"""Companion of a live run that makes its node a full member of the robot's graph."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from bevviz.config import Config
from bevviz.config.reloading import ReloadableConfig
from bevviz.errors import UserError
from bevviz.extras.ros_node.diagnostics import Diagnostics
from bevviz.extras.ros_node.parameters import RosRequests
from bevviz.extras.ros_node.topics import RosTopics
from bevviz.live.companions import Companion
from bevviz.live.runtime import Live
from bevviz.model.results import FrameResult


class RosNode(Companion):
    """Parameters and the service of the node, and its topics if they are asked for.

    Args:
        publish: publish the results.
        diagnostics: publish the state of the run.
    """

    def __init__(self, *, publish: bool, diagnostics: bool) -> None:
        self._publishes, self._reports = publish, diagnostics
        self.takes_results = publish or diagnostics
        self._requests: RosRequests | None = None  # None until ``join``
        self._topics: RosTopics | None = None
        self._diagnostics: Diagnostics | None = None

    def join(self, node: Any, settings: ReloadableConfig, save: Callable[[], Path]) -> None:
        """Declare the parameters, take those of the command line, and offer the service."""
        self._node = node

        def take(more: list[str]) -> None:
            settings.take(more)
            if self._requests is not None:
                self._requests.config = settings.config

        self._requests = RosRequests(node, settings.config, take, save)
        self._requests.config = settings.config

    def begin(self, live: Live) -> None:
        """Pass requests to the run, and publish."""
        if self._requests is not None:
            self._requests.save, self._requests.change = live.save, live.update
        if self._publishes:
            self._topics = RosTopics(self._node, live.notes.warn)
        if not self._reports:
            return
        try:
            self._diagnostics = diagnostics = Diagnostics(self._node)
        except UserError as error:
            live.notes.warn(f"/diagnostics is not published: {error}")
        else:
            diagnostics.every_second(lambda: diagnostics.publish(live.numbers, live.problems.current))

    def show(self, config: Config) -> None:
        """Set the parameters to a changed configuration."""
        if self._requests is not None:
            self._requests.show(config)

    def observe(self, result: FrameResult) -> None:
        """Report the state of a result."""
        if self._diagnostics is not None:
            self._diagnostics.observe(result)

    def wants(self, topic: str) -> bool:
        """Return whether a node receives a topic."""
        return self._topics is not None and self._topics.wants(topic)

    def send(self, topic: str, data: bytes, stamp: int) -> None:
        """Publish a message."""
        if self._topics is not None:
            self._topics.send(topic, data, stamp)
