"""False alarms on undisturbed drives, and how soon planted faults are told.

Faults are planted around the synthetic drive: what a frame holds, or what the detector says of it, is changed
from one moment on, and a copy of the session, with all that it remembers, goes on with that.
"""

from __future__ import annotations

import argparse
import copy
import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

import bevviz
from benchmarks.pages import write_section
from benchmarks.sensor_faults import SensorTally, play_forth_and_back, results
from benchmarks.sensor_faults import measure as measure_sensors
from bevviz.anomalies import Onsets
from bevviz.config import Config, load
from bevviz.extras.demo.drive import Snapshot, SyntheticSource
from bevviz.model import geometry
from bevviz.model.frame import Bool, Camera, Frame
from bevviz.model.results import Anomaly, Detections, FrameResult
from bevviz.pipeline.session import Session
from bevviz.pipeline.stage_loader import StageLoader
from tests.support.sensor_plants import Results

CHOSEN_ON = (2000, 2001, 2011)  # seeds that rules and limits were looked at on
SEEDS = (2010, 2012, 2013)  # seeds that figures are of

INTRO = f"""## Anomalies

Faults planted in the synthetic drives {SEEDS} of 10 s, and faults of sensors in {{real}} as well, by
`python -m benchmarks.anomalies`, which also lists the false alarms. Limits were chosen on {CHOSEN_ON}
and on the real drive.
"""
REAL = "25 frames of a KITTI drive"

FRAMES = 100
EVERY, FIRST = 20, 30  # frames: when faults are planted
IN_TIME = 0.3  # seconds
HORIZON = 6  # frames that a fault is watched for
NEAR = 25.0  # metres: a fault of an object is planted on one that is nearer
SEEN = 8  # of the last ten frames, that it was reported in

Shot = tuple[Snapshot, Detections]
Kinds = frozenset[str]


class Shown:
    """A detector that says what it is given."""

    detections: Detections

    def __call__(self, camera: Camera) -> Detections:
        return self.detections


@dataclass(frozen=True, slots=True)
class Target:
    """The object that a fault is planted on."""

    number: int  # of the world's actors
    label: str


@dataclass(frozen=True, slots=True)
class Fault:
    """A change of a frame; ``plant`` gets it, the one before it, and the target."""

    kinds: Kinds  # of anomalies that tell it
    labels: tuple[str, ...]  # that the target may have; (): it needs none
    plant: Callable[[Shot, Shot, Target], tuple[Frame, Detections]]


def shots(seed: int, frames: int = FRAMES) -> Iterator[Shot]:
    """Yield the frames of an undisturbed drive with the detections of the demo network."""
    detector = StageLoader().load(load(settings=["detector.model=demo"])).detector
    assert detector is not None
    source = SyntheticSource(frames, seed)
    for index in range(frames):
        shot = source.snapshot(index)
        image = shot.frame.cameras[0].image
        assert image is not None
        yield shot, detector(image.bgr)


# --- faults ------------------------------------------------------------------------------------


def _without(found: Detections, gone: Bool) -> Detections:
    """Return the detections without the rows ``gone``. A suppressed detection stays suppressed."""
    rows = np.flatnonzero(~gone)
    return Detections(
        found.xyxy[rows],
        found.score[rows],
        found.class_id[rows],
        tuple(found.names[d] for d in rows),
        found.state[rows],
        np.full(len(rows), -1, np.int32),
        found.overlap[rows],
    )


def _place(shot: Snapshot, target: Target) -> np.ndarray:
    """(1, 4) around the target's pixels in the image."""
    rows, columns = np.nonzero(shot.pixel_object == target.number)
    if len(rows) == 0:
        return np.full((1, 4), np.nan, np.float32)
    return np.array([[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]], np.float32) - 0.5


def _class_dropped(now: Shot, before: Shot, target: Target) -> tuple[Frame, Detections]:
    shot, found = now
    return shot.frame, _without(found, np.array([name == target.label for name in found.names], bool))


def _unseen_by_camera(now: Shot, before: Shot, target: Target) -> tuple[Frame, Detections]:
    shot, found = now
    near = geometry.iou(found.xyxy, _place(shot, target))[:, 0] > 0.2
    same = np.array([name == target.label for name in found.names], bool)
    return shot.frame, _without(found, near & same)


def _points(frame: Frame, points: np.ndarray, kept: np.ndarray) -> Frame:
    fields = {name: values[kept] for name, values in frame.fields.items()}
    cloud = replace(frame.clouds[0], xyz=points[kept], fields=fields)
    return replace(frame, points=points[kept], fields=fields, clouds=(cloud,))


def _unseen_by_lidar(now: Shot, before: Shot, target: Target) -> tuple[Frame, Detections]:
    shot, found = now
    others = np.flatnonzero(shot.point_object != target.number)
    return _points(shot.frame, shot.frame.points, others), found


