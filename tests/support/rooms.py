"""Scans of a solid-state LiDAR in rooms: walls, floor, ceiling and persons, ray by ray."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bevviz.model.frame import F32, F64, Bool

PERSON = 0.25, 1.75  # metres: radius and height


def rays(low: float = -7.0, high: float = 52.0) -> F64:
    """Return (N, 3) unit vectors of a Mid-360: elevations from ``low`` to ``high`` degrees."""
    elevation, azimuth = np.meshgrid(
        np.radians(np.linspace(low, high, 40)), np.radians(np.arange(0, 360, 0.72)), indexing="ij"
    )
    flat = np.cos(elevation)
    unit = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1)
    return np.asarray(unit.reshape(-1, 3))


def scan(
    height: float,
    half: float,
    ceiling: float,
    persons: Sequence[tuple[float, float]] = ((2.0, 0.0),),
    *,
    upside_down: bool = False,
    low: float = -7.0,
) -> tuple[F32, Bool]:
    """Return the points in the sensor's frame, and which of them are on a person.

    Args:
        height: of the sensor above the floor.
        half: half the width of the square room.
        ceiling: height of the room.
        persons: x and y of each, in the upright frame at the sensor.
        upside_down: the sensor is rolled by 180 degrees.
        low: lowest elevation of its rays in degrees.
    """
    own = rays(low)
    ray = own * np.array([1.0, -1.0, -1.0]) if upside_down else own
    near, far = np.array([-half, -half, -height]), np.array([half, half, ceiling - height])
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(np.abs(ray) < 1e-12, np.inf, np.where(ray > 0, far, near) / ray).min(axis=1)
        is_person = np.zeros(len(ray), np.bool_)
        for x, y in persons:
            a = ray[:, 0] ** 2 + ray[:, 1] ** 2
            b = -2 * (ray[:, 0] * x + ray[:, 1] * y)
            inner = b * b - 4 * a * (x * x + y * y - PERSON[0] ** 2)
            hit = (-b - np.sqrt(np.maximum(inner, 0))) / (2 * a)
            z = hit * ray[:, 2] + height
            on = (inner > 0) & (hit > 0) & (hit < reach) & (z > 0) & (z < PERSON[1])
            reach, is_person = np.where(on, hit, reach), is_person | on
    reach = reach + np.random.default_rng(0).normal(0, 0.01, len(reach))
    return (own * reach[:, None]).astype(np.float32), is_person
