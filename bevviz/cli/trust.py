"""Command ``bevviz trust``: allow the functions that a file names to run."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bevviz.cli.command import command, flag, option
from bevviz.errors import UserError

if TYPE_CHECKING:
    from bevviz.config.trust import TrustRecord
EXAMPLES = """examples:
  bevviz trust                     the bevviz.toml of this folder, or of one above
  bevviz trust robot.yaml          a file that --config takes
  bevviz trust --list              what is trusted, and what has changed since
  bevviz trust --revoke robot.yaml"""


@dataclass(frozen=True, kw_only=True)
class TrustOptions:
    """Options of ``trust``."""

    path: Path | None = option(
        "PATH",
        "project file, YAML file, or folder (default: the project of this folder)",
        positional=True,
        nargs="?",
    )
    list: bool = flag("print what is trusted", one_of="instead")
    revoke: bool = flag("trust PATH no longer", one_of="instead")


@command(
    "trust",
    description="A project file or a YAML file can name functions (module:function), which are code. "
    "They run once you trust the file. After an edit of the file or of a module beside it, bevviz asks "
    "again. Read them first: a module may import each Python file of the folder.",
    epilog=EXAMPLES,
)
def _trust(options: TrustOptions) -> int:
    from bevviz.config.project import named_code
    from bevviz.config.trust import grant_trust, revoke_trust

    if options.list:
        if options.path is not None:
            raise UserError("--list prints all that is trusted: leave PATH out")
        return _list()
    path = _file(options.path)
    if options.revoke:
        if not revoke_trust(path):
            raise UserError(f"{path}: is not trusted; 'bevviz trust --list' says what is")
        print(f"{path}: no longer trusted")
        return 0
    code = named_code(path)
    if not code.functions:
        print(f"{path}: names no function, so that there is nothing to trust")
        return 0
    if not code.is_regular:
        raise UserError(f"{path}: is no file that can be trusted: name the function by --set")
    others = len(grant_trust(code).modules) - len(code.modules)
    beside = f", and {others} other Python file{'s' * (others > 1)} that they may import" if others else ""
    print(f"{path}: trusted, with {code}{beside}")
    return 0


def _list() -> int:
    from bevviz.config.trust import trust_records

    trusted = list(trust_records())
    for record in trusted:
        print(f"{record.path}: {', '.join(record.functions)}{_state(record)}")
    if not trusted:
        print("nothing is trusted")
    return 0


def _state(record: TrustRecord) -> str:
    """Return what has changed since a file was trusted, as the end of a line."""
    from bevviz.config.project import named_code

    try:
        same = named_code(record.path).digest() == record.sha256
        modules = record.changed_modules()
    except UserError:
        return " (cannot be read any more)"
    if not same:
        return " (changed since: not trusted as it is now)"
    return f" (changed since, and not run: {', '.join(modules)})" if modules else ""


def _file(path: Path | None) -> Path:
    """Return the file to trust: the path itself, or the project file of its folder or of one above."""
    from bevviz.config.project import NAME, find_project_file

    if path is not None and not path.is_dir():
        return path
    folder = Path.cwd() if path is None else path.absolute()
    project_file = find_project_file(folder)
    if project_file is None:
        raise UserError(f"{os.path.relpath(folder)}: there is no {NAME} in this folder, or in one above")
    return project_file
