"""Configurations as YAML."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bevviz.config.dotted import flattened, keys, unit
from bevviz.config.sections import Config
from bevviz.errors import UserError


@dataclass(frozen=True, slots=True)
class Layer:
    """Values by dotted key, and where they are stated."""

    where: str
    values: Mapping[str, Any]


def read_layer(path: Path) -> Layer:
    """What a YAML file states.

    Raises:
        UserError: it cannot be read.
    """
    return Layer(str(path), flattened(_read_yaml(path)))


def _read_yaml(path: Path) -> Mapping[str, Any]:
    try:
        if path.is_fifo() and path.parts[1:2] not in (("dev",), ("proc",)):  # <(...) of a shell is welcome
            raise UserError(f"{path}: cannot read the configuration: it is no file")
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"{path}: cannot read the configuration: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is no UTF-8 text: {error.reason} at byte {error.start}") from None
    tree = yaml_value(text, str(path))
    if tree is None:
        return {}
    if not isinstance(tree, Mapping):
        raise UserError(f"{path}: expected 'section: {{key: value}}' lines, as 'bevviz config' prints them")
    return tree


def yaml_value(text: str, where: str) -> Any:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        return YAML(typ="safe", pure=True).load(text)
    except YAMLError as error:
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        mark = getattr(error, "problem_mark", None)
        line = f" line {mark.line + 1}" if mark else ""
        raise UserError(f"{where}:{line} is not valid YAML: {problem}") from None
    except RecursionError:
        raise UserError(f"{where}: is not valid YAML for a configuration: too deep") from None
    except (ValueError, OverflowError) as error:  # a date that is none
        raise UserError(f"{where}: is not valid YAML: {error}") from None


def dump(config: Config) -> str:
    """The configuration as YAML with each parameter's unit and meaning, readable back by ``load``."""
    about = keys(config)
    lines = []
    for section, content in config.model_dump(mode="json").items():
        if not isinstance(content, dict):
            lines.append(f"{section}: {json.dumps(content)}")
            continue
        lines.append(f"{section}:")
        params = content.pop("params", {})
        for name, value in content.items():
            note = _note(f"{section}.{name}", about)
            if isinstance(value, dict) and value:
                lines.append(f"  {name}:{note}")
                lines += [f"    {json.dumps(key)}: {json.dumps(inner)}" for key, inner in value.items()]
            else:
                lines.append(f"  {name}: {json.dumps(value)}{note}")
        if params:
            lines.append("  params:")
        for name, value in params.items():
            lines.append(f"    {name}: {json.dumps(value)}{_note(f'{section}.params.{name}', about)}")
    return "\n".join(lines) + "\n"


def _note(key: str, about: Mapping[str, str]) -> str:
    text = (f"in {unit(key)}; " if unit(key) else "") + about.get(key, "")
    return f"  # {text}" if text else ""


def flat_yaml(text: str, where: str) -> dict[str, Any]:
    """Dotted keys and values of what ``dump`` has written, by this version or another.

    Raises:
        UserError: no YAML; ``where`` says whose.
    """
    return flattened(yaml_value(text, where) or {})


def stated_lines(config: Config, *, folders: bool = True) -> list[str]:
    """For each place that states parameters one line, with their names: ``bevviz.toml: clustering.eps``."""
    found: dict[str, list[str]] = {}
    for key, where in config.stated.items():
        place = "command line" if where.startswith("--") else where if folders else Path(where).name
        found.setdefault(place, []).append(key)
    return [f"{place}: {', '.join(names)}" for place, names in found.items()]
