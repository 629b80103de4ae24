"""``--json``: the result for other programs, one form for each command (docs/api.md)."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

OPTION = "--json"
STDOUT = "-"


def add_json(group: argparse._ArgumentGroup | argparse.ArgumentParser) -> None:
    group.add_argument(
        OPTION,
        nargs="?",
        const=STDOUT,
        type=Path,
        metavar="FILE.json",
        help="the result for programs, instead of the text; into a file: beside it",
    )


def with_json(arguments: Iterable[str]) -> list[str]:
    """The arguments with ``--json PATH`` as ``--json=- PATH``, unless it is followed by a file for it."""
    told: list[str] = []
    for argument in arguments:
        if told and told[-1] == OPTION and not argument.endswith(".json"):
            told[-1] = f"{OPTION}={STDOUT}"
        told.append(argument)
    return told


def on_stdout(options: argparse.Namespace) -> bool:
    """Whether it takes the place of the text."""
    return str(options.json) == STDOUT


def give(options: argparse.Namespace, form: str, tree: Mapping[str, Any]) -> None:
    """Print or write it, where it is asked for.

    Args:
        options: of the command.
        form: its name; the number behind it counts up where a reader of the old one would fail.
        tree: of what JSON knows, NaN, and tuples.

    Raises:
        UserError: the file cannot be written.
    """
    if options.json is None:
        return
    import json

    from bevviz.support.files import save

    text = json.dumps({"form": f"bevviz.{form}/1", **_plain(tree)}, indent=1, allow_nan=False)
    if on_stdout(options):
        print(text, flush=True)
    else:
        save(options.json, f"{text}\n", OPTION)


def _plain(value: Any) -> Any:
    """What is no number is null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
