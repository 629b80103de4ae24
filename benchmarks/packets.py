"""What is decoded of LiDARs' packets, held against the clouds that other decoders made of the same ones.

``python -m benchmarks.packets NEBULA`` takes a checkout of https://github.com/tier4/nebula: its tests have
bags with packets (pandar_msgs, velodyne_msgs), the calibration of each sensor, and clouds that nebula's own
decoders made of them. For each point of these clouds the nearest one of ours is looked for. (Nebula leaves
out more: returns within 0.1 m of another one of the same beam, and what is beyond the range that it states.)
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d

from bevviz.bags.bag import Recording
from bevviz.config import SourceConfig
from bevviz.messages.clouds import decode_cloud
from bevviz.model.frame import F32, F64

ANGLES = {  # of the folders, in nebula's calibration
    "40p": "Pandar40P",
    "64": "Pandar64",
    "qt64": "PandarQT64",
    "qt128": "PandarQT128",
    "xt16": "PandarXT16",
    "xt32": "PandarXT32",
    "xt32m": "PandarXT32M",
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("nebula", type=Path, help="folder of the checkout")
    nebula: Path = parser.parse_args().nebula
    print("| model | points | decoded | same within 0.1 mm | median, mm | largest, mm | ms a scan |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    for bag in sorted(nebula.glob("src/*/*/test_resources/decoder_ground_truth/*/*/*.db3")):
        folder = bag.parent.parent
        clouds = [path for path in folder.glob("*.pcd") if bag.parent.name.isdigit()]
        if clouds:
            print(_row(folder.name, bag, clouds[0], nebula), flush=True)


def _row(name: str, bag: Path, cloud: Path, nebula: Path) -> str:
    stated = next(nebula.glob(f"**/calibration/{ANGLES[name]}.csv"), None) if name in ANGLES else None
    with Recording([bag]) as recording:
        topic = next(topic.name for topic in recording.topics if topic.kind == "PointCloud2")
    config = SourceConfig(lidar_calibration={topic: str(stated)} if stated else {})
    took, ours = list[float](), list[F32]()
    with Recording([bag], config) as recording:
        for message in recording.messages([topic]):
            started = time.perf_counter()
            ours.append(decode_cloud(recording.decode(message), topic, 0).xyz)
            took.append(time.perf_counter() - started)
    theirs = np.asarray(o3d.io.read_point_cloud(cloud).points)
    tensor: Any = o3d.core.Tensor.from_numpy
    tree = o3d.core.nns.NearestNeighborSearch(tensor(np.concatenate(ours)))
    tree.knn_index()
    _, squared = tree.knn_search(tensor(theirs.astype(np.float32)), 1)
    off: F64 = np.sqrt(squared.numpy().astype(np.float64)).ravel() * 1e3
    return (
        f"| {ANGLES.get(name, name.upper())} | {len(theirs)} | {len(max(ours, key=len))} "
        f"| {(off < 0.1).mean():.1%} | {np.median(off):.3g} | {off.max():.3g} | {np.median(took) * 1e3:.1f} |"
    )


if __name__ == "__main__":
    main()
