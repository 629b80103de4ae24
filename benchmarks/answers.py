"""What of the workbench's latencies is the server's: it is asked as its page asks, without a browser.

``python -m benchmarks.answers`` opens the synthetic drive, of 120,000 points a frame, with its network, and
waits until all of it is run. It prints how long the first frame takes from the command on, an answer from the
question on, and a changed parameter until what is to be drawn is there and what it does is said.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from benchmarks.journey import ANSWER, CHANGES, FRAMES, PICTURE, demo, serving

WAIT = 120.0  # seconds after which something does not come about


class Page:
    """The page's part of the talk.

    Attributes:
        first: seconds, by the clock of ``time.monotonic``, at which the first frame was there.
        sights: stamp and pick of what is worth a look.
    """

    def __init__(self, stack: ExitStack, address: str) -> None:
        parts = urlsplit(address)
        self._number = 0
        self.sights: list[tuple[int, str]] = []

        def opened(path: str) -> ClientConnection:
            url, origin = f"ws://{parts.netloc}/{path}&{parts.query}", Origin(f"http://{parts.netloc}")
            return stack.enter_context(connect(url, origin=origin, max_size=None))

        self._talk = opened("talk?")
        lane = self._next("welcome")["overlay"]
        recording, self._overlay = (opened(f"recording?lane={name}") for name in ("recording", lane))
        recording.recv(timeout=WAIT)
        self.first = time.monotonic()
        self._talk.send(json.dumps({"id": 0, "type": "shown"}))
        while not self._next("progress")["over"]:
            pass

    def ask(self, kind: str, *, drawn: bool = False, **message: Any) -> float:
        """Seconds until the answer of that kind, or also until there is something to draw."""
        self._number += 1
        start = time.monotonic()
        self._talk.send(json.dumps({"id": self._number, **message}))
        answer = self._next(kind)
        while answer["id"] != self._number:
            answer = self._next(kind)
        if drawn:
            self._overlay.recv(timeout=WAIT)
        seconds = time.monotonic() - start
        while not drawn:  # what is marked is not what is waited for
            try:
                self._overlay.recv(timeout=0.05)
            except TimeoutError:
                break
        return seconds

    def _next(self, kind: str) -> dict[str, Any]:
        while True:
            message: dict[str, Any] = json.loads(self._talk.recv(timeout=WAIT))
            if message["type"] == "error":
                raise SystemExit(message["text"])
            if message["type"] == "entries":
                sights = [sight for entry in message["entries"] for sight in entry["sights"]]
                self.sights += [(int(sight["stamp"]), sight["pick"]) for sight in sights if sight["pick"]]
            if message["type"] == kind:
                return message


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--number", type=int, default=40, help="questions and changes (default: 40)")
    parser.add_argument("--frames", type=int, default=FRAMES, help=f"of the drive (default: {FRAMES})")
    options = parser.parse_args()
    print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        arguments = demo(folder, options.frames)
        with ExitStack() as stack:  # once, so that the machine is warm
            Page(stack, stack.enter_context(serving(arguments, folder)))
        with ExitStack() as stack:
            start = time.monotonic()
            page = Page(stack, stack.enter_context(serving(arguments, folder)))
            print(f"  {page.first - start:.2f} s  from the command to the first frame, ready to be drawn")
            new, further, changed = list[float](), list[float](), list[float]()
            for step in range(options.number):
                stamp, pick = page.sights[rng.integers(len(page.sights))]
                about: dict[str, Any] = {"type": "ask", "time": stamp, "set": []}
                new.append(page.ask("answer", pick=pick, **about))
                x, y = rng.uniform((4, -5), (20, 5))
                further.append(page.ask("answer", pick=f"point//{x:g},{y:g},0", **about))
                key, bounds = list(CHANGES.items())[step % len(CHANGES)]
                one = [f"{key}={rng.uniform(*bounds):.3f}"]
                changed.append(page.ask("tried", type="try", time=stamp, set=one, pick=pick, drawn=True))
    told = {
        "questions about a frame chosen at random": (new, ANSWER),
        "further ones about the same frame": (further, ANSWER),
        "changed parameters": (changed, PICTURE),
    }
    for what, (seconds, wanted) in told.items():
        p50, p95 = np.percentile(seconds, [50, 95])
        print(f"  {1e3 * p50:.0f} ms (median), {1e3 * p95:.0f} ms (95 %)  {what} (wanted: {wanted:g} s)")
    good = max(np.percentile(new, 95), np.percentile(further, 95)) <= ANSWER
    return 0 if good and np.percentile(changed, 95) <= PICTURE else 1


if __name__ == "__main__":
    sys.exit(main())
