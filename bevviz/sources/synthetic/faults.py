"""Scenes that perception gets wrong, planted into the drive at known places and times.

Each is real geometry that both sensors see and that the ground truth holds; nothing is pretended.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bevviz.errors import UserError
from bevviz.sources.synthetic import models
from bevviz.sources.synthetic.world import Stage


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


def find(names: Sequence[str], duration: float) -> list[Fault]:
    """The faults of these names.

    Args:
        names: keys of ``FAULTS``.
        duration: seconds of the drive.

    Raises:
        UserError: unknown name, or the drive ends before the fault is seen.
    """
    found = []
    for name in names:
        if name not in FAULTS:
            near = difflib.get_close_matches(name, FAULTS, 1, 0.4)
            hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(FAULTS)}"
            raise UserError(f"plant {name}: unknown; {hint}")
        fault = FAULTS[name]
        if fault.time > duration:
            raise UserError(
                f"plant {name}: it is seen after {fault.time:g} s and the drive has {duration:g} s; "
                "give it more frames"
            )
        found.append(fault)
    return found
