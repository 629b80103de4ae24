"""Check of the output paths: no output may overwrite an input or another output."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from bevviz.cli.machine import STDOUT
from bevviz.errors import UserError

READ = ("paths", "recording", "config", "model", "a", "b", "kitti_labels", "note_file", "blueprint")
WRITTEN = {
    "save": "--save",
    "output": "-o",
    "csv": "--csv",
    "json": "--json",
    "junit": "--junit",
    "write": "--write",
    "bag": "--bag",
}
# Files written at the end of the run. Only this module checks their folder before.
TEXTS = ("csv", "json", "write")


def check_outputs(options: argparse.Namespace) -> None:
    """Check the output paths before the run starts.

    Raises:
        UserError: an output is one of the inputs, also by another name or link. Or two outputs are the same
            file. Or the folder of an output does not exist.
    """
    if getattr(options, "check", False):  # It writes nothing.
        return
    inputs = {identity: path for path in _inputs(options) for identity in _identities(path)}
    outputs: dict[Path, str] = {}
    for name, option in WRITTEN.items():
        target = getattr(options, name, None)
        if not isinstance(target, Path) or target.is_dir() or target == Path(STDOUT):
            continue
        other = outputs.setdefault(target.resolve(), option)
        if other != option and (target.is_file() or not target.exists()):
            raise UserError(f"{option} {target}: {other} writes that file; give another name")
        if name in TEXTS and not target.parent.is_dir():
            raise UserError(f"{option} {target}: there is no folder {target.parent}")
        for identity in _identities(target):
            if identity in inputs:
                other_name = "" if inputs[identity] == target else f" ({inputs[identity]})"
                raise UserError(f"{option} {target}: is what is read{other_name}; give another name")


def _inputs(options: argparse.Namespace) -> Iterator[Path]:
    for name in READ:
        values = getattr(options, name, None)
        for value in values if isinstance(values, list) else [values]:
            if isinstance(value, str | Path) and str(value):
                yield Path(value)


def _identities(path: Path) -> Iterator[tuple[int, int]]:
    """Yield device and inode of a file, or of each file in a folder."""
    with suppress(OSError, ValueError):
        for file in path.iterdir() if path.is_dir() else [path]:
            with suppress(OSError):
                status = file.stat()
                yield status.st_dev, status.st_ino
