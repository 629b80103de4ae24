"""Parameter controls of the page, with unit, range, value and description of each."""

from __future__ import annotations

from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

import annotated_types
from pydantic.fields import FieldInfo
from pydantic_core import to_jsonable_python

from bevviz.config import Config, field_of, unit, values

UNSEEN = ("source.", "live.", "logging.", "sync.", "detector.model")  # no effect on a single frame


def controls(config: Config, opened: Config | None = None) -> list[dict[str, Any]]:
    """Return one control for each stage parameter that a frame can be run again with.

    Args:
        config: configuration whose stages have the parameters.
        opened: configuration with the initial values. A stage that it does not name has its defaults. None:
            the values of ``config``.
    """
    at_first = values(config if opened is None else opened)
    return [
        _control(key, at_first.get(key, _default(value, info)), info)
        for key, value in values(config).items()
        if "." in key and not key.startswith(UNSEEN) and (info := field_of(key, config)) is not None
    ]


def _default(value: Any, info: FieldInfo) -> Any:
    """Return the default of a parameter, or ``value`` if it has none."""
    return value if info.is_required() else to_jsonable_python(info.get_default(call_default_factory=True))


def _control(key: str, value: Any, info: FieldInfo) -> dict[str, Any]:
    """Return the control of one parameter as JSON for the page."""
    control: dict[str, Any] = {
        "key": key,
        "value": value,
        "unit": unit(key),
        "about": info.description or "",
        "kind": _kind(info.annotation),
    }
    for rule in info.metadata:
        if isinstance(rule, annotated_types.Ge | annotated_types.Gt):
            control["low"] = rule.ge if isinstance(rule, annotated_types.Ge) else rule.gt
        if isinstance(rule, annotated_types.Le | annotated_types.Lt):
            control["high"] = rule.le if isinstance(rule, annotated_types.Le) else rule.lt
    if get_origin(info.annotation) is Literal:
        control["choices"] = list(get_args(info.annotation))
    return control


def _kind(annotation: Any) -> str:
    """Return the kind of input for a type annotation: choice, switch, whole, number or text."""
    if get_origin(annotation) is Literal:
        return "choice"
    united = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else ()
    inner = {annotation, *united}
    return "switch" if bool in inner else "whole" if int in inner else "number" if float in inner else "text"
