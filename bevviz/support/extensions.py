"""Find and load what packages register for bevviz by entry points. The extras register themselves so, too."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal, TypeAlias, TypeVar

from bevviz.errors import UserError, first_line

EXTRAS = "bevviz.extras."
Kind: TypeAlias = Literal[
    "calibrations",
    "commands",
    "datasets",
    "decoders",
    "exports",
    "files",
    "message_types",
    "questions",
    "rescuers",
    "simulators",
    "stages",
    "watches",
]
T = TypeVar("T")


@cache
def registered(kind: Kind) -> Mapping[str, EntryPoint]:
    """Return the entry points of the group ``bevviz.KIND`` by name, those of bevviz first."""
    points = sorted(
        entry_points(group=f"bevviz.{kind}"), key=lambda point: not point.value.startswith(EXTRAS)
    )
    named: dict[str, EntryPoint] = {}
    for point in points:
        named.setdefault(point.name, point)
    return named


def find(kind: Kind, name: str) -> Any:
    """Import what is registered by a name.

    Raises:
        UserError: nothing is, or it cannot be imported.
    """
    if (point := registered(kind).get(name)) is None:
        raise UserError(f"this installation of bevviz lacks '{name}': pip install 'bevviz[{name}]'")
    return load(point)


def load(point: EntryPoint) -> Any:
    """Import what an entry point names.

    Raises:
        UserError: it cannot be imported. Where an extra lacks a package, the error names the command that
            installs it.
    """
    try:
        return point.load()
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing == "bevviz" or not point.value.startswith(EXTRAS):
            raise _unusable(point, error) from error
        extra = point.value.removeprefix(EXTRAS).partition(".")[0].partition(":")[0]
        raise UserError(f"{point.name} needs the package {missing}: pip install 'bevviz[{extra}]'") from None
    except Exception as error:  # A package may raise anything when it is imported.
        raise _unusable(point, error) from error


def load_class(point: EntryPoint, base: type[T]) -> type[T]:
    """Import the subclass of ``base`` that an entry point names.

    Raises:
        UserError: it cannot be imported, or it is no such class.
    """
    target = load(point)
    if not isinstance(target, type) or not issubclass(target, base):
        expected = f"{base.__module__}.{base.__name__}"
        raise _unusable(point, TypeError(f"it is no subclass of {expected}"))
    return target


def load_all(kind: Kind, tell: Callable[[str], object], but: Container[str] = ()) -> Iterator[Any]:
    """Yield what is registered under other names than ``but``. Tell what cannot be imported."""
    for point in registered(kind).values():
        if point.name not in but:
            try:
                yield load(point)
            except UserError as error:
                tell(str(error))


def _unusable(point: EntryPoint, error: Exception) -> UserError:
    """Return the error for an entry point whose package is broken."""
    group = point.group.removeprefix("bevviz.").removesuffix("s")
    return UserError(
        f"the {group} '{point.name}' ({point.value}) cannot be loaded: {type(error).__name__}: "
        f"{first_line(error)}; repair or uninstall its package"
    )
