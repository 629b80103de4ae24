"""Pillars that a 3D detector is shown, held against those of spconv, number by number and in time.

``python -m benchmarks.pillars FOLDER --python PYTHON`` takes a folder with KITTI's scans (.bin) and a Python
in which spconv is installed (``pip install spconv numpy``). Pillars are those of PointPillars for KITTI, the
range is the whole scan's, so that no point is left out beforehand.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np

from bevviz.extras.pillars.group import Pillars, group

LOW, HIGH, SIZE = (-80.0, -80.0, -5.0), (80.0, 80.0, 3.0), (0.16, 0.16, 8.0)
MAX_POINTS, MAX_PILLARS, REPETITIONS = 32, 40_000, 9
THEIRS = f"""
import sys, time, numpy as np
from cumm import tensorview
from spconv.utils import Point2VoxelCPU3d
points = np.load(sys.argv[1])
make = Point2VoxelCPU3d(vsize_xyz={list(SIZE)}, coors_range_xyz={[*LOW, *HIGH]}, num_point_features=4,
                        max_num_points_per_voxel={MAX_POINTS}, max_num_voxels={MAX_PILLARS})
given, seconds = tensorview.from_numpy(points), []
for _ in range({REPETITIONS} + 1):
    start = time.perf_counter()
    voxels, cells, counts = make.point_to_voxel(given)
    seconds.append(time.perf_counter() - start)
np.savez(sys.argv[2], voxels=voxels.numpy(), cells=cells.numpy(), counts=counts.numpy(), seconds=seconds[1:])
"""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="with scans, x y z intensity in float32")
    parser.add_argument("--python", required=True, help="with spconv")
    options = parser.parse_args()
    ratios = []
    print("scan      points  pillars  left out  spconv ms  bevviz ms  theirs / ours")
    for path in sorted(options.folder.glob("*.bin")):
        points = np.fromfile(path, np.float32).reshape(-1, 4)
        with tempfile.TemporaryDirectory() as folder:
            given, made = Path(folder) / "points.npy", Path(folder) / "made.npz"
            np.save(given, points)
            subprocess.run([options.python, "-c", THEIRS, str(given), str(made)], check=True)
            with np.load(made) as file:
                theirs = {name: file[name] for name in file.files}
        found, seconds = _ours(points)
        same = np.array_equal(found.points, theirs["voxels"])
        same &= np.array_equal(found.counts, theirs["counts"])
        same &= np.array_equal(found.cells, theirs["cells"][:, [2, 1]])
        if not same:
            raise SystemExit(f"{path.name}: the pillars differ")
        slow, fast = median(theirs["seconds"]) * 1e3, median(seconds) * 1e3
        ratios.append(slow / fast)
        print(
            f"{path.stem:<8} {len(points):>7,} {len(found):>8,} {found.left_out_points:>9,} "
            f"{slow:>10.1f} {fast:>10.1f} {ratios[-1]:>14.2f}"
        )
    print(f"every number the same in {len(ratios)} scans; theirs / ours, median: {median(ratios):.2f}")


def _ours(points: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> tuple[Pillars, list[float]]:
    xyz, intensity = points[:, :3].copy(), points[:, 3].copy()
    shape = tuple(round((b - a) / size) for a, b, size in zip(LOW[:2], HIGH[:2], SIZE, strict=False))
    seconds = []
    for _ in range(REPETITIONS + 1):
        start = time.perf_counter()
        found = group(
            *(xyz, LOW, SIZE, (shape[0], shape[1]), HIGH[2], MAX_POINTS, MAX_PILLARS),
            features=("x", "y", "z", "intensity"),
            intensity=intensity,
        )
        seconds.append(time.perf_counter() - start)
    return found, seconds[1:]


if __name__ == "__main__":
    main()
