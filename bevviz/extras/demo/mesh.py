"""Triangle meshes and the primitives that the street is built from.

Every solid is a loft: closed rings with equal numbers of vertices, joined one to the next and capped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from bevviz.model import geometry
from bevviz.model.frame import F32, F64, I32, U8


class Material(IntEnum):
    """Surface material. It determines pattern, texture and reflectance."""

    ROAD = 0
    PAVEMENT = 1
    KERB = 2
    GRASS = 3
    FACADE = 4
    ROOF = 5
    PAINT = 6
    GLASS = 7
    RUBBER = 8
    CLOTH = 9
    SKIN = 10
    METAL = 11
    FOLIAGE = 12
    BARK = 13
    SIGN = 14


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles with colours, materials and object numbers."""

    vertices: F32  # (V, 3)
    uv: F32  # (V, 2) metres over the surface, for materials with a pattern
    triangles: I32  # (T, 3)
    color: U8  # (T, 3) BGR
    material: U8  # (T,) Material
    object: I32  # (T,) number of the object, 0: scenery

    def moved(self, a_from_b: F64) -> Mesh:
        """Return the mesh in another frame."""
        return replace(self, vertices=geometry.apply(a_from_b, self.vertices))

    def numbered(self, number: int) -> Mesh:
        """Return the mesh with this object number."""
        return replace(self, object=np.full(len(self.triangles), number, np.int32))


def build(
    vertices: ArrayLike,
    triangles: ArrayLike,
    color: Sequence[int],
    material: Material,
    uv: ArrayLike | None = None,
) -> Mesh:
    """Make a mesh of one colour and material."""
    v, t = np.asarray(vertices, np.float32), np.asarray(triangles, np.int32)
    return Mesh(
        vertices=v,
        uv=np.zeros((len(v), 2), np.float32) if uv is None else np.asarray(uv, np.float32),
        triangles=t,
        color=np.tile(np.asarray(color, np.uint8), (len(t), 1)),
        material=np.full(len(t), material, np.uint8),
        object=np.zeros(len(t), np.int32),
    )


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """Merge meshes to one."""
    if not meshes:
        return build(np.zeros((0, 3)), np.zeros((0, 3)), (0, 0, 0), Material.ROAD)
    first = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        vertices=np.concatenate([m.vertices for m in meshes]),
        uv=np.concatenate([m.uv for m in meshes]),
        triangles=np.concatenate([m.triangles + np.int32(n) for m, n in zip(meshes, first, strict=True)]),
        color=np.concatenate([m.color for m in meshes]),
        material=np.concatenate([m.material for m in meshes]),
        object=np.concatenate([m.object for m in meshes]),
    )


def loft(rings: ArrayLike, color: Sequence[int], material: Material, closed: bool = False) -> Mesh:
    """Join (R, n, 3) rings. ``closed`` joins the last to the first, otherwise both ends are capped."""
    r = np.asarray(rings, np.float32)
    count, n = r.shape[:2]
    ring = np.arange(count if closed else count - 1)[:, None]
    a, b = np.arange(n), np.roll(np.arange(n), -1)
    ring_start, next_start = ring * n, (ring + 1) % count * n
    sides = [
        np.stack([ring_start + a, ring_start + b, next_start + b], -1),
        np.stack([ring_start + a, next_start + b, next_start + a], -1),
    ]
    vertices, triangles = r.reshape(-1, 3), [s.reshape(-1, 3) for s in sides]
    if not closed:
        centre, last = count * n, (count - 1) * n
        vertices = np.concatenate([vertices, r[[0, -1]].mean(1)])
        triangles += [
            np.stack([np.full(n, centre), b, a], -1),
            np.stack([np.full(n, centre + 1), last + a, last + b], -1),
        ]
    return build(vertices, np.concatenate(triangles), color, material)


def grid(points: ArrayLike, uv: ArrayLike, color: Sequence[int], material: Material) -> Mesh:
    """Make a surface over (R, n, 3) points, with (R, n, 2) texture coordinates."""
    p = np.asarray(points, np.float32)
    rows, n = p.shape[:2]
    a = (np.arange(rows - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate([np.stack([a, a + 1, a + n + 1], -1), np.stack([a, a + n + 1, a + n], -1)])
    return build(p.reshape(-1, 3), triangles, color, material, np.asarray(uv, np.float32).reshape(-1, 2))


def box(
    centre: ArrayLike,
    size: ArrayLike,
    color: Sequence[int],
    material: Material,
    top: tuple[float, float] = (1.0, 1.0),
    shift: float = 0.0,
) -> Mesh:
    """Make a box whose top is scaled by ``top`` in x and y, and moved ahead by ``shift``."""
    half = np.asarray(size, np.float64) / 2
    square = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half[:2]
    low = np.column_stack([square, np.full(4, -half[2])])
    high = np.column_stack([square * top + [shift, 0.0], np.full(4, half[2])])
    return loft(np.stack([low, high]) + np.asarray(centre), color, material)


def tube(
    start: ArrayLike,
    end: ArrayLike,
    radii: tuple[float, float],
    color: Sequence[int],
    material: Material,
    n: int = 8,
) -> Mesh:
    """Make a cylinder or cone from ``start`` to ``end``."""
    a, b = np.asarray(start, np.float64), np.asarray(end, np.float64)
    axis = (b - a) / np.linalg.norm(b - a)
    side = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)[:, None]
    circle = np.cos(angle) * side + np.sin(angle) * np.cross(axis, side)
    return loft(np.stack([a + circle * radii[0], b + circle * radii[1]]), color, material)


def ellipsoid(
    centre: ArrayLike, radii: ArrayLike, color: Sequence[int], material: Material, n: int = 8, rows: int = 6
) -> Mesh:
    """Make an ellipsoid of ``rows`` rings with ``n`` vertices each."""
    polar = np.linspace(0.02, np.pi - 0.02, rows)[:, None]
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    unit = np.stack(
        [np.sin(polar) * np.cos(angle), np.sin(polar) * np.sin(angle), np.cos(polar) * np.ones(n)], axis=-1
    )
    return loft(unit * np.asarray(radii) + np.asarray(centre), color, material)


def wheel_rim(
    centre: ArrayLike, radius: float, thickness: float, color: Sequence[int], material: Material
) -> Mesh:
    """Make a torus around y."""
    around, across = (
        np.linspace(0, 2 * np.pi, 16, endpoint=False)[:, None],
        np.linspace(0, 2 * np.pi, 4, endpoint=False),
    )
    r = radius + thickness * np.cos(across)
    rings = np.stack(
        [np.cos(around) * r, thickness * np.sin(across) * np.ones_like(around), np.sin(around) * r], -1
    )
    return loft(rings + np.asarray(centre), color, material, closed=True)
