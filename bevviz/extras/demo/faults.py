"""Faults planted in a drive: scenes that perception misjudges, and wrongly stated sensors.

A scene is real geometry that both sensors see and that the ground truth contains. A faulty sensor sees the
world as it is, but its stated mounting or its stated time is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bevviz.errors import UserError
from bevviz.extras.demo import models
from bevviz.extras.demo.world import SceneArea
from bevviz.support.text import did_you_mean


@dataclass(frozen=True, slots=True)
class Fault:
    """Scene that perception misjudges.

    Attributes:
        description: the scene, and the stage or preset that misjudges it.
        time: seconds into the drive at which it is seen best.
        scene: function that adds it to the world. Its stage is clear of other actors at that time.
    """

    description: str
    time: float
    scene: Callable[[SceneArea], None]


def _hidden_person(stage: SceneArea) -> None:
    """Add a van parked on the right, and a person directly behind it as seen from the sensors."""
    stage.add("car", models.car(stage.rng, "van"), 12.0, -5.0)
    stage.add("person", models.person(stage.rng, walking=False), 16.3, -5.2, turn=np.pi / 2)


def _flat_car(stage: SceneArea) -> None:
    """Add a car half a metre high."""
    stage.add("car", models.car(stage.rng, "saloon").scaled((0.7, 0.7, 0.33)), 10.0, -4.6)


def _merged_people(stage: SceneArea) -> None:
    """Add two people a hand's breadth apart."""
    for lateral in (-4.6, -3.75):
        stage.add("person", models.person(stage.rng, walking=False, child=False), 10.0, lateral, turn=np.pi)


def _shared_box(stage: SceneArea) -> None:
    """Add a person beside a cabinet of the same height. The cabinet has no class."""
    stage.add("person", models.person(stage.rng, walking=False, child=False), 9.0, -4.2, turn=np.pi)
    stage.place(models.litter_bin(stage.rng).moved(np.diag([1.2, 1.2, 1.7, 1.0])), 10.5, -5.4)


def _small_child(stage: SceneArea) -> None:
    """Add a child of 0.9 m at the roadside."""
    child = models.Model(models.person(stage.rng, walking=False, child=True).at(0.0))
    stage.add("person", child.scaled((0.8, 0.8, 0.7)), 7.0, -4.3, turn=np.pi)


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
    "small_child": Fault(
        "a child of 0.9 m at the roadside: the reference preset takes half of it for ground",
        0.5,
        _small_child,
    ),
}


@dataclass(frozen=True, slots=True)
class SensorFault:
    """Wrong statement about a sensor, in frames and bag alike.

    Attributes:
        description: the error.
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


def find_faults(names: Sequence[str], duration: float) -> tuple[list[Fault], list[SensorFault]]:
    """Return the scenes and the sensor faults with these names.

    Args:
        names: keys of ``FAULTS`` and ``SENSOR_FAULTS``.
        duration: seconds of the drive.

    Raises:
        UserError: a name is unknown, or the drive ends before the fault is seen.
    """
    known = [*FAULTS, *SENSOR_FAULTS]
    for name in names:
        if name not in known:
            hint = did_you_mean(name, known, 0.4) or f"; there are {', '.join(known)}"
            raise UserError(f"plant {name}: unknown{hint}")
        if name in FAULTS and FAULTS[name].time > duration:
            raise UserError(
                f"plant {name}: it is seen after {FAULTS[name].time:g} s and the drive has {duration:g} s; "
                "give it more frames"
            )
    scenes = [FAULTS[name] for name in names if name in FAULTS]
    return scenes, [SENSOR_FAULTS[name] for name in names if name in SENSOR_FAULTS]
