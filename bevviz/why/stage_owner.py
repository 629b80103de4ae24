"""Owner of each stage: bevviz, a user's function, or a topic of the robot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bevviz.config import BUILTIN_METHODS, METHOD_KEYS, Config, plugin_of
from bevviz.config.plugins import TOPIC
from bevviz.errors import UserError


@dataclass(frozen=True, slots=True)
class StageOwner:
    """The owner of one stage.

    Attributes:
        section: section of the configuration.
        function: ``module:name`` of the user's function; empty: none.
        topic: topic of the robot; empty: none.
    """

    section: str
    function: str = ""
    topic: str = ""

    @property
    def ours(self) -> bool:
        """Whether the stage is part of bevviz."""
        return not self.function and not self.topic

    @property
    def name(self) -> str:
        """Name of the function or topic for sentences, empty for our stages."""
        return self.function or self.topic


def owner_of(config: Config, section: str) -> StageOwner:
    """Return the owner of the stage of a section."""
    method = str(getattr(getattr(config, section), METHOD_KEYS[section]))
    if method.startswith(TOPIC):
        return StageOwner(section, topic=method.removeprefix(TOPIC))
    try:
        plugin = plugin_of(config, section)
    except UserError:  # The function could be loaded when the frame was run.
        return StageOwner(section, function=method)
    if plugin is None and section == "objects" and method not in BUILTIN_METHODS:
        return StageOwner(section, function=Path(method).name)  # file of a network
    return StageOwner(section, function=plugin.name if plugin is not None else "")
