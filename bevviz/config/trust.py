"""Trust in files that name functions: the user grants it once, for a path and a content.

A project file or a YAML file may name ``module:function``, which is code. Such a function runs only after
``bevviz trust FILE``. An edit of the file, or of a YAML file that it names, revokes the trust. A module
beside it is checked when it is imported.
"""

from __future__ import annotations

import hashlib
import json
import os
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from bevviz.config.module_folder import WORKING_DIRECTORY, ModuleFolder, find_source, hash_sources
from bevviz.errors import UserError
from bevviz.support.files import check_owned, data_folder, read_bytes, save_text
from bevviz.support.limits import CONFIG_LIMIT


@dataclass(frozen=True, slots=True)
class Trust:
    """Permission to run the functions that a source of values names.

    Attributes:
        granted: the user has named the functions, or has trusted the file that names them.
        folder: folder of the modules that are not installed.
        advice: how to run functions that may not run. ``{setting}`` stands for the setting that names one.
    """

    granted: bool = False
    folder: ModuleFolder = WORKING_DIRECTORY
    advice: str = "if you trust it, add --set {setting}"


USER = Trust(granted=True)  # the command line, the environment, Python code
RECEIVED = Trust()  # a recording, a report, a data set, or any file that is not trusted
MESSAGE = Trust(advice="if you trust it, start bevviz with --set {setting}")  # a message of another program


@dataclass(frozen=True)
class NamedCode:
    """Functions that a file names, and the files that hold them.

    Attributes:
        files: the file, then the YAML files that it names.
        functions: ``module:function`` each.
    """

    files: tuple[Path, ...]
    functions: tuple[str, ...]

    @cached_property
    def path(self) -> Path:
        """Path of the file, with links resolved."""
        return self.files[0].resolve()

    @property
    def folder(self) -> Path:
        """Folder of the local modules."""
        return self.path.parent

    @cached_property
    def modules(self) -> tuple[Path, ...]:
        """Python files of the folder that hold the functions."""
        names = dict.fromkeys(name.partition(":")[0] for name in self.functions)
        return tuple(file for name in names if (file := find_source(name, self.folder)) is not None)

    @property
    def is_regular(self) -> bool:
        """Whether the files can be read twice. The shell's ``<(...)`` cannot."""
        return all(file.is_file() for file in self.files)

    def digest(self) -> str:
        """Return the SHA-256 (hexadecimal) of the files that name the functions.

        Raises:
            UserError: a file cannot be read.
        """
        content = hashlib.sha256()
        for file in self.files:
            data = read_bytes(file, CONFIG_LIMIT)
            name = os.path.relpath(file.resolve(), self.folder)
            content.update(f"{name}\0{hashlib.sha256(data).hexdigest()}\n".encode(errors="surrogateescape"))
        return content.hexdigest()

    def __str__(self) -> str:
        """Return the functions and modules as part of a sentence."""
        files = ", ".join(str(file.relative_to(self.folder)) for file in self.modules)
        local = f" ({files})" if files else ""
        return f"{', '.join(self.functions)}{local}"


@dataclass(frozen=True, slots=True)
class TrustRecord:
    """A file that the user has trusted.

    Attributes:
        path: path of the file, with links resolved.
        sha256: ``NamedCode.digest`` at that time.
        functions: functions that the file named.
        modules: name and SHA-256 of each Python file beside it that they may import.
    """

    path: Path
    sha256: str
    functions: tuple[str, ...]
    modules: tuple[tuple[str, str], ...]

    def changed_modules(self) -> tuple[str, ...]:
        """Return the names of the modules whose content is another one now."""
        hashes = hash_sources(self.path.parent)
        return tuple(name for name, sha256 in self.modules if hashes.get(name) != sha256)


def trust_in(code: NamedCode) -> Trust:
    """Return the user's trust in a file with its current content."""
    if not code.functions:
        return RECEIVED
    shown = shlex.quote(os.path.relpath(code.files[0]))
    if not code.is_regular:
        return Trust(advice=f"{shown} is no file that can be trusted: add --set {{setting}}")
    record = _record(code.path)
    # The files may have changed since their values were read, so that the functions are compared, too.
    if record is not None and record.sha256 == code.digest() and {*code.functions} <= {*record.functions}:
        folder = ModuleFolder(str(code.folder), record.modules, str(code.path))
        return Trust(granted=True, folder=folder)
    state = "has changed since you trusted it" if record is not None else "is not trusted"
    return Trust(
        advice=f"{shown} {state} and would load {code}; read it and what it imports, then run "
        f"'bevviz trust {shown}', or put another method in its place by --set"
    )


def grant_trust(code: NamedCode) -> TrustRecord:
    """Trust a file, and the modules beside it, with their current content.

    Raises:
        UserError: the user's data folder cannot be used.
    """
    modules = hash_sources(code.folder)
    record = TrustRecord(code.path, code.digest(), code.functions, tuple(modules.items()))
    folder = _folder()
    try:
        for place in (folder.parent, folder):
            place.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot keep what is trusted: {error.strerror}") from None
    _check(folder)
    content = {
        "path": str(code.path),
        "sha256": record.sha256,
        "functions": list(code.functions),
        "modules": modules,
    }
    save_text(folder / _name(code.path), json.dumps(content, indent=1) + "\n", "trust")
    return record


def revoke_trust(path: Path) -> bool:
    """Withdraw the trust in a file. Return whether it was trusted.

    Raises:
        UserError: the user's data folder cannot be used.
    """
    file = _folder() / _name(path.resolve())
    try:
        file.unlink()
    except FileNotFoundError:
        return False
    except OSError as error:
        raise UserError(f"{file}: cannot be removed: {error.strerror}") from None
    return True


def trust_records() -> Iterator[TrustRecord]:
    """Iterate over all files that the user has trusted, by path."""
    folder = _folder()
    all_records = [record for file in folder.glob("*.json") if (record := _read(file)) is not None]
    yield from sorted(all_records, key=lambda record: record.path)


def _record(path: Path) -> TrustRecord | None:
    """Return the record of a path, or None."""
    try:
        record = _read(_folder() / _name(path))
    except UserError:  # The user has no data folder.
        return None
    return record if record is not None and record.path == path else None


def _read(file: Path) -> TrustRecord | None:
    """Return the record in a file, or None if this user has not written a valid one."""
    try:
        _check(file.parent)
        content = json.loads(file.read_text(encoding="utf-8"))
        functions = tuple(str(function) for function in content["functions"])
        modules = tuple((str(name), str(sha256)) for name, sha256 in content["modules"].items())
        return TrustRecord(Path(content["path"]), str(content["sha256"]), functions, modules)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, UserError):
        return None


def _check(folder: Path) -> None:
    """Raise UserError if other users could write a record."""
    for place in (folder.parent, folder):
        check_owned(place, "XDG_DATA_HOME")


def _folder() -> Path:
    """Return the folder of the records.

    Raises:
        UserError: the user has no home folder.
    """
    return data_folder("what you trust") / "trusted"


def _name(path: Path) -> str:
    """Return the file name of a path's record."""
    return f"{hashlib.sha256(os.fsencode(path)).hexdigest()[:32]}.json"
