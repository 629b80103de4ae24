"""Build the effective configuration from presets, files and settings, with one-line errors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from bevviz.config.files import Layer, parse_yaml, read_layer
from bevviz.config.methods import (
    METHOD_KEYS,
    holds_file,
    is_stage_file,
    names_function,
    params_model,
    same_stage,
)
from bevviz.config.module_folder import ModuleFolder
from bevviz.config.parameters import TUTORIAL_NAMES, parameter, parameters, unknown_key
from bevviz.config.sections import Config, Functions, Preset
from bevviz.config.trust import MESSAGE, RECEIVED, USER, Trust
from bevviz.config.value_types import COMPLETE_SENTENCE
from bevviz.config.values_by_key import flatten, values
from bevviz.errors import UserError
from bevviz.support.text import short_repr

BASE = "configuration"  # source name of values that come from a whole configuration

REFERENCE: dict[str, dict[str, Any]] = {
    "voxel": {"size": 0.05, "average": True},
    "ground": {"method": "plane", "distance_threshold": 0.5, "iterations": 100},
    "clustering": {
        "eps": 0.5,
        "min_points": 50,
        "min_cluster_points": 1,
        "max_cluster_points": None,  # The tutorial declares 1000 and never applies it.
        "boxes": "axis_aligned",
    },
    "detector": {"conf_threshold": 0.25},
    "fusion": {"method": "centroid", "match_radius": 150.0},
    "odometry": {"method": "none"},
    "tracking": {"method": "none"},
    "bev": {"range_x": 10.0, "range_y": 10.0, "resolution": 0.05, "style": "reference"},
    "sync": {"motion_compensation": False},
}


def load(
    file: str | Path | Sequence[Path] | None = None,
    settings: Iterable[str | Layer] = (),
    preset: Preset | None = None,
    base: Config | Layer | None = None,
    layers: Iterable[Layer] = (),
    in_force: Config | None = None,
) -> Config:
    """Build the effective configuration.

    The preset comes first, then the layers, the files, and each ``key=value``. Later values win.

    A function (``module:function``) runs only if the user has named it, or has trusted the file that names
    it. Each value comes in a layer whose ``trust`` says so. Only this function decides it.

    Args:
        file: YAML files.
        settings: ``key=value`` each, typed by the user. ``untrusted_layers`` takes settings of other sources.
        preset: name of the preset. None: the preset that the files name, or else ``default``.
        base: configuration to change, or its values by dotted key.
        layers: layers of the project, see ``bevviz.config.project``.
        in_force: running configuration. Its functions may go on running.

    Raises:
        UserError: a file cannot be read, a key is unknown, a unit is wrong, a value is out of range, or a
            function may not run. The message is one line.
    """
    files = [Path(file)] if isinstance(file, str | Path) else file or ()
    base_layer = Layer(BASE, values(base)) if isinstance(base, Config) else base
    sources = [
        *([base_layer] if base_layer is not None else []),
        *layers,
        *map(read_layer, files),
        *(setting if isinstance(setting, Layer) else _setting(setting, USER) for setting in settings),
    ]
    entries = [
        (TUTORIAL_NAMES.get(key, key), value, layer)
        for layer in sources
        for key, value in layer.values.items()
    ]
    preset_name = preset or next((value for key, value, _ in reversed(entries) if key == "preset"), "default")
    preset_values = flatten(REFERENCE) if preset_name == "reference" else {}
    stated: dict[str, Any] = {}
    origin: dict[str, str] = {}
    layers_in_force: dict[str, Layer] = {}
    for key, value, layer in entries:
        section, _, name = key.partition(".")
        previous = stated.get(key, value)
        if name == METHOD_KEYS.get(section) and not same_stage(section, str(previous), str(value)):
            stated = {k: v for k, v in stated.items() if not k.startswith(f"{section}.params.")}
        stated[key], origin[key], layers_in_force[key] = value, layer.where, layer
    running_functions = [config.functions for config in (in_force, base) if isinstance(config, Config)]
    functions = _functions(entries, stated, layers_in_force, running_functions)
    param_models = _param_models({**preset_values, **stated}, origin, functions)
    params = {
        f"{section}.params.{name}": info.description or ""
        for section, model in param_models.items()
        for name, info in model.model_fields.items()
    }
    known_keys = [*parameters(), *params]
    tree: dict[str, Any] = {"preset": preset_name}
    for key, value in {**preset_values, **stated}.items():
        full = key
        if key not in known_keys:
            section, _, name = key.partition(".")
            full = f"{section}.params.{name}"
            if full not in params:
                raise UserError(f"{origin[key]}: {unknown_key(key, known_keys)}")
            origin[full], layers_in_force[full] = origin[key], layers_in_force[key]
        if full != "preset":
            _insert(tree, full, value)
    try:
        for section, model in param_models.items():
            prefix = f"{section}.params."
            stated_params = tree[section].get("params", {})
            for name, file in stated_params.items():
                stating_layer = layers_in_force.get(f"{prefix}{name}")
                folder = None if stating_layer is None else stating_layer.folder
                is_file = name in model.model_fields and holds_file(model.model_fields[name])
                if file and is_file and folder is not None:
                    stated_params[name] = str(folder / str(file))
            tree[section]["params"] = model.model_validate(stated_params).model_dump(mode="json")
        prefix = ""
        loaded = Config.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        loc = (*prefix.split(".")[:-1], *first["loc"])
        key = next((k for k in _prefixes(loc) if k in origin), ".".join(map(str, loc)))
        where = origin.get(key, BASE)
        if prefix and first["type"] == "missing":
            method_key = f"{loc[0]}.{METHOD_KEYS[str(loc[0])]}"
            method = str(stated[method_key])
            raise UserError(_lacking_stage(origin[method_key], method_key, method, key, params)) from None
        is_complete = first["type"] in ("wrong_unit", "missing", COMPLETE_SENTENCE)
        value = f" (given: {short_repr(first['input'])})" if not is_complete else ""
        declared = parameter(key)
        description = (declared.text if declared else "") or params.get(key, "")
        hint = f"; it is: {description}" if description else ""
        stated_unit = f", in {declared.unit}" if declared and declared.unit and not is_complete else ""
        raise UserError(f"{where}: {key} {_lower(first['msg'])}{stated_unit}{value}{hint}") from None
    before = base.stated if isinstance(base, Config) else {}
    loaded._stated = {
        **before,
        **{key: where for key, where in origin.items() if layers_in_force[key] is not base_layer},
    }
    loaded._functions = functions
    return loaded


def preset_differences(config: Config) -> dict[str, Any]:
    """Return the preset's value of each parameter that has another value in a configuration."""
    current = values(config)
    return {
        key: value
        for key, value in _preset_values(config.preset).items()
        if key in current and current[key] != value
    }


