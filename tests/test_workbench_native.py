"""The panel beside Rerun's own viewer, which runs without a window where Vulkan can be had."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from rerun.experimental import ViewerClient

from bevviz.cli import main
from bevviz.recording import entities, rerun_cli
from bevviz.recording.ports import LOOPBACK, free_port, is_listening
from tests.support.workbench_pages import FRAMES, chromium, demo_bag, serving, state, until, verdict

if TYPE_CHECKING:
    from playwright.sync_api import Browser

START = 1_750_000_000_000_000_000  # stamp of the synthetic drive's first scan
LAST = 300_000_000  # of a later one
NO_VULKAN = "needs Vulkan, if only in software: apt-get install mesa-vulkan-drivers"


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return demo_bag(tmp_path_factory.mktemp("workbench"))


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


@pytest.fixture
def native() -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Run a viewer without a window. Yield its URL and its process."""
    port = free_port(9950)
    arguments = ["--headless", "--bind", LOOPBACK, "--port", str(port), "--hide-welcome-screen"]
    process = subprocess.Popen(
        [rerun_cli.rerun_program(), *arguments],
        stdin=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=rerun_cli.environment(),
    )
    url = f"rerun+http://{LOOPBACK}:{port}/proxy"
    try:
        end = time.monotonic() + 30
        while not is_listening(LOOPBACK, port) and time.monotonic() < end and process.poll() is None:
            time.sleep(0.05)
        try:
            ViewerClient.connect(url).get_state()
        except (RuntimeError, ConnectionError, TimeoutError):
            pytest.skip(NO_VULKAN)
        yield url, process
    finally:
        rerun_cli.stop(process)


def shown(client: ViewerClient) -> tuple[str | None, int | None]:
    """Return the viewer's timeline and time."""
    with suppress(TimeoutError):
        for recording in client.get_state().recordings:
            return recording.current_timeline, recording.current_time
    return None, None


def test_panel_and_viewer_are_at_the_same_time(
    bag: Path,
    browser: Browser,
    native: tuple[str, subprocess.Popen[bytes]],
) -> None:
    """A row of the list moves the viewer and is marked in it; the viewer's own slider moves the panel."""
    url, process = native
    client = ViewerClient.connect(url)
    with serving("open", str(bag), "--connect", url) as (address, _):
        page = browser.new_page(viewport={"width": 900, "height": 900})
        page.goto(address)
        assert not page.locator("#viewer").is_visible()
        until(lambda: page.inner_text("#run").startswith(f"{FRAMES} frames"))  # all of them
        until(lambda: shown(client)[0] == entities.STAMP)
        with suppress(TimeoutError):
            client.set_time(entities.STAMP, timestamp=np.datetime64(START + LAST, "ns"))
        until(lambda: f"at={START + LAST}" in page.evaluate("location.hash"))
        page.locator("#found button:has(.missed)").first.click()
        until(lambda: "missed" in (page.locator("#answer").get_attribute("class") or "") and verdict(page))
        stamp = int(state(page)["at"][0])
        first = state(page)["pick"][0]
        assert first.startswith("truth/")
        until(lambda: shown(client) == (entities.STAMP, stamp))
        (recording,) = client.get_state().recordings
        schema = client.get_recording_schema(recording.store_id, entity_path=entities.WHY)
        assert schema.entities, "what was asked about is marked in the viewer"
        page.keyboard.press("n")
        until(lambda: state(page)["pick"][0] != first or int(state(page)["at"][0]) != stamp)
        until(lambda: shown(client) == (entities.STAMP, int(state(page)["at"][0])))
        process.kill()
        until(lambda: page.locator("#viewer-gone").count() == 1)
        assert "The viewer was closed" in page.inner_text("#viewer-gone")
        page.close()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--connect", "http://here"], "expected a URL such as"),
        (["--connect", "rerun+http://127.0.0.1:9/proxy"], "no viewer answers there"),
        (["--viewer"], "no display"),
    ],
)
def test_impossible_viewers_are_one_line(
    bag: Path,
    given: list[str],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["open", str(bag), "--no-browser", *given]) == 2
    assert said in capsys.readouterr().err
