"""Swept parameters as the user writes them, and the configurations of all their combinations."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.model.frame import F64
from bevviz.pipeline.variants import check_same_frames

MOST = 500  # combinations of values, at most

_NUMBER = r"[-+]?[\d.]+(?:[eE][-+]?\d+)?"
_RANGE = re.compile(rf"\s*({_NUMBER})\s*:\s*({_NUMBER})\s*:\s*({_NUMBER})\s*")

Values = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Parameter:
    """A dotted key and the values that it takes in turn, as text."""

    key: str
    values: Values

    @property
    def numbers(self) -> F64:
        """(N,) positions of the values on an axis: the values as numbers, or 0, 1, 2 ... for words."""
        try:
            return np.array([float(value) for value in self.values])
        except ValueError:
            return np.arange(len(self.values), dtype=np.float64)

    def place(self, value: str) -> float | None:
        """Return the position of a value on the axis; None: off the axis."""
        if value in self.values:
            return float(self.numbers[self.values.index(value)])
        try:
            number, *others = (float(word) for word in (value, *self.values))
        except ValueError:  # A word that is not in the list has no position.
            return None
        return number if min(others) <= number <= max(others) else None


def parse(settings: Sequence[str]) -> tuple[list[Parameter], list[str]]:
    """Split ``key=value`` settings into swept ones and constant ones.

    A swept setting has a range ``a:b:step`` or a list ``x,y,z``.

    Raises:
        UserError: an empty range, no swept parameter, more than two, or too many values.
    """
    swept, constant = [], []
    for text in settings:
        key, _, value = text.partition("=")
        match = _RANGE.fullmatch(value)
        if match:
            swept.append(Parameter(key.strip(), _range(text, *map(float, match.groups()))))
        elif "," in value and value.strip()[0] not in "[{\"'":
            swept.append(Parameter(key.strip(), tuple(part.strip() for part in value.split(","))))
        else:
            constant.append(text)
    if not swept:
        raise UserError("sweep: over what? Give a range or a list, e.g. --set clustering.eps=0.3:0.9:0.1")
    if len(swept) > 2:
        keys = ", ".join(parameter.key for parameter in swept)
        raise UserError(f"sweep: two parameters at most, not {len(swept)}: {keys}")
    number = math.prod(len(parameter.values) for parameter in swept)
    if number > MOST:
        raise UserError(f"sweep: {number} combinations are more than {MOST}; take larger steps")
    return swept, constant


def _range(text: str, first: float, last: float, step: float) -> Values:
    """Return the values of a range, both ends included."""
    if step <= 0 or last < first:
        raise UserError(f"--set {text}: expected first:last:step with last >= first and step > 0")
    number = int((last - first) / step + 1e-6) + 1
    if number > MOST:
        raise UserError(f"--set {text}: {number} values are more than {MOST}; take larger steps")
    return tuple(f"{first + i * step:.10g}" for i in range(number))


def combine(parameters: Sequence[Parameter], load: Callable[[list[str]], Config]) -> dict[Values, Config]:
    """Return the configuration of every combination of values.

    Args:
        parameters: one or two parameters.
        load: returns the configuration with further settings.

    Raises:
        UserError: an unknown key, a value out of range, or a key that changes how frames are made.
    """
    configs = {}
    for values in itertools.product(*(parameter.values for parameter in parameters)):
        stated = zip(parameters, values, strict=True)
        configs[values] = load([f"{parameter.key}={value}" for parameter, value in stated])
    check_same_frames({" ".join(values): config for values, config in configs.items()})
    return configs
