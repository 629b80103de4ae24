"""Methods that a stage can name, and their parameters: built-in, a function, a network, or a topic."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from bevviz.config import plugins
from bevviz.config.module_folder import ModuleFolder
from bevviz.config.pillars import PillarParams, is_network_file
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
    name = method
    if names_function(section, method):
        if (section, method) not in functions:  # ``load`` did not build this configuration.
            raise UserError(f"{section}.{METHOD_KEYS[section]} {method}: no function that the user has named")
        folder = functions[section, method]
    else:
        is_builtin = method in BUILTIN_METHODS or (section == "detector" and Path(method).exists())
        name = "" if is_builtin else plugins.registered().get(method, "")
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


def object_network_params(config: Config) -> PillarParams | None:
    """Return the parameters of the 3D detector file that ``objects.method`` names, or None."""
    return (
        PillarParams.model_validate(config.objects.params) if is_network_file(config.objects.method) else None
    )


def object_files(config: Config) -> dict[str, str]:
    """Return the files of the 3D detector, by the dotted key that names each."""
    params = object_network_params(config)
    if params is None:
        return {}
    files = {"objects.method": config.objects.method, "objects.params.encoder": params.encoder}
    return {key: file for key, file in files.items() if file}


def with_object_files(config: Config, rename: Callable[[str], str]) -> Config:
    """Return the configuration with the files of the 3D detector renamed by ``named``."""
    files = object_files(config)
    if not files:
        return config
    encoder = rename(files.get("objects.params.encoder", "")) if len(files) > 1 else ""
    params = {**config.objects.params, "encoder": encoder}
    changed = {"method": rename(files["objects.method"]), "params": params}
    return config.model_copy(update={"objects": config.objects.model_copy(update=changed)})


def params_model(section: str, method: str, functions: Functions) -> type[BaseModel] | None:
    """Return the model of the additional parameters of a stage, or None.

    Args:
        section: name of the section.
        method: method that the section names.
        functions: ``Config.functions``.
    """
    if section == "objects" and is_network_file(method):
        return PillarParams
    plugin = _plugin(section, method, functions)
    return None if plugin is None else plugin.params


def params_of(config: Config, section: str) -> Mapping[str, FieldInfo]:
    """Return the additional parameters of a stage: those of a function or of a network on pillars."""
    if section not in METHOD_KEYS:
        return {}
    model = params_model(section, method_of(config, section), config.functions)
    return {} if model is None else model.model_fields
