"""Values of a configuration by dotted key, and their differences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bevviz.config.sections import Config, Section


def values(config: Config) -> dict[str, Any]:
    """Return the value of each dotted key, including the parameters of plugins."""
    values_by_key: dict[str, Any] = {}
    for section, content in config:
        if not isinstance(content, Section):
            values_by_key[section] = content
            continue
        for name, value in content:
            if name != "params":
                values_by_key[f"{section}.{name}"] = value
            else:
                values_by_key |= {f"{section}.params.{key}": inner for key, inner in value.items()}
    return values_by_key


@dataclass(frozen=True, slots=True)
class ParameterChange:
    """Old and new value of one parameter."""

    before: Any
    after: Any

    def __str__(self) -> str:
        if not isinstance(self.before, Mapping) or not isinstance(self.after, Mapping):
            return f"{self.before} -> {self.after}"
        both = dict.fromkeys([*self.before, *self.after])
        pairs = {key: (self.before.get(key), self.after.get(key)) for key in both}
        return "; ".join(f"{key}: {old} -> {new}" for key, (old, new) in pairs.items() if old != new)


def changes(old: Config, new: Config) -> dict[str, ParameterChange]:
    """Return each dotted key that differs between two configurations."""
    before, after = values(old), values(new)
    return {
        key: ParameterChange(before.get(key, "absent"), after.get(key, "absent"))
        for key in dict.fromkeys([*before, *after])
        if before.get(key, "absent") != after.get(key, "absent")
    }


def flatten(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a tree of sections by dotted key.

    A deeper mapping is a value, except for the parameters of plugins.
    """
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        if name not in Config.model_fields or name == "preset" or not isinstance(value, Mapping):
            flat[str(name)] = value
            continue
        for inner, content in value.items():
            if inner == "params" and isinstance(content, Mapping):
                flat.update({f"{name}.params.{key}": v for key, v in content.items()})
            else:
                flat[f"{name}.{inner}"] = content
    return flat
