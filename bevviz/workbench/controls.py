"""The controls of the page: every parameter with its unit, range, value and what it means."""

from __future__ import annotations

from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

import annotated_types
from pydantic.fields import FieldInfo
from pydantic_core import to_jsonable_python

from bevviz.config import Config, unit, values
from bevviz.config.descriptions import field_of

UNSEEN = ("source.", "live.", "logging.", "sync.", "detector.model")  # nothing that one frame could show anew


def controls(config: Config, opened: Config | None = None) -> list[dict[str, Any]]:
    """One for each parameter of the stages that a frame can be run with again.

    Args:
        config: whose stages they are.
        opened: whose values they have; of a stage that it does not name, the defaults. None: those of
            ``config``.
    """
    at_first = values(config if opened is None else opened)
    return [
        _control(key, at_first.get(key, _default(value, info)), info)
        for key, value in values(config).items()
        if "." in key and not key.startswith(UNSEEN) and (info := field_of(key, config)) is not None
    ]


def _default(value: Any, info: FieldInfo) -> Any:
    """Of a parameter; the value where it has none."""
    return value if info.is_required() else to_jsonable_python(info.get_default(call_default_factory=True))


def _control(key: str, value: Any, info: FieldInfo) -> dict[str, Any]:
    found: dict[str, Any] = {
        "key": key,
        "value": value,
        "unit": unit(key),
        "about": info.description or "",
        "kind": _kind(info.annotation),
    }
    for rule in info.metadata:
        if isinstance(rule, annotated_types.Ge | annotated_types.Gt):
            found["low"] = rule.ge if isinstance(rule, annotated_types.Ge) else rule.gt
        if isinstance(rule, annotated_types.Le | annotated_types.Lt):
            found["high"] = rule.le if isinstance(rule, annotated_types.Le) else rule.lt
    if get_origin(info.annotation) is Literal:
        found["choices"] = list(get_args(info.annotation))
    return found


def _kind(annotation: Any) -> str:
    if get_origin(annotation) is Literal:
        return "choice"
    united = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else ()
    inner = {annotation, *united}
    return "switch" if bool in inner else "whole" if int in inner else "number" if float in inner else "text"
