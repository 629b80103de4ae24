"""Description of one parameter: meaning, unit, range, current value and where it was stated."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from typing import Any

from bevviz.config import TUTORIAL_NAMES, Config, Parameter, load, parameters, unknown_key, values
from bevviz.errors import UserError, printable

WIDTH = 100


def describe_parameters(asked: str, config: Config) -> str:
    """Describe a parameter, or all parameters of a section.

    Args:
        asked: dotted key, tutorial name or section.
        config: configuration in force.

    Raises:
        UserError: no key has this name. The message names the nearest one.
    """
    table = parameters(config)
    key = TUTORIAL_NAMES.get(asked, asked)
    if key in table:
        return "\n".join(_lines(table[key], config))
    inside = [parameter for name, parameter in table.items() if name.startswith(f"{key}.")]
    if not inside:
        raise UserError(unknown_key(asked, [*table]))
    current = values(config)
    return "\n".join(
        _wrapped(f"{parameter.key} = {_value(current[parameter.key])}", parameter.text)
        for parameter in inside
    )


def _lines(parameter: Parameter, config: Config) -> Iterator[str]:
    """Yield the lines that describe one parameter."""
    key = parameter.key
    yield f"{key} = {_value(values(config)[key])}"
    if parameter.text:
        yield textwrap.fill(parameter.text, WIDTH, initial_indent="  ", subsequent_indent="  ")
    if parameter.unit:
        yield f"  unit       {parameter.unit}; a unit can be given: {', '.join(parameter.spellings)}"
    if parameter.allowed:
        yield f"  allowed    {parameter.allowed}"
    presets = {name: values(load(preset=name)).get(key) for name in ("default", "reference")}
    if key in parameters() and key != "preset":
        yield "  presets    " + ", ".join(f"{name}: {_value(value)}" for name, value in presets.items())
    if parameter.aliases:
        yield f"  tutorial   {', '.join(parameter.aliases)}, which is accepted, too"
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
