"""Share of the worst findings of a drive that the workbench lists early, and the memory that it needs.

Opens the drive in an empty store and waits for the complete list. The ten worst findings are the first rows
of the page's table. One counts as listed early if a row of the same kind and name has a frame within 64
frames of one of its frames.

    python -m benchmarks.worst_findings long.mcap --model yolox_nano.onnx --after 10 20 60
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from websockets.sync.client import connect
from websockets.typing import Origin

from benchmarks.measure import peak_memory
from bevviz.findings.finding_list import CELL
from tests.support.workbench_pages import serving

WORST = 10

Entries = dict[int, dict[str, Any]]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bag", type=Path)
    parser.add_argument("--model", required=True)
    parser.add_argument("--after", type=float, nargs="+", default=[10, 20, 30, 60], help="seconds")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["BEVVIZ_STORE"] = folder
        start = time.monotonic()
        with serving("open", str(options.bag.resolve()), model=options.model) as (address, server):
            early, whole = watch(address, start, options.after)
            seconds, memory = time.monotonic() - start, peak_memory(server.pid)
    worst = sorted(whole.values(), key=itemgetter("rank"))[:WORST]
    print(
        "the worst:",
        ", ".join(f"{one['what']} {one['name']} at frame {one['sights'][0]['frame']}" for one in worst),
    )
    for after, entries in early.items():
        listed = sum(any(same(one, other) for other in entries.values()) for one in worst)
        frames = len({sight["frame"] for one in entries.values() for sight in one["sights"]})
        print(f"after {after:g} s: {listed} of {len(worst)}; {len(entries)} rows of {frames} frames")
    print(f"complete after {seconds:.0f} s with {len(whole)} rows; at most {memory:.0f} MB of memory")


def watch(address: str, start: float, times: list[float]) -> tuple[dict[float, Entries], Entries]:
    """Return the list after each of the times, in seconds since the command, and the complete list."""
    parts = urlsplit(address)
    url, origin = f"ws://{parts.netloc}/talk?{parts.query}", Origin(f"http://{parts.netloc}")
    early, entries, left = dict[float, Entries](), Entries(), sorted(times)
    with connect(url, origin=origin, max_size=None) as channel:
        channel.send(json.dumps({"id": 0, "type": "shown"}))
        while True:
            message = json.loads(channel.recv(timeout=600))
            while left and time.monotonic() - start >= left[0]:
                copied = {number: {**one, "sights": list(one["sights"])} for number, one in entries.items()}
                early[left.pop(0)] = copied
            if message["type"] == "entries":
                for number in message["gone"]:
                    del entries[number]
                for one in message["entries"]:
                    known = entries.get(one["number"], {"sights": []})
                    entries[one["number"]] = {**one, "sights": known["sights"] + one["sights"]}
            if message["type"] == "progress" and message["over"]:
                return early, entries


def same(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return whether two rows may be one finding."""
    if (one["what"], one["name"]) != (other["what"], other["name"]):
        return False
    frames = [sight["frame"] for sight in other["sights"]]
    return any(abs(sight["frame"] - frame) <= CELL for sight in one["sights"] for frame in frames)


if __name__ == "__main__":
    main()
