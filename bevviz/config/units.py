"""Units of stored values, and units that users may write."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit of stored values, and the factor of each accepted spelling."""

    name: str
    factors: Mapping[str, float]

    def parse(self, value: Any) -> Any:
        """Convert ``"50 cm"`` to 0.5. Return other values unchanged, for pydantic to check."""
        if not isinstance(value, str):
            return value
        match = re.fullmatch(r"\s*([-+.\deE]*\d\.?)\s*([^\s\d]*)\s*", value)
        if match is None:
            return value
        number, suffix = match.groups()
        if suffix and suffix not in self.factors:
            raise PydanticCustomError(
                "wrong_unit",
                "is in {unit}, not in '{given}'; accepted: {accepted}",
                {"unit": self.name, "given": suffix, "accepted": ", ".join(self.factors)},
            )
        try:
            return float(number) * self.factors.get(suffix, 1.0)
        except ValueError:
            return value


METRES = Unit("metres", {"m": 1.0, "cm": 0.01, "mm": 0.001})
SECONDS = Unit("seconds", {"s": 1.0, "ms": 0.001, "us": 1e-6, "min": 60.0, "h": 3600.0})
DEGREES = Unit("degrees", {"deg": 1.0, "rad": 57.29577951308232})
PIXELS = Unit("pixels", {"px": 1.0})
MEGABYTES = Unit("MB", {"MB": 1.0, "GB": 1000.0, "kB": 0.001})
Metres = Annotated[float, BeforeValidator(METRES.parse)]
Seconds = Annotated[float, BeforeValidator(SECONDS.parse)]
Degrees = Annotated[float, BeforeValidator(DEGREES.parse)]
Pixels = Annotated[float, BeforeValidator(PIXELS.parse)]
Megabytes = Annotated[float, BeforeValidator(MEGABYTES.parse)]
