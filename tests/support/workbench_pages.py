"""The workbench's server, and how tests wait for and read its page in a browser."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

import psutil
import pytest

from bevviz.cli import main
from tests.support import waiting
from tests.support.waiting import PATIENCE

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


FRAMES = 6
POLL = 0.5  # seconds: a page that draws without a graphics card has little time to be asked
SOFTWARE_GL = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]


def demo_bag(folder: Path) -> Path:
    """Write the bag that the workbench opens in most tests."""
    path = folder / "demo.mcap"
    assert main(["demo", "--frames", str(FRAMES), "-o", str(path)]) == 0
    return path


@contextmanager
def serving(*arguments: str, model: str = "demo") -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """``bevviz open`` as a user starts it, in a folder that is not the bag's: its address and its process."""
    command = [sys.executable, "-m", "bevviz.cli", *arguments, "--model", model, "--no-browser"]
    beside = next(Path(argument).parent for argument in arguments if argument.endswith(("mcap", "bag")))
    (folder := beside / "elsewhere").mkdir(exist_ok=True)
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=folder) as server:
        try:
            assert server.stderr is not None
            for line in server.stderr:
                if found := re.search(r"workbench at (\S+)", line):
                    yield found[1], server
                    break
            else:
                pytest.fail("the server has said no address")
        finally:
            server.send_signal(signal.SIGINT)
            said = server.communicate(timeout=PATIENCE)[1]
        assert "Traceback" not in said


@contextmanager
def chromium() -> Iterator[Browser]:
    """Run a browser that draws without a graphics card. Skip the test where none is installed."""
    executable = (
        os.environ.get("BEVVIZ_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    )
    if executable is None:
        pytest.skip("needs a browser: apt-get install chromium (or BEVVIZ_CHROMIUM=its path)")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=SOFTWARE_GL)
        try:
            yield browser
        finally:
            kill_browsers()  # A browser that hangs on its software GPU would never answer ``close``.
            browser.close()


def kill_browsers() -> None:
    """Kill the browsers that this process started."""
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            if process.name().startswith(("chrom", "google-chrome")):
                process.kill()


until = partial(waiting.until, every=POLL)


def verdict(page: Page) -> str:
    """Return the sentence of the newest answer; empty while the answer is pending."""
    answer = page.locator("#answer")
    busy = "busy" in (answer.get_attribute("class") or "")
    return "" if busy else page.inner_text("#verdict")


def state(page: Page) -> dict[str, list[str]]:
    """Return the state that the page's address holds."""
    return parse_qs(urlsplit(page.url).fragment)


def watched_page(browser: Browser, width: int, height: int) -> Page:
    """Return an empty page that keeps the viewer's events in ``window.seen``."""
    page = browser.new_page(viewport={"width": width, "height": height})
    page.add_init_script(
        "window.seen = []; window.addEventListener('viewer-event', (e) => window.seen.push(e.detail))"
    )
    return page


@contextmanager
def opened(browser: Browser, address: str, width: int = 1000, height: int = 620) -> Iterator[Page]:
    """Yield the page as soon as the viewer shows a frame."""
    page = watched_page(browser, width, height)
    try:
        page.goto(address)
        until(lambda: events(page, "time_update") or events(page, "timeline_change"))
        yield page
    finally:
        page.close()


def events(page: Page, kind: str) -> list[dict[str, Any]]:
    """Return the viewer's events of one kind."""
    found: list[dict[str, Any]] = page.evaluate("window.seen")
    return [event for event in found if event["type"] == kind]


def listed(page: Page) -> bool:
    """Whether a page has all frames, and what is missed in them."""
    whole = f"{FRAMES} frames" in page.inner_text("#run")
    return whole and page.locator("#found button .missed").count() > 0


class Talk:
    """A page without a browser."""

    def __init__(self, address: str) -> None:
        from websockets.sync.client import connect
        from websockets.typing import Origin

        parts = urlsplit(address)
        self.entries: dict[int, dict[str, Any]] = {}
        self._number = 0
        url, origin = f"ws://{parts.netloc}/talk?{parts.query}", Origin(f"http://{parts.netloc}")
        self._channel = connect(url, origin=origin, max_size=None).__enter__()
        self.say(type="shown")
        self.over = self.until("progress", lambda message: message["over"])

    def __enter__(self) -> Talk:
        return self

    def __exit__(self, *error: Any) -> None:
        self._channel.__exit__(*error)

    def say(self, **message: Any) -> None:
        self._number += 1
        self._channel.send(json.dumps({"id": self._number, **message}))

    def asked(self, kind: str, **message: Any) -> dict[str, Any]:
        """Send a message and return its answer of this kind, or its error."""
        self.say(**message)
        return self.until(kind, lambda answer: answer.get("id") == self._number)

    def until(self, kind: str, wanted: Callable[[dict[str, Any]], Any] = bool) -> dict[str, Any]:
        """Return the next message of a kind that meets the condition, or the next error."""
        while True:
            message: dict[str, Any] = json.loads(self._channel.recv(timeout=PATIENCE))
            if message["type"] == "entries":
                for number in message["gone"]:
                    del self.entries[number]
                for entry in message["entries"]:
                    known = self.entries.setdefault(entry["number"], {**entry, "sights": []})
                    known["sights"] += entry["sights"]
            if message["type"] == "error" or (message["type"] in kind.split("|") and wanted(message)):
                return message

    def of(self, *whats: str) -> list[dict[str, Any]]:
        return [entry for entry in self.entries.values() if entry["what"] in whats]
