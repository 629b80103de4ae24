"""Types of parameters: quantities with a unit, sizes of classes, and methods of a stage."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, PositiveFloat
from pydantic_core import PydanticCustomError

from bevviz.config import plugins


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


# Mean length, width and height of a class in metres, and the spread (one sigma) of each.
# Means of road users are KITTI's (Geiger et al. 2012, as Qi et al. 2018 give them for Frustum PointNets).
# Classes that KITTI lacks have the means of nuScenes (Caesar et al. 2020, as Zhu et al. 2019 give them for
# CBGS). The truck is between the two, since COCO also calls a pickup a truck.
COMPLETE_SENTENCE = "unfit"  # type of an error whose text contains the stated value

# Cars have three sizes, those of KITTI and two of American streets. People's size seen from above is between
# those of KITTI, nuScenes, View of Delft and SUSTechPOINTS, and the points of a person correct it. Other
# spreads are wider than the difference between two data sets. Sizes below the line are our own estimates.
CLASS_SIZES: dict[str, tuple[float, ...]] = {
    "car": (
        *(3.88, 1.63, 1.53, 0.43, 0.15, 0.14),  # compact
        *(4.90, 1.95, 1.80, 0.50, 0.15, 0.25),  # full size
        *(5.30, 2.15, 2.20, 0.50, 0.15, 0.25),  # pickups and tall utility vehicles
    ),
    "van": (5.07, 1.90, 2.21, 0.50, 0.15, 0.25),
    "truck": (8.50, 2.55, 3.05, 2.50, 0.25, 0.50),
    "bus": (10.50, 2.94, 3.47, 2.00, 0.25, 0.35),
    "train": (16.17, 2.53, 3.53, 6.00, 0.20, 0.30),
    "tram": (16.17, 2.53, 3.53, 6.00, 0.20, 0.30),
    "trailer": (12.29, 2.90, 3.87, 3.00, 0.30, 0.60),
    "construction_vehicle": (6.37, 2.85, 3.19, 1.60, 0.50, 0.60),
    "motorcycle": (2.11, 0.77, 1.47, 0.30, 0.15, 0.20),
    "bicycle": (1.70, 0.60, 1.28, 0.25, 0.15, 0.25),
    "cyclist": (1.76, 0.60, 1.74, 0.20, 0.12, 0.15),
    "bicyclist": (1.76, 0.60, 1.74, 0.20, 0.12, 0.15),
    "rider": (1.76, 0.60, 1.74, 0.20, 0.12, 0.15),
    "motor": (2.11, 0.77, 1.47, 0.30, 0.15, 0.20),
    "moped_scooter": (2.11, 0.77, 1.47, 0.30, 0.15, 0.20),
    "person": (0.78, 0.68, 1.76, 0.20, 0.18, 0.14),
    "pedestrian": (0.78, 0.68, 1.76, 0.20, 0.18, 0.14),
    "person_sitting": (0.80, 0.60, 1.27, 0.20, 0.12, 0.14),
    "traffic_cone": (0.41, 0.41, 1.07, 0.10, 0.10, 0.25),
    "barrier": (2.53, 0.50, 0.98, 0.60, 0.15, 0.15),
    # ---
    "fire hydrant": (0.35, 0.35, 0.75, 0.08, 0.08, 0.12),
    "bench": (1.60, 0.60, 0.85, 0.40, 0.15, 0.15),
    "chair": (0.55, 0.55, 0.90, 0.12, 0.12, 0.15),
    "couch": (2.00, 0.90, 0.85, 0.40, 0.15, 0.15),
    "dog": (0.90, 0.35, 0.65, 0.25, 0.10, 0.18),
    "horse": (2.20, 0.60, 1.60, 0.30, 0.12, 0.20),
    "cow": (2.30, 0.75, 1.45, 0.30, 0.12, 0.15),
}


def with_default_sizes(stated: Any) -> Any:
    """Return the default sizes with the stated classes changed."""
    if not isinstance(stated, Mapping):
        return stated
    return {**CLASS_SIZES, **{str(name).lower(): size for name, size in stated.items()}}


def _check_count(size: tuple[float, ...]) -> tuple[float, ...]:
    """Raise an error for pydantic unless there are six numbers for each size."""
    if not size or len(size) % 6:
        raise PydanticCustomError(
            "size",
            "has {count} numbers, a class has six: length, width, height and the spread of each, "
            "and six more for each further size",
            {"count": len(size)},
        )
    return size


ClassSize = Annotated[tuple[PositiveFloat, ...], AfterValidator(_check_count)]


@dataclass(frozen=True, slots=True)
class StageMethods:
    """Allowed methods of a stage: built-in, registered, ``module:function``, a file, or ``topic:NAME``."""

    section: str
    ours: tuple[str, ...]

    def check(self, value: str) -> str:
        """Return the method. Raise an error for pydantic if the stage does not allow it."""
        if value in self.ours or ":" in value or value in plugins.registered():
            return value
        if plugins.file_stage(self.section, value):
            return value
        registered = f", {', '.join(plugins.registered())} (registered)" if plugins.registered() else ""
        raise PydanticCustomError(
            "method",
            "must be one of {ours}{registered}, {file}module:function, or topic:/name",
            {
                "ours": ", ".join(self.ours),
                "registered": registered,
                "file": "".join(f"FILE{suffix}, " for suffix in plugins.file_stages(self.section)),
            },
        )


GROUND = StageMethods("ground", ("polar", "plane"))
CLUSTERING = StageMethods("clustering", ("dbscan",))
OBJECTS = StageMethods("objects", ("frustum",))
