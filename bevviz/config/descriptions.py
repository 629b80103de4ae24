"""Description of one parameter: meaning, unit, range, current value and where it was stated."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from typing import Any, Literal, get_args, get_origin

import annotated_types
from pydantic.fields import FieldInfo

from bevviz.config import (
    TUTORIAL_NAMES,
    Config,
    field_of,
    keys,
    load,
    unit,
    unit_spellings,
    unknown_key,
    values,
)
from bevviz.errors import UserError
from bevviz.support.text import printable

WIDTH = 100


def describe_parameters(asked: str, config: Config) -> str:
    """Describe a parameter, or all parameters of a section.

    Args:
        asked: dotted key, tutorial name or section.
        config: configuration in force.

    Raises:
        UserError: no key has this name. The message names the nearest one.
    """
    descriptions = keys(config)
    key = TUTORIAL_NAMES.get(asked, asked)
    if key in descriptions:
        return "\n".join(_lines(key, config, descriptions[key]))
    names_inside = [name for name in descriptions if name.startswith(f"{key}.")]
    if not names_inside:
        raise UserError(unknown_key(asked, [*descriptions]))
    current = values(config)
    return "\n".join(
        _wrapped(f"{name} = {_value(current[name])}", descriptions[name]) for name in names_inside
    )


def _lines(key: str, config: Config, description: str) -> Iterator[str]:
    """Yield the lines that describe one parameter."""
    yield f"{key} = {_value(values(config)[key])}"
    if description:
        yield textwrap.fill(description, WIDTH, initial_indent="  ", subsequent_indent="  ")
    info, in_all_configs = field_of(key, config), field_of(key) is not None
    if spellings := unit_spellings(key):
        yield f"  unit       {unit(key)}; a unit can be given: {', '.join(spellings)}"
    if info is not None and (allowed := _allowed(info)):
        yield f"  allowed    {allowed}"
    presets = {name: values(load(preset=name)).get(key) for name in ("default", "reference")}
    if in_all_configs and key != "preset":
        yield "  presets    " + ", ".join(f"{name}: {_value(value)}" for name, value in presets.items())
    if names := [name for name, target in TUTORIAL_NAMES.items() if target == key]:
        yield f"  tutorial   {', '.join(names)}, which is accepted, too"
    yield f"  stated by  {printable(config.stated.get(key, '')) or f'the preset, {config.preset}'}"
    if key == "preset":
        yield "  change it  --preset NAME, or in a file 'preset: NAME'"
        return
    section, _, name = key.partition(".")
    in_yaml, table = f"{section}: {{{name}: VALUE}}", section
    if name.startswith("params."):
        in_yaml, table = (
            f"{section}: {{params: {{{name.removeprefix('params.')}: VALUE}}}}",
            f"{section}.params",
        )
    yield f"  change it  --set {key}=VALUE, in YAML '{in_yaml}', in bevviz.toml under [{table}]"


def _allowed(info: FieldInfo) -> str:
    """Return the choices or the range of a parameter in words."""
    annotation = info.annotation
    options = [a for a in (annotation, *get_args(annotation)) if get_origin(a) is Literal]
    if options:
        return ", ".join(map(str, get_args(options[0])))
    rules = [
        *info.metadata,
        *(bound for inner in get_args(annotation) for bound in getattr(inner, "__metadata__", ())),
    ]
    words = []
    for rule in rules:
        words += [f"at least {rule.ge}"] if isinstance(rule, annotated_types.Ge) else []
        words += [f"above {rule.gt}"] if isinstance(rule, annotated_types.Gt) else []
        words += [f"at most {rule.le}"] if isinstance(rule, annotated_types.Le) else []
        words += [f"below {rule.lt}"] if isinstance(rule, annotated_types.Lt) else []
    empty = ["or empty"] if type(None) in get_args(annotation) else []
    return ", ".join([*words, *empty])


def _value(value: Any) -> str:
    """Return a value as text of at most ``WIDTH`` characters."""
    import json

    def plain(item: Any) -> Any:
        return dict(item) if hasattr(item, "items") else str(item)

    text = "empty" if value in (None, "", ()) else json.dumps(value, default=plain)
    return text if len(text) <= WIDTH else f"{text[: WIDTH - 4]} ..."


def _wrapped(head: str, description: str) -> str:
    """Return a line with its description wrapped below it."""
    return f"{head}\n{textwrap.fill(description, WIDTH, initial_indent='  ', subsequent_indent='  ')}"
