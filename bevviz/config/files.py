"""Configurations as YAML files."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bevviz.config.methods import METHOD_KEYS
from bevviz.config.parameters import Parameter, parameters
from bevviz.config.plugins import is_user_function
from bevviz.config.sections import Config
from bevviz.config.trust import RECEIVED, NamedCode, Trust, trust_in
from bevviz.config.values_by_key import flatten
from bevviz.errors import UserError, first_line
from bevviz.support.files import read_text
from bevviz.support.limits import CONFIG_LIMIT, MOST_DOTS, MOST_VALUES

RECORDINGS = frozenset({".rrd", ".mcap", ".bag", ".db3"})  # suffixes of files that are no configuration


@dataclass(frozen=True, slots=True)
class Layer:
    """Values by dotted key, and where they are stated.

    Attributes:
        where: name of the source, for error messages.
        values: values by dotted key.
        trust: whether functions among the values may run. By default they may not.
        folder: folder that files in parameters of stages are relative to. None: the working directory.
    """

    where: str
    values: Mapping[str, Any]
    trust: Trust = RECEIVED
    folder: Path | None = None

    @property
    def functions(self) -> tuple[str, ...]:
        """The ``module:function`` of every stage for which the values name one."""
        methods = (self.values.get(f"{section}.{key}") for section, key in METHOD_KEYS.items())
        return tuple(method for method in methods if isinstance(method, str) and is_user_function(method))


def read_layer(path: Path, *, pipe: bool = True) -> Layer:
    """Read the values that a YAML file states. Its functions may run only if the user has trusted the file.

    Args:
        path: the file.
        pipe: whether the file may be a pipe of the shell, ``<(...)``.

    Raises:
        UserError: the file cannot be read.
    """
    layer = Layer(str(path), flatten(_read_yaml(path, pipe)))
    return replace(layer, trust=trust_in(NamedCode((path,), layer.functions)))


def _read_yaml(path: Path, pipe: bool) -> Mapping[str, Any]:
    """Read the tree of sections of a YAML file.

    Raises:
        UserError: the file cannot be read, or is no tree of sections.
    """
    if path.suffix in RECORDINGS:
        raise UserError(f"{path} is a recording; --config takes a YAML file, as 'bevviz config' prints it")
    problem = f"{path}: cannot read the configuration"
    tree = parse_yaml(read_text(path, CONFIG_LIMIT, problem=problem, pipe=pipe), str(path))
    if tree is None:
        return {}
    if not isinstance(tree, Mapping):
        raise UserError(f"{path}: expected 'section: {{key: value}}' lines, as 'bevviz config' prints them")
    return tree


def parse_yaml(text: str, where: str) -> Any:
    """Parse YAML.

    Args:
        text: YAML.
        where: name of the source, for error messages.

    Raises:
        UserError: the text is not valid YAML, or its aliases stand for too many values.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        tree = YAML(typ="safe", pure=True).load(text)
        _check_size(tree, where)
    except YAMLError as error:
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        mark = getattr(error, "problem_mark", None)
        line = f" line {mark.line + 1}" if mark else ""
        raise UserError(f"{where}:{line} is not valid YAML: {problem}") from None
    except RecursionError:
        raise UserError(f"{where}: is not valid YAML for a configuration: too deep") from None
    except (ValueError, OverflowError) as error:  # a date that does not exist
        raise UserError(f"{where}: is not valid YAML: {error}") from None
    return tree


def _check_size(tree: Any, where: str) -> None:
    """Refuse YAML whose aliases stand for too many values. A few lines can stand for billions.

    Raises:
        UserError: there are more than ``MOST_VALUES``.
    """
    sizes: dict[int, int] = {}

    def size(value: Any) -> int:
        if not isinstance(value, list | dict):
            return 1
        if id(value) not in sizes:
            sizes[id(value)] = 1  # for a node that contains itself
            sizes[id(value)] = 1 + sum(map(size, value.values() if isinstance(value, dict) else value))
        return sizes[id(value)]

    if size(tree) > MOST_VALUES:
        raise UserError(f"{where}: its aliases stand for more than {MOST_VALUES:,} values")


def read_toml(path: Path, problem: str) -> dict[str, Any]:
    """Read a TOML file.

    Args:
        path: the file.
        problem: beginning of the error message if the file cannot be read.

    Raises:
        UserError: the file cannot be read, or is not TOML.
    """
    text = read_text(path, CONFIG_LIMIT, problem=problem)
    if any(line.count(".") > MOST_DOTS for line in text.splitlines()):
        raise UserError(f"{path}: is no TOML for a configuration: a line has more than {MOST_DOTS} dots")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise UserError(f"{path}: is no TOML for a configuration: too deep") from None
    except ValueError as error:  # also for a number of thousands of digits
        raise UserError(f"{path}: is no TOML: {first_line(error)}") from None


def config_yaml(config: Config) -> str:
    """Return the configuration as YAML, with the unit and meaning of each parameter. ``load`` can read it."""
    table = parameters(config)
    lines = []
    for section, content in config.model_dump(mode="json").items():
        if not isinstance(content, dict):
            lines.append(f"{section}: {json.dumps(content)}")
            continue
        lines.append(f"{section}:")
        params = content.pop("params", {})
        for name, value in content.items():
            note = _note(table[f"{section}.{name}"])
            if isinstance(value, dict) and value:
                lines.append(f"  {name}:{note}")
                lines += [f"    {json.dumps(key)}: {json.dumps(inner)}" for key, inner in value.items()]
            else:
                lines.append(f"  {name}: {json.dumps(value)}{note}")
        if params:
            lines.append("  params:")
        for name, value in params.items():
            lines.append(f"    {name}: {json.dumps(value)}{_note(table[f'{section}.params.{name}'])}")
    return "\n".join(lines) + "\n"


def _note(parameter: Parameter) -> str:
    """Return the comment with the unit and meaning of a parameter."""
    text = (f"in {parameter.unit}; " if parameter.unit else "") + parameter.text
    return f"  # {text}" if text else ""


def flat_yaml(text: str, where: str) -> dict[str, Any]:
    """Return the values by dotted key of YAML that ``config_yaml`` of any version has written.

    Args:
        text: YAML.
        where: name of the source, for error messages.

    Raises:
        UserError: the text is not valid YAML.
    """
    return flatten(parse_yaml(text, where) or {})


def stated_lines(config: Config, *, folders: bool = True) -> list[str]:
    """Return one line for each source of values, with the keys it states: ``bevviz.toml: clustering.eps``.

    Args:
        config: the configuration.
        folders: whether to write the folder of a file.
    """
    keys_of: dict[str, list[str]] = {}
    for key, where in config.stated.items():
        source = "command line" if where.startswith("--") else where if folders else Path(where).name
        keys_of.setdefault(source, []).append(key)
    return [f"{source}: {', '.join(names)}" for source, names in keys_of.items()]
