"""Faults of sensors, planted in the synthetic drives and in a real one: how soon each is told by its name."""

from __future__ import annotations

import copy
import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bevviz.anomalies.sensors import SensorWatch
from bevviz.config import Config
from bevviz.model.frame import Frame
from bevviz.model.results import Anomaly, FrameResult
from bevviz.pipeline.session import Session
from tests.support.sensor_plants import (
    Results,
    blocked_sector,
    covered,
    defocused,
    jittered,
    muddy,
    noisy,
    pixels,
    recompressed,
    thinned,
    turned_camera,
    turned_lidar,
    turned_transform,
    with_image,
    with_scan,
    without_far_returns,
    without_image,
)

FIRST, EVERY = 8, 8  # frames, when faults are planted in a drive
NEWEST = 150_000_000  # nanoseconds by which a fault may be dated back
HORIZON = 6  # frames that a fault is watched for
PLAYED, STEP = 60.0, 0.1  # seconds that a real drive is played, and between its frames
LONGEST = 100  # frames that a transform which was always wrong is watched for
DEGREES = 3.0
TURNS = [(axis, sign * DEGREES) for axis in range(3) for sign in (1, -1)]
FADING = "returns that fade by 2 % a frame"
FADED = 40  # frames, that fading returns are watched for
ALWAYS = "transform wrong by 3 degrees from the first frame on"

Plant = Callable[[Results, int, int], FrameResult]  # of a drive, a frame and the first frame with the fault


@dataclass(frozen=True, slots=True)
class SensorPlant:
    """A fault, the name that tells it, and the ways to plant it."""

    told_by: str
    plants: tuple[Plant, ...]


def _turns(turn: Callable[[FrameResult, int, float], FrameResult]) -> tuple[Plant, ...]:
    """Return plants of a rotation about each axis, to both sides."""

    def plant(axis: int, degrees: float) -> Plant:
        return lambda drive, row, first: turn(drive[row], axis, degrees)

    return tuple(plant(axis, degrees) for axis, degrees in TURNS)


def _late_after_gap(drive: Results, row: int, first: int) -> FrameResult:
    """Return a frame without image, and then frames with the image before."""
    late = with_image(drive[row], pixels(drive[row - 1]).copy())
    return without_image(late) if row == first else late


