"""Settings of a project for every command: ``bevviz.toml`` in the folder or above, and ``BEVVIZ_MODEL``.

    model = "models/yolo11n.onnx"      # file names are relative to this file
    config = "robot.yaml"              # or several, later ones winning
    preset = "default"

    [source]                           # and any other section, as 'bevviz config' prints them
    lidar_topics = ["/front/points", "/rear/points"]

The command line wins over the environment. The environment wins over the project file, and the project file
wins over the preset.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from bevviz.config import (
    OURS,
    TUTORIAL_NAMES,
    Config,
    Layer,
    Preset,
    flattened,
    plugins,
    read_layer,
)
from bevviz.config.files import toml_tree
from bevviz.config.methods import CLASS_LISTS
from bevviz.config.pillars import is_network
from bevviz.config.trust import USER, NamedCode, trust_in
from bevviz.errors import UserError
from bevviz.support.text import shown

NAME = "bevviz.toml"
MODEL = "BEVVIZ_MODEL"


def _several(given: Any) -> Any:
    """Return a single string as a list."""
    return [given] if isinstance(given, str) else given


class ProjectFile(BaseModel):
    """Keys that only a project file has. Its sections are those of ``Config``."""

    model_config = ConfigDict(extra="allow", strict=True)

    model: str = Field("", description="as --model")
    config: Annotated[list[str], BeforeValidator(_several)] = Field([], description="as --config")
    preset: Preset | None = Field(None, description="as --preset")


def layers(folder: Path, environment: Mapping[str, str] = os.environ) -> list[Layer]:
    """Return the layers of a folder's project, the weakest first.

    Raises:
        UserError: the project file, or a file that it names, cannot be used.
    """
    path = find(folder)
    found: list[Layer] = []
    if path is not None:
        stated = _of_file(path)
        trust = trust_in(_code(path, stated))
        found = [replace(layer, trust=trust) for layer in stated]
    if model := environment.get(MODEL, "").strip():
        found.append(Layer(MODEL, {"detector.model": model}, USER))
    return found


def find(folder: Path) -> Path | None:
    """Find the nearest project file, in the folder or above.

    Raises:
        UserError: a folder cannot be read.
    """
    for place in (folder, *folder.parents):
        path = place / NAME
        try:
            is_there = path.is_file()
        except OSError as error:
            raise UserError(f"{path}: cannot read the project file: {error.strerror}") from None
        if is_there:
            return Path(os.path.relpath(path))
    return None


def named_code(path: Path) -> NamedCode:
    """Return the functions that a project file or a YAML file names.

    Raises:
        UserError: the file, or a file that it names, cannot be used.
    """
    return _code(path, _of_file(path) if path.suffix == ".toml" else [read_layer(path)])


def _code(path: Path, stated: Sequence[Layer]) -> NamedCode:
    """Return the functions that the layers of a file name."""
    files = [Path(layer.where) for layer in stated if layer.where != str(path)]
    functions = dict.fromkeys(function for layer in stated for function in layer.functions)
    return NamedCode((path, *files), tuple(functions))


def _of_file(path: Path) -> list[Layer]:
    """Read the YAML files that a project file names, and then the project file itself."""
    try:
        stated = ProjectFile.model_validate(toml_tree(path, f"{path}: cannot read the project file"))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        about = ProjectFile.model_fields[str(first["loc"][0])].description
        message = first["msg"].replace("Input should be", "must be")
        raise UserError(f"{path}: {key} {message} (given: {shown(first['input'])}); it is {about}") from None
    sections = stated.model_extra or {}
    known = [*ProjectFile.model_fields, *Config.model_fields, *TUTORIAL_NAMES]
    for name in sections:
        if name not in known and "." not in name:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise UserError(f"{path}: unknown key '{name}'{hint}")
    own = flattened(sections)
    if stated.preset is not None:
        own["preset"] = stated.preset
    if stated.model:
        own["detector.model"] = stated.model
    for key in ("detector.model", "detector.names"):
        if isinstance(own.get(key), str):
            own[key] = _from(path.parent, key, own[key])
    for key in ("objects.method", "objects.encoder", "objects.params.encoder"):
        if is_network(str(own.get(key, ""))):
            own[key] = str(path.parent / own[key])
    named = [read_layer(path.parent / name, pipe=False) for name in stated.config]
    return [*named, Layer(str(path), own)]


def _from(folder: Path, key: str, value: str) -> str:
    """Return a file name relative to a folder. A name that is no file stays as it is."""
    known = (*OURS, *plugins.registered()) if key == "detector.model" else CLASS_LISTS
    return value if not value or value in known or ":" in value else str(folder / value)
