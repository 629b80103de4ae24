"""How near ``bevviz calib`` gets to errors planted in the synthetic drive: the tables of docs/calib.md.

python -m benchmarks.calib
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from tqdm import tqdm

from bevviz import geometry
from bevviz.calib import AXES, Calibration, Finding, calibrate, gather
from bevviz.calib.axes import SCALES, TIME, error_pose
from bevviz.frame import F64, Frame
from bevviz.synthetic import SyntheticSource

PLANTED = {"rx": 1.0, "ry": 1.0, "rz": 1.0, "tx": 5.0, "ty": 5.0, "tz": 5.0, "dt": 40.0}
EVERY = 3
HEADER = """| planted | found | largest error elsewhere | called off | cannot tell |
| --- | --- | --- | --- | --- |"""


class Drive:
    """Frames of a drive, rendered once: an error of what is stated changes no pixel and no point."""

    def __init__(self, frames: int, seed: int, weave: bool, every: int = EVERY) -> None:
        self.source = SyntheticSource(frames, seed, weave=weave)
        numbers = tqdm(range(0, frames, every), unit="scan", desc="simulate", disable=None, leave=False)
        self.frames = [self.source.snapshot(i).frame for i in numbers]

    def pose(self, frame: Frame, stamp: int) -> F64:
        return self.source.map_from_base(stamp) @ self.source.base_from_lidar

    def planted(self, offsets: F64) -> Iterator[Frame]:
        """The frames as a robot would deliver them whose calibration is wrong by (7,) ``offsets``."""
        camera_from_lidar = geometry.inverse(self.source.base_from_camera) @ self.source.base_from_lidar
        stated = geometry.inverse(error_pose(offsets)) @ camera_from_lidar
        for frame in self.frames:
            camera = frame.cameras[0]
            assert camera.image is not None
            stamp = camera.image.stamp + round(offsets[TIME] * 1e9)
            moved = geometry.inverse(self.pose(frame, stamp)) @ self.pose(frame, frame.stamp)
            image = replace(camera.image, stamp=stamp)
            wrong = replace(camera, image=image, camera_from_points=stated @ moved)
            yield replace(frame, cameras=(wrong,))

    def calibrate(self, offsets: F64) -> Calibration:
        return calibrate(gather(self.planted(offsets), ["zed"], self.pose)["zed"])


def errors() -> Iterator[tuple[str, F64]]:
    """No error, and one of each axis."""
    yield "nothing", np.zeros(len(AXES))
    for row, axis in enumerate(AXES):
        offsets = np.zeros(len(AXES))
        offsets[row] = PLANTED[axis.name] / axis.scale
        yield f"{axis.name} {PLANTED[axis.name]:g} {axis.unit}", offsets


def row(name: str, offsets: F64, result: Calibration) -> str:
    """What was planted, what was found on that axis, the largest error on the others, and the findings."""
    wrong = np.array([axis.offset for axis in result.axes]) - offsets * SCALES
    planted = np.flatnonzero(offsets)
    found = result.axes[planted[0]].measured if len(planted) else ""
    others = np.delete(np.abs(wrong), planted)
    names = np.delete(np.arange(len(AXES)), planted)
    worst = [others[(names // 3) == kind].max(initial=0.0) for kind in range(3)]
    off = ", ".join(axis.axis.name for axis in result.by(Finding.OFF)) or "none"
    unknown = ", ".join(axis.axis.name for axis in result.by(Finding.UNKNOWN)) or "none"
    left = f"{worst[0]:.2f} deg, {worst[1]:.1f} cm" + (f", {worst[2]:.1f} ms" if TIME in names else "")
    return f"| {name} | {found} | {left} | {off} | {unknown} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=90, help="length of each drive (default: 90)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="drives of each kind (default: 0)")
    parser.add_argument("--only", choices=("weave", "cruise"), help="one kind of drive")
    options = parser.parse_args()
    for kind in [options.only] if options.only else ["weave", "cruise"]:
        for seed in options.seeds:
            drive = Drive(options.frames, seed, kind == "weave")
            print(f"\n{kind}, seed {seed}, {len(drive.frames)} frames\n")
            print(HEADER)
            start = time.perf_counter()
            for name, offsets in errors():
                print(row(name, offsets, drive.calibrate(offsets)), flush=True)
            print(f"\n{(time.perf_counter() - start) / 8:.1f} s each")


if __name__ == "__main__":
    main()
