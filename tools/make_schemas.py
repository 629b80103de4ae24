"""Write the JSON schemas of the commands' outputs into docs/schemas."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from bevviz.cli import make_parser
from bevviz.cli.command import Command
from bevviz.cli.outputs import form_name

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "schemas"


class _OutputSchema(GenerateJsonSchema):
    """Generator of schemas. An output has a key also where its field has a default."""

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> JsonSchemaValue:
        return self.generate_inner(schema["schema"])

    def field_is_required(
        self,
        field: core_schema.ModelField | core_schema.DataclassField | core_schema.TypedDictField,
        total: bool,
    ) -> bool:
        return field.get("serialization_exclude_if") is None


def commands_with_forms() -> Mapping[str, Command[Any]]:
    """Return the commands that write JSON, by name."""
    commands = {name: parser.get_default("command") for name, parser in make_parser()[1].items()}
    return {name: command for name, command in commands.items() if command.forms}


def schema(command: Command[Any]) -> dict[str, Any]:
    """Return the JSON schema of the output of a command. Keys that not all its classes have are optional."""
    trees = []
    for module, _, name in (form.partition(":") for form in command.forms):
        adapter: TypeAdapter[Any] = TypeAdapter(getattr(import_module(module), name))
        trees.append(adapter.json_schema(mode="serialization", schema_generator=_OutputSchema))
    properties = {key: value for tree in reversed(trees) for key, value in tree["properties"].items()}
    required = set.intersection(*(set(tree["required"]) for tree in trees))
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **trees[0],
        "properties": {"form": {"const": form_name(command.name), "type": "string"}, **properties},
        "required": ["form", *(key for key in properties if key in required)],
    }


def text_of(command: Command[Any]) -> str:
    """Return the file of a command."""
    return json.dumps(schema(command), indent=1, sort_keys=False) + "\n"


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name, command in commands_with_forms().items():
        (FOLDER / f"{name}.json").write_text(text_of(command))


if __name__ == "__main__":
    main()
