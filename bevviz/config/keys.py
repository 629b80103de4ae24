"""Parameters by their dotted keys: what they mean, what they are, and what differs."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import BaseModel

from bevviz.config.sections import Config, Section
from bevviz.config.units import Unit
from bevviz.config.user_stages import params_of

TUTORIAL_NAMES = {
    "voxel_size": "voxel.size",
    "ground_distance_threshold": "ground.distance_threshold",
    "cluster_tolerance": "clustering.eps",
    "min_cluster_size": "clustering.min_points",
    "max_cluster_size": "clustering.max_cluster_points",
    "conf_threshold": "detector.conf_threshold",
    "match_radius": "fusion.match_radius",
    "range_x": "bev.range_x",
    "range_y": "bev.range_y",
    "resolution": "bev.resolution",
}


def keys(config: Config | None = None) -> dict[str, str]:
    """Every dotted key with its description, in order; of a configuration, those of its plugins too."""
    found: dict[str, str] = {}
    for section, info in Config.model_fields.items():
        model = _model(section)
        if model is None:
            found[section] = info.description or ""
            continue
        for name, inner in model.model_fields.items():
            if name != "params":
                found[f"{section}.{name}"] = inner.description or ""
        if config is not None:
            found |= {
                f"{section}.params.{name}": inner.description or ""
                for name, inner in params_of(config, section).items()
            }
    return found


def values(config: Config) -> dict[str, Any]:
    """The value of each dotted key, those of plugins included."""
    found: dict[str, Any] = {}
    for section, given in config:
        if not isinstance(given, Section):
            found[section] = given
            continue
        for name, value in given:
            if name != "params":
                found[f"{section}.{name}"] = value
            else:
                found |= {f"{section}.params.{key}": inner for key, inner in value.items()}
    return found


@dataclass(frozen=True, slots=True)
class ParameterChange:
    """Of one parameter."""

    before: Any
    after: Any

    def __str__(self) -> str:
        if not isinstance(self.before, Mapping) or not isinstance(self.after, Mapping):
            return f"{self.before} -> {self.after}"
        both = dict.fromkeys([*self.before, *self.after])
        pairs = {key: (self.before.get(key), self.after.get(key)) for key in both}
        return "; ".join(f"{key}: {old} -> {new}" for key, (old, new) in pairs.items() if old != new)


def changes(old: Config | Mapping[str, Any], new: Config | Mapping[str, Any]) -> dict[str, ParameterChange]:
    """Each dotted key that differs. Mappings are of ``flat_yaml``, perhaps of another version."""
    before, after = (values(side) if isinstance(side, Config) else side for side in (old, new))
    return {
        key: ParameterChange(before.get(key, "absent"), after.get(key, "absent"))
        for key in dict.fromkeys([*before, *after])
        if before.get(key, "absent") != after.get(key, "absent")
    }


def flattened(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted keys of a tree of sections. What is deeper is a value, but for the parameters of plugins."""
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


def unit(key: str) -> str:
    """Name of the unit that the value of a dotted key is in; empty where it has none."""
    found = _unit(key)
    return found.name if found is not None else ""


def unit_spellings(key: str) -> tuple[str, ...]:
    """Units that the value of a dotted key may be given in, e.g. m, cm and mm."""
    found = _unit(key)
    return tuple(found.factors) if found is not None else ()


def _unit(key: str) -> Unit | None:
    section, _, name = key.partition(".")
    model = _model(section)
    if model is None or name not in model.model_fields:
        return None
    info = model.model_fields[name]
    # An optional quantity carries its unit inside the union.
    inner = [extra for part in get_args(info.annotation) for extra in getattr(part, "__metadata__", ())]
    for extra in [*info.metadata, *inner]:
        owner = getattr(getattr(extra, "func", None), "__self__", None)
        if isinstance(owner, Unit):
            return owner
    return None


def _model(section: str) -> type[BaseModel] | None:
    """Of a section; None: there is none of that name, or it is a value."""
    model = Config.model_fields[section].annotation if section in Config.model_fields else None
    return model if isinstance(model, type) and issubclass(model, BaseModel) else None


def unknown_key(key: str, known: Sequence[str]) -> str:
    """That there is no such key, with the nearest of the ``known`` ones."""
    choices = {k.replace(".params.", "."): k for k in [*known, *TUTORIAL_NAMES]}
    by_last = [k for k in choices if k.rsplit(".", 1)[-1] == key.rsplit(".", 1)[-1]]
    near = by_last or difflib.get_close_matches(key.replace(".params.", "."), choices, 1, 0.3)
    hint = f"; did you mean '{choices[near[0]]}'?" if near else ""
    return f"unknown key '{key}'{hint} ('bevviz config' lists all)"
