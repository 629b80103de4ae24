"""The effective configuration, of presets, files and settings; what is wrong in them, in one line."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from bevviz.config.files import Layer, read_layer, yaml_value
from bevviz.config.keys import TUTORIAL_NAMES, flattened, keys, unit, unknown_key, values
from bevviz.config.methods import STAGES
from bevviz.config.pillars import UNFIT, is_network
from bevviz.config.sections import Config, Functions, Preset
from bevviz.config.trust import MESSAGE, RECEIVED, USER, Trust
from bevviz.config.user_stages import names_function, params_model
from bevviz.errors import UserError
from bevviz.support.text import shown

BASE = "configuration"  # where values are stated that came as a whole

REFERENCE: dict[str, dict[str, Any]] = {
    "voxel": {"size": 0.05, "average": True},
    "ground": {"method": "plane", "distance_threshold": 0.5, "iterations": 100},
    "clustering": {
        "eps": 0.5,
        "min_points": 50,
        "min_cluster_points": 1,
        "max_cluster_points": None,  # declared by the tutorial as 1000 and never applied
        "boxes": "axis_aligned",
    },
    "detector": {"conf_threshold": 0.25},
    "fusion": {"method": "centroid", "match_radius": 150.0},
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
    """The effective configuration: preset, then the layers, the files, then each ``key=value``, later ones
    winning.

    Functions (``module:function``) run only where the user has named them or has trusted the file that does:
    each value comes in a layer, whose ``trust`` says so. This is the one place where it is decided.

    Args:
        file: YAML files.
        settings: ``key=value`` each, of the user; what others have sent comes as ``received`` makes it.
        preset: which one; None: as the files say, else ``default``.
        base: a whole configuration that all of this is to change, or its values by dotted key.
        layers: of the project, see ``bevviz.config.project``.
        in_force: a configuration whose functions run already, and may go on.

    Raises:
        UserError: unreadable file, unknown key, wrong unit or value out of range, or a function that may not
            run, in one line.
    """
    files = [Path(file)] if isinstance(file, str | Path) else file or ()
    whole = Layer(BASE, values(base)) if isinstance(base, Config) else base
    sources = [
        *([whole] if whole is not None else []),
        *layers,
        *map(read_layer, files),
        *(one if isinstance(one, Layer) else _setting(one, USER) for one in settings),
    ]
    given = [
        (TUTORIAL_NAMES.get(key, key), value, layer)
        for layer in sources
        for key, value in layer.values.items()
    ]
    chosen = preset or next((value for key, value, _ in reversed(given) if key == "preset"), "default")
    of_preset = flattened(REFERENCE) if chosen == "reference" else {}
    stated: dict[str, Any] = {}
    origin: dict[str, str] = {}
    stating: dict[str, Layer] = {}
    for key, value, layer in given:
        section, _, name = key.partition(".")
        before_it = stated.get(key, value)
        if name == STAGES.get(section) and before_it != value and not _alike(before_it, value):
            stated = {k: v for k, v in stated.items() if not k.startswith(f"{section}.params.")}
        stated[key], origin[key], stating[key] = value, layer.where, layer
    running = [config.functions for config in (in_force, base) if isinstance(config, Config)]
    functions = _functions(given, stated, stating, running)
    params = _params({**of_preset, **stated}, origin, functions)
    known = [*keys(), *params]
    tree: dict[str, Any] = {"preset": chosen}
    for key, value in {**of_preset, **stated}.items():
        full = key
        if key not in known:
            section, _, name = key.partition(".")
            full = f"{section}.params.{name}"
            if full not in params:
                raise UserError(f"{origin[key]}: {unknown_key(key, known)}")
            origin[full], stating[full] = origin[key], stating[key]
        if full != "preset":
            _insert(tree, full, value)
    try:
        for section, model in _param_models(tree, functions):
            prefix = f"{section}.params."
            tree[section]["params"] = model.model_validate(tree[section].get("params", {})).model_dump(
                mode="json"
            )
        prefix = ""
        made = Config.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        loc = (*prefix.split(".")[:-1], *first["loc"])
        key = next((k for k in _prefixes(loc) if k in origin), ".".join(map(str, loc)))
        where = origin.get(key, BASE)
        if prefix and first["type"] == "missing" and is_network(method := str(tree["objects"]["method"])):
            raise UserError(
                _unfit_network(origin.get("objects.method", where), method, key, params)
            ) from None
        silent = first["type"] in ("wrong_unit", "missing", UNFIT)
        value = f" (given: {shown(first['input'])})" if not silent else ""
        about = keys().get(key) or params.get(key, "")
        hint = f"; it is: {about}" if about else ""
        stated_unit = f", in {unit(key)}" if unit(key) and not silent else ""
        raise UserError(f"{where}: {key} {_lower(first['msg'])}{stated_unit}{value}{hint}") from None
    before = base.stated if isinstance(base, Config) else {}
    made._stated = {**before, **{key: where for key, where in origin.items() if stating[key] is not whole}}
    made._functions = functions
    return made


def revised(config: Config, settings: Iterable[str], trust: Trust = MESSAGE) -> Config:
    """The configuration with other values.

    Args:
        config: that is in force.
        settings: ``key=value`` each.
        trust: whether functions among the values may run. Those that are in force may.

    Raises:
        UserError: as ``load``.
    """
    return load(settings=[_setting(setting, trust) for setting in settings], base=config)


def received(settings: Iterable[str], where: str = "", trust: Trust = RECEIVED) -> list[Layer]:
    """Read settings that the user has not typed, for ``load``: functions among them do not run.

    Args:
        settings: ``key=value`` each.
        where: they come from, for errors; empty: the setting itself is told.
        trust: with what the user can do instead.

    Raises:
        UserError: one of them is no ``key=value``.
    """
    return [_setting(setting, trust, where) for setting in settings]


def _setting(text: str, trust: Trust, where: str = "") -> Layer:
    """One ``key=value``."""
    key, sep, value = text.partition("=")
    if not sep:
        raise UserError(f"--set {text}: expected key=value, for example --set clustering.eps=0.6")
    parsed = yaml_value(value, f"--set {text}") if value.strip() else ""
    if isinstance(parsed, int) and _is_text(key.strip()):  # 0001 is a name
        parsed = value.strip()
    return Layer(where or f"--set {text}", {key.strip(): parsed}, trust)


def _functions(
    given: Iterable[tuple[str, Any, Layer]],
    stated: Mapping[str, Any],
    stating: Mapping[str, Layer],
    running: Iterable[Functions],
) -> Functions:
    """Check that the user has named the functions of the stages, or trusts who does.

    A value that was received is kept where a trusted layer, or the configuration in force, has the same.

    Args:
        given: every key and value with its layer.
        stated: the values in force.
        stating: the layer of each.
        running: functions that are in force already.

    Returns:
        The functions in force, with the folder of each one's module.

    Raises:
        UserError: a function may not run.
    """
    granted = {function: folder for functions in running for function, folder in functions.items()}
    for key, value, layer in given:
        section, _, name = key.partition(".")
        if layer.trust.granted and name == STAGES.get(section) and isinstance(value, str):
            granted[section, value] = layer.trust.folder
    found: dict[tuple[str, str], str] = {}
    for section, name in STAGES.items():
        key = f"{section}.{name}"
        method = stated.get(key)
        if not isinstance(method, str) or not names_function(section, method):
            continue
        if (section, method) not in granted:
            layer = stating[key]
            advice = layer.trust.advice.replace("{setting}", f"{key}={method}")
            raise UserError(f"{layer.where}: {key} names the function {method}, which may not run: {advice}")
        found[section, method] = granted[section, method]
    return found


def _unfit_network(where: str, method: str, key: str, about: Mapping[str, str]) -> str:
    """What a file that is named as a 3D detector lacks first: itself, or what no file tells."""
    head = where if method in where else f"{where}: objects.method {method}"
    if not Path(method).is_file():
        return f"{head}: no such file"
    return f"{head}: a 3D detector needs {key}, in a YAML file or by --set; it is: {about.get(key, '')}"


def _alike(method: Any, other: Any) -> bool:
    """Whether the parameters of one method are those of the other, too: networks, trained twice."""
    return is_network(str(method)) and is_network(str(other))


def _is_text(key: str) -> bool:
    """Whether a parameter is a text, whatever is in it."""
    section, _, name = key.partition(".")
    model = Config.model_fields[section].annotation if section in Config.model_fields else None
    return name in getattr(model, "model_fields", {}) and model.model_fields[name].annotation is str  # type: ignore[union-attr]


def _params(stated: Mapping[str, Any], origin: Mapping[str, str], functions: Functions) -> dict[str, str]:
    """Dotted keys and descriptions of the parameters of the plugins and networks that are named."""
    found: dict[str, str] = {}
    for section, key in STAGES.items():
        method = stated.get(f"{section}.{key}")
        if not isinstance(method, str):
            continue
        try:
            model = params_model(section, method, functions)
        except UserError as error:
            raise UserError(f"{origin[f'{section}.{key}']}: {error}") from error.__cause__
        if model is not None:
            fields = model.model_fields
            found |= {f"{section}.params.{name}": info.description or "" for name, info in fields.items()}
    return found


def _param_models(tree: Mapping[str, Any], functions: Functions) -> Iterator[tuple[str, type[BaseModel]]]:
    """The sections whose functions or networks have parameters of their own, with the model of these."""
    for section, key in STAGES.items():
        model = params_model(section, str(tree.get(section, {}).get(key, "")), functions)
        if model is not None:
            yield section, model


def _lower(message: str) -> str:
    message = message.replace("Input should be", "must be")
    return message[0].lower() + message[1:]


def _prefixes(loc: tuple[int | str, ...]) -> Iterable[str]:
    for end in range(len(loc), 0, -1):
        yield ".".join(map(str, loc[:end]))


def _insert(tree: dict[str, Any], key: str, value: Any) -> None:
    *path, last = key.split(".")
    for part in path:
        tree = tree.setdefault(part, {})
    tree[last] = value
