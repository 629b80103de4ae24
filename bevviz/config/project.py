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

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from bevviz.config import (
    BUILTIN_METHODS,
    METHOD_KEYS,
    TUTORIAL_NAMES,
    Config,
    Layer,
    Preset,
    flatten,
    is_stage_file,
    plugins,
    read_layer,
)
from bevviz.config.files import read_toml
from bevviz.config.methods import CLASS_LISTS
from bevviz.config.trust import USER, NamedCode, trust_in
from bevviz.errors import UserError
from bevviz.support.text import did_you_mean, short_repr

NAME = "bevviz.toml"
MODEL = "BEVVIZ_MODEL"


def _as_list(value: Any) -> Any:
    """Return a single string as a list."""
    return [value] if isinstance(value, str) else value


class ProjectFile(BaseModel):
    """Keys that only a project file has. Its sections are those of ``Config``."""

    model_config = ConfigDict(extra="allow", strict=True)

    model: str = Field("", description="as --model")
    config: Annotated[list[str], BeforeValidator(_as_list)] = Field([], description="as --config")
    preset: Preset | None = Field(None, description="as --preset")


def read_project_layers(folder: Path, environment: Mapping[str, str] = os.environ) -> list[Layer]:
    """Return the layers of a folder's project, the weakest first.

    Raises:
        UserError: the project file, or a file that it names, cannot be used.
    """
    path = find_project_file(folder)
    project_layers: list[Layer] = []
    if path is not None:
        file_layers = _read_layers(path)
        trust = trust_in(_named_code(path, file_layers))
        project_layers = [replace(layer, trust=trust) for layer in file_layers]
    if model := environment.get(MODEL, "").strip():
        project_layers.append(Layer(MODEL, {"detector.model": model}, USER))
    return project_layers


def find_project_file(folder: Path) -> Path | None:
    """Find the nearest project file, in the folder or above.

    Raises:
        UserError: a folder cannot be read.
    """
    for parent in (folder, *folder.parents):
        path = parent / NAME
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
    return _named_code(path, _read_layers(path) if path.suffix == ".toml" else [read_layer(path)])


def _named_code(path: Path, file_layers: Sequence[Layer]) -> NamedCode:
    """Return the functions that the layers of a file name."""
    files = [Path(layer.where) for layer in file_layers if layer.where != str(path)]
    functions = dict.fromkeys(function for layer in file_layers for function in layer.functions)
    return NamedCode((path, *files), tuple(functions))


def _read_layers(path: Path) -> list[Layer]:
    """Read the YAML files that a project file names, and then the project file itself."""
    try:
        project = ProjectFile.model_validate(read_toml(path, f"{path}: cannot read the project file"))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(item) for item in first["loc"])
        description = ProjectFile.model_fields[str(first["loc"][0])].description
        message = first["msg"].replace("Input should be", "must be")
        raise UserError(
            f"{path}: {key} {message} (given: {short_repr(first['input'])}); it is {description}"
        ) from None
    sections = project.model_extra or {}
    known = [*ProjectFile.model_fields, *Config.model_fields, *TUTORIAL_NAMES]
    for name in sections:
        if name not in known and "." not in name:
            raise UserError(f"{path}: unknown key '{name}'{did_you_mean(name, known)}")
    own_values = flatten(sections)
    if project.preset is not None:
        own_values["preset"] = project.preset
    if project.model:
        own_values["detector.model"] = project.model
    for key in ("detector.model", "detector.names"):
        if isinstance(own_values.get(key), str):
            own_values[key] = _relative_to(path.parent, key, own_values[key])
    for section, name in METHOD_KEYS.items():
        if is_stage_file(section, str(own_values.get(key := f"{section}.{name}", ""))):
            own_values[key] = str(path.parent / own_values[key])
    yaml_layers = [read_layer(path.parent / name, pipe=False) for name in project.config]
    return [*yaml_layers, Layer(str(path), own_values, folder=path.parent)]


def _relative_to(folder: Path, key: str, value: str) -> str:
    """Return a file name relative to a folder. A name that is no file stays as it is."""
    known = (*BUILTIN_METHODS, *plugins.registered()) if key == "detector.model" else CLASS_LISTS
    return value if not value or value in known or ":" in value else str(folder / value)
