"""What is decoded of an Ouster's packets, held against what ouster-sdk makes of the same ones.

``python -m benchmarks.ouster SDK --python PYTHON`` takes a checkout of
https://github.com/ouster-lidar/ouster-sdk, whose tests have packets of real sensors, and a Python in which
ouster-sdk is installed: it needs another release of rosbags than bevviz. The points of the first scan of each
file are compared one by one.
"""

from __future__ import annotations

import argparse
import struct
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from bevviz.extras.lidars import ouster

FILES = (  # of packets, and of metadata
    ("OS-1-32-G_v2.1.1_1024x10", "OS-1-32-G_v2.1.1_1024x10"),
    ("OS-2-32-U0_v2.0.0_1024x10", "OS-2-32-U0_v2.0.0_1024x10"),
    ("OS-0-32-U1_v2.2.0_1024x10", "OS-0-32-U1_v2.2.0_1024x10"),
    ("OS-0-128-U1_v2.3.0_1024x10", "OS-0-128-U1_v2.3.0_1024x10"),
    ("OS-1-128_v2.3.0_1024x10_lb_n3", "OS-1-128_v2.3.0_1024x10"),
    ("OS-2-128-U1_v2.3.0_1024x10", "OS-2-128-U1_v2.3.0_1024x10"),
)
THEIRS = """
import sys, numpy as np, ouster.sdk.core as core
from ouster.sdk import open_source
packets, metadata, out = sys.argv[1:]
scan = next(iter(open_source(packets, meta=[metadata])))[0]
info = core.SensorInfo(open(metadata).read())
into = np.linalg.inv(info.lidar_to_sensor_transform)  # they are in the frame of the sensor
points = core.XYZLut(info, False)(scan).reshape(-1, 3) @ into[:3, :3].T + into[:3, 3] * 1e-3
met = scan.field("RANGE")
ring, column = np.nonzero(met)
order = np.lexsort((ring, column))
np.savez(out, xyz=points[met.reshape(-1) > 0][order], ring=ring[order],
         reflectivity=scan.field("REFLECTIVITY")[ring, column][order],
         time=(scan.timestamp[column][order] - scan.timestamp[column].min()) * 1e-9)
"""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sdk", type=Path, help="folder of the checkout")
    parser.add_argument("--python", type=Path, required=True, help="that has ouster-sdk")
    request = parser.parse_args()
    print("| packets | profile | points | theirs | largest distance, mm | other fields | ms |")
    print("| --- | --- | ---: | ---: | ---: | --- | ---: |")
    for packets, metadata in FILES:
        folder: Path = request.sdk / "tests" / "pcaps"
        print(_row(folder / f"{packets}.pcap", folder / f"{metadata}.json", request.python), flush=True)


def _row(packets: Path, metadata: Path, python: Path) -> str:
    sensor = ouster.read_sensor(metadata.read_text(), str(metadata))
    found = [(at, data) for at, data in _captured(packets) if len(data) == sensor.size]
    first = [(at, data) for at, data in found if sensor.number(data) == sensor.number(found[0][1])]
    started = time.perf_counter()
    ours = ouster.decode(sensor, first)
    took = time.perf_counter() - started
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "theirs.npz"
        subprocess.run([python, "-c", THEIRS, packets, metadata, out], check=True, capture_output=True)
        theirs = dict(np.load(out))
    profile = next(name for name, profile in ouster.PROFILES.items() if profile is sensor.profile)
    row = f"| {packets.stem} | {profile} | {len(ours.xyz)} | {len(theirs['xyz'])}"
    if len(ours.xyz) != len(theirs["xyz"]):
        return f"{row} | | |"
    off = np.linalg.norm(ours.xyz - theirs["xyz"], axis=1).max() * 1e3
    same = all((ours.fields[name] == theirs[name]).all() for name in ("ring", "reflectivity"))
    same &= bool(np.abs(ours.fields["time"] - theirs["time"]).max() < 1e-7)
    return f"{row} | {off:.3g} | {'the same' if same else 'differ'} | {took * 1e3:.1f} |"


def _captured(path: Path) -> list[tuple[int, bytes]]:
    """Read the UDP payloads of an Ethernet capture with whole packets, each with its time in nanoseconds."""
    data, at, found = path.read_bytes(), 24, list[tuple[int, bytes]]()
    while at + 16 <= len(data):
        seconds, micros, size = struct.unpack_from("<III", data, at)
        frame = data[at + 16 : at + 16 + size]
        found.append((seconds * 10**9 + micros * 1000, frame[14 + (frame[14] & 15) * 4 + 8 :]))
        at += 16 + size
    return found


if __name__ == "__main__":
    main()
