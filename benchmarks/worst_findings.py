"""Share of the worst findings of a drive that the workbench lists early, and the memory that it needs.

Opens the drive in an empty store and waits for the complete list. The ten worst findings are the first rows
of the page's table. One counts as listed early if a row of the same kind and name has a frame within 64
frames of one of its frames. With ``--browser``, a browser shows the drive from the start to the end. Its
memory, the server's and the size of temporary files are printed each minute. Once a minute, and twenty times
at the end, it jumps to a random place of the drive: printed is the time until the page has that frame.

    python -m benchmarks.worst_findings long.mcap --model yolox_nano.onnx --after 10 20 60 --browser
"""

from __future__ import annotations

import argparse
import json
import os
import random
import tempfile
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np
import psutil
from websockets.sync.client import connect
from websockets.typing import Origin

from benchmarks.measure import peak_memory
from bevviz.findings.finding_list import CELL
from tests.support.workbench_pages import browser_processes, chromium, serving, watched_page

if TYPE_CHECKING:
    from playwright.sync_api import Page

WORST = 10
MINUTE = 60.0  # seconds between two looks at memory
JUMPS = 20  # once the list is complete
NAMES = 70  # pixels of the timeline that hold the names of its lanes

Entries = dict[int, dict[str, Any]]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bag", type=Path)
    parser.add_argument("--model", required=True)
    parser.add_argument("--after", type=float, nargs="+", default=[10, 20, 30, 60], help="seconds")
    parser.add_argument("--browser", action="store_true", help="with a page that is looked at")
    options = parser.parse_args()
    with (
        tempfile.TemporaryDirectory() as store,
        tempfile.TemporaryDirectory() as temporary,
        ExitStack() as stack,
    ):
        os.environ |= {"BEVVIZ_STORE": store, "TMPDIR": temporary}
        start = time.monotonic()
        bag = str(options.bag.resolve())
        address, server = stack.enter_context(serving("open", bag, model=options.model))
        page = PageMonitor(address, server.pid, Path(temporary)) if options.browser else None
        early, whole = watch(address, start, options.after)
        seconds, memory = time.monotonic() - start, peak_memory(server.pid)
        if page is not None:
            page.end()
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


class PageMonitor:
    """Monitor of a page in a browser, in a thread of its own.

    Args:
        address: address of the page.
        server: process of the server.
        temporary: folder of the server's temporary files.
    """

    def __init__(self, address: str, server: int, temporary: Path) -> None:
        self._address, self._server, self._temporary = address, psutil.Process(server), temporary
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Jump a last few times, and close the browser."""
        self._over.set()
        self._thread.join()

    def _look(self) -> None:
        start, places = time.monotonic(), random.Random(0)
        with chromium() as browser:
            page = watched_page(browser, 1000, 700)
            page.goto(self._address)
            page.locator("#events").wait_for()
            print("|  min | server, MB | browser, MB | temporary, MB | jump, s | run |")
            print("| ---: | ---------: | ----------: | ------------: | ------: | --- |")
            while not self._over.is_set():
                jump = _jump(page, places.random())
                server, browser_memory = _memory(self._server), sum(map(_memory, browser_processes()))
                files = sum(file.stat().st_size for file in self._temporary.rglob("*") if file.is_file())
                print(
                    f"| {(time.monotonic() - start) / 60:4.0f} | {server:10.0f} | {browser_memory:11.0f} "
                    f"| {1e-6 * files:13.1f} | {jump:7.2f} | {page.inner_text('#run').strip()} |",
                    flush=True,
                )
                deadline = time.monotonic() + MINUTE
                while time.monotonic() < deadline and not self._over.is_set():
                    page.wait_for_timeout(1000)
            jumps = [_jump(page, places.random()) for _ in range(JUMPS)]
            p50, most = np.percentile(jumps, [50, 100])
            print(f"{JUMPS} jumps at the end: {p50:.2f} s (median), {most:.2f} s (longest)")


def _jump(page: Page, share: float) -> float:
    """Click a place of the drive, and return the seconds until the page has its frame."""
    box = page.locator("#events").bounding_box()
    assert box is not None
    before = page.inner_text("#shown")
    start = time.monotonic()
    page.mouse.click(box["x"] + NAMES + share * (box["width"] - NAMES - 2), box["y"] + box["height"] - 2)
    while time.monotonic() - start < MINUTE:
        shown = page.inner_text("#shown")
        if shown != before and "..." not in shown:
            break
        page.wait_for_timeout(10)
    return time.monotonic() - start


def _memory(process: psutil.Process) -> float:
    """Return the MB that a process alone has, 0 where it has ended."""
    try:
        return 1e-6 * float(process.memory_full_info().uss)
    except psutil.NoSuchProcess:
        return 0.0


def same(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return whether two rows may be one finding."""
    if (one["what"], one["name"]) != (other["what"], other["name"]):
        return False
    frames = [sight["frame"] for sight in other["sights"]]
    return any(abs(sight["frame"] - frame) <= CELL for sight in one["sights"] for frame in frames)


if __name__ == "__main__":
    main()
