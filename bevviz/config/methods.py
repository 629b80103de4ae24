"""Methods that a stage can name, and their parameters: built-in, a function, a file, or a topic."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from bevviz.config import plugins
from bevviz.config.module_folder import ModuleFolder
from bevviz.config.plugins import TOPIC
from bevviz.config.sections import Config, Functions
from bevviz.config.value_types import CLUSTERING, GROUND, OBJECTS
from bevviz.errors import UserError

BUILTIN_METHODS = ("", "demo", *GROUND.ours, *CLUSTERING.ours, *OBJECTS.ours)
CLASS_LISTS = ("coco", "coco91")  # values of detector.names that name no file
METHOD_KEYS = {  # section -> key that names the function
    "ground": "method",
    "clustering": "method",
    "detector": "model",
    "objects": "method",
}


def method_of(config: Config, section: str) -> str:
    """Return the method that a stage's section names."""
    return str(getattr(getattr(config, section), METHOD_KEYS[section]))


def plugin_of(config: Config, section: str) -> plugins.Plugin | None:
    """Return the user-defined function of a stage's section, or None for a built-in method or a topic.

    Raises:
        UserError: the function cannot be loaded.
    """
    return _plugin(section, method_of(config, section), config.functions)


def names_function(section: str, method: str) -> bool:
    """Return whether a stage's section names ``module:function``."""
    if not plugins.is_user_function(method):
        return False
    return section != "detector" or not Path(method).exists()


def _plugin(section: str, method: str, functions: Functions) -> plugins.Plugin | None:
    """Load the user-defined function of a method, or return None."""
    folder: ModuleFolder | None = None
    name = ""
    if names_function(section, method):
        if (section, method) not in functions:  # ``load`` did not build this configuration.
            raise UserError(f"{section}.{METHOD_KEYS[section]} {method}: no function that the user has named")
        name, folder = method, functions[section, method]
    else:
        is_builtin = method in BUILTIN_METHODS or (section == "detector" and Path(method).exists())
        if not is_builtin:
            name = plugins.file_stage(section, method) or plugins.registered().get(method, "")
    if not name:
        return None
    try:
        return plugins.load_plugin(name, folder)
    except UserError as error:
        raise UserError(f"{section}.{METHOD_KEYS[section]} {method}: {error}") from error.__cause__


def stage_topics(config: Config) -> dict[str, str]:
    """Return the robot's topics that replace stages, by the dotted key that names each."""
    methods = {f"{section}.{key}": method_of(config, section) for section, key in METHOD_KEYS.items()}
    return {key: name.removeprefix(TOPIC) for key, name in methods.items() if name.startswith(TOPIC)}


def is_stage_file(section: str, method: str) -> bool:
    """Return whether a stage's section names a file that a registered stage reads."""
    return bool(plugins.file_stage(section, method))


def same_stage(section: str, method: str, other: str) -> bool:
    """Return whether two methods of a section are the same function, or two files of one stage."""
    return method == other or "" != plugins.file_stage(section, method) == plugins.file_stage(section, other)


def method_label(config: Config, section: str) -> str:
    """Return the name of a user-defined stage for sentences: ``module:function``, or the name of its file."""
    method = method_of(config, section)
    if is_stage_file(section, method):
        return Path(method).name
    plugin = plugin_of(config, section)
    return "" if plugin is None else plugin.name


def holds_file(info: FieldInfo) -> bool:
    """Return whether a parameter names a file: its type is Path, also of pydantic's kinds, or optional."""
    kinds = get_args(info.annotation) or (info.annotation,)
    return any(isinstance(kind, type) and issubclass(kind, Path) for kind in kinds)


def stage_files(config: Config) -> dict[str, str]:
    """Return the files of user-defined stages, by the dotted key that names each."""
    files: dict[str, str] = {}
    for section, key in METHOD_KEYS.items():
        if is_stage_file(section, method := method_of(config, section)):
            files[f"{section}.{key}"] = method
        for name, info in params_of(config, section).items():
            file = getattr(config, section).params.get(name)
            if file and holds_file(info):
                files[f"{section}.params.{name}"] = str(file)
    return files


def with_stage_files(config: Config, rename: Callable[[str], str]) -> Config:
    """Return the configuration with the files of user-defined stages renamed."""
    renamed = {key: rename(file) for key, file in stage_files(config).items()}
    sections: dict[str, Any] = {}
    for section, key in METHOD_KEYS.items():
        prefix = f"{section}.params."
        params = {k.removeprefix(prefix): file for k, file in renamed.items() if k.startswith(prefix)}
        settings = getattr(config, section)
        update: dict[str, Any] = {"params": {**settings.params, **params}} if params else {}
        if (method := renamed.get(f"{section}.{key}")) is not None:
            update[key] = method
        if update:
            sections[section] = settings.model_copy(update=update)
    return config.model_copy(update=sections) if sections else config


def params_model(section: str, method: str, functions: Functions) -> type[BaseModel] | None:
    """Return the model of the additional parameters of a stage, or None.

    Args:
        section: name of the section.
        method: method that the section names.
        functions: ``Config.functions``.
    """
    plugin = _plugin(section, method, functions)
    return None if plugin is None else plugin.params


def params_of(config: Config, section: str) -> Mapping[str, FieldInfo]:
    """Return the additional parameters of a stage: those of a user-defined function."""
    if section not in METHOD_KEYS:
        return {}
    model = params_model(section, method_of(config, section), config.functions)
    return {} if model is None else model.model_fields
