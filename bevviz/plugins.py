"""Finds what a configuration names by ``module:name``, or by a name that an installed package registered."""

from __future__ import annotations

import importlib
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points, packages_distributions
from importlib.metadata import version as installed_version
from inspect import Parameter, signature
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from bevviz.errors import UserError, first_line

GROUP = "bevviz.stages"  # of the entry points that packages register
TOPIC = "topic:"
PARAMS = "Params"  # the pydantic model beside the function, where it has parameters


@dataclass(frozen=True, slots=True)
class Plugin:
    """Somebody else's function, or class to be made once.

    Attributes:
        name: ``module:name``, also where the configuration has a registered name.
        target: what that is.
        params: the model of its parameters; None: it has none.
        takes_params: whether it is to be given them, after its array.
    """

    name: str
    target: Callable[..., Any]
    params: type[BaseModel] | None
    takes_params: bool

    @property
    def module(self) -> str:
        return self.name.partition(":")[0]

    @property
    def file(self) -> Path | None:
        """Where it was loaded from; None for what is no file."""
        found = getattr(sys.modules.get(self.module), "__file__", None)
        return Path(found) if found else None

    @property
    def version(self) -> str:
        """Of the distribution that it came with, else what its package says of itself, else empty."""
        package = self.module.partition(".")[0]
        for distribution in packages_distributions().get(package, ()):
            return f"{distribution} {installed_version(distribution)}"
        return str(getattr(sys.modules.get(package), "__version__", ""))


@cache
def registered() -> dict[str, str]:
    """The names that installed packages registered, with the ``module:name`` of each."""
    return {point.name: point.value for point in entry_points(group=GROUP)}


def is_foreign(method: str) -> bool:
    """Whether it names a function of somebody else's, rather than one of ours or a topic."""
    return ":" in method and not method.startswith(TOPIC)


@cache
def find(name: str) -> Plugin:
    """Import what is named ``module:name``. The working directory counts as a place of modules.

    Raises:
        UserError: there is no such module or name, it cannot be imported, or it cannot be called.
    """
    module_name, _, attribute = name.partition(":")
    if not all(part.isidentifier() for part in (*module_name.split("."), *attribute.split("."))):
        raise UserError(f"'{name}' is no module:function")
    try:
        with _from_here():
            module = importlib.import_module(module_name)
        target = EntryPoint(name, name, GROUP).load()
    except ModuleNotFoundError as error:
        raise UserError(
            f"there is no module '{error.name}' here ('pip install' it, or run where it lies)"
        ) from None
    except AttributeError:
        own = {n: v for n, v in vars(module).items() if getattr(v, "__module__", "") == module_name}
        there = [n for n, v in own.items() if callable(v) and n != PARAMS and not n.startswith("_")]
        listed = f"; it has {', '.join(there[:8])}" if there else ""
        raise UserError(f"module '{module_name}' has no '{attribute}'{listed}") from None
    except Exception as error:  # whatever a user's file may do
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f" ({Path(where.filename).name}, line {where.lineno})"
        raise UserError(
            f"'{module_name}' cannot be imported: {type(error).__name__}: {first_line(error)}{place}"
        ) from error
    if not callable(target):
        raise UserError(f"'{name}' is a {type(target).__name__}, not a function")
    params = getattr(module, PARAMS, None)
    if not (isinstance(params, type) and issubclass(params, BaseModel)):
        params = None
    return Plugin(name, target, params, params is not None and _takes_two(target))


def _takes_two(target: Callable[..., Any]) -> bool:
    """A class takes its parameters when it is made, a function after its array."""
    wanted = 1 if isinstance(target, type) else 2
    try:
        given = signature(target).parameters.values()
    except (TypeError, ValueError):
        return True
    positional = [p for p in given if p.kind in (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)]
    return len(positional) >= wanted or any(p.kind is Parameter.VAR_POSITIONAL for p in given)


@contextmanager
def _from_here() -> Iterator[None]:
    """A console script has its own folder on the path, not the one that it is run in."""
    here = str(Path.cwd())
    if here in sys.path or "" in sys.path:
        yield
        return
    sys.path.append(here)
    try:
        yield
    finally:
        sys.path.remove(here)
