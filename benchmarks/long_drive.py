"""Long drives for measuring the workbench: recorded drives one after the other, with random faults.

Writes an MCAP of N minutes that repeats the given bags in random order, with times that go on. In some
windows of a few seconds the cameras are black, as if something covered them.

    python -m benchmarks.long_drive a.mcap b.mcap -o long.mcap --minutes 5
"""

from __future__ import annotations

import argparse
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from bevviz.bags.bag import Recording
from bevviz.bags.mcap_writer import McapWriter
from bevviz.bags.message import RawMessage

SECOND = 1_000_000_000
BETWEEN = SECOND // 10  # nanoseconds from the last message of a bag to the first of the next one


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "bags", type=Path, nargs="+", help="bags, or folders of data sets, with the same topics"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="the .mcap file to make")
    parser.add_argument("--minutes", type=float, default=5.0, help="least length of the drive (default: 5)")
    parser.add_argument("--faults", type=int, default=6, help="windows with black images (default: 6)")
    parser.add_argument("--seed", type=int, default=0, help="of the order and the faults (default: 0)")
    options = parser.parse_args()
    write(options.bags, options.output, options.minutes * 60, options.faults, options.seed)


def write(paths: Sequence[Path], output: Path, seconds: float, faults: int, seed: int) -> None:
    """Write the long drive."""
    random = np.random.default_rng(seed)
    recordings = [Recording([path]) for path in paths]
    start = recordings[0].start
    begins = np.sort(random.uniform(0, seconds, faults))
    windows = [(start + int(t * SECOND), start + int((t + random.uniform(3, 8)) * SECOND)) for t in begins]
    print("black:", ", ".join(f"{(a - start) / SECOND:.1f}-{(b - start) / SECOND:.1f} s" for a, b in windows))
    at = start
    bar = tqdm(total=round(seconds), unit="s", disable=None)
    with McapWriter(output, recordings[0].types.definition, compress=False) as bag:
        connections: dict[str, Any] = {}
        while at < start + seconds * SECOND:
            recording = recordings[int(random.integers(len(recordings)))]
            shift = at - recording.start
            for message in recording.messages([topic.name for topic in recording.topics]):
                if message.topic == "/tf_static" and at != start:
                    continue
                received = message.received + shift
                is_black = any(low <= received < high for low, high in windows)
                content = shifted(recording, message, shift, is_black=is_black)
                bag.write(connections.setdefault(message.topic, message.connection), received, content)
            bar.update(round((recording.end - recording.start + BETWEEN) / SECOND))
            at = recording.end + shift + BETWEEN


def shifted(recording: Recording, message: RawMessage, shift: int, *, is_black: bool) -> bytes | memoryview:
    """Return the content of a message with later stamps, and with a black image if it is one."""
    kind = message.type
    if kind.endswith("TFMessage"):
        content = recording.decode(message)
        for transform in content.transforms:
            transform.header.stamp = later(transform.header.stamp, shift)
        return recording.encode(message, content)
    if is_black and kind.endswith("Image"):
        content = recording.decode(message)
        content.header.stamp = later(content.header.stamp, shift)
        if kind.endswith("CompressedImage"):
            image = cv2.imdecode(np.asarray(content.data), cv2.IMREAD_COLOR)
            content = replace(
                content, data=cv2.imencode(".jpg", np.zeros_like(image))[1].ravel(), format="jpeg"
            )
        else:
            content = replace(content, data=np.zeros_like(content.data))
        return recording.encode(message, content)
    data = bytearray(message.content())
    seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
    total = seconds * SECOND + nanoseconds + shift
    struct.pack_into("<iI", data, 4, *divmod(total, SECOND))
    return bytes(data)


def later(stamp: Any, shift: int) -> Any:
    """Return a stamp that is later."""
    seconds, nanoseconds = divmod(stamp.sec * SECOND + stamp.nanosec + shift, SECOND)
    return replace(stamp, sec=seconds, nanosec=nanoseconds)


if __name__ == "__main__":
    main()
