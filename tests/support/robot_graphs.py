r"""A robot of eight nodes that pass on objects, with a planted loss: the messages, and which node did it.

Nothing of the package is used but the record of a message, so that the inference is not judged by itself.

    lidar_detector -> validator ---\
                                    merger -> tracker -> lane_filter -> planner -> display
    camera_detector ---------------/
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bevviz.extras.robot_chain.chain import ObjectMessage

TOPICS = {
    "lidar_detector": "/lidar/objects",
    "camera_detector": "/camera/objects",
    "validator": "/lidar/valid",
    "merger": "/merged",
    "tracker": "/tracks",
    "lane_filter": "/relevant",
    "planner": "/planner/objects",
    "display": "/display/objects",
}
NODES = tuple(TOPICS)
PARENT = {"validator": "lidar_detector", "merger": "validator", "tracker": "merger"}
PARENT |= {"lane_filter": "tracker", "planner": "lane_filter", "display": "planner"}
DELAY = {"lidar_detector": 40, "camera_detector": 60, "validator": 5, "merger": 12, "tracker": 9}
DELAY |= {"lane_filter": 4, "planner": 30, "display": 3}  # milliseconds
NAMES = ("car", "person", "cyclist", "truck")
SIZES = {
    "car": (4.3, 1.8, 1.5),
    "person": (0.6, 0.6, 1.75),
    "cyclist": (1.8, 0.6, 1.7),
    "truck": (8.0, 2.5, 3.0),
}
PERIOD = 100_000_000  # nanoseconds
START = 1_700_000_000_000_000_000

Kind = Literal["dropped", "renamed", "moved", "delayed", "message lost"]
KINDS: tuple[Kind, ...] = ("dropped", "renamed", "moved", "delayed", "message lost")


@dataclass(frozen=True)
class Plant:
    """One planted loss: a node does something to an object of a frame."""

    node: str
    kind: Kind
    frame: int
    thing: int


@dataclass
class _Row:
    thing: int
    name: str
    place: np.ndarray
    size: np.ndarray
    identity: str


@dataclass(frozen=True)
class Graph:
    """Messages by topic, stamps of the sensors, and where each planted thing really is."""

    messages: Mapping[str, Sequence[ObjectMessage]]
    sensors: Mapping[str, Sequence[int]]
    plants: Sequence[Plant]
    places: Mapping[Plant, tuple[int, np.ndarray]]


def make_graph(
    seed: int,
    frames: int = 60,
    things: int = 14,
    plants: int = 16,
    start: int = START,
    jitter: int = 2_000_000,
    losses: float = 0.01,
) -> Graph:
    """Drive past things for some seconds.

    Args:
        seed: seed of all that is random.
        frames: number of scans.
        things: number of things.
        plants: number of planted losses.
        start: stamp of the first scan.
        jitter: nanoseconds that a stamp is off at most.
        losses: share of the things that each node loses of its own accord.
    """
    rng = np.random.default_rng(seed)
    names = [str(name) for name in rng.choice(NAMES, things)]
    begin = np.column_stack(
        [rng.uniform(-30, 50, things), np.arange(things) * 4.0 - 2.0 * things, np.zeros(things)]
    )
    speed = np.where(rng.random(things) < 0.5, 0.0, rng.uniform(-8, 8, things))
    seen_by_lidar, seen_by_camera = rng.random(things) < 0.85, rng.random(things) < 0.6
    seen_by_lidar |= ~seen_by_camera
    outside = rng.random(things) < 0.15  # things beside the lane, which the filter leaves out for good
    seen_by_lidar[0], seen_by_camera[0], outside[0] = True, False, False
    planted = _choose(rng, frames, plants, seen_by_lidar & ~seen_by_camera & ~outside)
    by_frame = {(plant.frame, plant.node): plant for plant in planted}
    messages: dict[str, list[ObjectMessage]] = {topic: [] for topic in TOPICS.values()}
    lags = dict.fromkeys(range(things), np.zeros(3))
    places = {}
    for frame in range(frames):
        stamp = start + frame * PERIOD + int(rng.integers(-jitter, jitter + 1))
        real = begin + np.column_stack([speed, np.zeros(things), np.zeros(things)]) * frame * 0.1
        for plant in planted:
            if plant.frame == frame:
                places[plant] = stamp, real[plant.thing]
        outputs: dict[str, list[_Row] | None] = {}
        times: dict[str, int] = {}
        for node in NODES:
            if node.endswith("detector"):
                seen = seen_by_lidar if node.startswith("lidar") else seen_by_camera
                rows: list[_Row] | None = [
                    _detection(rng, real[i], names[i], i) for i in np.flatnonzero(seen).tolist()
                ]
                ready = stamp
            else:
                rows, ready = outputs[PARENT[node]], times.get(PARENT[node], 0)
                if node == "merger" and rows is not None:
                    known = {row.thing for row in rows}
                    rows = rows + [row for row in outputs["camera_detector"] or () if row.thing not in known]
                    ready = max(ready, times["camera_detector"])
                if rows is not None:
                    rows = [_changed(rng, node, row, lags) for row in rows]
                if node == "lane_filter" and rows is not None:
                    rows = [row for row in rows if not outside[row.thing]]
                if node == "planner" and frame % 2:  # it runs at half of the rate
                    rows = None
            if rows is not None:  # Every node loses something now and then.
                asked = [plant.thing for plant in planted if plant.frame == frame]
                rows = [row for row in rows if row.thing in asked or rng.random() >= losses]
            plant_here = by_frame.get((frame, node))
            late = 0
            if plant_here is not None and rows is not None:
                rows, late = _plant(rng, rows, plant_here)
            outputs[node] = rows
            if rows is None:
                continue
            slow = max(0.3, rng.normal(1, 0.15))
            times[node] = ready + int(DELAY[node] * 1e6 * slow) + late
            messages[TOPICS[node]].append(_message(rng, stamp, times[node], rows))
    sensors = {"/points": sorted({one.stamp for one in messages[TOPICS["lidar_detector"]]})}
    ordered = {topic: sorted(those, key=lambda one: one.received) for topic, those in messages.items()}
    return Graph(ordered, sensors, planted, places)


def _choose(rng: np.random.Generator, frames: int, count: int, usable: np.ndarray) -> list[Plant]:
    """Choose nodes in turn. A planted frame is even, since the planner runs at half of the rate."""
    nodes = [node for node in NODES if node != "camera_detector"]
    chosen = rng.choice(np.arange(4, frames - 4, 2), count, replace=False)
    plants = []
    for row, frame in enumerate(chosen.tolist()):
        node, kind = nodes[row % len(nodes)], KINDS[int(rng.integers(len(KINDS)))]
        if node == "lidar_detector":
            kind = "dropped"  # Whether a first node renames or moves something, only the truth can tell.
        plants.append(Plant(node, kind, frame, int(rng.choice(np.flatnonzero(usable)))))
    return plants


def _detection(rng: np.random.Generator, place: np.ndarray, name: str, thing: int) -> _Row:
    size = np.asarray(SIZES[name]) * rng.normal(1, 0.03, 3)
    return _Row(thing, name, place + rng.normal(0, 0.05, 3), size, "")


def _changed(rng: np.random.Generator, node: str, row: _Row, lags: dict[int, np.ndarray]) -> _Row:
    """Return a row as a node changes all of them: a tracker smooths, a display has names of its own."""
    name, place, size, identity = row.name, row.place, row.size, row.identity
    if node == "tracker":
        lags[row.thing] = 0.7 * lags[row.thing] + rng.normal(0, 0.06, 3)
        place, identity = place + lags[row.thing], f"track-{row.thing}"
    if node == "display":
        name = {"car": "VEHICLE", "truck": "VEHICLE", "person": "VRU", "cyclist": "VRU"}.get(name, "OTHER")
    return _Row(row.thing, name, place, size, identity)


def _plant(rng: np.random.Generator, rows: list[_Row], plant: Plant) -> tuple[list[_Row] | None, int]:
    """Return the rows with the planted change, and nanoseconds of further delay."""
    if plant.kind == "message lost":
        return None, 0
    if plant.kind == "delayed":
        return rows, int(rng.uniform(150e6, 300e6))
    if plant.kind == "dropped":
        return [row for row in rows if row.thing != plant.thing], 0
    changed = []
    for row in rows:
        if row.thing == plant.thing and plant.kind == "renamed":
            row = _Row(row.thing, "animal", row.place, row.size, row.identity)
        elif row.thing == plant.thing:
            row = _Row(
                row.thing,
                row.name,
                row.place + rng.choice([-1, 1]) * np.array([4.5, 0, 0]),
                row.size,
                row.identity,
            )
        changed.append(row)
    return changed, 0


def _message(rng: np.random.Generator, stamp: int, received: int, rows: Sequence[_Row]) -> ObjectMessage:
    order = rng.permutation(len(rows))
    rows = [rows[row] for row in order]
    return ObjectMessage(
        stamp,
        received,
        np.array([row.place for row in rows], np.float32).reshape(-1, 3),
        np.array([row.size for row in rows], np.float32).reshape(-1, 3),
        tuple(row.name for row in rows),
        tuple(row.identity for row in rows) if rows and rows[0].identity else (),
    )
