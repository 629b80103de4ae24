"""Option ``--json``: the result for other programs, in one format for each command (docs/api.md)."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

OPTION = "--json"
STDOUT = "-"


def add_json(group: argparse._ArgumentGroup | argparse.ArgumentParser) -> None:
    """Add the option ``--json``."""
    group.add_argument(
        OPTION,
        nargs="?",
        const=STDOUT,
        type=Path,
        metavar="FILE.json",
        help="the result for programs, instead of the text; into a file: beside it",
    )


def join_json_option(arguments: Iterable[str]) -> list[str]:
    """Replace ``--json PATH`` by ``--json=- PATH``, unless PATH is a .json file."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] == OPTION and not argument.endswith(".json"):
            joined[-1] = f"{OPTION}={STDOUT}"
        joined.append(argument)
    return joined


def json_on_stdout(options: argparse.Namespace) -> bool:
    """Return whether JSON replaces the text on standard output."""
    return str(options.json) == STDOUT


def write_json(options: argparse.Namespace, form: str, tree: Mapping[str, Any]) -> None:
    """Print or write the result if ``--json`` is given.

    Args:
        options: of the command.
        form: name of the format. The number after it increases with a change that breaks a reader.
        tree: the result: values that JSON can represent, NaN, and tuples.

    Raises:
        UserError: the file cannot be written.
    """
    if options.json is None:
        return
    import json

    from bevviz.support.files import save_text

    text = json.dumps({"form": f"bevviz.{form}/1", **_plain(tree)}, indent=1, allow_nan=False)
    if json_on_stdout(options):
        print(text, flush=True)
    else:
        save_text(options.json, f"{text}\n", OPTION)


def _plain(value: Any) -> Any:
    """Replace NaN and infinity by None, and tuples by lists."""
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
