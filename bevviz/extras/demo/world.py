"""The street, its actors, and the pose of everything at a given time.

The view at a time depends only on the seed, not on the length of the drive. Every row of objects along the
street has its own random numbers and is drawn from its beginning, so that a longer drive only adds objects.
The scenery is cut into sections. Each section holds everything that is visible from it.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from bevviz.extras.demo import models
from bevviz.extras.demo.mesh import Material, Mesh, grid, merge
from bevviz.model import geometry
from bevviz.model.frame import F32, F64

SPEED = 8.0  # metres per second, mean speed of the ego vehicle
MARGIN = 140.0  # metres of street before and after a section: more than the range of any sensor
SECTION = 60.0  # metres along the street that are driven with the same scenery
ROAD, PAVEMENT, KERB = (
    6.4,
    9.4,
    0.14,
)  # metres: half width of the road, edge of the pavement, height of the kerb

_PACE = 2 * np.pi / 8.0  # radians per second at which a weaving vehicle brakes and speeds up


class Street:
    """A centre line with curves and grades. ``s`` is the way along it, ``lateral`` the distance to its left.

    Args:
        rng: for its curves and grades.
        length: metres that are driven from ``s`` = 0. The street begins before and ends after them.
    """

    def __init__(self, rng: np.random.Generator, length: float) -> None:
        self.start, self.end = -MARGIN, (length // SECTION + 1) * SECTION + MARGIN
        beyond = 30.0  # metres: the last house begins before the end
        self.s = np.arange(self.start, self.end + beyond, 0.5)
        wave, phase = rng.uniform((200, 150, 90), (300, 200, 120)), rng.uniform(0, 2 * np.pi, 3)
        grade = rng.uniform(0.035, 0.055) * np.sin(2 * np.pi * self.s / wave[1] + phase[1])
        grade += 0.015 * np.sin(2 * np.pi * self.s / wave[2] + phase[2])
        heading = rng.uniform(0.12, 0.2) * np.sin(2 * np.pi * self.s / wave[0] + phase[0])
        heading -= np.interp(0.0, self.s, heading)
        steps = 0.5 * np.stack([np.cos(heading), np.sin(heading), grade], axis=-1)
        way = np.cumsum(steps, axis=0)
        way -= [np.interp(0.0, self.s, column) for column in way.T]
        self.way, self.heading, self.grade = way, heading, grade

    def point(self, s: F64 | float, lateral: F64 | float, height: F64 | float = 0.0) -> F64:
        """Return (..., 3) points in the map frame."""
        x, y, z = (np.interp(s, self.s, column) for column in self.way.T)
        heading = np.interp(s, self.s, self.heading)
        placed = (x - np.sin(heading) * lateral, y + np.cos(heading) * lateral, z + np.asarray(height))
        return np.stack(np.broadcast_arrays(*placed), axis=-1)

    def pose(
        self, s: float, lateral: float, height: float = 0.0, turn: float = 0.0, upright: bool = True
    ) -> F64:
        """Return (4, 4) map_from_body, rotated by ``turn``.

        Unless ``upright``, the body is pitched with the grade of the road.
        """
        heading, grade = (
            np.interp(s, self.s, self.heading),
            0.0 if upright else np.interp(s, self.s, self.grade),
        )
        ahead = np.array([np.cos(heading), np.sin(heading), grade]) / np.hypot(1.0, grade)
        left = np.array([-np.sin(heading), np.cos(heading), 0.0])
        c, t = np.cos(turn), np.sin(turn)
        m = np.eye(4)
        m[:3, :3] = np.stack([c * ahead + t * left, c * left - t * ahead, np.cross(ahead, left)], axis=-1)
        m[:3, 3] = self.point(s, lateral, height)
        return m


@dataclass(frozen=True, slots=True)
class Actor:
    """A road user: its place at time 0 and its motion along the street."""

    number: int  # from 1, with gaps: the object number in meshes and images
    label: str
    model: models.Model
    s: float
    lateral: float
    height: float
    turn: float  # relative to the heading of the street
    speed: float  # along the street; negative towards its start
    upright: bool

    def pose(self, street: Street, time: float) -> F64:
        """Return the (4, 4) pose at a time."""
        return street.pose(self.s + self.speed * time, self.lateral, self.height, self.turn, self.upright)

    def mesh(self, street: Street, time: float) -> Mesh:
        """Return the mesh at a time, in the map frame."""
        return self.model.at(abs(self.speed) * time).moved(self.pose(street, time)).numbered(self.number)


@dataclass(frozen=True, slots=True)
class Light:
    """Sunlight and colours of the sky."""

    sun: F32  # (3,) unit vector to the sun
    direct: F32  # (3,) BGR strength of the sun
    ambient: F32  # (3,) BGR strength of the sky
    zenith: F32  # (3,) BGR colour
    horizon: F32  # (3,)


class World:
    """The world of one seed: the street with its scenery, and its actors.

    Args:
        seed: seed of all random numbers.
        duration: seconds that the ego vehicle drives.
        scenes: additional scenes: seconds into the drive, and the function that adds the scene. Other actors
            stay the same, except those in the way.
        weave: whether the ego vehicle swerves, brakes and speeds up. Its mean position stays the same.
    """

    def __init__(
        self,
        seed: int,
        duration: float,
        scenes: Sequence[tuple[float, Callable[[SceneArea], None]]] = (),
        *,
        weave: bool = False,
    ) -> None:
        self.length = SPEED * duration + 10.0
        self._weave = weave
        self.street = Street(_stream(seed, "street"), self.length)
        self.light = _light(_stream(seed, "light"))
        self._sway = _stream(seed, "sway").uniform(0, 2 * np.pi, 2)
        stages = [
            SceneArea(self.street, self._way(time), time, np.random.default_rng(seed)) for time, _ in scenes
        ]
        for (_, scene), stage in zip(scenes, stages, strict=True):
            scene(stage)
        rows: list[list[Actor]] = [list(row) for row in _population(seed, self.street, duration)]
        rows.append([actor for stage in stages for actor in stage.actors])
        self.actors = [
            # The number of an actor does not depend on the number of other actors.
            replace(actor, number=1 + i + k * len(rows))
            for i, row in enumerate(rows)
            for k, actor in enumerate(row)
            if row is rows[-1] or all(stage.is_clear_of(actor) for stage in stages)
        ]
        self._parked = {a.number: a.mesh(self.street, 0.0) for a in self.actors if a.speed == 0}
        self._scenery: list[SceneryItem] = [
            *chain.from_iterable(_houses(_stream(seed, "houses", side), self.street, side) for side in SIDES),
            *chain.from_iterable(
                _furniture(_stream(seed, "furniture", side), self.street, side) for side in SIDES
            ),
            *chain.from_iterable(stage.placed for stage in stages),
            *((a.s, self._parked[a.number]) for a in self.actors if a.speed == 0),
        ]

    def section(self, time: float) -> int:
        """Return the section of the street that the ego vehicle is in."""
        return int(self._way(time) // SECTION)

    def static(self, section: int) -> Mesh:
        """Return the static scenery within ``MARGIN`` metres of a section."""
        start = max(section * SECTION - MARGIN, self.street.start)
        end = (section + 1) * SECTION + MARGIN
        return merge([_ground(self.street, start, end), *(m for s, m in self._scenery if start <= s < end)])

    def ego(self, time: float) -> F64:
        """Return (4, 4) map_from_base_link: on the road below the middle of the vehicle."""
        if self._weave:
            return self._weaving(time)
        s = self._way(time)
        rate = 2 * np.pi / 6.0
        lateral = -1.7 + 0.2 * np.sin(rate * time + self._sway[1])
        turn = np.arctan2(0.2 * rate * np.cos(rate * time + self._sway[1]), SPEED)
        return self.street.pose(s, lateral, turn=turn, upright=False)

    def _weaving(self, time: float) -> F64:
        """Return the pose of a weaving vehicle.

        It varies between 2 and 14 m/s in 8 s, and by 0.7 m to either side in 5 s: up to 12 degrees a second.
        """
        swing = 2 * np.pi / 5.0
        phase, pace = swing * time + self._sway[1], SPEED + 6.0 * np.cos(_PACE * time)
        turn = np.arctan2(0.7 * swing * np.cos(phase), pace)
        return self.street.pose(self._way(time), -1.7 + 0.7 * np.sin(phase), turn=turn, upright=False)

    def _way(self, time: float) -> float:
        """Return the position of the ego vehicle in metres along the street."""
        if self._weave:
            return SPEED * time + 6.0 / _PACE * float(np.sin(_PACE * time))
        return SPEED * time + 1.5 * float(np.sin(0.5 * time + self._sway[0]) - np.sin(self._sway[0]))

    def moving(self, time: float, centre: F64, reach: float) -> Mesh:
        """Return the meshes of the moving actors within ``reach`` metres of ``centre``."""
        return merge([a.mesh(self.street, time) for a in self._near(time, centre, reach) if a.speed != 0])

    def objects(self, time: float, centre: F64, reach: float) -> list[tuple[Actor, Mesh, float]]:
        """Return every actor within ``reach`` metres of ``centre``, its mesh and its heading.

        Mesh and heading are in the map frame.
        """
        return [
            (
                a,
                self._parked.get(a.number) or a.mesh(self.street, time),
                geometry.yaw(a.pose(self.street, time)),
            )
            for a in self._near(time, centre, reach)
        ]

    def _near(self, time: float, centre: F64, reach: float) -> list[Actor]:
        """Return the actors within ``reach`` metres of ``centre``."""
        s = np.array([a.s + a.speed * time for a in self.actors])
        place = self.street.point(s, np.array([a.lateral for a in self.actors]))
        near = (
            (np.linalg.norm(place - centre, axis=1) < reach)
            & (s > self.street.start + 5)
            & (s < self.street.end - 5)
        )
        return [self.actors[i] for i in np.flatnonzero(near)]


class SceneArea:
    """The right half of the road ahead of the ego vehicle at one time, where a scene is placed.

    Args:
        street: the street.
        way: position of the ego vehicle in metres along the street.
        time: seconds into the drive.
        rng: random numbers of the scene.
    """

    AHEAD, RIGHT, LEFT = (-4.0, 19.0), -6.4, 0.0  # metres from the ego vehicle, and from the centre line

    def __init__(self, street: Street, way: float, time: float, rng: np.random.Generator) -> None:
        self.rng, self._street, self._way, self._time = rng, street, way, time
        self.actors: list[Actor] = []
        self.placed: list[SceneryItem] = []

    def add(self, label: str, model: models.Model, ahead: float, lateral: float, turn: float = 0.0) -> None:
        """Add a standing road user ``ahead`` metres in front of the ego vehicle."""
        s, upright = self._way + ahead, label == "person"
        self.actors.append(Actor(0, label, model, s, lateral, 0.0, turn, 0.0, upright))

    def place(self, mesh: Mesh, ahead: float, lateral: float) -> None:
        """Add an object without a class."""
        s = self._way + ahead
        self.placed.append((s, mesh.moved(self._street.pose(s, lateral))))

    def is_clear_of(self, actor: Actor) -> bool:
        """Return whether an actor of the street is elsewhere at that time. Other actors are removed."""
        ahead = actor.s + actor.speed * self._time - self._way
        return not (self.AHEAD[0] < ahead < self.AHEAD[1] and self.RIGHT < actor.lateral < self.LEFT)


# --- population --------------------------------------------------------------------------------

SIDES = (-1, 1)
SceneryItem = tuple[float, Mesh]  # metres along the street, and the mesh that begins there
_TOWN = (
    1  # chosen so that each planted fault on the street of seed 0 fools the stages named in its description
)


def _stream(seed: int, kind: str, side: int = 0) -> np.random.Generator:
    """Return random numbers for one kind of objects. Draws for other kinds do not change them."""
    return np.random.default_rng((_TOWN, seed, zlib.crc32(kind.encode()), side + 1))


def _population(seed: int, street: Street, duration: float) -> Iterator[Iterator[Actor]]:
    """Yield rows of actors, each in order along the street.

    The actors of a lane share one speed, so that none drives through another. Oncoming actors start from
    beyond the end of the street.
    """

    def until(speed: float) -> float:
        return street.end + max(0.0, -speed) * duration

    for side in SIDES:
        yield _parked(_stream(seed, "parked", side), street, side)
    yield _cars(_stream(seed, "traffic"), -1.7, SPEED, (-22.0, 21.0), 55.0, until(SPEED))
    yield _cars(_stream(seed, "oncoming"), 1.7, -9.0, (), 20.0, until(-9.0))
    yield _cyclists(_stream(seed, "cyclists", -1), -3.7, 4.6, 9.0, 45.0, until(4.6))
    yield _cyclists(_stream(seed, "cyclists", 1), 3.7, -4.8, 14.0, 55.0, until(-4.8))
    for side in SIDES:
        for lateral, way in ((8.0, 1), (8.8, -1)):
            rng = _stream(seed, f"walkers at {lateral}", side)
            speed = way * rng.uniform(1.15, 1.3)
            yield _walkers(rng, side * lateral, speed, street.start, until(1.03 * speed))
        yield _standing(_stream(seed, "standing", side), street, side)


def _spaced(rng: np.random.Generator, start: float, end: float, least: float, most: float) -> Iterator[float]:
    """Yield positions along the street with random gaps between ``least`` and ``most`` metres."""
    s = start + rng.uniform(0.0, most - least)
    while s < end:
        yield s
        s += rng.uniform(least, most)


def _actor(
    label: str, model: models.Model, s: float, lateral: float, height: float, turn: float, speed: float = 0.0
) -> Actor:
    """Make an actor without a number."""
    return Actor(0, label, model, s, lateral, height, turn, speed, upright=label == "person")


def _parked(rng: np.random.Generator, street: Street, side: int) -> Iterator[Actor]:
    """Yield parked cars, and people standing in gaps between them."""
    for s in _spaced(rng, street.start + 8, street.end, 5.9, 7.5):
        if rng.random() < 0.48:
            turn = rng.normal(0, 0.02) + (np.pi if (side > 0) ^ (rng.random() < 0.15) else 0)
            yield _actor("car", models.car(rng), s, side * (5.3 + rng.normal(0, 0.05)), 0.0, turn)
        elif rng.random() < 0.4:
            yield _actor("person", models.person(rng, False), s, side * 4.9, 0.0, -side * np.pi / 2)


def _cars(
    rng: np.random.Generator, lateral: float, speed: float, first: tuple[float, ...], start: float, end: float
) -> Iterator[Actor]:
    """Yield the cars of a lane."""
    for s in chain(first, _spaced(rng, start, end, 20, 60)):
        yield _actor("car", models.car(rng), s, lateral, 0.0, 0.0 if speed > 0 else np.pi, speed)


def _cyclists(
    rng: np.random.Generator, lateral: float, speed: float, start: float, most: float, end: float
) -> Iterator[Actor]:
    """Yield the cyclists of a lane."""
    for s in _spaced(rng, start, end, 18, most):
        yield _actor("cyclist", models.cyclist(rng), s, lateral, 0.0, 0.0 if speed > 0 else np.pi, speed)


def _walkers(
    rng: np.random.Generator, lateral: float, speed: float, start: float, end: float
) -> Iterator[Actor]:
    """Yield people who walk alone or in pairs."""
    for s in _spaced(rng, start, end, 5, 26):
        turn = 0.0 if speed > 0 else np.pi
        offsets = (0.0, 0.6) if rng.random() < 0.25 else (rng.normal(0, 0.1),)
        for offset in offsets:
            model = models.person(rng)
            pace = speed * (1.0 if len(offsets) == 2 else rng.uniform(0.97, 1.03))
            yield _actor("person", model, s, lateral - np.sign(lateral) * offset, KERB, turn, pace)


def _standing(rng: np.random.Generator, street: Street, side: int) -> Iterator[Actor]:
    """Yield people who stand on the pavement."""
    for s in _spaced(rng, street.start, street.end, 12, 50):
        turn = rng.uniform(0, 2 * np.pi)
        yield _actor("person", models.person(rng, walking=False), s, side * 7.3, KERB, turn)


# --- scenery -----------------------------------------------------------------------------------


def _light(rng: np.random.Generator) -> Light:
    """Return a random light of the day."""
    azimuth, height = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(28, 62))
    sun = np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])
    cloudy = rng.random()
    clear, grey = np.array([(215, 160, 105), (235, 215, 190)]), np.array([(205, 200, 195), (222, 220, 216)])
    zenith, horizon = clear + cloudy * (grey - clear)
    direct = np.array([0.62, 0.68, 0.72]) * (1 - 0.75 * cloudy)
    ambient = np.array([0.5, 0.46, 0.43]) + 0.28 * cloudy
    return Light(*(v.astype(np.float32) for v in (sun, direct, ambient, zenith, horizon)))


def _ground(street: Street, start: float, end: float) -> Mesh:
    """Return road, kerbs, pavements and grass between two positions along the street."""
    s = np.arange(start, end + 1.0, 2.0)
    strips = (
        ((-60, -25, -PAVEMENT), KERB, (60, 115, 95), Material.GRASS),
        ((-PAVEMENT, -8, -ROAD), KERB, (140, 146, 150), Material.PAVEMENT),
        ((-ROAD, -3.2, 0, 3.2, ROAD), 0.0, (82, 82, 82), Material.ROAD),
        ((ROAD, 8, PAVEMENT), KERB, (140, 146, 150), Material.PAVEMENT),
        ((PAVEMENT, 25, 60), KERB, (60, 115, 95), Material.GRASS),
    )
    parts = []
    for lateral, height, color, material in strips:
        points = street.point(s[:, None], np.array(lateral, float), height)
        uv = np.stack(np.broadcast_arrays(s[:, None], np.array(lateral, float)), axis=-1)
        parts.append(grid(points, uv, color, material))
    for lateral_ in (-ROAD, ROAD):
        points = np.stack([street.point(s, lateral_), street.point(s, lateral_, KERB)], axis=1)
        parts.append(grid(points, np.zeros((*points.shape[:2], 2)), (170, 172, 175), Material.KERB))
    return merge(parts)


def _houses(rng: np.random.Generator, street: Street, side: int) -> Iterator[SceneryItem]:
    """Yield houses, and gaps with hedges and trees."""
    s = street.start
    while s < street.end:
        length = rng.uniform(8, 18)
        if rng.random() < 0.2:
            yield s, models.hedge(rng, length).moved(street.pose(s + length / 2, side * 9.9, KERB))
            for at in np.arange(s + 2, s + length, 5.0):
                yield at, models.tree(rng).moved(street.pose(at, side * rng.uniform(11.5, 18), KERB))
        else:
            mesh = models.house(rng, length, rng.uniform(8, 12), rng.uniform(6, 14))
            front = side * (PAVEMENT + 0.25 + max(0.0, rng.normal(0, 0.5)))
            turn = 0 if side > 0 else np.pi
            yield s, mesh.moved(street.pose(s + length / 2, front, KERB, turn=turn))
        s += length


def _furniture(rng: np.random.Generator, street: Street, side: int) -> Iterator[SceneryItem]:
    """Yield lamps, trees, signs and bins along the pavement."""
    turn = 0 if side < 0 else np.pi
    for s in _spaced(rng, street.start + 2, street.end, 7, 15):
        kind = rng.choice(["lamp", "tree", "sign", "bin"], p=[0.35, 0.35, 0.18, 0.12])
        if kind == "lamp":
            yield s, models.lamp_post().moved(street.pose(s, side * 6.75, KERB, turn=turn))
        elif kind == "tree":
            yield s, models.tree(rng).moved(street.pose(s, side * 6.9, KERB))
        elif kind == "sign":
            yield s, models.sign(rng).moved(street.pose(s, side * 6.8, KERB, turn=turn))
        else:
            yield s, models.litter_bin(rng).moved(street.pose(s, side * 6.85, KERB))


def bounds(mesh: Mesh, frame_from_map: F64, heading: float) -> tuple[F32, F32]:
    """Return centre and size of the tight upright box around a mesh, rotated by ``heading``.

    The mesh is in the map frame, the box in the frame.
    """
    points = geometry.apply(frame_from_map, mesh.vertices)
    c, s = np.float32(np.cos(heading)), np.float32(np.sin(heading))
    turned = np.stack(
        [c * points[:, 0] + s * points[:, 1], c * points[:, 1] - s * points[:, 0], points[:, 2]], -1
    )
    low, high = turned.min(0), turned.max(0)
    x, y, z = (low + high) / 2
    return np.array([c * x - s * y, s * x + c * y, z], np.float32), high - low
