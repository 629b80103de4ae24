"""Finds what a configuration names by ``module:name``, or by a name that an installed package registered."""

from __future__ import annotations

import ast
import importlib
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.metadata import EntryPoint, entry_points, packages_distributions
from importlib.metadata import version as installed_version
from importlib.util import spec_from_file_location
from inspect import Parameter, signature, unwrap
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

from pydantic import BaseModel

from bevviz.errors import UserError, first_line

GROUP = "bevviz.stages"  # of the entry points that packages register
TOPIC = "topic:"
PARAMS = "Params"  # the pydantic model beside the function, where it has parameters
POSITIONAL = (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
# Names of a stage's first parameter.
CLOUDS = ("points", "cloud", "point_cloud", "pointcloud", "pts", "xyz", "xyzi", "voxels", "obstacles")
IMAGES = ("image", "img", "bgr", "frame", "picture")
_ARRAY_TYPE = re.compile(r"\b(ndarray|NDArray|ArrayLike|Tensor)\b")
HOW = "write a function whose first parameter is 'points' or 'image' (docs/stages.md)"


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
def find(name: str, folder: str | None = "") -> Plugin:
    """Import what is named ``module:name``.

    Args:
        name: of the function or class.
        folder: where its module lies, if it is not installed. Empty: the working directory. None: nowhere, as
            an installed package has registered it.

    Raises:
        UserError: there is no such module or name, it cannot be imported, or it is no stage.
    """
    module_name, _, attribute = name.partition(":")
    if not all(part.isidentifier() for part in (*module_name.split("."), *attribute.split("."))):
        raise UserError(f"'{name}' is no module:function")
    if module_name.partition(".")[0] in sys.stdlib_module_names:
        raise UserError(f"'{name}' is no stage: module '{module_name}' is a part of Python; {HOW}")
    module = _imported(module_name, folder)
    try:
        target = EntryPoint(name, name, GROUP).load()
    except AttributeError:
        own = {n: v for n, v in vars(module).items() if getattr(v, "__module__", "") == module_name}
        there = [n for n, v in own.items() if callable(v) and n != PARAMS and not n.startswith("_")]
        listed = f"; it has {', '.join(there[:8])}" if there else ""
        raise UserError(f"module '{module_name}' has no '{attribute}'{listed}") from None
    if not callable(target):
        raise UserError(f"'{name}' is a {type(target).__name__}, not a function")
    params = getattr(module, PARAMS, None)
    if not (isinstance(params, type) and issubclass(params, BaseModel)):
        params = None
    if folder is not None and (fault := _fault(target, has_params=params is not None)):
        raise UserError(f"'{name}' is no stage: {fault}")
    return Plugin(name, target, params, params is not None and _takes_two(target))


def _imported(name: str, folder: str | None) -> ModuleType:
    """Import a module, see ``find``."""
    try:
        with _importing(name, folder):
            return importlib.import_module(name)
    except UserError:
        raise
    except ModuleNotFoundError as error:
        where = f"in {folder}, nor installed" if folder else "here"
        raise UserError(
            f"there is no module '{error.name}' {where} ('pip install' it, or run where it lies)"
        ) from None
    except Exception as error:  # whatever a user's file may do
        line = traceback.extract_tb(error.__traceback__)[-1]
        place = f" ({Path(line.filename).name}, line {line.lineno})"
        raise UserError(
            f"'{name}' cannot be imported: {type(error).__name__}: {first_line(error)}{place}"
        ) from error


def _takes_two(target: Callable[..., Any]) -> bool:
    """A class takes its parameters when it is made, a function after its array."""
    wanted = 1 if isinstance(target, type) else 2
    try:
        given = signature(target).parameters.values()
    except (TypeError, ValueError):
        return True
    positional = [p for p in given if p.kind in POSITIONAL]
    return len(positional) >= wanted or any(p.kind is Parameter.VAR_POSITIONAL for p in given)


# --- what is a stage ---------------------------------------------------------------------------


def _fault(target: Callable[..., Any], *, has_params: bool) -> str:
    """Say why a target is no stage; empty: it is one.

    A stage says so by its signature. This keeps out ``numpy:load`` and the like, which take anything and run
    what is in it.
    """
    if isinstance(target, type):
        made, call = (
            next((vars(base)[name] for base in target.__mro__ if name in vars(base)), None)
            for name in ("__init__", "__call__")
        )
        if not _is_ours(target) or not _plain(call):
            return f"a class needs a method __call__(self, points) of its own; {HOW}"
        if _plain(made) and (fault := _misfit(made, 1, 1 + has_params)):
            return f"{fault}; {HOW}"
        return _unlike_a_stage(call, 1, 0)
    if not _plain(target) or not _is_ours(target):
        return f"it is no Python function or class of a module outside Python's own library; {HOW}"
    return _unlike_a_stage(target, 0, int(has_params))


def _unlike_a_stage(function: Any, own: int, more: int) -> str:
    """Say what of a signature is not a stage's.

    Args:
        function: that gets the array.
        own: number of parameters before the array (``self``).
        more: number of arguments that it may be given after the array.
    """
    names = [p for p in signature(function).parameters.values() if p.kind in POSITIONAL][own:]
    if not names:
        return f"it takes no array; {HOW}"
    array = names[0]
    if array.name not in (*CLOUDS, *IMAGES) and not _ARRAY_TYPE.search(str(array.annotation)):
        return f"its first parameter is '{array.name}'; {HOW}"
    fault = _misfit(function, own + 1, own + 1 + more)
    return f"{fault}; {HOW}" if fault else ""


def _misfit(function: Any, first: int, last: int) -> str:
    """Name a parameter that nothing is given for; empty: there is none.

    Args:
        function: that is called.
        first: number of arguments that it gets in any case.
        last: number of arguments that it gets at most.
    """
    stated = list(signature(function).parameters.values())
    needed = [p for p in stated if p.kind in POSITIONAL and p.default is Parameter.empty][last:]
    needed += [p for p in stated if p.kind is Parameter.KEYWORD_ONLY and p.default is Parameter.empty]
    if not needed:
        return ""
    why = f"its module has no model {PARAMS}" if last <= first else "nothing is given for it"
    return f"it needs '{needed[0].name}', and {why}"


def _plain(target: object) -> bool:
    """Whether it is a Python function, perhaps with a decorator such as numba's."""
    return isinstance(unwrap(target) if callable(target) else target, FunctionType)


def _is_ours(target: Any) -> bool:
    """Whether it is defined outside Python's own library."""
    module = getattr(unwrap(target), "__module__", None) or "builtins"
    return module.partition(".")[0] not in sys.stdlib_module_names


# --- where modules lie -------------------------------------------------------------------------


def local_files(names: Iterable[str], folder: Path) -> tuple[Path, ...]:
    """Find the Python files of a folder that functions need: their modules, and what these import.

    Args:
        names: ``module:name`` each.
        folder: that the modules may lie in. Nothing in it is run.
    """
    found: dict[Path, None] = {}
    waiting = [name.partition(":")[0] for name in names]
    seen = set(waiting)
    while waiting:
        module = waiting.pop()
        parts = module.split(".")
        for end in range(1, len(parts) + 1):
            file = _file_of(".".join(parts[:end]), folder)
            if file is None or file in found:
                continue
            found[file] = None
            package = parts[:end] if file.name == "__init__.py" else parts[: end - 1]
            imported = [name for name in _imports(file, package) if name not in seen]
            waiting += imported
            seen.update(imported)
    return tuple(sorted(found))


def _file_of(module: str, folder: Path) -> Path | None:
    """The source of a module in a folder; None: it has none there."""
    parts = module.split(".")
    if not all(part.isidentifier() for part in parts):
        return None
    place = folder.joinpath(*parts)
    choices = (place / "__init__.py", place.with_name(f"{parts[-1]}.py"))
    return next((file for file in choices if file.is_file()), None)


def _imports(file: Path, package: Sequence[str]) -> Iterator[str]:
    """Modules that a file may import. What cannot be parsed imports nothing."""
    try:
        tree = ast.parse(file.read_bytes())
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = list(package[: len(package) - node.level + 1]) if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            if base:
                yield base
            yield from (f"{base}.{name.name}".lstrip(".") for name in node.names)


class _FolderFinder(MetaPathFinder):
    """Finder of modules in a trusted folder: only of those sources that the trust is about.

    They come before installed modules of the same name. It does not look at compiled files beside them
    (``.pyc``, ``.so``): the user cannot have read these.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.files: set[Path] = set()
        self.is_importing = False  # what is not in a package of the folder is found only meanwhile

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if not self.has(fullname):
            return None
        file = _file_of(fullname, self.folder)
        if not (self.is_importing if path is None else self._is_within(path)):
            return None
        if file is None or file not in self.files:
            spec = ModuleSpec(fullname, None, is_package=True)  # a folder without __init__.py
            spec.submodule_search_locations = [str(self.folder.joinpath(*fullname.split(".")))]
            return spec
        places = [str(file.parent)] if file.name == "__init__.py" else None
        loader = _SourceLoader(fullname, str(file))
        return spec_from_file_location(fullname, file, loader=loader, submodule_search_locations=places)

    def has(self, name: str) -> bool:
        """Whether a module, or a package, is among the files."""
        place = self.folder.joinpath(*name.split("."))
        return _file_of(name, self.folder) in self.files or any(place in file.parents for file in self.files)

    def check(self, name: str) -> None:
        """Raise UserError where another module of the same name has been imported already."""
        module = sys.modules.get(name)
        if module is None or not self.has(name):
            return
        file = getattr(module, "__file__", None)
        places = [file] if file else list(getattr(module, "__path__", []))
        if not self._is_within(places):
            raise UserError(f"another module '{name}' is in use already, of {', '.join(places)}")

    def _is_within(self, paths: Iterable[str]) -> bool:
        return any(Path(path).is_relative_to(self.folder) for path in paths)


class _SourceLoader(SourceFileLoader):
    """Loader that compiles the source itself: a ``__pycache__`` may have come with the folder."""

    def get_code(self, fullname: str) -> CodeType:
        path = self.get_filename(fullname)
        return self.source_to_code(self.get_data(path), path)


@contextmanager
def _importing(module: str, folder: str | None) -> Iterator[None]:
    """Let modules be found in a folder, see ``find``."""
    if folder is None:
        yield
    elif folder:
        # The finder stays: a function may import a part of its package when it is called.
        finders = (f for f in sys.meta_path if isinstance(f, _FolderFinder) and f.folder == Path(folder))
        finder = next(finders, None) or _FolderFinder(Path(folder))
        finder.files.update(local_files([module], Path(folder)))
        finder.check(module.partition(".")[0])
        if finder not in sys.meta_path:
            sys.meta_path.insert(0, finder)
        finder.is_importing = True
        try:
            with _without_here():
                yield
        finally:
            finder.is_importing = False
    else:
        with _from_here():
            yield


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


@contextmanager
def _without_here() -> Iterator[None]:
    """Leave the working directory out, which ``python -m`` puts on the path; PYTHONPATH may name it."""
    stated = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    here = ("", str(Path.cwd()))
    left_out = [path for path in sys.path if path in here and (not path or path not in stated)]
    for path in left_out:
        sys.path.remove(path)
    try:
        yield
    finally:
        sys.path[:0] = left_out
