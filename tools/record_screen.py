"""Record a minute of the workbench: from a missed object to a filed report, in a headless Chromium.

    python tools/record_screen.py docs/images/workbench.webp --picture docs/images/workbench.png

The pictures are those that the browser draws. A picture that does not change is shown for two seconds at
most, so that a slow machine makes the same film as a fast one. A caption says each step.
"""

from __future__ import annotations

import argparse
import base64
import io
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from benchmarks.journey import SOFTWARE, busy, serving, until
from bevviz.extras.demo.command import SHIPPED

SIZE = (1280, 800)
WIDTH = 960  # pixels of the film
IDLE = 2.0  # seconds that an unchanged picture is shown at most
BAR = 40  # pixels of the caption


class Film:
    """Pictures of a page, each with its time and its caption."""

    def __init__(self, page: Any) -> None:
        self.pictures: list[tuple[float, str, bytes]] = []
        self.caption = ""
        self._session = page.context.new_cdp_session(page)
        self._session.on("Page.screencastFrame", self._add)
        self._session.send("Page.startScreencast", {"format": "jpeg", "quality": 90, "everyNthFrame": 1})

    def _add(self, event: dict[str, Any]) -> None:
        self.pictures.append((time.monotonic(), self.caption, base64.b64decode(event["data"])))
        self._session.send("Page.screencastFrameAck", {"sessionId": event["sessionId"]})

    def stop(self) -> None:
        """End the recording, before the page is closed."""
        self._session.send("Page.stopScreencast")

    def write(self, path: Path, seconds: float) -> float:
        """Write the film as a WebP of at most some seconds. Return its length in seconds."""
        font = ImageFont.load_default(20)
        height = WIDTH * SIZE[1] // SIZE[0]
        images, lengths = list[Image.Image](), list[float]()
        ends = [*(at for at, _, _ in self.pictures[1:]), self.pictures[-1][0] + IDLE]
        last: tuple[str, bytes] | None = None
        for (at, caption, data), end in zip(self.pictures, ends, strict=True):
            shown = min(end - at, IDLE)
            image = Image.open(io.BytesIO(data)).convert("RGB").resize((WIDTH, height))
            raw = caption, image.resize((96, 60)).quantize(32).tobytes()
            if raw == last or (lengths and lengths[-1] < 0.25 and shown < 0.25):
                lengths[-1] = min(lengths[-1] + shown, IDLE)
                continue
            last = raw
            picture = Image.new("RGB", (WIDTH, height + BAR), "#1b1d21")
            picture.paste(image, (0, 0))
            ImageDraw.Draw(picture).text((12, height + 8), caption, "white", font)
            images.append(picture)
            lengths.append(shown)
        factor = min(1.0, seconds / sum(lengths))
        durations = [max(40, round(1000 * length * factor)) for length in lengths]
        images[0].save(
            path, save_all=True, append_images=images[1:], duration=durations, loop=0, quality=55, method=4
        )
        return sum(durations) / 1000


def play(page: Any, film: Film, picture: Path | None) -> None:
    """Go from the missed object to the report. Save a picture of the page before the report."""

    def step(caption: str, act: Callable[[], Any], done: Callable[[], Any]) -> None:
        film.caption = caption
        page.wait_for_timeout(1500)
        act()
        until(done, 0.1)
        page.wait_for_timeout(5000)

    def answered() -> bool:
        return bool(page.inner_text("#verdict")) and not busy(page)

    # The page begins at the worst row that a tried change helps.
    missed = page.locator("#found button[aria-current=true]", has=page.locator(".missed"))
    step("bevviz open: the worst findings of the drive", lambda: None, missed.is_visible)
    step("1. The worst that a change helps: which stage lost it, by which number", lambda: None, answered)
    until(lambda: page.locator("#hints button").count(), 0.2)
    hint = page.locator("#hints button").first
    step(
        "2. Press the change that would keep it: it is tried at once",
        hint.click,
        lambda: "reported" in (page.get_attribute("#answer", "class") or "") and not busy(page),
    )
    step(
        "3. Run the whole drive with it: what it fixes, and what it breaks",
        lambda: page.click("#drive"),
        lambda: page.locator("#trial").is_visible() and page.locator("#drive-cancel").is_hidden(),
    )

    if picture is not None:
        for i in range(12):  # The viewer draws what it has read while there is input.
            page.mouse.move(SIZE[0] - 100 - i, 60)
            page.wait_for_timeout(1500)
        page.screenshot(path=picture, timeout=120e3)

    def report() -> None:
        page.fill("#words", "missed, although it is plainly there")
        page.click("#report")

    step(
        "4. File a report: a recording, a page and the raw messages",
        report,
        page.locator("#reports a").first.is_visible,
    )


def main() -> int:
    """Record the film."""
    parser = argparse.ArgumentParser(description="Record a minute of the workbench.")
    parser.add_argument("film", type=Path, help=".webp file")
    parser.add_argument("--picture", type=Path, help="PNG file of the page, too")
    parser.add_argument("--seconds", type=float, default=60.0, help="length at most (default: 60)")
    parser.add_argument("--browser", default=shutil.which("chromium"), help="Chromium or Chrome")
    options = parser.parse_args()
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=options.browser, args=SOFTWARE)
        bag = shutil.copy(SHIPPED, folder)  # The report is written beside it.
        with serving(["open", bag, "--model", "demo", "--no-browser"], Path(folder)) as address:
            page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]}, color_scheme="dark")
            page.goto(address)
            until(lambda: page.locator("#bar").is_hidden(), 0.5)  # the drive is loaded
            page.wait_for_timeout(8000)  # and drawn
            film = Film(page)
            play(page, film, options.picture)
            film.stop()
            page.wait_for_timeout(500)
        browser.close()
    print(f"{options.film}: {film.write(options.film, options.seconds):.0f} s, {len(film.pictures)} pictures")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