def _jumped(now: Shot, before: Shot, target: Target) -> tuple[Frame, Detections]:
    """Two metres farther away: the camera still sees it where it was."""
    shot, found = now
    mine = shot.point_object == target.number
    points = shot.frame.points.copy()
    sight = points[mine, :2].mean(axis=0)
    points[mine, :2] += 2.0 * sight / np.linalg.norm(sight)
    return _points(shot.frame, points, np.arange(len(points))), found


def _late_image(now: Shot, before: Shot, target: Target) -> tuple[Frame, Detections]:
    frame, camera = now[0].frame, before[0].frame.cameras[0]
    assert camera.image is not None and camera.world_from_camera is not None
    late = replace(
        camera,
        sync_error=(camera.image.stamp - frame.stamp) * 1e-9,
        camera_from_points=geometry.inverse(camera.world_from_camera) @ frame.pose,
    )
    return replace(frame, cameras=(late,)), before[1]


def _no_image(now: Shot, before: Shot, target: Target) -> tuple[Frame, Detections]:
    frame = now[0].frame
    gone = replace(frame.cameras[0], image=None, sync_error=float("nan"))
    return replace(frame, cameras=(gone,)), Detections.empty()


def _camera_lost(now: Shot, before: Shot, target: Target) -> tuple[Frame, Detections]:
    frame, found = now[0].frame, now[1]
    lost = replace(frame.cameras[0], camera_from_points=None, world_from_camera=None)
    return replace(frame, cameras=(lost,)), found


def _pose_lost(now: Shot, before: Shot, target: Target) -> tuple[Frame, Detections]:
    return replace(now[0].frame, world_from_points=None), now[1]


FAULTS = {
    "detector drops a class": Fault(
        frozenset({"flicker", "one_sensor"}), ("person", "car", "cyclist"), _class_dropped
    ),
    "box jumps by 2 m": Fault(frozenset({"jump", "one_sensor"}), ("person", "car", "cyclist"), _jumped),
    "person unseen by the camera": Fault(
        frozenset({"one_sensor", "flicker"}), ("person",), _unseen_by_camera
    ),
    "person unseen by the LiDAR": Fault(frozenset({"one_sensor", "flicker"}), ("person",), _unseen_by_lidar),
    "image of the scan before": Fault(frozenset({"sync"}), (), _late_image),
    "no image": Fault(frozenset({"sync"}), (), _no_image),
    "transform of the camera lost": Fault(frozenset({"tf"}), (), _camera_lost),
    "pose lost": Fault(frozenset({"tf"}), (), _pose_lost),
}


# --- what is told ------------------------------------------------------------------------------


@dataclass
class Tally:
    alarms: list[tuple[int, int, Anomaly]] = field(default_factory=list)  # seed, frame
    seconds: float = 0.0  # undisturbed
    delays: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))  # inf: not told


def measure(seeds: Sequence[int], config: Config, made: Callable[[int], Iterator[Shot]] = shots) -> Tally:
    """Every drive once undisturbed, and from time to time with each fault."""
    tally = Tally()
    for seed in seeds:
        drive = list(tqdm(made(seed), total=FRAMES, unit="frame", desc=f"drive {seed}", disable=None))
        session, onsets, reported = Session(config, Shown()), Onsets(), list[set[int]]()
        known: set[tuple[str, str, int]] = set()
        result: FrameResult | None = None
        for index, (shot, found) in enumerate(tqdm(drive, unit="frame", disable=None)):
            if (
                result is not None
                and index >= FIRST
                and (index - FIRST) % EVERY == 0
                and index + HORIZON < len(drive)
            ):
                window = drive[index - 1 : index + HORIZON]
                for name, fault in FAULTS.items():
                    for target in targets(fault, [shot for shot, _ in window], result, reported):
                        tally.delays[name].append(_delay(session, known, window, fault, target))
            result = run(session, shot.frame, found)
            known = {(a.kind, a.subject, a.since) for a in result.anomalies}
            tally.alarms += [(seed, index, anomaly) for anomaly in onsets.of(result.anomalies)]
            reported.append(_reported(shot, result))
        tally.seconds += len(drive) * 0.1
    return tally


def run(session: Session, frame: Frame, found: Detections) -> FrameResult:
    """Run the stages on the next frame with these detections. Skip what only the images need."""
    detect = session.stages.detect
    assert isinstance(detect, Shown)
    detect.detections = found
    return session.add_anomalies(session.perceive(frame))


def _delay(
    session: Session, known: set[tuple[str, str, int]], window: list[Shot], fault: Fault, target: Target
) -> float:
    """Seconds from the first frame with the fault to the first that tells it."""
    disturbed = copy.deepcopy(session)
    for step, (before, now) in enumerate(itertools.pairwise(window)):
        frame, found = fault.plant(now, before, target)
        result = run(disturbed, frame, found)
        new = [a for a in result.anomalies if (a.kind, a.subject, a.since) not in known]
        if any(anomaly.kind in fault.kinds for anomaly in new):
            return step * 0.1
    return float("inf")


