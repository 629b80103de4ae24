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
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

import psutil
import pytest
from pydantic import TypeAdapter

from bevviz.cli import main
from bevviz.config import load
from bevviz.drive import Drive
from bevviz.workbench.page_types import AnyToPage
from tests.support.kept_drives import BAG
from tests.support.waiting import PATIENCE, until

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route
    from websockets.sync.client import ClientConnection

    from bevviz.workbench.session import WorkbenchSession

FRAMES = 6
SOFTWARE_GL = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]
TO_PAGE = TypeAdapter[Any](AnyToPage)
EMPTY_WASM = b"\0asm\1\0\0\0"  # a module without content: the stand-in for the viewer's 64 MB


def demo_bag(folder: Path) -> Path:
    """Write the bag that the workbench opens in most tests: the first frames of the kept drive."""
    path = folder / "demo.mcap"
    assert main(["cut", str(BAG), "--end", f"{FRAMES / 10 - 0.05}", "-o", str(path)]) == 0
    return path


# --- servers ------------------------------------------------------------------------------------


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
def served(bag: Path, *settings: str) -> Iterator[str]:
    """Serve the workbench of a bag from a thread of this process. Yield its address."""
    pytest.importorskip("starlette", reason="needs pip install 'bevviz[workbench]'")
    from bevviz.workbench.labelled_source import LabelledSource
    from bevviz.workbench.server import page_server
    from bevviz.workbench.session import recorded_session

    config = load(None, ["detector.model=demo", *settings])
    with LabelledSource([bag], config) as source, LabelledSource([bag], config) as again:

        def make() -> WorkbenchSession:
            return recorded_session(Drive(source, config), again, [bag])

        addresses = list[str]()
        with page_server(make, "page", 0, addresses.append, str(bag)):
            yield addresses[0]


# --- a browser ----------------------------------------------------------------------------------


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
    for process in browser_processes():
        with suppress(psutil.NoSuchProcess):
            process.kill()


def browser_processes() -> Iterator[psutil.Process]:
    """Yield the processes of the browsers that this process started."""
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            if process.name().startswith(("chrom", "google-chrome")):
                yield process


def watched_page(browser: Browser, width: int, height: int) -> Page:
    """Return an empty page that keeps the viewer's events in ``window.seen``."""
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(1000 * PATIENCE)
    page.add_init_script(
        "window.seen = []; window.addEventListener('viewer-event', (e) => window.seen.push(e.detail))"
    )
    return page


@contextmanager
def opened(
    browser: Browser, address: str, width: int = 1000, height: int = 620, *, draws: bool = False
) -> Iterator[Page]:
    """Yield the page as soon as the viewer shows a frame. It may neither fail nor warn of its own commands.

    Args:
        browser: the browser.
        address: address of the page.
        width: of the window, in pixels.
        height: of the window, in pixels.
        draws: the page has Rerun's viewer, whose pictures take seconds without a graphics card. Otherwise a
            stand-in takes its messages, and reports the same events: see ``stand_in_viewer.js``.
    """
    page, wrong = watched_page(browser, width, height), list[str]()
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on(
        "console", lambda line: wrong.append(line.text) if line.text.startswith("Failed to set") else None
    )
    try:
        if not draws:
            page.route("**/viewer/*/*", _stand_in)
        page.goto(address)
        until(lambda: events(page, "time_update") or events(page, "timeline_change"), "a shown frame")
        yield page
        assert not wrong
    finally:
        page.close()


def _stand_in(route: Route) -> None:
    """Answer a request for one of the viewer's files."""
    if route.request.url.endswith(".js"):
        script = Path(__file__).with_name("stand_in_viewer.js").read_text()
        route.fulfill(body=script, content_type="text/javascript")
    elif route.request.url.endswith(".wasm"):
        route.fulfill(body=EMPTY_WASM, content_type="application/wasm")
    else:
        route.continue_()


def verdict(page: Page) -> str:
    """Return the sentence of the newest answer; empty while the answer is pending."""
    answer = page.locator("#answer")
    busy = "busy" in (answer.get_attribute("class") or "")
    return "" if busy else page.inner_text("#verdict")


def state(page: Page) -> dict[str, list[str]]:
    """Return the state that the page's address holds."""
    return parse_qs(urlsplit(page.url).fragment)


def subject(page: Page) -> dict[str, Any]:
    """Return the identity of the object that the page's address holds."""
    identity: dict[str, Any] = json.loads(state(page)["pick"][0])
    return identity


def events(page: Page, kind: str) -> list[dict[str, Any]]:
    """Return the viewer's events of one kind."""
    found: list[dict[str, Any]] = page.evaluate("window.seen")
    return [event for event in found if event["type"] == kind]


def listed(page: Page) -> bool:
    """Whether a page has all frames, and what is missed in them."""
    whole = f"{FRAMES} frames" in page.inner_text("#run")
    return whole and page.locator("#found button .missed").count() > 0


# --- a page without a browser -------------------------------------------------------------------


def channel(address: str, path: str, origin: str | None = "", token: bool = True) -> ClientConnection:
    """Connect to a channel of the page, as the page itself or a page of another origin does."""
    from websockets.sync.client import connect
    from websockets.typing import Origin

    parts = urlsplit(address)
    url = f"ws://{parts.netloc}{path}" + (f"{'&' if '?' in path else '?'}{parts.query}" if token else "")
    own = f"http://{parts.netloc}" if origin == "" else origin
    return connect(url, origin=None if own is None else Origin(own), max_size=None)


class Talk:
    """A page without a browser."""

    def __init__(self, address: str) -> None:
        self.entries: dict[int, dict[str, Any]] = {}
        self._number = 0
        self._channel = channel(address, "/talk").__enter__()
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
            TO_PAGE.validate_python(message)
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
