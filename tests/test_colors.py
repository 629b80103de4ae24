"""Colours that are to be told apart, also by who sees two primaries only."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from bevviz.model.colors import (
    CLASS_COLORS,
    FATE_COLORS,
    SIDE_COLORS,
    TRUTH_COLORS,
    Color,
    StateColor,
    class_color,
)
from bevviz.model.frame import F64

# Machado, Oliveira & Fernandes (2009), severity 1, of linear RGB.
SEEN = {
    "all": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
WHITE = np.array([0.95047, 1.0, 1.08883])
TELLS_APART = 12.0  # CIE76 distance; 2.3 is just noticeable side by side


def linear(color: Color) -> F64:
    c = np.array(color) / 255
    found: F64 = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return found


def lab(rgb: F64) -> F64:
    t = XYZ @ rgb / WHITE
    f = np.where(t > 0.008856, np.cbrt(t), 7.787 * t + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("sight", SEEN)
@pytest.mark.parametrize(
    "names",
    [
        {n: CLASS_COLORS[n] for n in ("person", "bicycle", "motorcycle", "car", "van", "truck", "bus")},
        {state.name: state.value for state in StateColor},
        SIDE_COLORS,
        TRUTH_COLORS,
        FATE_COLORS,
    ],
    ids=["classes", "states", "sides", "truth", "fates"],
)
def test_colours_differ_also_for_the_colour_blind(names: dict[str, Color], sight: str) -> None:
    seen = {name: lab(np.clip(SEEN[sight] @ linear(color), 0, 1)) for name, color in names.items()}
    near = {(a, b): float(np.linalg.norm(seen[a] - seen[b])) for a, b in combinations(seen, 2)}
    assert not {pair: round(away, 1) for pair, away in near.items() if away < TELLS_APART}


@pytest.mark.parametrize("back", [(13, 14, 18), (255, 255, 255)], ids=["dark", "light"])
def test_states_contrast_with_light_and_dark_themes(back: Color) -> None:
    def luminance(color: Color) -> float:
        return float(XYZ[1] @ linear(color))

    for state in StateColor:
        one, other = sorted((luminance(state.value), luminance(back)))
        assert (other + 0.05) / (one + 0.05) > 1.3, state


def test_a_class_has_one_colour_however_it_is_written() -> None:
    assert class_color("Car") == class_color("car") == CLASS_COLORS["car"]
    assert class_color("zebra") == class_color("zebra")
