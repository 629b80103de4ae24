"""The way from a missed object to a filed report in the workbench, in a real browser against the real server.

First it starts ``bevviz demo`` as on a new machine: nothing is compiled, and no browser has the viewer.
Then it goes the way on the synthetic drive and on KITTI's labelled frames, prints its steps, its clicks and
the seconds that somebody waits, clicks 40 times in the views, asks about 40 things of the list, and changes
parameters 40 times. Of each it says what the viewer's own drawing takes, which without a graphics card is
most of it.

A browser gives its processes sessions and priorities of their own: ``nice`` does not reach them.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext, Page

DATA = Path(os.environ.get("BEVVIZ_DATA") or Path(__file__).resolve().parents[2] / "shared/data")
FRAMES = 20
CLICKS, SECONDS = 6, 20.0  # that the journey may take
FIRST, FRESH = 3.0, 15.0  # seconds to the first frame, and on a new machine
ANSWER, PICTURE = 0.7, 0.3  # seconds from a click to its answer, from a change to its picture, for 95 %
CHANGES = {  # that are tried in turn: the first stage, the last ones, and one between
    "voxel.size": (0.08, 0.15),
    "ground.distance_threshold": (0.1, 0.4),
    "clustering.eps": (0.3, 0.9),
    "detector.conf_threshold": (0.1, 0.5),
}
WIDTH, HEIGHT = 1400, 900
PANEL = 400  # pixels of the page's width that are not the viewer
SOFTWARE = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]
LATE = 400.0  # seconds after which something does not come about
TWO_PICTURES = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
CLICKING = 180.0  # seconds that clicks in the views may take together


@dataclass
class Journey:
    """What was done, and how long it took."""

    steps: list[tuple[str, float]] = field(default_factory=list)
    clicks: int = 0
    waited: float = 0.0

    def step(self, what: str, seconds: float, *, click: bool = True) -> None:
        self.steps.append((what, seconds))
        self.clicks += click
        self.waited += seconds
        print(f"  {seconds:6.2f} s  {what}")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--frames", type=int, default=FRAMES, help=f"of the synthetic drive (default: {FRAMES})"
    )
    parser.add_argument("--only", choices=("fresh", "demo", "kitti"), help="one of the three")
    parser.add_argument("--clicks", type=int, default=40, help="of each sort, timed one by one (default: 40)")
    parser.add_argument("--once", action="store_true", help="do not start it a first time, for the browser")
    parser.add_argument("--pictures", type=Path, help="folder for a picture of each step")
    options = parser.parse_args()
    print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    good = True
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if options.only in (None, "fresh"):
            good &= _fresh(folder / "fresh")
        if options.only in (None, "demo"):
            good &= _go("the synthetic drive", demo(folder, options.frames), folder, options)
        if options.only in (None, "kitti"):
            if not DATA.is_dir():
                print(f"no KITTI: {DATA} is not there")
            else:
                good &= _go("KITTI", _kitti(folder), folder, options)
    return 0 if good else 1


def demo(folder: Path, frames: int) -> list[str]:
    bag = folder / "demo.mcap"
    subprocess.run(
        [sys.executable, "-m", "bevviz.cli", "demo", "--frames", str(frames), "-o", str(bag)], check=True
    )
    return [str(bag), "--model", "demo"]


def _kitti(folder: Path) -> list[str]:
    """Its labelled frames as a bag, and the labels."""
    from tests.support import bags

    names = [f"{number:06}" for number in range(12)]
    bag = bags.write(folder / "kitti", bags.kitti_items(DATA.parent / "data", names=names))
    model = DATA / "models/yolox_nano.onnx"
    return [str(bag), "--model", str(model), "--kitti-labels", str(DATA / "kitti/label_2")]


@contextmanager
def serving(arguments: Sequence[str], folder: Path, **variables: str) -> Iterator[str]:
    """Start a command of the workbench as a user does, and yield the address that it prints."""
    command = [sys.executable, "-m", "bevviz.cli", *arguments]
    environment = os.environ | {"DISPLAY": "", "BROWSER": ""} | variables
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stderr=pipe, text=True, cwd=folder, env=environment) as server:
        try:
            assert server.stderr is not None
            for line in server.stderr:
                if found := re.search(r"workbench at (\S+)", line):
                    yield found[1]
                    break
            else:
                raise SystemExit("the server has said no address")
        finally:
            server.send_signal(signal.SIGINT)
            server.communicate(timeout=60)


@contextmanager
def _browser(folder: Path) -> Iterator[BrowserContext]:
    """Start a browser with an empty profile."""
    from playwright.sync_api import sync_playwright

    chromium = os.environ.get("BEVVIZ_CHROMIUM") or shutil.which("chromium")
    if chromium is None:
        raise SystemExit("needs a browser: apt-get install chromium (or BEVVIZ_CHROMIUM=its path)")
    with sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            folder / "profile",
            executable_path=chromium,
            args=SOFTWARE,
            viewport={"width": WIDTH, "height": HEIGHT},
        )
        yield context
        context.close()


def _fresh(folder: Path) -> bool:
    """Time the first frame of ``bevviz demo`` without compiled stages, stored results and cached viewer."""
    folder.mkdir()
    caches = {"NUMBA_CACHE_DIR": str(folder / "numba"), "XDG_CACHE_HOME": str(folder / "cache")}
    print("\na new machine: bevviz demo")
    with _browser(folder) as context:
        start = time.monotonic()
        with serving(["demo"], folder, **caches) as address:
            printed = time.monotonic() - start
            page = context.new_page()
            page.goto(address)
            return _first_frame(page, start, printed, "the first time", FRESH) <= FRESH


def _go(name: str, arguments: list[str], folder: Path, options: argparse.Namespace) -> bool:
    print(f"\n{name}: bevviz open {' '.join(arguments)}")
    with _browser(folder) as context:
        context.add_init_script(
            "window.seen = []; window.addEventListener('viewer-event', (e) => window.seen.push(e.detail))"
        )
        for warm in (True,) if options.once else (False, True):  # the second time the browser has the viewer
            start = time.monotonic()
            with serving(["open", *arguments, "--no-browser"], folder) as address:
                printed = time.monotonic() - start
                page = context.new_page()
                page.goto(address)
                which = "again: the browser has the viewer" if warm else "the first time"
                _first_frame(page, start, printed, which)
                if warm:
                    journey = _journey(page, name, options.pictures)
                    _latencies(page, options.clicks)
                page.close()
    print(
        f"  {journey.clicks} clicks (at most {CLICKS}), "
        f"{journey.waited:.1f} s of waiting (at most {SECONDS:g})"
    )
    return journey.clicks <= CLICKS and journey.waited <= SECONDS


def _journey(page: Page, name: str, pictures: Path | None) -> Journey:
    journey = Journey()

    def picture(what: str) -> None:
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            page.wait_for_timeout(3000)  # a browser without a graphics card draws late
            page.screenshot(path=pictures / f"{name.split()[-1].lower()}-{what}.png", timeout=1000 * LATE)

    def waited(done: Callable[[], Any]) -> float:
        start = time.monotonic()
        until(done, 0.1)
        return time.monotonic() - start

    until(lambda: page.locator("#bar").is_hidden(), 0.5)  # the drive is loaded
    picture("opened")
    helped = False
    for row in page.locator("#found button", has=page.locator(".missed")).all()[:12]:
        before = page.inner_text("#where")
        row.click()
        took = waited(_answered(page, before))
        verdict = page.inner_text("#verdict")
        hints = waited(lambda: not page.inner_text("#hints").startswith("Trying"))
        if page.locator("#hints button").count():
            journey.step(f"click a missed object: {verdict}", took)
            journey.step("read the verdict; meanwhile changes are tried", hints, click=False)
            helped = True
            break
    if not helped:
        print("  no missed object that a change would help")
        return journey
    picture("missed")
    hint = page.locator("#hints button").first
    what = hint.inner_text().splitlines()[0]
    hint.click()
    took = waited(
        lambda: (
            "reported" in (page.get_attribute("#answer", "class") or "")
            and not busy(page)
            and not page.inner_text("#effect").startswith("Running")
        )
    )
    journey.step(f"press its hint ({what}): {page.inner_text('#effect')}", took)
    picture("found")
    page.click("#drive")
    took = waited(lambda: page.locator("#trial").is_visible() and page.locator("#drive-cancel").is_hidden())
    journey.step(f"run the drive: {page.inner_text('#trial-text')}", took)
    picture("drive")
    page.fill("#words", "missed, although it is plainly there")
    page.click("#report")
    took = waited(lambda: page.locator("#reports a").count() >= 2)
    journey.step(f"write the report: {page.inner_text('#reports')}", took)
    start = time.monotonic()
    with page.context.expect_page() as opened:
        page.locator("#reports a", has_text=".html").click()
    report = opened.value
    report.wait_for_load_state()
    journey.step(f"open the report: {report.title()}", time.monotonic() - start)
    assert "was not reported" in report.inner_text("body") or "was reported, but" in report.inner_text("body")
    if pictures is not None:
        report.screenshot(path=pictures / f"{name.split()[-1].lower()}-report.png")
    report.close()
    return journey


def _latencies(page: Page, number: int) -> None:
    def told(what: str, seconds: list[tuple[float, float]], whole: str, own: str, wanted: float) -> None:
        if not seconds:
            print(f"  {what}: none was answered")
            return
        (p50, own50), (p95, own95) = np.percentile(seconds, [50, 95], axis=0)
        print(
            f"  {len(seconds)} {what}: {p50:.2f} s (median), {p95:.2f} s (95 %) {whole}; "
            f"{own}: {own50:.2f} s, {own95:.2f} s (wanted: {wanted:g} s)"
        )

    print(f"  {_drawing(page):6.2f} s  for the viewer to draw one picture")
    if page.locator("#reset").is_visible():
        page.click("#reset")
    verdict, question = "from the click to the verdict", "of it from the page's question to its answer"
    told("things of the list", _questions(page, number), verdict, question, ANSWER)
    told("clicks in the views", _clicks(page, number), verdict, question, ANSWER)
    drawn, answered = "from the change to the picture", "of it to its answer, with what is to be drawn"
    told("changed parameters", _changes(page, number), drawn, answered, PICTURE)


def _drawing(page: Page) -> float:
    """Median seconds of a picture, while the pointer moves over the view of space."""
    times = []
    for step in range(8):
        page.mouse.move(200 + 5 * step, 400)
        start = time.monotonic()
        page.evaluate("new Promise((then) => requestAnimationFrame(() => requestAnimationFrame(then)))")
        times.append(time.monotonic() - start)
    return float(np.median(times))


def _took(page: Page) -> tuple[float, float]:
    """Of the newest answer, as the page counts them."""
    took, own = (page.get_attribute("#answer", f"data-{name}") for name in ("took", "server"))
    return float(took or "nan") / 1000, float(own or "nan") / 1000


def _questions(page: Page, number: int) -> list[tuple[float, float]]:
    """Seconds from a key press that goes to the next thing of the list to the verdict."""
    found = []
    page.locator("#verdict").click()  # keys are for the panel
    for _ in range(number):
        page.evaluate("delete document.getElementById('answer').dataset.took")
        page.keyboard.press("n")
        until(lambda: page.get_attribute("#answer", "data-took") and not busy(page), 0.02)
        found.append(_took(page))
    return found


def _changes(page: Page, number: int) -> list[tuple[float, float]]:
    """Seconds from a changed parameter to its picture, and to the answer that has what is to be drawn."""
    rng, found = np.random.default_rng(0), list[tuple[float, float]]()
    for step in range(number):
        key, (low, high) = list(CHANGES.items())[step % len(CHANGES)]
        page.fill("#search", key)
        control = page.locator(f"[id='control-{key}']")
        control.fill(f"{rng.uniform(low, high):.3f}")
        page.evaluate("delete document.getElementById('effect').dataset.took")
        start = time.monotonic()
        control.press("Enter")
        until(lambda: page.get_attribute("#effect", "data-took"), 0.02)
        page.evaluate(TWO_PICTURES)
        took = page.get_attribute("#effect", "data-took")
        found.append((time.monotonic() - start, float(took or "nan") / 1000))
    return found


def _clicks(page: Page, number: int) -> list[tuple[float, float]]:
    """Seconds from a click in a view, and from the question, to the verdict, as the page counts them."""
    rng, found = np.random.default_rng(0), list[tuple[float, float]]()
    over = time.monotonic() + CLICKING
    while len(found) < number and time.monotonic() < over:
        x = int(rng.integers(20, WIDTH - PANEL - 20))
        y = int(rng.integers(40, HEIGHT - 60))
        before = page.inner_text("#where")
        page.mouse.move(x, y)
        page.wait_for_timeout(800)  # nobody clicks where the pointer has just come to
        page.mouse.click(x, y, delay=50)
        end = time.monotonic() + 6
        while time.monotonic() < end:
            page.wait_for_timeout(150)
            if not busy(page) and page.inner_text("#where") != before:
                found.append(_took(page))
                break
    return found


def _first_frame(page: Page, start: float, printed: float, which: str, wanted: float = FIRST) -> float:
    """Wait for it, and return how long it took since the command was started."""
    marks = (
        "Object.fromEntries(performance.getEntriesByType('mark').map((m) => [m.name, m.startTime / 1000]))"
    )
    until(lambda: "frame" in page.evaluate(marks), 0.1)
    opened = time.monotonic() - start - page.evaluate("performance.now()") / 1000
    at = {name: opened + seconds for name, seconds in page.evaluate(marks).items()}
    print(
        f"  {at['frame']:6.2f} s  from the command to the first frame drawn, {which} (wanted: {wanted:g} s): "
        f"the address after {printed:.2f} s, the viewer begun {at['viewer']:.2f}, the frame at the viewer "
        f"{at['piece']:.2f}, taken by it {at['told']:.2f}"
    )
    return float(at["frame"])


def _answered(page: Page, before: str) -> Callable[[], bool]:
    """Whether there is another answer than that one."""
    return lambda: page.inner_text("#where") != before and not busy(page)


def busy(page: Page) -> bool:
    """Whether an answer is on its way."""
    return "busy" in (page.get_attribute("#answer", "class") or "")


def events(page: Page, kind: str) -> list[dict[str, Any]]:
    """Return the viewer's events of one kind."""
    found: list[dict[str, Any]] = page.evaluate("window.seen")
    return [event for event in found if event["type"] == kind]


def until(done: Callable[[], Any], pause: float) -> None:
    """Wait for something."""
    end = time.monotonic() + LATE
    while not done():
        if time.monotonic() > end:
            raise SystemExit("it has not come about")
        time.sleep(pause)


if __name__ == "__main__":
    sys.exit(main())
