"""Look up functions that a configuration names by ``module:name`` or by a registered name."""

from __future__ import annotations

import importlib
import re
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, packages_distributions
from importlib.metadata import version as installed_version
from inspect import Parameter, signature, unwrap
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from pydantic import BaseModel

from bevviz.config.module_folder import WORKING_DIRECTORY, ModuleFolder, import_module
from bevviz.errors import UserError, first_line
from bevviz.support import extensions

TOPIC = "topic:"
PARAMS = "Params"  # name of the pydantic model of the parameters, in the function's module
POSITIONAL = (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
# Allowed names of a stage's first parameter.
CLOUD_PARAMETER_NAMES = (
    "points",
    "cloud",
    "point_cloud",
    "pointcloud",
    "pts",
    "xyz",
    "xyzi",
    "voxels",
    "obstacles",
)
IMAGE_PARAMETER_NAMES = ("image", "img", "bgr", "frame", "picture")
_ARRAY_ANNOTATION = re.compile(r"\b(ndarray|NDArray|ArrayLike|Tensor)\b")
FACTS = ("stamp", "number", "sensor")  # of the frame; a stage gets those that it has parameters for
# Of the configuration; a class gets those that its constructor has parameters for.
SETTINGS = ("file", "provider", "threads")
STAGE_HINT = "write a function whose first parameter is 'points' or 'image' (docs/stages.md)"


@dataclass(frozen=True, slots=True)
class Plugin:
    """A user-defined function, or a class that is instantiated once.

    Attributes:
        name: ``module:name``, also if the configuration has a registered name.
        target: the function or class.
        params: model of its parameters. None: it has none.
        takes_params: whether it takes its parameters as an argument after the array.
        facts: those of ``FACTS`` that it has parameters for.
        settings: those of ``SETTINGS`` that the constructor of a class has parameters for.
    """

    name: str
    target: Callable[..., Any]
    params: type[BaseModel] | None
    takes_params: bool
    facts: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()

    @property
    def module(self) -> str:
        """Name of the module."""
        return self.name.partition(":")[0]

    @property
    def file(self) -> Path | None:
        """File that the module was loaded from, or None if there is no file."""
        path = getattr(sys.modules.get(self.module), "__file__", None)
        return Path(path) if path else None

    @property
    def version(self) -> str:
        """Name and version of its distribution, else the version that its package states, else empty."""
        package = self.module.partition(".")[0]
        for distribution in packages_distributions().get(package, ()):
            return f"{distribution} {installed_version(distribution)}"
        return str(getattr(sys.modules.get(package), "__version__", ""))


def registered() -> dict[str, str]:
    """Return the ``module:name`` of each name that installed packages registered."""
    points = extensions.registered("stages")
    return {name: point.value for name, point in points.items() if "." not in name}


def file_stages(section: str) -> dict[str, str]:
    """Return the ``module:name`` that reads files, by their suffix, as installed packages registered it.

    The entry point ``objects.onnx`` is the stage that reads ``objects.method=FILE.onnx``.
    """
    points = [(name.partition("."), point.value) for name, point in extensions.registered("stages").items()]
    return {f".{suffix}": value for (name, dot, suffix), value in points if dot and name == section}


def file_stage(section: str, method: str) -> str:
    """Return the ``module:name`` that reads the file that a method names, or an empty text."""
    if ":" in method:
        return ""
    lower = method.lower()
    return next((name for suffix, name in file_stages(section).items() if lower.endswith(suffix)), "")


def is_user_function(method: str) -> bool:
    """Return whether a method names a user-defined function, and not a built-in method or a topic."""
    return ":" in method and not method.startswith(TOPIC)


@cache
def load_plugin(name: str, folder: ModuleFolder | None = WORKING_DIRECTORY) -> Plugin:
    """Import the function or class ``module:name``.

    Args:
        name: ``module:name``.
        folder: folder of a module that is not installed. None: no folder, since an installed package has
            registered the name.

    Raises:
        UserError: the module or name does not exist, cannot be imported, or is no stage.
    """
    module_name, _, attribute = name.partition(":")
    if not all(name_part.isidentifier() for name_part in (*module_name.split("."), *attribute.split("."))):
        raise UserError(f"'{name}' is no module:function")
    if module_name.partition(".")[0] in sys.stdlib_module_names:
        raise UserError(f"'{name}' is no stage: module '{module_name}' is a part of Python; {STAGE_HINT}")
    module = _import_module(module_name, folder)
    try:
        target = EntryPoint(name, name, "bevviz.stages").load()
    except AttributeError:
        members = {n: v for n, v in vars(module).items() if getattr(v, "__module__", "") == module_name}
        candidates = [n for n, v in members.items() if callable(v) and n != PARAMS and not n.startswith("_")]
        listed = f"; it has {', '.join(candidates[:8])}" if candidates else ""
        raise UserError(f"module '{module_name}' has no '{attribute}'{listed}") from None
    if not callable(target):
        raise UserError(f"'{name}' is a {type(target).__name__}, not a function")
    params = getattr(module, PARAMS, None)
    if not (isinstance(params, type) and issubclass(params, BaseModel)):
        params = None
    if folder is not None and (fault := _target_fault(target, has_params=params is not None)):
        raise UserError(f"'{name}' is no stage: {fault}")
    takes_params = params is not None and _accepts_params(target)
    call = target.__call__ if isinstance(target, type) else target
    settings = _named_parameters(target, SETTINGS) if isinstance(target, type) else ()
    return Plugin(name, target, params, takes_params, _named_parameters(call, FACTS), settings)


def _import_module(name: str, folder: ModuleFolder | None) -> ModuleType:
    """Import a module for ``load_plugin``."""
    try:
        return importlib.import_module(name) if folder is None else import_module(name, folder)
    except UserError:
        raise
    except ModuleNotFoundError as error:
        where = f"in {folder.path}, nor installed" if folder is not None and folder.path else "here"
        raise UserError(
            f"there is no module '{error.name}' {where} ('pip install' it, or run where it lies)"
        ) from None
    except (Exception, SystemExit) as error:  # A user's file may raise anything.
        raise UserError(f"'{name}' cannot be imported: {describe_exception(error)}") from error


def describe_exception(error: BaseException, file: Path | None = None) -> str:
    """Return type, first line and position of an exception.

    Args:
        error: the exception.
        file: file whose line is named; None, or if it has no part in the exception: where it was raised.
    """
    lines = traceback.extract_tb(error.__traceback__)
    position = next((line for line in reversed(lines) if file and Path(line.filename) == file), lines[-1])
    place = f"({Path(position.filename).name}, line {position.lineno})"
    return f"{type(error).__name__}: {first_line(error)} {place}"


def _named_parameters(call: Callable[..., Any], names: tuple[str, ...]) -> tuple[str, ...]:
    """Return those of the names that a callable has parameters for."""
    try:
        return tuple(name for name in names if name in signature(call).parameters)
    except (TypeError, ValueError):  # compiled code without a signature
        return ()


def _accepts_params(target: Callable[..., Any]) -> bool:
    """Return whether a target accepts parameters: a class in its constructor, a function after the array."""
    min_count, excluded = (1, SETTINGS) if isinstance(target, type) else (2, FACTS)
    try:
        parameters = signature(target).parameters.values()
    except (TypeError, ValueError):
        return True
    positional = [p for p in parameters if p.kind in POSITIONAL and p.name not in excluded]
    return len(positional) >= min_count or any(p.kind is Parameter.VAR_POSITIONAL for p in parameters)


# --- signatures of stages ----------------------------------------------------------------------


def _target_fault(target: Callable[..., Any], *, has_params: bool) -> str:
    """Return why a target is no stage, or an empty string if it is one.

    The signature must be that of a stage. This keeps out ``numpy:load`` and the like, which accept any
    argument and run code in the file they read.
    """
    if isinstance(target, type):
        constructor, call = (
            next((vars(base)[name] for base in target.__mro__ if name in vars(base)), None)
            for name in ("__init__", "__call__")
        )
        if not _is_outside_library(target) or not _is_python_function(call):
            return f"a class needs a method __call__(self, points) of its own; {STAGE_HINT}"
        if _is_python_function(constructor):
            fault = _missing_argument(constructor, 1, 1 + has_params, SETTINGS)
            if fault:
                return f"{fault}; {STAGE_HINT}"
        return _signature_fault(call, 1, 0)
    if not _is_python_function(target) or not _is_outside_library(target):
        return f"it is no Python function or class of a module outside Python's own library; {STAGE_HINT}"
    return _signature_fault(target, 0, int(has_params))


def _signature_fault(function: Any, skipped: int, additional: int) -> str:
    """Return how a signature differs from that of a stage, or an empty string.

    Args:
        function: function that gets the array.
        skipped: number of parameters before the array (``self``).
        additional: number of arguments that may follow the array.
    """
    names = [p for p in signature(function).parameters.values() if p.kind in POSITIONAL][skipped:]
    if not names:
        return f"it takes no array; {STAGE_HINT}"
    array = names[0]
    if array.name not in (*CLOUD_PARAMETER_NAMES, *IMAGE_PARAMETER_NAMES) and not _ARRAY_ANNOTATION.search(
        str(array.annotation)
    ):
        return f"its first parameter is '{array.name}'; {STAGE_HINT}"
    fault = _missing_argument(function, skipped + 1, skipped + 1 + additional)
    return f"{fault}; {STAGE_HINT}" if fault else ""


def _missing_argument(function: Any, first: int, last: int, by_name: tuple[str, ...] = FACTS) -> str:
    """Return the sentence about a required parameter that gets no argument, or an empty string.

    Args:
        function: function that is called.
        first: number of arguments that it always gets.
        last: number of arguments that it gets at most.
        by_name: names of parameters that get arguments by name.
    """
    parameters = [p for p in signature(function).parameters.values() if p.name not in by_name]
    required = [p for p in parameters if p.kind in POSITIONAL and p.default is Parameter.empty][last:]
    required += [p for p in parameters if p.kind is Parameter.KEYWORD_ONLY and p.default is Parameter.empty]
    if not required:
        return ""
    reason = f"its module has no model {PARAMS}" if last <= first else "nothing is given for it"
    return f"it needs '{required[0].name}', and {reason}"


def _is_python_function(target: object) -> bool:
    """Return whether a target is a Python function, perhaps with a decorator such as numba's."""
    return isinstance(unwrap(target) if callable(target) else target, FunctionType)


def _is_outside_library(target: Any) -> bool:
    """Return whether a target is defined outside Python's standard library."""
    module = getattr(unwrap(target), "__module__", None) or "builtins"
    return module.partition(".")[0] not in sys.stdlib_module_names
