"""What is wrong with a drive, planted on purpose: scenes that perception gets wrong, and sensors that lie.

A scene is real geometry that both sensors see and that the ground truth holds; nothing is pretended. A faulty
sensor sees the world as it is; what is stated of its mounting or of its time is wrong.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bevviz.errors import UserError
from bevviz.synthetic import models
from bevviz.synthetic.world import Stage


@dataclass(frozen=True, slots=True)
class Fault:
    """What is wrong with a drive.

    Attributes:
        description: what is there and who is fooled by it.
        time: seconds into the drive at which it is seen best.
        scene: puts it into the world; it is called with a stage that is clear of others at that time.
    """

    description: str
    time: float
    scene: Callable[[Stage], None]


def _hidden_person(stage: Stage) -> None:
    """A van parked on the right; straight behind it, as seen from the sensors, somebody stands."""
    stage.add("car", models.car(stage.rng, "van"), 12.0, -5.0)
    stage.add("person", models.person(stage.rng, walking=False), 16.3, -5.2, turn=np.pi / 2)


def _flat_car(stage: Stage) -> None:
    stage.add("car", models.car(stage.rng, "saloon").scaled((0.7, 0.7, 0.33)), 10.0, -4.6)


def _merged_people(stage: Stage) -> None:
    for lateral in (-4.6, -3.75):
        stage.add("person", models.person(stage.rng, walking=False, child=False), 10.0, lateral, turn=np.pi)


def _shared_box(stage: Stage) -> None:
    """The cabinet is as tall as a person, and no object that anybody looks for."""
    stage.add("person", models.person(stage.rng, walking=False, child=False), 9.0, -4.2, turn=np.pi)
    stage.place(models.litter_bin(stage.rng).moved(np.diag([1.2, 1.2, 1.7, 1.0])), 10.5, -5.4)


FAULTS: Mapping[str, Fault] = {
    "hidden_person": Fault("a person hidden behind a parked van: no point, no pixel", 1.0, _hidden_person),
    "flat_car": Fault(
        "a car half a metre high, which the reference preset takes for ground (one plane, 0.5 m thick)",
        3.0,
        _flat_car,
    ),
    "merged_people": Fault(
        "two people a hand's breadth apart: one cluster in both presets, as clustering.eps is wider",
        5.0,
        _merged_people,
    ),
    "shared_box": Fault(
        "a person beside a switch cabinet: the reference preset names both by the person's box",
        7.0,
        _shared_box,
    ),
}


@dataclass(frozen=True, slots=True)
class SensorFault:
    """What is stated wrongly, in frames and bag alike.

    Attributes:
        description: what is wrong.
        camera_error: translation in metres and quaternion x y z w of true_camera_from_stated_camera.
        image_late: seconds by which the stamps of the images are late.
    """

    description: str
    camera_error: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    image_late: float = 0.0


_HALF = np.radians(1.0) / 2

SENSOR_FAULTS: Mapping[str, SensorFault] = {
    "turned_camera": SensorFault(
        "the camera is stated 1 degree too far right",
        (0, 0, 0, 0, float(np.sin(_HALF)), 0, float(np.cos(_HALF))),
    ),
    "shifted_camera": SensorFault("the camera is stated 5 cm too far right", (0.05, 0, 0, 0, 0, 0, 1)),
    "late_image": SensorFault("the stamps of the images are 40 ms late", image_late=0.04),
}


def find_sensors(names: Sequence[str]) -> list[SensorFault]:
    """Those among the names that are keys of ``SENSOR_FAULTS``."""
    return [SENSOR_FAULTS[name] for name in names if name in SENSOR_FAULTS]


def find(names: Sequence[str], duration: float) -> list[Fault]:
    """The scenes of these names.

    Args:
        names: keys of ``FAULTS``; those of ``SENSOR_FAULTS`` are left out.
        duration: seconds of the drive.

    Raises:
        UserError: unknown name, or the drive ends before the fault is seen.
    """
    found = []
    for name in names:
        if name in SENSOR_FAULTS:
            continue
        if name not in FAULTS:
            known = [*FAULTS, *SENSOR_FAULTS]
            near = difflib.get_close_matches(name, known, 1, 0.4)
            hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(known)}"
            raise UserError(f"plant {name}: unknown; {hint}")
        fault = FAULTS[name]
        if fault.time > duration:
            raise UserError(
                f"plant {name}: it is seen after {fault.time:g} s and the drive has {duration:g} s; "
                "give it more frames"
            )
        found.append(fault)
    return found
