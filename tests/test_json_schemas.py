"""Schemas of the JSON outputs. The tests of each command check its real output by ``documented_json``."""

from __future__ import annotations

import json

import pytest
from jsonschema import Draft202012Validator

from bevviz.cli import make_parser
from tests.support import documented_json
from tools.make_schemas import FOLDER, commands_with_forms, schema, text_of

LIMIT = {"limit": "recall>=0.5", "kept": True, "reason": ""}
EVALUATION = {
    "form": "bevviz.evaluate/1",
    "frames": 1,
    "frames_without_truth": 0,
    "unusable_labels": 0,
    "unusable_examples": [],
    "metrics": {"recall": None},
    "false_causes": {},
    "worst": [],
    "limits": [LIMIT],
}


def test_the_kept_schemas_are_those_of_the_code() -> None:
    assert sorted(path.stem for path in FOLDER.glob("*.json")) == sorted(commands_with_forms())
    for name, command in commands_with_forms().items():
        kept = (FOLDER / f"{name}.json").read_text()
        assert json.loads(kept) == json.loads(text_of(command)), "run: python -m tools.make_schemas"
        Draft202012Validator.check_schema(schema(command))


def test_every_command_with_json_has_a_schema() -> None:
    _, commands = make_parser()
    with_json = {name for name, parser in commands.items() if "--json" in parser._option_string_actions}
    assert with_json == set(commands_with_forms())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"undocumented": 1}, "undocumented"),
        ({"limits": [{**LIMIT, "other": 1}]}, "other"),
        ({"frames": "1"}, "not of type 'integer'"),
    ],
)
def test_an_undocumented_or_wrong_key_fails(change: dict[str, object], message: str) -> None:
    documented_json.check(EVALUATION, "bevviz.evaluate/1")
    with pytest.raises(AssertionError, match=message):
        documented_json.check({**EVALUATION, **change}, "bevviz.evaluate/1")
    missing = {key: value for key, value in EVALUATION.items() if key != "worst"}
    with pytest.raises(AssertionError, match="'worst' is a required property"):
        documented_json.check(missing, "bevviz.evaluate/1")