@cache
def _preset_values(preset: Preset) -> Mapping[str, Any]:
    return values(load(preset=preset))


def changed_config(config: Config, settings: Iterable[str], trust: Trust = MESSAGE) -> Config:
    """Return the configuration with some values changed.

    Args:
        config: configuration in force.
        settings: ``key=value`` each.
        trust: whether functions among the new values may run. Functions in force may run in any case.

    Raises:
        UserError: as ``load``.
    """
    return load(settings=[_setting(setting, trust) for setting in settings], base=config)


def untrusted_layers(settings: Iterable[str], where: str = "", trust: Trust = RECEIVED) -> list[Layer]:
    """Read settings that the user has not typed, for ``load``. Functions among them do not run.

    Args:
        settings: ``key=value`` each.
        where: name of their source, for error messages. Empty: the message quotes the setting.
        trust: trust with the advice to give to the user.

    Raises:
        UserError: a setting is not ``key=value``.
    """
    return [_setting(setting, trust, where) for setting in settings]


def _setting(text: str, trust: Trust, where: str = "") -> Layer:
    """Parse one ``key=value``."""
    key, sep, value = text.partition("=")
    if not sep:
        raise UserError(f"--set {text}: expected key=value, for example --set clustering.eps=0.6")
    parsed = parse_yaml(value, f"--set {text}") if value.strip() else ""
    declared = parameter(key.strip())
    if isinstance(parsed, int) and declared is not None and declared.annotation is str:
        parsed = value.strip()  # The text 0001 is a name, not the number 1.
    return Layer(where or f"--set {text}", {key.strip(): parsed}, trust)