SENSOR_FAULTS = {
    "black image": SensorPlant(
        "black image", (lambda d, i, _: with_image(d[i], np.zeros_like(pixels(d[i]))),)
    ),
    "dark image": SensorPlant("dark image", (lambda d, i, _: with_image(d[i], pixels(d[i]) // 8),)),
    "frozen image": SensorPlant("frozen image", (lambda d, i, k: with_image(d[i], pixels(d[k]).copy()),)),
    "image late by one": SensorPlant(
        "late image", (lambda d, i, _: with_image(d[i], pixels(d[i - 1]).copy()),)
    ),
    "black image with noise": SensorPlant(
        "black image", (lambda d, i, _: with_image(d[i], noisy(np.zeros_like(pixels(d[i])), 3, i)),)
    ),
    "dark image with noise": SensorPlant(
        "dark image", (lambda d, i, _: with_image(d[i], noisy(pixels(d[i]) // 8, 2, i)),)
    ),
    "frozen image, compressed at other qualities": SensorPlant(
        "frozen image", (lambda d, i, k: with_image(d[i], recompressed(pixels(d[k]), 60 + 10 * (i % 4))),)
    ),
    "frozen image with one grey value of noise": SensorPlant(
        "frozen image", (lambda d, i, k: with_image(d[i], noisy(pixels(d[k]), 0.7, i)),)
    ),
    "image late by one, compressed": SensorPlant(
        "late image", (lambda d, i, _: with_image(d[i], recompressed(pixels(d[i - 1]), 80)),)
    ),
    "one image missing, then all late by one": SensorPlant("late image", (_late_after_gap,)),
    "cover over 40 % of the lens": SensorPlant(
        "covered lens", (lambda d, i, _: with_image(d[i], covered(pixels(d[i]))),)
    ),
    "mud on the lens": SensorPlant(
        "covered lens", (lambda d, i, k: with_image(d[i], muddy(pixels(d[i]), k)),)
    ),
    "defocus, sigma 12": SensorPlant(
        "blurred image", (lambda d, i, _: with_image(d[i], defocused(pixels(d[i]))),)
    ),
    "frozen scan": SensorPlant("frozen scan", (lambda d, i, k: with_scan(d[i], d[k].frame.points.copy()),)),
    "frozen scan with noise of 1 cm": SensorPlant(
        "frozen scan", (lambda d, i, k: jittered(d[i], d[k].frame.points, i),)
    ),
    "returns beyond 15 m lost": SensorPlant("far returns lost", (lambda d, i, _: without_far_returns(d[i]),)),
    "half of the returns lost": SensorPlant("fewer returns", (lambda d, i, _: thinned(d[i], 0.5, i),)),
    "blocked sector with few returns": SensorPlant(
        "blocked sector", (lambda d, i, _: blocked_sector(d[i], 0.05),)
    ),
    "blocked sector of 35 degrees": SensorPlant("blocked sector", (lambda d, i, _: blocked_sector(d[i]),)),
    "transform jumps by 3 degrees": SensorPlant("jumped", _turns(turned_transform)),
    "camera turned by 3 degrees": SensorPlant("camera turned", _turns(turned_camera)),
    "LiDAR turned by 3 degrees": SensorPlant("LiDAR turned", _turns(turned_lidar)),
}


@dataclass
class SensorTally:
    """Delays of the planted faults, and the false alarms."""

    delays: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))  # s; inf: not told
    alarms: list[Anomaly] = field(default_factory=list)
    seconds: float = 0.0  # undisturbed
    played: float = 0.0  # seconds of a real drive, forth and back
    played_alarms: list[Anomaly] = field(default_factory=list)
    misnamed: int = 0  # planted faults that were told by another name, too


def results(frames: Iterator[Frame], config: Config) -> Results:
    """Run the stages without a detector."""
    session = Session(config)
    return [session.perceive(frame) for frame in frames]


def measure(drive: Results, tally: SensorTally) -> None:
    """Run a drive undisturbed and with each fault."""
    watch, seen = SensorWatch(), set[tuple[str, int]]()
    for row, result in enumerate(drive):
        if row >= FIRST and (row - FIRST) % EVERY == 0 and row + HORIZON <= len(drive):
            for name, fault in SENSOR_FAULTS.items():
                for plant in fault.plants:
                    window = [plant(drive, i, row) for i in range(row, row + HORIZON)]
                    tally.delays[name].append(_delay(_copy(watch), window, fault.told_by, tally))
        new = [a for a in _update(watch, result) if (a.subject, a.since) not in seen]
        seen |= {(a.subject, a.since) for a in new}
        tally.alarms += new
    fading = [thinned(r, max(1 - 0.02 * max(i - FIRST, 0), 0.1), i) for i, r in enumerate(drive[:FADED])]
    tally.delays[FADING].append(_delay(SensorWatch(), fading, "fewer returns", tally) - 0.1 * FIRST)
    for axis, degrees in TURNS:
        wrong = [turned_transform(result, axis, degrees) for result in drive[:LONGEST]]
        tally.delays[ALWAYS].append(_delay(SensorWatch(), wrong, "not where its transform says", tally))
    tally.seconds += 0.1 * len(drive)


def play_forth_and_back(drive: Results, tally: SensorTally) -> None:
    """Count the false alarms of a short real drive that is played forth and back for a minute.

    The content is real at every step, and no frame follows itself.
    """
    watch, seen = SensorWatch(), set[tuple[str, int]]()
    rows = [*range(len(drive)), *range(len(drive) - 2, 0, -1)]
    start = drive[0].frame.stamp
    for number, row in zip(range(round(PLAYED / STEP)), itertools.cycle(rows), strict=False):
        result = _moved(drive[row], start + round(number * STEP * 1e9) - drive[row].frame.stamp)
        new = [a for a in _update(watch, result) if (a.subject, a.since) not in seen]
        seen |= {(a.subject, a.since) for a in new}
        tally.played_alarms += new
    tally.played += PLAYED


def _moved(result: FrameResult, by: int) -> FrameResult:
    """Return a result with later stamps, in nanoseconds."""
    frame, cameras = result.frame, []
    for camera in result.cameras:
        image = camera.camera.image
        moved = image and replace(image, stamp=image.stamp + by)
        cameras.append(replace(camera, camera=replace(camera.camera, image=moved)))
    frame = replace(
        frame,
        stamp=frame.stamp + by,
        clouds=tuple(replace(cloud, stamp=cloud.stamp + by) for cloud in frame.clouds),
        cameras=tuple(camera.camera for camera in cameras),
    )
    return replace(result, frame=frame, cameras=tuple(cameras))


def _update(watch: SensorWatch, result: FrameResult) -> Sequence[Anomaly]:
    """Return the faults of a frame."""
    return watch.update(result.frame, result.voxels, result.ground)


def _copy(watch: SensorWatch) -> SensorWatch:
    """Return a copy with the same past. Both share the threads and what these were asked for."""
    check = watch._placement._check
    shared = [watch.worker, watch._checker, watch._lock, *([] if check is None else [check[3]])]
    return copy.deepcopy(watch, {id(one): one for one in shared})


def _delay(watch: SensorWatch, window: Sequence[FrameResult], told_by: str, tally: SensorTally) -> float:
    """Return the seconds from the first frame to the one that tells the fault."""
    delay, others = float("inf"), False
    for row, result in enumerate(window):
        for anomaly in _update(watch, result):
            if anomaly.since < window[0].frame.stamp - NEWEST:
                continue  # an alarm from before the fault
            words = anomaly.subject.partition(": ")
            name = f"{words[0].split()[0]} {words[2]}"
            if told_by in name:
                delay = min(delay, 0.1 * row)
            else:
                others = True
    tally.misnamed += others
    return delay
