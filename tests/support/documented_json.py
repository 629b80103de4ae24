"""Judges the output of ``--json`` by the schemas in docs/schemas, with another project's validator."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from jsonschema import Draft202012Validator

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "schemas"


def check(tree: dict[str, Any], form: str) -> None:
    """Assert that the output has all keys of its form, no others, and values of the stated types."""
    assert tree["form"] == form
    schema = json.loads((FOLDER / f"{form.removeprefix('bevviz.').partition('/')[0]}.json").read_text())
    errors = [
        f"{error.json_path}: {error.message}" for error in Draft202012Validator(schema).iter_errors(tree)
    ]
    assert not errors, f"{form}: {errors}"
