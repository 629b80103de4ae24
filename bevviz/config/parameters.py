"""Table of the parameters: one `Parameter` for each dotted key, made from the sections of the configuration.

The command line, YAML files, the page, ROS, agents and the docs take what they say of a parameter from here.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, TypeAlias, Union, get_args, get_origin

import annotated_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import to_jsonable_python

from bevviz.config.methods import params_of
from bevviz.config.sections import Config
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
BOUNDS = {  # rule of a field: the words for it
    annotated_types.Ge: ("at least", "ge"),
    annotated_types.Gt: ("above", "gt"),
    annotated_types.Le: ("at most", "le"),
    annotated_types.Lt: ("below", "lt"),
}

Kind: TypeAlias = Literal["choice", "list", "switch", "whole", "number", "text"]


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter of the configuration.

    Attributes:
        key: dotted key.
        text: its meaning.
        kind: kind of its values.
        default: default as JSON. None if the parameter is required.
        required: whether it has no default.
        optional: whether its value may be empty.
        unit: name of its unit; empty: none.
        spellings: units that a user may write, e.g. m, cm and mm.
        bounds: words and number of each limit, e.g. ``("at least", 0.0)``.
        choices: allowed values, of a list's items too; empty: others.
        methods: built-in methods of a stage; None if it is no stage's method.
        annotation: type of its values.
    """

    key: str
    text: str
    kind: Kind
    default: Any
    required: bool
    optional: bool
    unit: str
    spellings: tuple[str, ...]
    bounds: tuple[tuple[str, Any], ...]
    choices: tuple[Any, ...]
    methods: tuple[str, ...] | None
    annotation: Any

    @property
    def low(self) -> Any:
        """The least number, also if it is excluded. None: there is none."""
        return next((number for words, number in self.bounds if words in ("at least", "above")), None)

    @property
    def high(self) -> Any:
        """The largest number, also if it is excluded. None: there is none."""
        return next((number for words, number in self.bounds if words in ("at most", "below")), None)

    @property
    def allowed(self) -> str:
        """The choices or the range in words."""
        if self.choices:
            return ", ".join(map(str, self.choices))
        limits = [f"{words} {number}" for words, number in self.bounds]
        return ", ".join([*limits, *(["or empty"] if self.optional else [])])

    @property
    def aliases(self) -> tuple[str, ...]:
        """The tutorial's names for it, which are accepted, too."""
        return tuple(name for name, key in TUTORIAL_NAMES.items() if key == self.key)

    def is_number_or_choice(self, value: Any) -> bool:
        """Return whether a value can only be a number, a boolean or a choice that bevviz declares.

        Such a value names no file, topic or function. The declaration of the parameter decides, and not the
        look of the value: a file may have any name. Of a stage's method, the built-in ones are choices.
        """
        if self.methods is not None:
            return value in self.methods
        return _holds_numbers_or_choices(self.annotation)


def parameters(config: Config | None = None) -> Mapping[str, Parameter]:
    """Return every parameter by its dotted key, in order.

    Args:
        config: configuration whose plugins add the keys ``SECTION.params.NAME``.
    """
    if config is None:
        return _built_in()
    added = {
        f"{section}.params.{name}": field
        for section in Config.model_fields
        for name, field in params_of(config, section).items()
    }
    if not added:
        return _built_in()
    own = {key: _parameter(key, field) for key, field in added.items()}
    order = [*Config.model_fields]
    both = {**_built_in(), **own}
    return dict(sorted(both.items(), key=lambda item: order.index(item[0].partition(".")[0])))


def parameter(key: str, config: Config | None = None) -> Parameter | None:
    """Return the parameter of a dotted key, or None for an unknown key.

    Args:
        key: dotted key. Of a plugin's parameter the word ``params`` may be left out.
        config: configuration whose plugins define the keys ``SECTION.params.NAME``. Without it, they are
            unknown.
    """
    table = parameters(config)
    section, _, name = key.partition(".")
    return table.get(key) or table.get(f"{section}.params.{name}")


@cache
def _built_in() -> Mapping[str, Parameter]:
    """Return the parameters of bevviz itself."""
    table: dict[str, Parameter] = {}
    for section, field in Config.model_fields.items():
        model = field.annotation
        if isinstance(model, type) and issubclass(model, BaseModel):
            fields = {
                f"{section}.{name}": inner for name, inner in model.model_fields.items() if name != "params"
            }
        else:
            fields = {section: field}
        table |= {key: _parameter(key, inner) for key, inner in fields.items()}
    return table


def _parameter(key: str, field: FieldInfo) -> Parameter:
    """Return the parameter that a pydantic field declares."""
    inner = get_args(field.annotation)
    # An optional quantity carries its unit and its bounds inside the union.
    rules = [*field.metadata, *(rule for one in inner for rule in getattr(one, "__metadata__", ()))]
    owners = [getattr(getattr(rule, "func", None), "__self__", None) for rule in rules]
    unit = next((owner for owner in owners if isinstance(owner, Unit)), None)
    methods = next((owner.ours for owner in owners if isinstance(owner, StageMethods)), None)
    literal = next((one for one in (field.annotation, *inner) if get_origin(one) is Literal), None)
    return Parameter(
        key,
        field.description or "",
        _kind(field.annotation),
        None if field.is_required() else to_jsonable_python(field.get_default(call_default_factory=True)),
        field.is_required(),
        NoneType in inner,
        unit.name if unit is not None else "",
        tuple(unit.factors) if unit is not None else (),
        tuple((words, getattr(rule, name)) for rule in rules for words, name in _bound(rule)),
        get_args(literal),
        methods,
        field.annotation,
    )


def _bound(rule: Any) -> list[tuple[str, str]]:
    """Return words and attribute of a rule that limits a number."""
    return [bound for kind, bound in BOUNDS.items() if isinstance(rule, kind)]


def _kind(annotation: Any) -> Kind:
    """Return the kind of values of a type."""
    if get_origin(annotation) is Literal:
        return "choice"
    if get_origin(annotation) in (list, tuple):
        return "list"
    united = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else ()
    types = {annotation, *united}
    return "switch" if bool in types else "whole" if int in types else "number" if float in types else "text"


def _holds_numbers_or_choices(annotation: Any) -> bool:
    """Return whether a type holds only numbers, booleans and declared choices."""
    if annotation in (bool, int, float, NoneType) or get_origin(annotation) is Literal:
        return True
    if hasattr(annotation, "__metadata__"):  # Annotated
        return _holds_numbers_or_choices(annotation.__origin__)
    items = [item for item in get_args(annotation) if item is not ...]
    is_container = get_origin(annotation) in (tuple, list, Union, UnionType)
    return is_container and bool(items) and all(map(_holds_numbers_or_choices, items))


def unknown_key(key: str, known: Sequence[str]) -> str:
    """Return the sentence for an unknown key, with the nearest of the ``known`` keys."""
    choices = {k.replace(".params.", "."): k for k in [*known, *TUTORIAL_NAMES]}
    by_last = [k for k in choices if k.rsplit(".", 1)[-1] == key.rsplit(".", 1)[-1]]
    begun = [k for k in choices if k.startswith(key) and "." in key]  # a name that was cut short
    near = by_last or begun or difflib.get_close_matches(key.replace(".params.", "."), choices, 1, 0.3)
    hint = f"; did you mean '{choices[near[0]]}'?" if near else ""
    return f"unknown key '{key}'{hint} ('bevviz config' lists all)"
