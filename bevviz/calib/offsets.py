"""The seven offsets of a calibration, in the axes of the camera: three turns, three shifts, one time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F64


@dataclass(frozen=True, slots=True)
class Axis:
    """One of the seven offsets. The computation uses radians, metres and seconds. The output uses ``unit``.

    ``prior`` is larger than a usual error. It holds the offsets that the scene does not determine: an error
    of that size costs as much as one standard deviation of the edges. ``floor`` is the error that remains
    between the edges of perfectly calibrated sensors (docs/calib.md). It is part of every reported
    uncertainty.
    """

    name: str
    what: str  # its name in sentences
    short: str  # its name in narrow places
    positive: str  # error of the stated calibration if the offset is positive
    negative: str
    unit: str
    scale: float  # unit / internal unit
    prior: float  # in ``unit``, as all numbers below
    floor: float
    least: float  # smaller errors are not reported
    sure: float  # an axis is fine if its error is surely smaller than this
    reach: float  # the score is plotted this far to both sides
    decimals: int


_DEGREES: dict[str, Any] = {
    "unit": "deg",
    "scale": 180 / np.pi,
    "prior": 5.0,
    "floor": 0.05,
    "least": 0.1,
    "sure": 0.4,
    "reach": 2.0,
    "decimals": 2,
}
_CM: dict[str, Any] = {
    "unit": "cm",
    "scale": 100.0,
    "prior": 30.0,
    "floor": 1.0,
    "least": 1.5,
    "sure": 6.0,
    "reach": 20.0,
    "decimals": 1,
}
_MS: dict[str, Any] = {
    "unit": "ms",
    "scale": 1000.0,
    "prior": 100.0,
    "floor": 1.0,
    "least": 5.0,
    "sure": 25.0,
    "reach": 100.0,
    "decimals": 1,
}

AXES: tuple[Axis, ...] = (
    Axis("rx", "turn about the camera's x axis", "turn x", "looks too high", "looks too low", **_DEGREES),
    Axis(
        "ry",
        "turn about the camera's y axis",
        "turn y",
        "looks too far right",
        "looks too far left",
        **_DEGREES,
    ),
    Axis("rz", "turn about the camera's z axis", "turn z", "is rolled right", "is rolled left", **_DEGREES),
    Axis("tx", "shift along the camera's x axis", "shift x", "is too far right", "is too far left", **_CM),
    Axis("ty", "shift along the camera's y axis", "shift y", "is too low", "is too high", **_CM),
    Axis("tz", "shift along the camera's z axis", "shift z", "is too far ahead", "is too far back", **_CM),
    Axis("dt", "time of the image", "image time", "the stamps are late", "the stamps are early", **_MS),
)
TIME = 6  # row of the time in AXES
SCALES = np.array([axis.scale for axis in AXES])
PRIOR = np.array([axis.prior for axis in AXES]) / SCALES
FLOOR = np.array([axis.floor for axis in AXES]) / SCALES


def error_pose(offsets: F64) -> F64:
    """Return the (4, 4) true_camera_from_stated_camera of (7,) offsets in radians, metres and seconds.

    The stated camera, seen from the true one, is turned by the rotation vector and then shifted. The time has
    no effect.
    """
    turn = np.asarray(offsets[:3], np.float64)
    angle = float(np.linalg.norm(turn))
    axis = turn / angle if angle > 0 else turn
    return geometry.transform(offsets[3:6], np.array([*(axis * np.sin(angle / 2)), np.cos(angle / 2)]))
