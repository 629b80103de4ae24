"""Results as JSON: dataclasses whose fields are the keys and whose docstrings are the descriptions."""

from __future__ import annotations

import json
from functools import cache
from typing import Annotated, Any, TypeVar

from pydantic import ConfigDict, Field, PlainSerializer, TypeAdapter, with_config
from pydantic.json_schema import SkipJsonSchema

T = TypeVar("T")

# For the dataclass that is the whole output. It holds for the dataclasses in it, too.
json_form = with_config(
    ConfigDict(
        extra="forbid",
        use_attribute_docstrings=True,
        arbitrary_types_allowed=True,  # of fields that are left out
    )
)
# For a dataclass that is a message or a part of one. The other side finds all of its keys.
message_form = with_config(
    ConfigDict(arbitrary_types_allowed=True, json_schema_serialization_defaults_required=True)
)
LEFT_OUT = Field(exclude=True)
WhereKnown = Annotated[T | SkipJsonSchema[None], Field(exclude_if=lambda value: value is None)]
"""Value of a key that the output lacks where the value is None."""


def rounded(decimals: int) -> PlainSerializer:
    """Return the mark of a number that is rounded in the output."""
    return PlainSerializer(lambda value: round(value, decimals), return_type=float)


@cache
def _adapter(form: Any) -> TypeAdapter[Any]:
    return TypeAdapter(form)


def json_tree(result: object) -> dict[str, Any]:
    """Return a result as values of JSON. NaN and infinity are None."""
    form: Any = type(result)
    tree: dict[str, Any] = json.loads(_adapter(form).dump_json(result))
    return tree
