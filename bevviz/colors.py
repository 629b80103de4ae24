"""Colours that stay the same from frame to frame: for classes by name, for ids by number."""

from __future__ import annotations

import colorsys
import zlib
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from bevviz.frame import F32, U8

CLASS_COLORS = {
    "person": (255, 92, 92),
    "pedestrian": (255, 92, 92),
    "rider": (255, 170, 60),
    "cyclist": (255, 170, 60),
    "bicycle": (255, 170, 60),
    "motorcycle": (255, 120, 200),
    "car": (80, 170, 255),
    "van": (120, 200, 255),
    "truck": (150, 120, 255),
    "bus": (200, 140, 255),
}


@lru_cache(maxsize=4)
def palette(size: int = 64) -> U8:
    """(size, 3) RGB colours, neighbours far apart in hue (golden-ratio steps), bright enough on black."""
    hues = np.arange(size) * 0.6180339887498949 % 1.0
    rgb = [colorsys.hsv_to_rgb(h, (0.55, 0.8)[i % 2], (1.0, 0.85, 0.95)[i % 3]) for i, h in enumerate(hues)]
    colors: U8 = np.round(np.array(rgb) * 255).astype(np.uint8)
    colors.flags.writeable = False
    return colors


def class_color(name: str) -> tuple[int, int, int]:
    """RGB colour of a class: the same in every run and on every machine."""
    known = CLASS_COLORS.get(name.lower())
    if known is not None:
        return known
    r, g, b = palette()[zlib.crc32(name.lower().encode()) % len(palette())].tolist()
    return r, g, b


@lru_cache(maxsize=4)
def turbo(size: int = 256) -> U8:
    """(size, 3) RGB of the Turbo colour map, blue to red (polynomial fit of Mikhailov 2019)."""
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


def bins(values: F32, low: float, high: float, size: int) -> NDArray[np.uint16]:
    """(N,) rows of a colour map of ``size`` colours; what is outside low ... high gets the end colour."""
    scaled = (values - np.float32(low)) * np.float32(size / (high - low))
    rows: NDArray[np.uint16] = np.clip(scaled, 0, size - 1).astype(np.uint16)
    return rows
