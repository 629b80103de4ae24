"""The workbench's server, and how tests wait for and read its page in a browser."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

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
    assert main(["demo", "--frames", str(FRAMES), "--bag", str(path)]) == 0
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
            server.communicate(timeout=PATIENCE)


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
        yield browser
        browser.close()


until = partial(waiting.until, every=POLL)


def verdict(page: Page) -> str:
    """Return the sentence of the newest answer; empty while the answer is pending."""
    answer = page.locator("#answer")
    busy = "busy" in (answer.get_attribute("class") or "")
    return "" if busy else page.inner_text("#verdict")


def state(page: Page) -> dict[str, list[str]]:
    """Return the state that the page's address holds."""
    return parse_qs(urlsplit(page.url).fragment)
