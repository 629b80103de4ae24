"""Take a picture of a recording in Rerun's viewer, without a window (needs mesa-vulkan-drivers).

python tools/screenshot.py demo.rrd docs/images/debug.png --frame 20 --blueprint views.rbl
"""

from __future__ import annotations

import argparse
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from rerun.experimental import ViewerClient

from bevviz.recording import entities, rerun_cli
from bevviz.recording.ports import LOOPBACK, free_port, is_listening

TOP_BAR = 36  # pixels of the viewer's menu, which is cut off
LOOKS = 60  # at most, until the picture no longer changes


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path, help=".rrd file")
    parser.add_argument("image", type=Path, help="PNG file")
    parser.add_argument("--size", default="1400x792", help="of the window, pixels (default: 1400x792)")
    parser.add_argument("--timeline", default=entities.FRAME, help="timeline (default: frame)")
    parser.add_argument("--frame", type=int, default=0, help="number on that timeline (default: 0)")
    parser.add_argument("--blueprint", type=Path, help=".rbl file of another layout")
    options = parser.parse_args()
    port = free_port(9950)
    files = [str(path) for path in (options.recording, options.blueprint) if path is not None]
    arguments = [*files, "--headless", "--hide-welcome-screen", "--window-size", options.size]
    viewer = subprocess.Popen(
        [rerun_cli.rerun_program(), *arguments, "--bind", LOOPBACK, "--port", str(port)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=rerun_cli.environment(),
    )
    try:
        while not is_listening(LOOPBACK, port):
            if viewer.poll() is not None:
                raise SystemExit("the viewer does not start: apt-get install mesa-vulkan-drivers")
            time.sleep(0.05)
        client = ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
        picture = cv2.imdecode(
            np.frombuffer(settled(client, options.timeline, options.frame), np.uint8), cv2.IMREAD_COLOR
        )
        assert picture is not None
        cv2.imwrite(str(options.image), picture[TOP_BAR:])
    finally:
        rerun_cli.stop(viewer)


def settled(client: ViewerClient, timeline: str, number: int) -> bytes:
    """Go to a frame, and return the picture as soon as two in a row are equal."""
    before = b""
    for _ in range(LOOKS):
        with suppress(TimeoutError, RuntimeError, ConnectionError):  # It is still loading.
            client.set_time(timeline, sequence=number, play_state="paused")
            time.sleep(1)
            if (now := client.take_screenshot()) == before:
                break
            before = now
    return before


if __name__ == "__main__":
    main()
