"""Result of a calibration: its seven offsets, and its sentence, table, JSON and corrected configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F64
from bevviz.support.json_form import json_form


@dataclass(frozen=True, slots=True)
class Axis:
    """One of the seven offsets. The computation uses radians, metres and seconds. The output uses ``unit``.

    ``prior`` is larger than a usual error. It holds the offsets that the scene does not determine: an error
    of that size costs as much as one standard deviation of the edges. ``floor`` is the error that remains
    between the edges of perfectly calibrated sensors (docs/extras/calib.md). It is part of every reported
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


class AxisFinding(StrEnum):
    """Judgement about one axis."""

    FINE = "fine"
    OFF = "off"
    UNKNOWN = "cannot tell"  # too little data
    CONFLICT = "no agreement"  # enough data, but its parts contradict each other


@dataclass(frozen=True, slots=True)
class AxisResult:
    """Result for one axis, in its own unit.

    ``interval`` is two standard deviations to either side of ``offset``.
    """

    axis: Axis
    offset: float  # of the stated value from the best fit
    interval: float
    finding: AxisFinding
    reason: str  # reason of a finding UNKNOWN or CONFLICT, else empty
    abscissa: F64  # (S,) offsets along this axis; the other axes stay at their best fit
    score: F64  # (S,) mean score at each of these offsets

    @property
    def error(self) -> AxisError:
        """The result in plain values."""
        axis = self.axis
        return AxisError(axis.what, axis.unit, self.offset, self.interval, self.finding.value, self.reason)

    @property
    def measured(self) -> str:
        """Offset, interval and unit in words."""
        if self.interval >= 2 * self.axis.prior:
            return "not known"
        decimals = self.axis.decimals
        return f"{self.offset:+.{decimals}f} +- {self.interval:.{decimals}f} {self.axis.unit}"

    @property
    def text(self) -> str:
        """The finding in words."""
        if self.finding is AxisFinding.OFF:
            return f"off: {self.axis.positive if self.offset > 0 else self.axis.negative}"
        if self.finding is AxisFinding.FINE:
            most = abs(self.offset) + self.interval
            return f"fine: off by no more than {most:.{self.axis.decimals}f} {self.axis.unit}"
        return f"{self.finding}: {self.reason}" if self.reason else str(self.finding)


@dataclass(frozen=True, slots=True)
class AxisError:
    """Error along one axis."""

    what: str
    unit: str
    """of offset and interval"""
    offset: float | None
    """the error"""
    interval: float | None
    """two standard deviations to either side of the offset"""
    finding: str
    """one of the findings in docs/extras/calib.md"""
    reason: str


@dataclass(frozen=True, slots=True)
class CalibrationScores:
    """Agreement of the edges of clouds and images."""

    stated: float | None
    corrected: float | None


@dataclass(frozen=True, slots=True)
class Extrinsics:
    """4 x 4 pose of the child in the parent."""

    stated: Sequence[Sequence[float]]
    corrected: Sequence[Sequence[float]]


@dataclass(frozen=True, slots=True)
class CameraCalibration:
    """Calibration of one camera."""

    camera: str
    answer: str
    frames: int
    """frames that were used"""
    edges: int
    """edges that were used"""
    score: CalibrationScores
    axes: Mapping[str, AxisError]
    """by name: rx, ry, rz, tx, ty, tz, dt"""
    parent: str
    """frame"""
    child: str
    """frame"""
    extrinsics: Extrinsics
    notes: Sequence[str]


@json_form
@dataclass(frozen=True, slots=True)
class CalibrationResults:
    """Errors of the mounting and the stamps of each camera."""

    cameras: Sequence[CameraCalibration]


