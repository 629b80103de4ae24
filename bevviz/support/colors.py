"""The palette of all layouts, recordings and pages, and the meaning of each colour.

Context is grey: ground, points, clusters without a name, tracks. A class has one hue, far from the red of
missed and the yellow of false objects: found is calm. Any two states differ by at least 20 (CIEDE2000), also
for people without green cones; any two classes or states by at least 10, whichever cones somebody lacks.
"""

from __future__ import annotations

import colorsys
import zlib
from enum import Enum
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

F32: TypeAlias = NDArray[np.float32]
U8: TypeAlias = NDArray[np.uint8]

Color: TypeAlias = tuple[int, int, int]

# Colour-blind people can tell these apart, and from the states (after Okabe & Ito 2008), on dark and on light
# backgrounds. A test checks it.
CLASS_COLORS: dict[str, Color] = {
    "person": (130, 170, 130),
    "pedestrian": (130, 170, 130),
    "rider": (30, 240, 165),
    "cyclist": (30, 240, 165),
    "bicycle": (30, 240, 165),
    "motorcycle": (225, 140, 190),
    "car": (86, 186, 245),
    "van": (190, 229, 250),
    "truck": (20, 100, 190),
    "bus": (120, 84, 130),
}


class StateColor(Enum):
    """Colour of each state that a result can have."""

    GOOD = (50, 140, 235)
    DOUBTFUL = (255, 205, 70)  # false, degraded, contradicted
    BAD = (225, 60, 55)  # missed, failed
    OTHER = (130, 45, 90)  # neither good nor bad: taken by another detection, or another class
    SUBJECT = (255, 255, 255)  # the object that the user asked about
    UNKNOWN = (130, 135, 145)


GROUND: Color = (78, 80, 86)
UNNAMED: Color = (112, 116, 126)  # clusters without a name, tracks, detections without a match
CONTEXT: Color = (150, 154, 164)  # obstacle points
FAINT = (*CONTEXT, 110)

# Colours of the comparison with ground truth, of the two sides of a comparison, of opinions on an object, and
# of the stages at which points are lost.
TRUTH_COLORS: dict[str, Color] = {
    "true": StateColor.GOOD.value,
    "missed": StateColor.BAD.value,
    "false": StateColor.DOUBTFUL.value,
}
SIDE_COLORS: dict[str, Color] = {
    "same": StateColor.UNKNOWN.value,
    "moved": (255, 230, 90),
    "class": (115, 110, 45),
    "only A": (90, 230, 255),
    "only B": StateColor.GOOD.value,
}
OPINION_COLORS: dict[str, Color] = {
    "contradicted": StateColor.DOUBTFUL.value,
    "named otherwise": StateColor.OTHER.value,
    "missed": StateColor.BAD.value,
    "confirmed": StateColor.GOOD.value,
    "unseen": StateColor.UNKNOWN.value,
}
FATE_COLORS: dict[str, Color] = {
    "ground": (150, 120, 95),
    "noise": (215, 70, 40),
    "set aside": (240, 145, 70),
    "clustered": (250, 230, 80),
    "reported": (110, 200, 250),
    "in front": (45, 90, 200),
}


# Colours of curves in one plot: the ten of Petroff (arXiv 2107.02270), with red and purple lighter for a dark
# background. Any two are at least 10 apart in CAM02-UCS, also for people who lack one of the three kinds of
# cones.
SERIES_COLORS: tuple[Color, ...] = (
    *((63, 144, 218), (255, 169, 14), (205, 40, 15), (148, 164, 162), (150, 70, 205)),
    *((169, 107, 89), (231, 99, 0), (185, 172, 112), (113, 117, 129), (146, 218, 221)),
)


def css_properties() -> str:
    """Return the palette as custom properties of CSS: ``--bad``, ``--doubtful`` and so on, and ``--s0``."""
    colors = {state.name.lower(): state.value for state in StateColor}
    colors |= {f"s{number}": color for number, color in enumerate(SERIES_COLORS)}
    lines = [f"--{name}: rgb{color};" for name, color in colors.items()]
    return f":root {{ {' '.join(lines)} }}\n"


@lru_cache(maxsize=4)
def palette(size: int = 64) -> U8:
    """Return (size, 3) RGB colours that are bright enough on black.

    Neighbours are far apart in hue (golden-ratio steps).
    """
    hues = np.arange(size) * 0.6180339887498949 % 1.0
    rgb = [colorsys.hsv_to_rgb(h, (0.55, 0.8)[i % 2], (1.0, 0.85, 0.95)[i % 3]) for i, h in enumerate(hues)]
    colors: U8 = np.round(np.array(rgb) * 255).astype(np.uint8)
    colors.flags.writeable = False
    return colors


def class_color(name: str) -> Color:
    """Return the RGB colour of a class. It is the same in every run and on every machine."""
    known = CLASS_COLORS.get(name.lower())
    if known is not None:
        return known
    r, g, b = palette()[zlib.crc32(name.lower().encode()) % len(palette())].tolist()
    return r, g, b


@lru_cache(maxsize=4)
def turbo(size: int = 256) -> U8:
    """Return (size, 3) RGB of the Turbo colour map, blue to red (polynomial fit of Mikhailov 2019)."""
    x = np.linspace(0.0, 1.0, size)
    powers = x[:, None] ** np.arange(6)
    coefficients = np.array(
        [
            [0.13572138, 4.61539260, -42.66032258, 132.13108234, -152.94239396, 59.28637943],
            [0.09140261, 2.19418839, 4.84296658, -14.18503333, 4.27729857, 2.82956604],
            [0.10667330, 12.64194608, -60.58204836, 110.36276771, -89.90310912, 27.34824973],
        ]
    )
    colors: U8 = np.round(np.clip(powers @ coefficients.T, 0, 1) * 255).astype(np.uint8)
    colors.flags.writeable = False
    return colors


def color_rows(values: F32, low: float, high: float, size: int) -> NDArray[np.uint16]:
    """Return the (N,) rows of a colour map of ``size`` colours.

    A value outside low ... high gets the colour at the end.
    """
    scaled = (values - np.float32(low)) * np.float32(size / (high - low))
    rows: NDArray[np.uint16] = np.clip(scaled, 0, size - 1).astype(np.uint16)
    return rows
