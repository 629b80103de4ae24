"""Ground against Patchwork++ (Lee et al. 2022): on the simulator's truth, and on real scans.

Real scans have no labels of the ground. What is in a labelled box is none, from a foot above its bottom on;
and of a cluster that is ten metres long, what is flat is likely to be some.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time

import numpy as np
from tqdm import tqdm

from benchmarks.kitti import DATA
from benchmarks.pages import write_section
from bevviz.config import Config, load
from bevviz.evaluate.evaluation import GROUND_LABELS
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.model import geometry
from bevviz.model.frame import F32, Bool, Boxes3D
from bevviz.stages.clustering import cluster
from bevviz.stages.ground import segment_ground
from bevviz.stages.voxel import voxel_grid
from tests.support.kitti_accuracy import shots

INTRO = """## Ground against Patchwork++

Voxels of 12 synthetic scans, of the 12 labelled KITTI frames and of 9 scans of a KITTI drive, by
`python -m benchmarks.ground`. Patchwork++ (`pypatchworkpp`, Lee et al. 2022) is told the sensor's height.
Flat points of long clusters are probably ground.
"""

SEEDS, FRAMES, STEP = (1000, 1001, 1002), 60, 15
CLEARANCE = 0.3  # metres above the bottom of a labelled box, where the road ends
LONG, CELL, FLAT = (
    10.0,
    1.0,
    0.4,
)  # metres: of a cluster; of a cell of it; what a flat cell has of height at most
LEAST = 5  # points that a cell is judged by

Method = Callable[[F32, float], Bool]  # points, height of the sensor -> which are ground


def ours(config: Config) -> Method:
    return lambda points, _: segment_ground(points, config.ground).mask


def patchwork() -> Method:
    """With the defaults of its package, and the height of the sensor, which ours is not told."""
    import pypatchworkpp

    def segment(points: F32, height: float) -> Bool:
        parameters = pypatchworkpp.Parameters()
        parameters.sensor_height = height
        parameters.enable_RNR = False  # it needs intensities, which the voxels have not
        parameters.verbose = False
        method = pypatchworkpp.patchworkpp(parameters)
        method.estimateGround(points)
        mask = np.zeros(len(points), bool)
        mask[np.asarray(method.getGroundIndices(), np.int64)] = True
        return mask

    return segment


@dataclass
class Tally:
    true: int = 0
    false: int = 0
    missed: int = 0
    inside: int = 0  # points of labelled objects
    lost: int = 0  # of them called ground
    flat: int = 0  # points of long clusters in flat cells
    scans: int = 0
    times: list[float] = field(default_factory=list)

    @property
    def iou(self) -> float:
        return self.true / max(self.true + self.false + self.missed, 1)


@dataclass(frozen=True, slots=True)
class Scan:
    points: F32  # voxels
    sensor: float  # metres above the road
    ground: Bool | None = None  # truth
    objects: Boxes3D | None = None


def synthetic(config: Config) -> Iterator[Scan]:
    for seed in SEEDS:
        source = SyntheticSource(FRAMES, seed)
        for index in range(0, FRAMES, STEP):
            frame = source.snapshot(index).frame
            voxels = voxel_grid(frame.points, config.voxel)
            first = np.zeros(len(voxels.points), np.int64)
            first[voxels.inverse[::-1]] = np.arange(len(frame.points))[::-1]
            ground = np.isin(frame.fields["label"][first], GROUND_LABELS)
            yield Scan(voxels.points, 1.9, ground)


def labelled(config: Config, data: Path) -> Iterator[Scan]:
    for shot in shots(data / "kitti"):
        boxes = Boxes3D(
            np.array([label.center for label in shot.labels], np.float32).reshape(-1, 3),
            np.array([label.size for label in shot.labels], np.float32).reshape(-1, 3),
            np.array([label.yaw for label in shot.labels], np.float32),
        )
        yield Scan(voxel_grid(shot.frame.points, config.voxel).points, 1.73, objects=boxes)


def drive(config: Config, data: Path) -> Iterator[Scan]:
    for file in sorted((data / "kitti_drive/velodyne").glob("*.bin"))[::3]:
        points = np.fromfile(file, np.float32).reshape(-1, 4)[:, :3]
        yield Scan(voxel_grid(np.ascontiguousarray(points), config.voxel).points, 1.73)


def judge(tally: Tally, scan: Scan, method: Method, config: Config) -> None:
    start = process_time()
    mask = method(scan.points, scan.sensor)
    tally.times.append(process_time() - start)
    tally.scans += 1
    if scan.ground is not None:
        tally.true += int((mask & scan.ground).sum())
        tally.false += int((mask & ~scan.ground).sum())
        tally.missed += int((~mask & scan.ground).sum())
        return
    if scan.objects is not None:
        for k in range(len(scan.objects)):
            inside = geometry.inside(scan.points, scan.objects, k)
            bottom = scan.objects.center[k, 2] - scan.objects.size[k, 2] / 2
            inside &= scan.points[:, 2] > bottom + CLEARANCE
            tally.inside += int(inside.sum())
            tally.lost += int((inside & mask).sum())
    obstacles = scan.points[~mask]
    clusters = cluster(obstacles, config.clustering)
    for row in np.flatnonzero(clusters.obb.size[:, :2].max(axis=1) >= LONG):
        tally.flat += _flat(obstacles[clusters.labels == row])


def _flat(points: F32) -> int:
    """Points in flat cells."""
    cells = np.floor(points[:, :2] / CELL).astype(np.int64)
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    low, high = np.full(len(count), np.inf), np.full(len(count), -np.inf)
    np.minimum.at(low, cell.ravel(), points[:, 2])
    np.maximum.at(high, cell.ravel(), points[:, 2])
    return int(count[(count >= LEAST) & (high - low < FLAT)].sum())


def measure(methods: dict[str, Method], config: Config, data: Path) -> dict[str, list[Tally]]:
    """For each method: the synthetic drive, the labelled frames, the drive."""
    tallies = {name: [Tally(), Tally(), Tally()] for name in methods}
    sources: list[Iterator[Scan]] = [synthetic(config)]
    if data.is_dir():
        sources += [labelled(config, data), drive(config, data)]
    for place, source in enumerate(sources):
        for scan in tqdm(source, unit="scan", disable=None):
            for name, method in methods.items():
                judge(tallies[name][place], scan, method, config)
    return tallies


def table(tallies: dict[str, list[Tally]]) -> str:
    heads = (
        "method",
        "synthetic drives: IoU",
        "labelled frames: points of objects called ground",
        "flat points of long clusters, a scan",
        "drive: the same",
        "median ms",
    )
    lines = [f"| {' | '.join(heads)} |", "| --- |" + " ---: |" * (len(heads) - 1)]
    for name, (made, frames, real) in tallies.items():
        times = sorted(made.times[1:] + frames.times + real.times)
        cells = [
            f"{made.iou:.3f}",
            f"{100 * frames.lost / max(frames.inside, 1):.1f} %",
            *(f"{t.flat / max(t.scans, 1):.0f}" for t in (frames, real)),
            f"{1e3 * times[len(times) // 2]:.1f}",
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA, help="folder with kitti/ and kitti_drive/")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="a further row, with this changed"
    )
    parser.add_argument("--write", type=Path, help="page whose section is replaced, instead of printing it")
    options = parser.parse_args(arguments)
    config = load()
    methods = {"polar": ours(config), "plane": ours(load(settings=["ground.method=plane"]))}
    methods |= {text: ours(load(settings=[text])) for text in options.set}
    try:
        methods["Patchwork++"] = patchwork()
    except ImportError:
        print("without Patchwork++: pip install pypatchworkpp")
    found = table(measure(methods, config, options.data))
    if options.write:
        write_section(options.write, f"{INTRO}\n{found}\n")
    else:
        print(found)


if __name__ == "__main__":
    main()
