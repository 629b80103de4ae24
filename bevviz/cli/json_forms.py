"""Forms of the JSON that commands write with ``--json``: their names and schemas.

``docs/schemas`` keeps the schemas (``python -m tools.make_schemas``). A key that is not in a form fails the
tests.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from bevviz.support.json_form import json_schema

# Result of each command. For several classes, their base comes first.
FORMS: Mapping[str, tuple[str, ...]] = {
    "calib": ("bevviz.calib.result:CalibrationResults",),
    "causes": ("bevviz.fleet.causes:CausesResult",),
    "compare": ("bevviz.compare.summary:ComparisonResult",),
    "evaluate": ("bevviz.evaluate.evaluation:EvaluationResult",),
    "fix": ("bevviz.fleet.fix:Fix",),
    "info": (
        "bevviz.pipeline.bag_info:TopicContents",
        "bevviz.pipeline.bag_info:BagInfo",
        "bevviz.live.graph_info:LiveInfo",
    ),
    "sweep": ("bevviz.sweep.run:SweepResult",),
    "why": ("bevviz.why.answer_results:FrameAnswers",),
}
VERSION = 1  # of every form


def form_name(command: str) -> str:
    """Return the value of the key ``form`` in the JSON of a command."""
    return f"bevviz.{command}/{VERSION}"


def schema(command: str) -> dict[str, Any]:
    """Return the JSON schema of the output of a command. Keys that not all its classes have are optional."""
    names = [name.partition(":") for name in FORMS[command]]
    trees = [json_schema(getattr(import_module(module), name)) for module, _, name in names]
    properties = {key: value for tree in reversed(trees) for key, value in tree["properties"].items()}
    required = set.intersection(*(set(tree["required"]) for tree in trees))
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **trees[0],
        "properties": {"form": {"const": form_name(command), "type": "string"}, **properties},
        "required": ["form", *(key for key in properties if key in required)],
    }
