"""Import modules of a user's folder from their sources: the bytes that are checked are the bytes that run."""

from __future__ import annotations

import hashlib
import importlib
import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from importlib import machinery
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from bevviz.errors import UserError
from bevviz.support.files import read_bytes
from bevviz.support.limits import CONFIG_LIMIT


@dataclass(frozen=True, slots=True)
class ModuleFolder:
    """A folder that functions are imported from. Pickles of a configuration carry it to other processes.

    Attributes:
        path: the folder. Empty: the working directory.
        sha256: path in the folder and SHA-256 of each Python file that may run. None: any file may, since the
            user has named the function.
        trusted: file with which the user has trusted these, for messages.
    """

    path: str = ""
    sha256: tuple[tuple[str, str], ...] | None = None
    trusted: str = ""

    @property
    def root(self) -> Path:
        """The folder itself."""
        return Path(self.path) if self.path else Path.cwd()

    def expected(self, file: Path) -> str | None:
        """Return the SHA-256 that a file of a trusted folder must have. None: it may not run."""
        return dict(self.sha256 or ()).get(file.relative_to(self.root).as_posix())

    def check(self, file: Path, sha256: str) -> None:
        """Check that a source may run with this content.

        Raises:
            UserError: it has changed since the user trusted it, or was not there.
        """
        if self.sha256 is not None and self.expected(file) != sha256:
            shown = shlex.quote(os.path.relpath(self.trusted))
            state = "has changed" if self.expected(file) else "is new"
            raise UserError(
                f"{os.path.relpath(file)} {state} since you trusted {shown}: read it, then run "
                f"'bevviz trust {shown}'"
            )


WORKING_DIRECTORY = ModuleFolder()


def hash_sources(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each Python file that modules of a folder may import from there.

    Folders whose names no import can spell are left out, as are hidden ones, and files that cannot be read.
    """
    hashes: dict[str, str] = {}
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if name.isidentifier())
        for file in (Path(place, name) for name in sorted(files) if name.endswith(".py")):
            with suppress(UserError):
                content = read_bytes(file, CONFIG_LIMIT)
                hashes[file.relative_to(folder).as_posix()] = hashlib.sha256(content).hexdigest()
    return hashes


def find_source(module: str, folder: Path) -> Path | None:
    """Return the source file of a module in a folder, or None."""
    parts = module.split(".")
    if not all(part.isidentifier() for part in parts):
        return None
    path = folder.joinpath(*parts)
    choices = (path / "__init__.py", path.with_name(f"{path.name}.py"))
    return next((file for file in choices if file.is_file()), None)


def import_module(name: str, folder: ModuleFolder) -> ModuleType:
    """Import a module from a folder, or an installed one.

    Modules of a trusted folder win over installed ones. Those of the working directory do not.

    Raises:
        UserError: a file has changed since the user trusted it, or another module of this name is in use.
    """
    from bevviz.support.numba_cache import keep_user_kernels_apart  # numba takes a quarter of a second.

    keep_user_kernels_apart()
    hook = _hooks.setdefault(folder.root, _FolderHook(folder))
    if folder.sha256 is not None:
        hook.folder = folder
    if hook not in sys.path_hooks:
        sys.path_hooks.insert(0, hook)
    for path in filter(hook.covers, list(sys.path_importer_cache)):
        del sys.path_importer_cache[path]
    with _searching(folder):
        module = importlib.import_module(name)
    source = find_source(name, folder.root)
    if folder.sha256 is not None and source is not None:
        content = getattr(module.__loader__, "source_sha256", None)
        if content is None or content != folder.expected(source):
            raise UserError(
                f"another module '{name}' or another content of it is in use already, of {module.__file__}: "
                "start bevviz again"
            )
    return module


class SourceLoader(machinery.SourceFileLoader):
    """Loader of a user's module. It compiles the source that it has checked.

    It reads no ``__pycache__``, which may have come with the folder.
    """

    def __init__(self, fullname: str, path: str, folder: ModuleFolder) -> None:
        super().__init__(fullname, path)
        self._folder = folder
        self.source_sha256 = ""  # of the content that runs

    def get_code(self, fullname: str) -> CodeType:
        """Compile the source file."""
        content = self.get_data(self.path)
        self.source_sha256 = hashlib.sha256(content).hexdigest()
        self._folder.check(Path(self.path), self.source_sha256)
        return self.source_to_code(content, self.path)


class _SourceFinder(machinery.FileFinder):
    """Finder of a user's modules. A file beside them takes the place of no module of Python itself."""

    def find_spec(self, fullname: str, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the specification of a module, or None."""
        return None if fullname in sys.stdlib_module_names else super().find_spec(fullname, target)


class _FolderHook:
    """Hook by which Python finds the modules of a folder, in whatever way it comes to search there.

    It stays, since a function may import when it is called.
    """

    def __init__(self, folder: ModuleFolder) -> None:
        self.folder, self._root = folder, folder.root
        # An environment of Python may lie in the folder, or bevviz itself.
        places = [*map(Path, sys.path), Path(__file__).parents[1]]
        self._installed = [path for path in places if self._root in path.parents]

    def covers(self, path: str) -> bool:
        """Return whether a path is of the folder."""
        place = Path(path)
        inside = place.is_relative_to(self._root)
        return inside and not any(place.is_relative_to(installed) for installed in self._installed)

    def __call__(self, path: str) -> machinery.FileFinder:
        """Return the finder of a path of the folder. An archive in it has no modules.

        Raises:
            ImportError: the path is of another folder, or a script, which ``runpy`` runs as a file.
        """
        if not self.covers(path) or (path.endswith(".py") and Path(path).is_file()):
            raise ImportError
        loaders: list[tuple[Any, list[str]]] = [
            (partial(SourceLoader, folder=self.folder), machinery.SOURCE_SUFFIXES)
        ]
        if self.folder.sha256 is None:  # Nobody can have read a compiled module of a folder to be trusted.
            loaders.insert(0, (machinery.ExtensionFileLoader, machinery.EXTENSION_SUFFIXES))
        return _SourceFinder(path, *loaders)


_hooks: dict[Path, _FolderHook] = {}


@contextmanager
def _searching(folder: ModuleFolder) -> Iterator[None]:
    """Let Python search a folder: a trusted one first, the working directory last.

    ``python -m`` puts the working directory first. It stays there only if PYTHONPATH names it.
    """
    from_environment = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    directories = ("", str(Path.cwd()))
    removed = [
        path for path in sys.path if path in directories and (not path or path not in from_environment)
    ]
    for path in removed:
        sys.path.remove(path)
    added = str(folder.root)
    sys.path.insert(0 if folder.sha256 is not None else len(sys.path), added)
    try:
        yield
    finally:
        sys.path.remove(added)
        sys.path[:0] = removed
