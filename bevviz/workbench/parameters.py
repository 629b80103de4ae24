"""The controls of the page: every parameter with its unit, range, value and what it means."""

from __future__ import annotations

from typing import Any, Literal, get_args, get_origin

import annotated_types
from pydantic.fields import FieldInfo

from bevviz.config import Config, unit, values
from bevviz.parameters import field_of

UNSEEN = ("source.", "live.", "logging.", "sync.", "detector.model")  # nothing that one frame could show anew


def controls(config: Config) -> list[dict[str, Any]]:
    """One for each parameter of the stages that a frame can be run with again."""
    return [
        _control(key, value, info)
        for key, value in values(config).items()
        if "." in key and not key.startswith(UNSEEN) and (info := field_of(key)) is not None
    ]


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
    inner = {annotation, *get_args(annotation)}
    return "switch" if bool in inner else "whole" if int in inner else "number" if float in inner else "text"
