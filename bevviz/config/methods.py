"""Methods that a stage can name: built-in, a function, a network, or a topic of the robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from pydantic_core import PydanticCustomError

from bevviz.config import plugins
from bevviz.config.pillars import is_network_file


@dataclass(frozen=True, slots=True)
class StageMethods:
    """Allowed methods of a stage: built-in, ``module:function``, a registered name, or ``topic:NAME``."""

    ours: tuple[str, ...]
    former: Mapping[str, str] = field(default_factory=dict)  # former names of built-in methods
    networks: bool = False  # whether an ONNX file is allowed

    def check(self, value: str) -> str:
        """Return the current name of a method. Raise an error for pydantic if the stage does not allow it."""
        value = self.former.get(value, value)
        if value in self.ours or ":" in value or value in plugins.registered():
            return value
        if self.networks and is_network_file(value):
            return value
        registered = f", {', '.join(plugins.registered())} (registered)" if plugins.registered() else ""
        raise PydanticCustomError(
            "method",
            "must be one of {ours}{registered}, {file}module:function, or topic:/name",
            {
                "ours": ", ".join(self.ours),
                "registered": registered,
                "file": "FILE.onnx, " if self.networks else "",
            },
        )


GROUND = StageMethods(("polar", "plane"), {"ransac": "plane"})
CLUSTERING = StageMethods(("dbscan",))
OBJECTS = StageMethods(("frustum",), networks=True)
BUILTIN_METHODS = ("", "demo", *GROUND.ours, *GROUND.former, *CLUSTERING.ours, *OBJECTS.ours)
CLASS_LISTS = ("coco", "coco91")  # values of detector.names that name no file
METHOD_KEYS = {  # section -> key that names the function
    "ground": "method",
    "clustering": "method",
    "detector": "model",
    "objects": "method",
}