def _functions(
    entries: Iterable[tuple[str, Any, Layer]],
    stated: Mapping[str, Any],
    layers_in_force: Mapping[str, Layer],
    running_functions: Iterable[Functions],
) -> Functions:
    """Check that the user has named or trusted the functions of the stages.

    A received value is kept if a trusted layer, or the configuration in force, has the same value.

    Args:
        entries: every key and value with its layer.
        stated: values in force.
        layers_in_force: layer of each value in force.
        running_functions: functions that are in force already.

    Returns:
        The functions in force, with the folder of each module.

    Raises:
        UserError: a function may not run.
    """
    granted = {function: folder for functions in running_functions for function, folder in functions.items()}
    for key, value, layer in entries:
        section, _, name = key.partition(".")
        if layer.trust.granted and name == METHOD_KEYS.get(section) and isinstance(value, str):
            granted[section, value] = layer.trust.folder
    in_force: dict[tuple[str, str], ModuleFolder] = {}
    for section, name in METHOD_KEYS.items():
        key = f"{section}.{name}"
        method = stated.get(key)
        if not isinstance(method, str) or not names_function(section, method):
            continue
        if (section, method) not in granted:
            layer = layers_in_force[key]
            advice = layer.trust.advice.replace("{setting}", f"{key}={method}")
            raise UserError(f"{layer.where}: {key} names the function {method}, which may not run: {advice}")
        in_force[section, method] = granted[section, method]
    return in_force


def _lacking_stage(
    where: str, method_key: str, method: str, key: str, descriptions: Mapping[str, str]
) -> str:
    """Return the error about a stage whose file or first required parameter is missing."""
    head = where if method in where else f"{where}: {method_key} {method}"
    if is_stage_file(method_key.partition(".")[0], method) and not Path(method).is_file():
        return f"{head}: no such file"
    return f"{head}: it needs {key}, in a YAML file or by --set; it is: {descriptions.get(key, '')}"


def _param_models(
    stated: Mapping[str, Any], origin: Mapping[str, str], functions: Functions
) -> dict[str, type[BaseModel]]:
    """Return the model of the parameters for each section whose function has parameters."""
    models: dict[str, type[BaseModel]] = {}
    for section, key in METHOD_KEYS.items():
        method = stated.get(f"{section}.{key}")
        if not isinstance(method, str):
            continue
        try:
            model = params_model(section, method, functions)
        except UserError as error:
            raise UserError(f"{origin[f'{section}.{key}']}: {error}") from error.__cause__
        if model is not None:
            models[section] = model
    return models


def _lower(message: str) -> str:
    """Return a message of pydantic as the middle of a sentence."""
    message = message.replace("Input should be", "must be")
    return message[0].lower() + message[1:]


def _prefixes(loc: tuple[int | str, ...]) -> Iterable[str]:
    """Yield the dotted keys that contain a location, longest first."""
    for end in range(len(loc), 0, -1):
        yield ".".join(map(str, loc[:end]))


def _insert(tree: dict[str, Any], key: str, value: Any) -> None:
    """Insert the value of a dotted key into a tree."""
    *path, last = key.split(".")
    for name in path:
        tree = tree.setdefault(name, {})
    tree[last] = value
