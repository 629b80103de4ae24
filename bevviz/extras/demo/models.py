"""Models of objects in the street: cars, people, cyclists, houses, trees, poles.

A model stands on z = 0, faces +x and is centred on the origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bevviz.extras.demo.mesh import Material, Mesh, box, ellipsoid, grid, loft, merge, tube, wheel_rim
from bevviz.model.frame import F64

Color = tuple[int, int, int]  # BGR

PAINTS: Sequence[Color] = (
    (235, 235, 235), (190, 190, 185), (120, 120, 120), (50, 50, 52), (28, 26, 25), (130, 60, 30),
    (160, 110, 60), (30, 30, 150), (40, 40, 190), (60, 100, 50), (60, 120, 190), (110, 150, 170),
    (40, 160, 210),
)  # fmt: skip
CLOTHES: Sequence[Color] = (
    (40, 40, 45), (90, 60, 40), (140, 90, 50), (50, 50, 150), (40, 60, 180), (70, 110, 60), (200, 200, 200),
    (60, 180, 220), (150, 120, 160), (90, 90, 95), (120, 160, 190), (40, 90, 150), (180, 150, 90),
)  # fmt: skip
TROUSERS: Sequence[Color] = (
    (45, 40, 38),
    (110, 75, 45),
    (70, 70, 72),
    (80, 110, 135),
    (35, 30, 30),
    (130, 130, 125),
)
SKINS: Sequence[Color] = ((160, 185, 225), (120, 150, 200), (70, 100, 150), (45, 65, 100))
HAIR: Sequence[Color] = ((25, 30, 40), (40, 60, 90), (90, 130, 170), (110, 110, 115))
WALLS: Sequence[Color] = (
    (80, 95, 150), (150, 185, 205), (190, 205, 215), (140, 160, 175), (110, 140, 190), (165, 165, 160),
    (130, 175, 215),
)  # fmt: skip
ROOFS: Sequence[Color] = ((60, 70, 130), (75, 75, 80), (50, 60, 95))
BLACK, DARK, GREY, STEEL, WHITE = (
    (18, 18, 18),
    (35, 35, 36),
    (120, 120, 120),
    (165, 165, 160),
    (235, 235, 235),
)


@dataclass(frozen=True, slots=True)
class Limb:
    """A part that swings about y around its pivot, in step with the walked distance."""

    mesh: Mesh
    pivot: tuple[float, float, float]
    amplitude: float  # radians
    phase: float


@dataclass(frozen=True, slots=True)
class Model:
    """A road user with moving limbs."""

    body: Mesh
    limbs: tuple[Limb, ...] = ()
    stride: float = 1.4  # metres for one swing to and fro of every limb

    def at(self, distance: float) -> Mesh:
        """Return the mesh after ``distance`` metres."""
        return merge(
            [self.body, *(limb.mesh.moved(_swing(limb, distance / self.stride)) for limb in self.limbs)]
        )

    def scaled(self, factors: tuple[float, float, float]) -> Model:
        """Return the model stretched along x, y and z. It must not have limbs."""
        return replace(self, body=self.body.moved(np.diag([*factors, 1.0])))


def _swing(limb: Limb, cycles: float) -> F64:
    """Return the (4, 4) rotation of a limb after this number of cycles."""
    angle = limb.amplitude * np.sin(2 * np.pi * cycles + limb.phase)
    c, s = np.cos(angle), np.sin(angle)
    m = np.eye(4)
    m[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    m[:3, 3] = np.asarray(limb.pivot) - m[:3, :3] @ np.asarray(limb.pivot)
    return m


def _pick(rng: np.random.Generator, colors: Sequence[Color]) -> Color:
    """Choose one of the colours and vary its brightness."""
    shade = rng.normal(0, 8)
    b, g, r = (int(np.clip(c + shade, 8, 245)) for c in colors[int(rng.integers(len(colors)))])
    return b, g, r


# --- road users --------------------------------------------------------------------------------


def car(rng: np.random.Generator, kind: str = "") -> Model:
    """Make a car of a random or the given kind."""
    kind = kind or rng.choice(["hatchback", "saloon", "suv", "van"], p=[0.35, 0.3, 0.22, 0.13])
    length, width, height, rear, front = {
        "hatchback": (4.05, 1.76, 1.48, -0.47, 0.22),
        "saloon": (4.65, 1.82, 1.45, -0.33, 0.2),
        "suv": (4.6, 1.9, 1.72, -0.47, 0.22),
        "van": (5.2, 2.0, 2.15, -0.49, 0.34),
    }[kind]
    length, width = length * rng.uniform(0.96, 1.04), width * rng.uniform(0.97, 1.02)
    paint = _pick(rng, PAINTS)
    belt, x = height * (0.5 if kind == "van" else 0.6), length / 2
    profile = np.array(
        [(-x, 0.38), (-x + 0.04, belt - 0.12), (-x + 0.22, belt), (front * length, belt),
         (x - 0.3, belt - 0.16), (x - 0.04, belt - 0.32), (x, 0.36), (x - 0.18, 0.2), (-x + 0.18, 0.2)]
    )  # fmt: skip
    sides = []
    for y, inset in ((-0.5, 0.94), (-0.44, 1.0), (0.44, 1.0), (0.5, 0.94)):
        ring = (profile - profile.mean(0)) * inset + profile.mean(0)
        sides.append(np.column_stack([ring[:, 0], np.full(len(ring), y * width), ring[:, 1]]))
    parts = [loft(sides, paint, Material.PAINT)]
    low = np.array([(front, 0.46), (rear, 0.46), (rear, -0.46), (front, -0.46)]) * [length, width]
    slant = {"hatchback": 0.25, "saloon": 0.5, "suv": 0.2, "van": 0.03}[kind]
    high = low * [1.0, 0.84] + np.array([-0.65, slant, slant, -0.65])[:, None] * [1.0, 0.0]
    base = np.column_stack([low, np.full(4, belt - 0.03)])
    roof = np.column_stack([high, np.full(4, height - 0.06)])
    parts.append(loft([base, roof], DARK, Material.GLASS))
    parts.append(loft([roof, roof * [0.97, 0.94, 1.0] + [0, 0, 0.06]], paint, Material.PAINT))
    parts += [tube(b, r, (0.05, 0.045), paint, Material.PAINT, 5) for b, r in zip(base, roof, strict=True)]
    for side in (0, 3):
        across = 1 - 2 * (side == 3)
        b, r = base[side] * 0.45 + base[side + across] * 0.55, roof[side] * 0.45 + roof[side + across] * 0.55
        parts.append(tube(b, r, (0.05, 0.05), paint, Material.PAINT, 5))
    if kind == "van":  # the load space has no windows
        middle = ((front * 0.35 + rear * 0.65) * length, 0, (belt + height) / 2)
        size = (length * 0.58, width * 0.91, height - belt - 0.04)
        parts.append(box(middle, size, paint, Material.PAINT, (1.0, 0.86)))
    for ahead in (-0.31 * length, 0.31 * length):
        for side in (-1, 1):
            inner, outer = ((ahead, side * (width / 2 + y), 0.32) for y in (-0.23, 0.005))
            hub = np.add(outer, (0, side * 0.006, 0))
            parts.append(tube(inner, outer, (0.32, 0.32), BLACK, Material.RUBBER, 14))
            parts.append(tube(outer, hub, (0.2, 0.19), STEEL, Material.METAL, 10))
    for side in (-1, 1):
        lamp = side * (width / 2 - 0.25)
        parts.append(box((x - 0.07, lamp, belt - 0.38), (0.16, 0.36, 0.14), (225, 235, 240), Material.METAL))
        parts.append(box((-x + 0.05, lamp, belt - 0.2), (0.12, 0.26, 0.2), (30, 25, 190), Material.METAL))
        mirror = (front * length - 0.25, side * (width / 2 + 0.05), belt + 0.08)
        parts.append(box(mirror, (0.12, 0.2, 0.14), paint, Material.PAINT))
    parts += [box((end * (x + 0.005), 0, 0.5), (0.03, 0.5, 0.12), WHITE, Material.SIGN) for end in (-1, 1)]
    parts.append(box((x - 0.03, 0, belt - 0.4), (0.08, width * 0.4, 0.14), DARK, Material.RUBBER))
    return Model(merge(parts))


def person(rng: np.random.Generator, walking: bool = True, child: bool | None = None) -> Model:
    """Make an adult or a child."""
    child = rng.random() < 0.12 if child is None else child
    height = rng.normal(1.25, 0.1) if child else np.clip(rng.normal(1.73, 0.09), 1.5, 1.95)
    shirt, trousers, skin = _pick(rng, CLOTHES), _pick(rng, TROUSERS), _pick(rng, SKINS)
    k, wide = height / 1.75, rng.uniform(0.9, 1.2)
    hip, shoulder = 0.86 * k, 1.44 * k
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    oval = np.stack([np.cos(angle), np.sin(angle)], -1)
    torso = [
        np.column_stack([oval * (np.array(r) * k * [wide, 1]), np.full(8, z * k)])
        for z, r in (
            (0.82, (0.1, 0.15)), (0.95, (0.12, 0.17)), (1.15, (0.11, 0.155)), (1.38, (0.12, 0.2)),
            (1.47, (0.07, 0.09)),
        )
    ]  # fmt: skip
    body = [
        loft(torso, shirt, Material.CLOTH),
        tube((0, 0, 1.45 * k), (0.01, 0, 1.55 * k), (0.055 * k, 0.05 * k), skin, Material.SKIN, 6),
        ellipsoid((0.015, 0, 1.63 * k), np.array((0.1, 0.078, 0.12)) * k, skin, Material.SKIN),
        ellipsoid((-0.015, 0, 1.66 * k), np.array((0.1, 0.083, 0.11)) * k, _pick(rng, HAIR), Material.CLOTH),
    ]
    if rng.random() < 0.3:
        body.append(
            box(
                (-0.2 * k * wide, 0, 1.2 * k),
                (0.18, 0.3, 0.42),
                _pick(rng, CLOTHES),
                Material.CLOTH,
                (0.8, 0.8),
            )
        )
    swing = rng.uniform(0.35, 0.5) if walking else 0.03
    phase, limbs = rng.uniform(0, 2 * np.pi), []
    for side in (-1, 1):
        y, step = side * 0.095 * k, phase + (np.pi if side > 0 else 0)
        leg = [
            tube((0, y, hip), (0.01, y, 0.45 * k), (0.088 * k * wide, 0.065 * k), trousers, Material.CLOTH),
            tube((0.01, y, 0.46 * k), (0, y, 0.06 * k), (0.065 * k, 0.045 * k), trousers, Material.CLOTH),
            box(
                (0.05, y, 0.04 * k), (0.25 * k, 0.09 * k, 0.08 * k), DARK, Material.RUBBER, (0.7, 0.8), -0.02
            ),
        ]
        limbs.append(Limb(merge(leg), (0, y, hip), swing, step))
        y = side * 0.235 * k * (1 + wide) / 2
        elbow, hand = (0.02, y * 1.04, 1.13 * k), (0.07, y * 1.04, 0.88 * k)
        arm = [
            tube((0, y * 0.95, shoulder), elbow, (0.058 * k, 0.046 * k), shirt, Material.CLOTH, 6),
            tube(elbow, hand, (0.045 * k, 0.035 * k), shirt, Material.CLOTH, 6),
            ellipsoid(
                (0.08, y * 1.04, 0.84 * k), np.array((0.04, 0.03, 0.06)) * k, skin, Material.SKIN, 6, 4
            ),
        ]
        limbs.append(Limb(merge(arm), (0, y, shoulder), swing * 0.9, step + np.pi))
    return Model(merge(body), tuple(limbs), stride=1.45 * k)


def cyclist(rng: np.random.Generator) -> Model:
    """Make a cyclist with the bicycle."""
    frame, shirt, trousers = _pick(rng, PAINTS), _pick(rng, CLOTHES), _pick(rng, TROUSERS)
    skin, helmet = _pick(rng, SKINS), _pick(rng, PAINTS)
    saddle, bottom, head, hub_r, hub_f = (
        (-0.2, 0, 0.95),
        (-0.08, 0, 0.3),
        (0.4, 0, 0.9),
        (-0.53, 0, 0.35),
        (0.55, 0, 0.35),
    )
    pipe, black = (0.022, 0.022), (0.018, 0.018)
    parts = [wheel_rim(hub, 0.33, 0.025, BLACK, Material.RUBBER) for hub in (hub_r, hub_f)]
    for hub in (hub_r, hub_f):
        parts += [
            tube(
                hub,
                np.add(hub, (0.32 * np.cos(a), 0, 0.32 * np.sin(a))),
                (0.006, 0.006),
                STEEL,
                Material.METAL,
                3,
            )
            for a in np.arange(8) * np.pi / 4 + 0.2
        ]
    lines = (
        (bottom, saddle),
        (bottom, head),
        ((-0.17, 0, 0.8), head),
        (bottom, hub_r),
        ((-0.17, 0, 0.8), hub_r),
        (head, hub_f),
    )
    parts += [tube(a, b, pipe, frame, Material.METAL, 5) for a, b in lines]
    parts += [
        tube(head, (0.36, 0, 1.05), black, BLACK, Material.METAL, 5),
        tube((0.36, -0.27, 1.05), (0.36, 0.27, 1.05), black, BLACK, Material.METAL, 5),
        box((-0.22, 0, 0.97), (0.26, 0.14, 0.06), BLACK, Material.RUBBER),
        box((-0.72, 0, 0.72), (0.03, 0.07, 0.07), (30, 25, 190), Material.SIGN),
    ]
    lean = rng.uniform(0.2, 0.4)
    hip, neck = np.array((-0.2, 0, 1.0)), np.array((-0.2 + lean, 0, 1.5))
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    oval = np.stack([np.cos(angle), np.sin(angle), np.zeros(8)], -1)
    torso = [
        hip + (neck - hip) * t + oval * [*r, 0]
        for t, r in (
            (-0.1, (0.1, 0.14)), (0.1, (0.13, 0.17)), (0.5, (0.12, 0.155)), (0.88, (0.12, 0.2)),
            (1.05, (0.07, 0.09)),
        )
    ]  # fmt: skip
    parts += [
        loft(torso, shirt, Material.CLOTH),
        tube(neck, np.add(neck, (0.04, 0, 0.12)), (0.055, 0.05), skin, Material.SKIN, 6),
        ellipsoid(np.add(neck, (0.06, 0, 0.19)), (0.1, 0.08, 0.12), skin, Material.SKIN),
        ellipsoid(np.add(neck, (0.05, 0, 0.24)), (0.13, 0.095, 0.09), helmet, Material.PAINT),
    ]
    limbs = []
    for side in (-1, 1):
        y = side * 0.1
        shoulder, elbow = np.add(neck, (0, side * 0.2, -0.06)), np.add(neck, (0.14, side * 0.27, -0.28))
        hand = (0.38, side * 0.25, 1.08)
        parts += [
            tube(shoulder, elbow, (0.058, 0.046), shirt, Material.CLOTH, 6),
            tube(elbow, hand, (0.045, 0.035), skin, Material.SKIN, 6),
        ]
        knee, foot = (0.14, y, 0.72), (-0.02, y, 0.28)
        leg = [
            tube(np.add(hip, (0, y, -0.04)), knee, (0.09, 0.065), trousers, Material.CLOTH),
            tube(knee, foot, (0.065, 0.045), trousers, Material.CLOTH),
            box((0.03, y, 0.26), (0.25, 0.09, 0.08), DARK, Material.RUBBER),
        ]
        limbs.append(Limb(merge(leg), (-0.2, y, 0.96), 0.22, np.pi / 2 * side))
    return Model(merge(parts), tuple(limbs), stride=5.0)


# --- scenery -----------------------------------------------------------------------------------


def house(rng: np.random.Generator, length: float, depth: float, height: float) -> Mesh:
    """Make a house with its front at y = 0 and its back at ``depth``.

    Texture coordinates run along each wall.
    """
    wall = _pick(rng, WALLS)
    corner = np.array([(-length / 2, 0.0), (length / 2, 0.0), (length / 2, depth), (-length / 2, depth)])
    parts = []
    low, eaves = -3.0, height
    for a, b in zip(corner, np.roll(corner, -1, axis=0), strict=True):
        span = float(np.linalg.norm(b - a))
        points = [[(*a, low), (*b, low)], [(*a, eaves), (*b, eaves)]]
        parts.append(
            grid(points, [[(0, low), (span, low)], [(0, eaves), (span, eaves)]], wall, Material.FACADE)
        )
    middle = (0, depth / 2, height)
    if rng.random() < 0.6:
        roof = box(
            np.add(middle, (0, 0, 1.5)),
            (length, depth + 0.5, 3.0),
            _pick(rng, ROOFS),
            Material.ROOF,
            (0.98, 0.02),
        )
    else:
        roof = box(np.add(middle, (0, 0, 0.2)), (length + 0.3, depth + 0.5, 0.4), GREY, Material.ROOF)
    trim = _pick(rng, WALLS)
    ledge = box((0, -0.08, 3.2), (length, 0.16, 0.2), trim, Material.KERB)
    door_x = rng.uniform(-0.3, 0.3) * length
    door = box((door_x, -0.02, 1.05), (1.1, 0.1, 2.1), _pick(rng, PAINTS), Material.PAINT)
    return merge([*parts, roof, ledge, door])


def tree(rng: np.random.Generator) -> Mesh:
    """Make a tree."""
    height, spread = rng.uniform(4.5, 7.0), rng.uniform(1.2, 1.8)
    green = _pick(rng, ((45, 95, 60), (40, 110, 75), (50, 120, 100)))
    parts = [tube((0, 0, 0), (0, 0, height - spread), (0.16, 0.1), (50, 70, 90), Material.BARK, 7)]
    for _ in range(6):
        offset = rng.normal(0, 0.45 * spread, 3) * (1, 1, 0.8)
        radii = spread * rng.uniform(0.5, 0.8, 3)
        parts.append(ellipsoid(np.add(offset, (0, 0, height)), radii, green, Material.FOLIAGE, 9, 7))
    return merge(parts)


def hedge(rng: np.random.Generator, length: float) -> Mesh:
    """Make a hedge of this length."""
    height, green = rng.uniform(0.9, 1.6), _pick(rng, ((40, 85, 55), (45, 100, 70)))
    return box((0, 0, height / 2), (length, 0.8, height), green, Material.FOLIAGE, (0.98, 0.8))


def lamp_post() -> Mesh:
    """Make a lamp post whose arm points along +y."""
    return merge(
        [
            tube((0, 0, 0), (0, 0, 6.5), (0.09, 0.06), GREY, Material.METAL),
            tube((0, 0, 6.4), (0, 1.5, 6.7), (0.04, 0.04), GREY, Material.METAL, 5),
            box((0, 1.6, 6.7), (0.3, 0.6, 0.12), STEEL, Material.METAL),
        ]
    )


def sign(rng: np.random.Generator) -> Mesh:
    """Make a road sign."""
    color = _pick(rng, ((40, 40, 200), (190, 100, 30), (230, 230, 235)))
    disc = tube((-0.05, 0, 2.4), (-0.08, 0, 2.4), (0.33, 0.33), color, Material.SIGN, 12)
    inner = tube((-0.08, 0, 2.4), (-0.085, 0, 2.4), (0.22, 0.22), WHITE, Material.SIGN, 12)
    return merge([tube((0, 0, 0), (0, 0, 2.7), (0.035, 0.035), STEEL, Material.METAL, 6), disc, inner])


def litter_bin(rng: np.random.Generator) -> Mesh:
    """Make a litter bin."""
    color = _pick(rng, ((60, 90, 50), (60, 60, 62)))
    lid = box((0, 0, 1.04), (0.62, 0.62, 0.1), DARK, Material.RUBBER, (0.8, 0.9))
    return merge([box((0, 0, 0.5), (0.5, 0.5, 1.0), color, Material.RUBBER, (1.15, 1.15)), lid])
