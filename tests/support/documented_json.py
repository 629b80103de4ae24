"""Holds what ``--json`` gives to what docs/api.md says of it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PAGE = Path(__file__).resolve().parents[2] / "docs" / "api.md"


def documented(form: str) -> dict[str, bool]:
    """Paths of a form, and whether they are always there. Capitals are any name, ``**`` is all below."""
    text = PAGE.read_text()
    section = text.partition(f"## `{form}`")[2].partition("\n## ")[0]
    assert section, f"{PAGE.name}: says nothing of {form}"
    block = section.partition("```text\n")[2].partition("```")[0]
    rows = re.findall(r"^(\S+?)(\??)(?:  .*)?$", block, re.MULTILINE)
    elements = {path + "[]": False for path, _ in rows}  # a list may be empty
    return elements | {path: not optional for path, optional in rows}


def check(tree: dict[str, Any], form: str) -> None:
    """Nothing is there that is not documented, nor is anything documented that is not there."""
    assert tree["form"] == form
    said = documented(form)
    found = set(_paths({key: value for key, value in tree.items() if key != "form"}))
    patterns = {path: _pattern(path) for path in said}
    unsaid = [path for path in found if not any(p.fullmatch(path) for p in patterns.values())]
    assert not unsaid, f"{form}: not documented: {sorted(unsaid)}"
    absent = [p for p, always in said.items() if always and not any(map(patterns[p].fullmatch, found))]
    assert not absent, f"{form}: documented, but not there: {absent}"


def _pattern(path: str) -> re.Pattern[str]:
    """Of a documented path, for those of ``_paths``."""
    parts = [re.sub(r"^[A-Z]{2,}", "[^|]+", re.escape(part)) for part in path.split(".")]
    return re.compile(r"\|".join(parts).replace(r"\*\*", r"[^|]+(\|.*)?"))


def _paths(value: Any, at: str = "") -> Iterator[str]:
    """Each place of a tree, by the names on the way to it, with | between."""
    if at:
        yield at
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _paths(inner, f"{at}|{key}" if at else str(key))
    elif isinstance(value, list):
        for inner in value:
            if isinstance(inner, dict | list):
                yield from _paths(inner, f"{at}[]")
