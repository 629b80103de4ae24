"""Companion of a live run that makes its node a full member of the robot's graph."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from bevviz.config.reloading import ReloadableConfig
from bevviz.errors import UserError
from bevviz.extras.ros_node.diagnostics import Diagnostics
from bevviz.extras.ros_node.parameters import RosRequests
from bevviz.extras.ros_node.topics import RosTopics
from bevviz.live.companions import Companion
from bevviz.live.runtime import Live


class RosNode(Companion):
    """Parameters and the service of the node, and its topics if they are asked for.

    Args:
        publish: publish the results.
        diagnostics: publish the state of the run.
    """

    def __init__(self, *, publish: bool, diagnostics: bool) -> None:
        self._publishes, self._reports = publish, diagnostics
        self._requests: RosRequests | None = None  # None: there is no graph to join

    def join(self, node: Any, settings: ReloadableConfig, save: Callable[[], Path]) -> None:
        """Declare the parameters, take those of the command line, and offer the service."""
        self._node = node
        self._requests = RosRequests(node, settings, save)

    def begin(self, live: Live) -> None:
        """Pass requests to the run, and publish."""
        if self._requests is None:
            return
        live.followers.append(self._requests.show)
        if self._publishes:
            live.receivers.append(RosTopics(self._node, live.notes.warn))
        if not self._reports:
            return
        try:
            diagnostics = Diagnostics(self._node)
        except UserError as error:
            live.notes.warn(f"/diagnostics is not published: {error}")
        else:
            live.receivers.append(diagnostics)
            diagnostics.every_second(lambda: diagnostics.publish(live.numbers, live.problems.current))