def targets(
    fault: Fault, window: list[Snapshot], result: FrameResult, reported: list[set[int]]
) -> list[Target]:
    """Return the objects on which the fault can be planted now: for each label the nearest reported object.

    An object does not count if it was not reported in most of the last frames. It does not count either if it
    leaves the image or gets hidden within the window.
    """
    if not fault.labels:
        return [Target(0, "")]
    before = window[0]
    truth = before.frame.truth
    assert truth is not None
    chosen = []
    away = np.hypot(*truth.boxes.center[:, :2].T)
    for label in fault.labels:
        for k in np.argsort(away).tolist():
            number = int(before.truth_object[k])
            often = sum(number in seen for seen in reported[-10:])
            if truth.labels[k] != label or away[k] > NEAR or often < SEEN or number not in reported[-1]:
                continue
            if _stays_in_view(window[: round(IN_TIME * 10) + 2], number):
                chosen.append(Target(number, label))
                break
    return chosen


def _stays_in_view(window: list[Snapshot], number: int) -> bool:
    """Whether an object does not touch the border of the image, nor gets hidden by half."""
    pixels, points = [], []
    for shot in window:
        mine = shot.pixel_object == number
        if mine[[0, -1]].any() or mine[:, [0, -1]].any():
            return False
        pixels.append(mine.sum())
        points.append((shot.point_object == number).sum())
    return bool(min(pixels) > pixels[0] / 2 and min(points) > points[0] / 2)


def _reported(shot: Snapshot, result: FrameResult) -> set[int]:
    """Numbers of the objects that were reported, under their own class and within 2 m."""
    truth, objects = shot.frame.truth, result.objects
    if truth is None or objects is None:
        return set()
    found = set()
    for j, name in enumerate(objects.names):
        distance = np.hypot(*(truth.boxes.center[:, :2] - objects.boxes.center[j, :2]).T)
        right = np.where([label == name for label in truth.labels], distance, np.inf)
        if len(right) and right.min() <= 2.0:
            found.add(int(shot.truth_object[right.argmin()]))
    return found


def sensor_drives(seeds: Sequence[int], folder: Path) -> Iterator[Results]:
    """Yield the drives in which faults of sensors are planted: the real one first, if it is in the folder."""
    if folder.is_dir():
        with bevviz.open(folder) as drive:
            yield results(iter(drive.frames), Config())
    for seed in seeds:
        source = SyntheticSource(FRAMES, seed)
        yield results((source.snapshot(index).frame for index in range(FRAMES)), Config())


def table(tally: Tally, sensors: SensorTally) -> str:
    lines = [
        "| fault | planted | reported within 0.3 s | never | delay, median s |",
        "| --- |" + " ---: |" * 4,
    ]
    for name, told_after in {**{name: tally.delays[name] for name in FAULTS}, **sensors.delays}.items():
        delays = np.array(told_after)
        if not len(delays):
            lines.append(f"| {name} | 0 | - | - | - |")
            continue
        soon, never = int((delays <= IN_TIME + 1e-6).sum()), int(np.isinf(delays).sum())
        told = delays[np.isfinite(delays)]
        middle = f"{np.median(told):.1f}" if len(told) else "-"
        lines.append(f"| {name} | {len(delays)} | {soon} | {never} | {middle} |")
    rate = 10 * len(tally.alarms) / tally.seconds
    lines += [
        "",
        f"{len(tally.alarms)} false alarms in {tally.seconds:.0f} s undisturbed: {rate:.1f} in 10 s.",
        f"{len(sensors.alarms)} of a sensor in {sensors.seconds:.1f} s, the real drive among them, and "
        f"{len(sensors.played_alarms)} in {sensors.played:.0f} s of it played forth and back. "
        f"{sensors.misnamed} of the {sum(map(len, sensors.delays.values()))} faults of sensors were told by "
        "another name, too.",
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, action="append", help=f"drives (default: {SEEDS})")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--write", type=Path, help="page whose section is replaced, instead of printing it")
    parser.add_argument(
        "--real",
        type=Path,
        default=Path("../shared/data/kitti_drive"),
        help="real drive (default: %(default)s)",
    )
    options = parser.parse_args(arguments)
    sensors = SensorTally()
    for drive in sensor_drives(options.seed or SEEDS, options.real):
        if options.real.is_dir() and not sensors.played:  # The real drive comes first.
            play_forth_and_back(drive, sensors)
        measure_sensors(drive, sensors)
    tally = measure(options.seed or SEEDS, load(settings=options.set))
    if options.write:
        real = REAL if options.real.is_dir() else "no real drive"
        write_section(options.write, f"{INTRO.format(real=real)}\n{table(tally, sensors)}\n")
        return
    print(table(tally, sensors))
    for seed, index, anomaly in tally.alarms:
        print(f"- drive {seed}, frame {index}: {anomaly.kind}: {anomaly.text}")
    for anomaly in (*sensors.alarms, *sensors.played_alarms):
        print(f"- {anomaly.text}")


if __name__ == "__main__":
    main()
