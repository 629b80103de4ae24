"""Placement of names in the views: few, and none over another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F32, F64, Bool

MAX_NAMES = 6  # boxes with a name; names of all boxes would cover the scene
EYE, LOOK_TARGET = (-16.0, 5.0, 11.0), (10.0, 0.0, -1.0)  # default eye position and look target in 3D
# Size of a name, across and up: as tangents of the view angle in 3D, in metres from above, and as fractions
# of the image width in an image. Two names must be further apart than this in one direction.
IN_SPACE, FROM_ABOVE, IN_IMAGE = (0.24, 0.045), (20.0, 3.5), (0.21, 0.05)
LETTER_WIDTH = 0.014  # width of a letter in an image, as a fraction of the image width; for longer names


@dataclass(frozen=True, slots=True)
class NameRoom:
    """Room that a name takes in an image or in the bird's-eye view, in pixels.

    Attributes:
        width, height: size of a name.
        letter: width of a letter of a longer name.
    """

    width: float
    height: float
    letter: float = 0.0

    @classmethod
    def in_image(cls, width: float) -> Self:
        """Return the room in an image of this width."""
        return cls(IN_IMAGE[0] * width, IN_IMAGE[1] * width, LETTER_WIDTH * width)

    @classmethod
    def from_above(cls, resolution: float) -> Self:
        """Return the room in the bird's-eye view, whose pixels have this size in metres."""
        return cls(FROM_ABOVE[0] / resolution, FROM_ABOVE[1] / resolution)

    def over(self, bounds: F32) -> F32:
        """Return (K, 2) places of names above items with these (K, 4) bounds."""
        return np.stack([bounds[:, ::2].mean(axis=1), np.maximum(bounds[:, 1] - self.height, 0)], axis=1)

    def choose(self, places: F32, names: Sequence[str], order: F32 | F64, first: Bool | None = None) -> Bool:
        """Choose names that do not overlap, see ``choose_named``. Return a (K,) mask."""
        widths = np.maximum(self.width, self.letter * np.array([len(name) for name in names], np.float64))
        return choose_named(places, order, (widths, self.height), first)


def under(bounds: F32) -> F32:
    """Return (K, 2) places of names below items with these (K, 4) bounds."""
    return np.stack([bounds[:, ::2].mean(axis=1), bounds[:, 3]], axis=1)


def choose_named_in_3d(places: F32 | F64, first: Bool | None = None, height: float = 1.0) -> Bool:
    """Choose the 3D boxes that get a name: the nearest ones, as long as names do not overlap.

    Args:
        places: (K, 3) positions around the robot.
        first: (K,) mask of positions that come before nearer ones.
        height: height of the view as a fraction of its usual height.

    Returns:
        (K,) mask.
    """
    ahead = np.subtract(LOOK_TARGET, EYE)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    eye_positions = (places - np.array(EYE)) @ np.stack([right, np.cross(right, ahead), ahead], axis=1)
    tangents = eye_positions[:, :2] / np.maximum(eye_positions[:, 2:], 0.1)
    return choose_named(tangents, _distances(places), (IN_SPACE[0] / height, IN_SPACE[1] / height), first)


def choose_named(
    at: geometry.FloatArray, order: F32 | F64, room: tuple[float | F64, float], first: Bool | None = None
) -> Bool:
    """Choose the first ``MAX_NAMES`` names that do not overlap. Return a (K,) mask.

    Args:
        at: (K, 2) positions of the names, across and up.
        order: (K,) sort key; the smallest comes first.
        room: size of a name: width, one for all or (K,), and height.
        first: (K,) mask of names that come before all others.
    """
    chosen: list[tuple[float, float, float]] = []
    widths = np.broadcast_to(room[0], len(at)).tolist()
    mask: Bool = np.zeros(len(at), bool)
    rows = np.lexsort((order, ~first)) if first is not None else np.argsort(order, kind="stable")
    positions = at.tolist()
    for row in rows.tolist():
        x, y = positions[row]
        if all(
            abs(x - other_x) >= (widths[row] + other_width) / 2 or abs(y - other_y) >= room[1]
            for other_x, other_y, other_width in chosen
        ):
            mask[row] = True
            chosen.append((x, y, widths[row]))
            if len(chosen) == MAX_NAMES:
                break
    return mask


def _distances(places: F32 | F64) -> F32:
    distances: F32 = np.hypot(places[:, 0], places[:, 1])
    return distances


def shown(names: Sequence[str], is_shown: Bool) -> list[str]:
    """Return the names, with empty texts for those that are not shown."""
    return [name if show else "" for name, show in zip(names, is_shown.tolist(), strict=True)]