@dataclass(frozen=True, slots=True)
class Calibration:
    """Result for one camera against the point cloud."""

    camera: str
    parent: str  # frame of the points
    child: str  # optical frame of the camera
    topic: str  # topic of the images
    offset: float  # seconds already added to the stamps of the images
    axes: tuple[AxisResult, ...]
    frames: int
    edges: int
    stated: F64  # (4, 4) parent_from_child
    corrected: F64  # (4, 4) parent_from_child with the axes that are off corrected, the others as stated
    correction: F64  # (7,) the correction in radians, metres, seconds
    score_stated: float
    score_corrected: float
    notes: tuple[str, ...] = ()

    def by(self, finding: AxisFinding) -> list[AxisResult]:
        """Return the axes with this finding."""
        return [axis for axis in self.axes if axis.finding is finding]

    @property
    def answer(self) -> str:
        """The whole result in one or two sentences."""
        reasons = {axis.reason for axis in self.axes}
        if len(reasons) == 1 and (reason := reasons.pop()):
            return f"Camera '{self.camera}': {self.axes[0].finding}: {reason}."
        off, fine, unknown = (
            self.by(kind) for kind in (AxisFinding.OFF, AxisFinding.FINE, AxisFinding.UNKNOWN)
        )
        if off:
            text = f"Camera '{self.camera}' is off: {'; '.join(_error(axis) for axis in off)}."
        elif not fine:
            text = f"Camera '{self.camera}': too little data to hold any axis."
        elif unknown:
            text = f"Camera '{self.camera}': what can be told is fine: the {_names(fine)}."
        else:
            text = f"Camera '{self.camera}': calibration and clock are fine."
        if not unknown:
            return text
        return f"{text} From {frames_text(self.frames)} it cannot tell the {_names(unknown)}."

    @property
    def measured_from(self) -> str:
        """Amount of data, e.g. ``30 frames, 43192 edges``."""
        return f"{frames_text(self.frames)}, {self.edges} edges"

    @property
    def moved(self) -> bool:
        """Whether the result corrects the mounting or the clock."""
        return bool(self.correction.any())

    @property
    def config(self) -> str:
        """Configuration that applies the correction, in YAML."""
        return correction_yaml([self])

    def table(self) -> str:
        """Return one line of fixed width for each axis."""
        rows = [("axis", "offset of what is stated", "finding")]
        same = len({axis.reason for axis in self.axes}) == 1  # The answer has the reason already.
        for axis in self.axes:
            text = str(axis.finding) if same and axis.reason else axis.text
            rows.append((f"{axis.axis.name}  {axis.axis.what}", axis.measured, text))
        widths = [max(len(row[i]) for row in rows) for i in range(2)]
        return "\n".join(
            f"{name:<{widths[0]}}  {offset:>{widths[1]}}  {finding_text}"
            for name, offset, finding_text in rows
        )

    def result(self) -> CameraCalibration:
        """Return the result in plain values."""
        return CameraCalibration(
            camera=self.camera,
            answer=self.answer,
            frames=self.frames,
            edges=self.edges,
            score=CalibrationScores(self.score_stated, self.score_corrected),
            axes={r.axis.name: r.error for r in self.axes},
            parent=self.parent,
            child=self.child,
            extrinsics=Extrinsics(self.stated.tolist(), self.corrected.tolist()),
            notes=self.notes,
        )


def frames_text(count: int) -> str:
    """Return e.g. ``2 frames``."""
    return f"{count} frame{'s' * (count != 1)}"


def correction_yaml(results: Sequence[Calibration]) -> str:
    """Return one configuration that corrects several cameras, in YAML: extrinsics and offsets of stamps."""
    lines = ["source:", "  extrinsics:"]
    for result in results:
        pose = [*result.corrected[:3, 3], *geometry.quaternion(result.corrected)]
        numbers = ", ".join(f"{float(number):.6f}" for number in pose)
        lines.append(f"    {result.parent} {result.child}: [{numbers}]")
    late = [result for result in results if result.correction[TIME] or result.offset]
    lines += ["sync:", "  offsets:"] if late else []
    lines += [
        f"    {shifted.topic}: {shifted.offset - float(shifted.correction[TIME]):.4f}" for shifted in late
    ]
    return "\n".join(lines) + "\n"


def _error(result: AxisResult) -> str:
    """Return e.g. ``it looks too high, by 1.02 +- 0.05 deg (turn about the camera's x axis)``."""
    axis, decimals = result.axis, result.axis.decimals
    size = f"{abs(result.offset):.{decimals}f} +- {result.interval:.{decimals}f} {axis.unit}"
    how = axis.positive if result.offset > 0 else axis.negative
    if axis is AXES[TIME]:
        return f"{how}, by {size}"
    return f"it {how}, by {size} ({axis.what})"


def _names(results: Sequence[AxisResult]) -> str:
    """Return e.g. ``turns about x and z, shift along z and time of the image``."""
    kinds: dict[str, list[str]] = {}
    for result in results:
        kind, _, axis = result.axis.what.partition(" the camera's ")
        kinds.setdefault(kind, []).append(axis.removesuffix(" axis"))
    named = []
    for kind, axes in kinds.items():
        noun, _, rest = kind.partition(" ")
        named.append(f"{noun}{'s' * (len(axes) > 1)} {rest} {_listed(axes)}".rstrip())
    return _listed(named)


def _listed(words: Sequence[str]) -> str:
    """Join words with commas and a final 'and'."""
    return " and ".join(filter(None, [", ".join(words[:-1]), words[-1]]))
