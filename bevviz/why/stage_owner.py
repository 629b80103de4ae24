"""Whose each stage is: bevviz's own, somebody's function, or the robot's topic."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bevviz.config import OURS, STAGES, Config, plugin_of
from bevviz.config.plugins import TOPIC
from bevviz.errors import UserError


@dataclass(frozen=True, slots=True)
class StageOrigin:
    """Of one stage.

    Attributes:
        section: of the configuration.
        function: ``module:name`` of somebody's function; empty: it is none.
        topic: of the robot; empty: it is not the robot's.
    """

    section: str
    function: str = ""
    topic: str = ""

    @property
    def ours(self) -> bool:
        return not self.function and not self.topic

    @property
    def name(self) -> str:
        """For a sentence about what it made; empty for ours, whose parameters are named instead."""
        return self.function or self.topic


def origin(config: Config, section: str) -> StageOrigin:
    """Whose the stage of a section is."""
    method = str(getattr(getattr(config, section), STAGES[section]))
    if method.startswith(TOPIC):
        return StageOrigin(section, topic=method.removeprefix(TOPIC))
    try:
        plugin = plugin_of(config, section)
    except UserError:  # it could be had when the frame was run
        return StageOrigin(section, function=method)
    if plugin is None and section == "objects" and method not in OURS:
        return StageOrigin(section, function=Path(method).name)  # a network's file
    return StageOrigin(section, function=plugin.name if plugin is not None else "")
