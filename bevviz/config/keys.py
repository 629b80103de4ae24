"""Parameters by their dotted keys: descriptions, values, units and differences."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

import annotated_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from bevviz.config.methods import params_of
from bevviz.config.sections import Config, Section
from bevviz.config.value_types import StageMethods, Unit

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
    """Return every dotted key with its description, in order.

    Args:
        config: configuration whose plugins add the keys ``SECTION.params.NAME``.
    """
    descriptions: dict[str, str] = {}
    for section, info in Config.model_fields.items():
        model = _model(section)
        if model is None:
            descriptions[section] = info.description or ""
            continue
        for name, inner in model.model_fields.items():
            if name != "params":
                descriptions[f"{section}.{name}"] = inner.description or ""
        if config is not None:
            descriptions |= {
                f"{section}.params.{name}": inner.description or ""
                for name, inner in params_of(config, section).items()
            }
    return descriptions


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


def unit(key: str) -> str:
    """Return the name of the unit of a dotted key, or an empty string if it has none."""
    key_unit = _unit(key)
    return key_unit.name if key_unit is not None else ""


def unit_spellings(key: str) -> tuple[str, ...]:
    """Return the units that a user may write for a dotted key, e.g. m, cm and mm."""
    key_unit = _unit(key)
    return tuple(key_unit.factors) if key_unit is not None else ()


def _unit(key: str) -> Unit | None:
    """Return the unit of a dotted key, or None if it has none."""
    info = field_of(key)
    if info is None:
        return None
    # An optional quantity carries its unit inside the union.
    inner = [
        extra for argument in get_args(info.annotation) for extra in getattr(argument, "__metadata__", ())
    ]
    for extra in [*info.metadata, *inner]:
        owner = getattr(getattr(extra, "func", None), "__self__", None)
        if isinstance(owner, Unit):
            return owner
    return None


def field_of(key: str, config: Config | None = None) -> FieldInfo | None:
    """Return the pydantic field of a dotted key, or None for an unknown key.

    Args:
        key: dotted key.
        config: configuration whose stages define the keys ``SECTION.params.NAME``. Without it, they are
            unknown.
    """
    section, _, name = key.partition(".")
    model = _model(section)
    info = Config.model_fields.get(key) if model is None else model.model_fields.get(name)
    if info is not None or config is None:
        return info
    return params_of(config, section).get(name.removeprefix("params."))  # The word params may be left out.


def limits_of(info: FieldInfo) -> tuple[Any, Any]:
    """Return the least and the largest number of a field, also if it excludes them. None: it has no limit."""
    low = high = None
    for rule in info.metadata:
        if isinstance(rule, annotated_types.Ge | annotated_types.Gt):
            low = rule.ge if isinstance(rule, annotated_types.Ge) else rule.gt
        if isinstance(rule, annotated_types.Le | annotated_types.Lt):
            high = rule.le if isinstance(rule, annotated_types.Le) else rule.lt
    return low, high


def is_number_or_choice(info: FieldInfo, value: Any) -> bool:
    """Return whether a value can only be a number, a boolean or a choice that bevviz declares.

    Such a value names no file, topic or function. The declaration of the parameter decides, and not the look
    of the value: a file may have any name. Of a stage's method, the built-in ones are choices.

    Args:
        info: field of the parameter.
        value: value that is stated for it.
    """
    for rule in info.metadata:
        methods = getattr(getattr(rule, "func", None), "__self__", None)
        if isinstance(methods, StageMethods):
            return value in methods.ours
    return _holds_numbers_or_choices(info.annotation)


def _holds_numbers_or_choices(annotation: Any) -> bool:
    """Return whether a type holds only numbers, booleans and declared choices."""
    if annotation in (bool, int, float, NoneType) or get_origin(annotation) is Literal:
        return True
    if hasattr(annotation, "__metadata__"):  # Annotated
        return _holds_numbers_or_choices(annotation.__origin__)
    items = [item for item in get_args(annotation) if item is not ...]
    is_container = get_origin(annotation) in (tuple, list, Union, UnionType)
    return is_container and bool(items) and all(map(_holds_numbers_or_choices, items))


def _model(section: str) -> type[BaseModel] | None:
    """Return the model of a section, or None if the name is unknown or stands for a single value."""
    model = Config.model_fields[section].annotation if section in Config.model_fields else None
    return model if isinstance(model, type) and issubclass(model, BaseModel) else None


def unknown_key(key: str, known: Sequence[str]) -> str:
    """Return the sentence for an unknown key, with the nearest of the ``known`` keys."""
    choices = {k.replace(".params.", "."): k for k in [*known, *TUTORIAL_NAMES]}
    by_last = [k for k in choices if k.rsplit(".", 1)[-1] == key.rsplit(".", 1)[-1]]
    begun = [k for k in choices if k.startswith(key) and "." in key]  # a name that was cut short
    near = by_last or begun or difflib.get_close_matches(key.replace(".params.", "."), choices, 1, 0.3)
    hint = f"; did you mean '{choices[near[0]]}'?" if near else ""
    return f"unknown key '{key}'{hint} ('bevviz config' lists all)"
