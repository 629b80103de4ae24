"""How well the default finds objects with other sensors and mountings, on simulated drives.

Each drive is written to a bag and read again, so that poses and gravity are those of a recording. The
detector sees the visible image box of every object: the figures are those of the LiDAR stages and the fusion.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import bevviz
from benchmarks.accuracy import required
from benchmarks.pages import write_section
from bevviz.config import load
from bevviz.evaluate import MAX_DISTANCE, MIN_HITS, RANGE, judge, truth_of
from bevviz.extras.demo.bag import write_bag
from bevviz.extras.demo.drive import PERIOD, START, Snapshot, SyntheticSource
from bevviz.extras.demo.sensors import Lidar, optical
from bevviz.model import geometry
from bevviz.model.frame import F64, Bool, Camera
from bevviz.model.results import Detections
from bevviz.pipeline.session import Session

SEEDS = (3001, 3002, 3003)
FRAMES = 12  # of each drive
DRAWS = 2000  # of frames, for the intervals

INTRO = f"""## Other rigs

`python -m benchmarks.rigs`: {FRAMES} frames of each of the drives {SEEDS}, with the `default` preset
and the visible image boxes of the objects as detections. An object of {MIN_HITS} LiDAR points and 20 px of
visible height must be found within {RANGE:.0f} m, of rigs with 16 lines within 20 m. Its box must be within
{MAX_DISTANCE:.0f} m of it. Brackets hold 95 % intervals from draws of whole frames.
"""


@dataclass(frozen=True, slots=True)
class SolidState(Lidar):
    """A LiDAR that sees 120 degrees ahead."""

    beams: int = 96
    azimuths: int = 2400
    lowest: float = -12.5
    highest: float = 12.5

    def __post_init__(self) -> None:
        Lidar.__post_init__(self)
        ahead = self._directions[:, 0] > np.cos(np.radians(60)) * np.hypot(*self._directions[:, :2].T)
        object.__setattr__(self, "_directions", self._directions[ahead])


@dataclass(frozen=True, slots=True)
class Rig:
    """Sensors, their heights above the ground, and how they move.

    Attributes:
        lidar: the LiDAR.
        height: metres of the LiDAR above the ground.
        camera: metres of the camera above the ground.
        pitch: degrees by which the camera looks down.
        swing: degrees by which the whole rig rolls and pitches.
        reach: metres within which an object must be found.
    """

    lidar: Lidar
    height: float
    camera: float
    pitch: float = 3.0
    swing: float = 0.0
    reach: float = RANGE


RIGS = {
    "64 lines on a car": Rig(Lidar(), 1.9, 1.55),
    "16 lines": Rig(Lidar(16, 1800, -15.0, 15.0, 100.0), 1.2, 1.1, reach=20.0),
    "solid state, 120 degrees": Rig(SolidState(), 1.6, 1.5),
    "handheld, swings by 18 degrees": Rig(Lidar(32, 1024, -22.5, 22.5, 100.0), 1.3, 1.2, 0.0, 18.0),
    "LaserScan with a camera": Rig(Lidar(1, 1440, 0.0, 0.0, 30.0), 0.3, 0.9, 0.0),
    "warehouse robot, 0.3 m high": Rig(Lidar(16, 1800, -15.0, 15.0, 100.0), 0.3, 0.35, 0.0, reach=20.0),
}


class RigSource(SyntheticSource):
    """Synthetic drive of a rig."""

    def __init__(self, rig: Rig, frames: int, seed: int) -> None:
        super().__init__(frames, seed, lidar=rig.lidar)
        self._rig = rig
        self.base_from_lidar = geometry.transform([0.2, 0.0, rig.height], [0, 0, 0, 1.0])
        self.base_from_camera = optical((0.3, 0.06, rig.camera), np.radians(rig.pitch))
        self._base_from_true_camera = self.base_from_camera

    def map_from_base(self, stamp: int) -> F64:
        """Return the pose of the rig, which rolls once in 2.3 s and pitches once in 1.7 s about its hand."""
        pose, time = super().map_from_base(stamp), (stamp - START) * 1e-9
        if not self._rig.swing:
            return pose
        amplitude, hand = np.radians(self._rig.swing), geometry.transform([0, 0, 1.2], [0, 0, 0, 1.0])
        swing = np.eye(4)
        roll, pitch = amplitude * np.sin(2.7 * time), amplitude * np.sin(3.7 * time)
        about_x, about_y = (geometry.rotations(axis, np.array([a]))[0] for axis, a in ((0, roll), (1, pitch)))
        swing[:3, :3] = about_y @ about_x
        return np.asarray(pose @ hand @ swing @ geometry.inverse(hand), np.float64)


@dataclass
class RigTally:
    """Counts of each frame: found, that had to be found, wrong, and reported objects."""

    rows: list[tuple[int, int, int, int]] = field(default_factory=list)

    def text(self, part: int, whole: int) -> str:
        """Return a share with its interval."""
        counts = np.array(self.rows, float).reshape(-1, 4)[:, [part, whole]]
        draws = np.random.default_rng(0).integers(0, max(len(counts), 1), (DRAWS, len(counts)))
        held, total = (counts[draws, column].sum(axis=1) for column in (0, 1))
        low, high = np.quantile(100 * held / np.maximum(total, 1), (0.025, 0.975))
        held_sum, total_sum = counts.sum(axis=0).astype(int)
        return f"{held_sum} of {total_sum} ({low:.0f}-{high:.0f} %)"


def _visible_boxes(shot: Snapshot) -> Detections:
    """Return the visible image box of each object of 8 pixels in height or more."""
    assert shot.frame.truth is not None
    _, boxes = required(shot)
    rows = np.flatnonzero(boxes[:, 3] - boxes[:, 1] >= 8)
    number, zeros = len(rows), np.zeros(len(rows), np.int32)
    names = tuple(shot.frame.truth.labels[row] for row in rows)
    score, none = np.full(number, 0.9, np.float32), np.full(number, -1, np.int32)
    return Detections(boxes[rows], score, zeros, names, zeros, none, np.zeros(number, np.float32))


def measure(rig: Rig, seed: int, frames: int, tally: RigTally) -> None:
    """Write a drive of a rig, read it, and count what the default finds."""
    source = RigSource(rig, frames, seed)
    shots = {START + index * PERIOD: source.snapshot(index) for index in range(frames)}
    detections = {stamp: _visible_boxes(shot) for stamp, shot in shots.items()}
    now = START

    def detect(camera: Camera) -> Detections:
        return detections[now]

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "drive.mcap")
        write_bag(source, path, [shot.frame for shot in shots.values()])
        session = Session(load(), detect)
        # The base of a handheld rig is not upright, which is said of base_link.
        settings = ["source.base_frame=none"] if rig.swing else []
        with bevviz.open(path, set=settings) as drive:
            for frame in _frames(drive):
                now, shot = frame.stamp, shots[frame.stamp]
                result = session.run(frame)
                assert frame.truth is not None and result.objects is not None, result.failures
                truth = truth_of(frame, frame.truth)
                order = [shot.frame.truth.ids.index(name) for name in truth.ids] if shot.frame.truth else []
                must: Bool = required(shot)[0][order] & (truth.boxes.distance <= rig.reach)
                matches = judge(result.objects, truth)
                found = np.isin(np.flatnonzero(must), matches.partner)
                row = int(found.sum()), int(must.sum()), int(matches.false.sum()), len(result.objects)
                tally.rows.append(row)


def _frames(drive: bevviz.Drive) -> Iterator[bevviz.Frame]:
    """Yield the frames of a drive."""
    for number in range(len(drive)):
        frame = drive.frames.frame(number)
        if frame is not None:
            yield frame


def table(tallies: dict[str, RigTally]) -> str:
    """Format the table."""
    lines = ["| rig | frames | found | wrong |", "| --- | ---: | ---: | ---: |"]
    for name, tally in tallies.items():
        lines.append(f"| {name} | {len(tally.rows)} | {tally.text(0, 1)} | {tally.text(2, 3)} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all rigs, or those that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rig", action="append", choices=list(RIGS), help="rigs (default: all)")
    parser.add_argument("--frames", type=int, default=FRAMES, help="frames of each drive")
    parser.add_argument("--seed", type=int, action="append", help=f"drives (default: {SEEDS})")
    parser.add_argument("--write", type=Path, help="page whose section is replaced, instead of printing it")
    options = parser.parse_args(arguments)
    tallies = {name: RigTally() for name in options.rig or RIGS}
    for name, tally in tallies.items():
        for seed in options.seed or SEEDS:
            measure(RIGS[name], seed, options.frames, tally)
        if not options.write:
            print(name, tally.text(0, 1), tally.text(2, 3), flush=True)
    if options.write:
        write_section(options.write, f"{INTRO}\n{table(tallies)}\n")
        return
    print(table(tallies))


if __name__ == "__main__":
    main()
