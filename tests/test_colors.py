"""Colours that are to be told apart, also by who sees two primaries only."""

from __future__ import annotations

from itertools import combinations

import colour
import numpy as np
import pytest

from bevviz.model.frame import F64
from bevviz.support.colors import (
    CLASS_COLORS,
    CONTEXT,
    FATE_COLORS,
    GROUND,
    OPINION_COLORS,
    SIDE_COLORS,
    TRUTH_COLORS,
    UNNAMED,
    Color,
    StateColor,
    class_color,
)

SEEN = {
    "all": np.eye(3),
    **{
        name: colour.matrix_cvd_Machado2009(name, 1.0)
        for name in ("Protanomaly", "Deuteranomaly", "Tritanomaly")
    },
}
TELLS_APART = 20.0  # CIEDE2000 of two states; 1 is just noticeable side by side
MEANINGS_APART = 10.0  # of any two classes or states, whichever cones somebody lacks
FAR_FROM_ALARM = 25.0  # of a found object and an alarm
FATES_APART = 8.0  # of fates, which are named beside their colours


def linear(color: Color) -> F64:
    return np.asarray(colour.cctf_decoding(np.array(color) / 255, function="sRGB"))


def distance(a: Color, b: Color, sight: str) -> float:
    labs = [
        colour.XYZ_to_Lab(colour.RGB_to_XYZ(np.clip(SEEN[sight] @ linear(color), 0, 1), "sRGB"))
        for color in (a, b)
    ]
    return float(colour.delta_E(labs[0], labs[1], method="CIE 2000"))


@pytest.mark.parametrize("sight", ["all", "Deuteranomaly"])
@pytest.mark.parametrize(
    "names",
    [{state.name: state.value for state in StateColor}, SIDE_COLORS, TRUTH_COLORS, OPINION_COLORS],
    ids=["states", "sides", "truth", "opinions"],
)
def test_states_differ_also_for_the_colour_blind(names: dict[str, Color], sight: str) -> None:
    near = {(a, b): distance(names[a], names[b], sight) for a, b in combinations(names, 2)}
    assert not {pair: round(away, 1) for pair, away in near.items() if away < TELLS_APART}


@pytest.mark.parametrize("sight", SEEN)
def test_fates_differ(sight: str) -> None:
    near = {(a, b): distance(FATE_COLORS[a], FATE_COLORS[b], sight) for a, b in combinations(FATE_COLORS, 2)}
    assert not {pair: round(away, 1) for pair, away in near.items() if away < FATES_APART}


@pytest.mark.parametrize("sight", SEEN)
def test_any_two_meanings_differ(sight: str) -> None:
    """Classes and states: both may outline one object."""
    classes = ("person", "bicycle", "motorcycle", "car", "van", "truck", "bus")
    meanings = {name: CLASS_COLORS[name] for name in classes}
    meanings |= {state.name: state.value for state in StateColor}
    near = {(a, b): distance(meanings[a], meanings[b], sight) for a, b in combinations(meanings, 2)}
    assert not {pair: round(away, 1) for pair, away in near.items() if away < MEANINGS_APART}


def test_found_objects_are_calm() -> None:
    """No class of traffic is near the red of missed or the yellow of false objects."""
    loud = {
        name: min(distance(color, state.value, "all") for state in (StateColor.BAD, StateColor.DOUBTFUL))
        for name, color in CLASS_COLORS.items()
    }
    assert not {name: round(away, 1) for name, away in loud.items() if away < FAR_FROM_ALARM}


def test_context_is_grey_and_contrasts() -> None:
    for color in (GROUND, UNNAMED, CONTEXT):
        assert max(color) - min(color) < 20
    assert not set(CLASS_COLORS.values()) & set(SIDE_COLORS.values())


def test_states_contrast_with_the_dark_background() -> None:
    def luminance(color: Color) -> float:
        return float(np.array([0.2126, 0.7152, 0.0722]) @ linear(color))

    for state in StateColor:
        assert (luminance(state.value) + 0.05) / (luminance((13, 14, 18)) + 0.05) > 2.0, state


def test_a_class_has_one_colour_however_it_is_written() -> None:
    assert class_color("Car") == class_color("car") == CLASS_COLORS["car"]
    assert class_color("zebra") == class_color("zebra")
