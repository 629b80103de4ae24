"""Journeys of users over the workbench's page, in a real browser.

One journey has Rerun's viewer, which draws slowly without a graphics card. The others have a stand-in for it.
"""

from __future__ import annotations

import csv
import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import pytest

import bevviz
from bevviz.cli import main
from bevviz.pipeline.notes import HandledFinding, Notes
from bevviz.recording import entities
from bevviz.workbench.thumbnails import WIDTH
from tests.support.kept_drives import BAG
from tests.support.waiting import until
from tests.support.workbench_pages import (
    FRAMES,
    Talk,
    chromium,
    demo_bag,
    events,
    listed,
    opened,
    served,
    serving,
    state,
    subject,
    verdict,
)

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

CLICK = 20.0  # seconds that the viewer has to say what was clicked, before it is clicked again
MARKUP = "<b>look</b> & here"


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return demo_bag(tmp_path_factory.mktemp("journeys"))


@pytest.fixture(scope="module")
def address(bag: Path) -> Iterator[str]:
    with served(bag) as address:
        yield address


@pytest.fixture(scope="module")
def whole(address: str) -> int:
    """Return the number of findings once the drive has been run."""
    with Talk(address) as first:
        assert first.over["done"] == FRAMES
    with Talk(address) as talk:  # The first one may have been told of the end before the last findings.
        return len(talk.entries)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


@pytest.fixture
def page(browser: Browser, address: str, whole: int) -> Iterator[Page]:
    """Yield a page that lists the findings of all frames."""
    with opened(browser, address) as page:
        until(lambda: listed(page) and number(page) == whole)
        until(lambda: page.locator("#found [aria-current=true]").count() and verdict(page))
        yield page


def rows(page: Page) -> list[str]:
    """Return the texts of the findings in the table."""
    return page.locator("#found li:not(.group)").all_inner_texts()


def number(page: Page) -> int:
    """Return the number of findings that the heading states."""
    return int(page.inner_text("#found-title").rpartition(": ")[2])


def frame(page: Page) -> int:
    """Return the number of the frame that the panel says is shown."""
    return int(page.inner_text("#shown").split()[1])


def new_verdict(page: Page, before: str) -> str:
    """Wait for the next verdict and return it."""
    until(lambda: verdict(page) not in ("", before))
    return verdict(page)


# --- with Rerun's viewer ------------------------------------------------------------------------


@pytest.mark.long
def test_the_viewer_is_clicked_and_shows_the_frame_of_the_panel(
    browser: Browser, address: str, bag: Path
) -> None:
    """Clicks in an image and in space, then the last frame. Each answer moves the views."""
    with bevviz.open(bag) as drive:
        last = drive.raw(FRAMES - 1).stamp
    with opened(browser, address, 1000, 620, draws=True) as page:  # a small picture is drawn sooner
        until(lambda: page.locator("#found [aria-current=true]").count())
        page.keyboard.press("Home")
        until(lambda: frame(page) == 0)
        before = verdict(page)

        def answered_at(x: float, y: float) -> dict[str, Any]:
            nonlocal before
            clicked = click(page, x, y)
            before = new_verdict(page, before)
            assert "cannot" not in before.split()[:4]
            assert page.locator("#chain li").count() > 0
            return clicked

        def pixel() -> tuple[float, float]:
            """Return the pixel that the page asked about."""
            words = page.inner_text("#where").split("pixel ")[1].split(" ·")[0]
            u, v = map(float, words.split(", "))
            return u, v

        assert answered_at(316, 110)["view_name"] == "zed"
        first = pixel()
        answered_at(466, 110)
        # The view went to the first pixel and shows a part of the image, so a step in it is shorter there.
        assert 0 < pixel()[0] - first[0] < 150 * 640 / 300
        answered_at(150, 300)
        until(lambda: listed(page))
        for shown in range(FRAMES - 1):
            until(lambda: frame(page) == shown)  # noqa: B023
            page.keyboard.press(".")
        until(lambda: events(page, "time_update")[-1]["time"] == float(last))


@pytest.mark.long
def test_the_viewer_shows_the_tried_side_after_a_reload(browser: Browser, address: str) -> None:
    with opened(browser, address, 700, 500, draws=True) as page:
        until(lambda: listed(page))
        shown = len(events(page, "time_update"))
        page.locator("#found button", has=page.locator(".missed")).filter(has_not_text="0.00 s").first.click()
        until(lambda: verdict(page))
        until(lambda: len(events(page, "time_update")) > shown)
        page.fill("#search", "min_cluster_points")
        page.locator("[id='control-clustering.min_cluster_points']").fill("9")
        page.keyboard.press("Enter")
        until(lambda: page.inner_text("#effect").startswith("Frame "))
        until(lambda: viewer_line(page) == "tried")
        text, held = until(lambda: verdict(page)), state(page)
        page.reload()
        until(lambda: verdict(page) == text and state(page) == held)
        until(lambda: viewer_line(page) == "tried")
        until(lambda: events(page, "time_update")[-1]["time"] == float(held["at"][0]))


def viewer_line(page: Page) -> str:
    """Return the timeline that the viewer reports."""
    changes = events(page, "timeline_change")
    return changes[-1]["timeline"] if changes else ""


def click(page: Page, x: float, y: float) -> dict[str, Any]:
    """Until the viewer selects an entity, which is given; without a graphics card it may miss a click."""
    number = len(events(page, "selection_change"))

    def selected() -> dict[str, Any] | None:
        new = [item for event in events(page, "selection_change")[number:] for item in event["items"]]
        return next(
            (item for item in reversed(new) if item["type"] == "entity"), None
        )  # rather than the view

    def tried() -> dict[str, Any] | None:
        page.mouse.move(x - 3, y)
        page.mouse.move(x, y)
        for _ in range(3):  # it finds what is under the pointer a picture or two later
            page.evaluate("new Promise((then) => { requestAnimationFrame(then); setTimeout(then, 5000); })")
        page.mouse.click(x, y, delay=60)
        end = time.monotonic() + CLICK
        while selected() is None and time.monotonic() < end:
            time.sleep(0.25)
        return selected()

    found: dict[str, Any] = until(tried)
    return found


# --- with a stand-in for the viewer -------------------------------------------------------------


def test_findings_are_sorted_filtered_and_saved(page: Page, whole: int, tmp_path: Path) -> None:
    """Severe ones first; by class, distance and cause; the CSV has the rows that are left."""
    counts = [dot.inner_text().count("●") for dot in page.locator("#found .dots").all()]
    assert counts == sorted(counts, reverse=True) and counts[0] > 0
    page.select_option("#class", "person")
    until(lambda: all("person" in text for text in rows(page)))
    people = number(page)
    page.select_option("#within", "20")
    until(lambda: 0 < number(page) < people)
    with page.expect_download() as waiting:
        page.click("#csv")
    waiting.value.save_as(tmp_path / "findings.csv")
    table = list(csv.DictReader((tmp_path / "findings.csv").read_text().splitlines()))
    assert len(table) == number(page)
    assert all(row["class"] == "person" and float(row["distance_m"]) <= 20 for row in table)
    for select in ("#class", "#within"):
        page.select_option(select, "")
    page.check("#grouped")
    until(lambda: page.locator("#found .group").count() > 1)
    heads = page.locator("#found .group").all_inner_texts()
    assert sum(int(head.rpartition(": ")[2]) for head in heads) == number(page) == whole
    page.uncheck("#grouped")
    until(lambda: page.locator("#found .group").count() == 0)
    page.check("#here")
    until(lambda: 0 < number(page) < whole)


@pytest.mark.long
def test_findings_are_marked_and_noted_beside_the_bag(
    page: Page, whole: int, bag: Path, browser: Browser, address: str
) -> None:
    """A handled finding leaves the table in all pages, and can be listed again. A note is text."""
    page.locator("#found li button").first.click()
    chosen = page.locator("#found li:has([aria-current=true])")
    until(lambda: chosen.locator(".chip").count())  # comes with the hints, after the answer
    text = chosen.locator("button").first.inner_text()
    chosen.locator("input").fill("parked, of no concern")
    chosen.get_by_text("ignore", exact=True).click()
    until(lambda: number(page) == whole - 1)
    assert "handled 1" in page.inner_text("#kinds")
    (kept,) = json.loads(Notes([bag]).path.read_text())["findings"]
    assert (kept["state"], kept["text"]) == ("ignored", "parked, of no concern")
    assert kept["name"] in text and Notes([bag]).handled() == [HandledFinding(**kept)]
    with opened(browser, address, 700, 500) as other:
        until(lambda: listed(other) and number(other) == whole - 1)
        page.fill("#words", MARKUP)
        page.click("#note")
        note = other.locator("#found li", has=other.locator(".note"))
        until(lambda: note.count() and MARKUP in note.inner_text())
        assert other.locator("#found b").count() == 0
    assert page.inner_text("#noted").startswith(f"Noted about the {kept['name']}")
    assert page.input_value("#words") == ""
    page.locator("#found").get_by_label("remove this note").click()
    until(lambda: page.locator("#found .note").count() == 0)
    page.get_by_text("handled 1").click()
    until(lambda: number(page) == whole)
    last = page.locator("#found li").last
    assert (
        text.split() == last.locator("button").first.inner_text().split()
        and "ignored: parked" in last.inner_text()
    )
    last.get_by_text("reopen").click()
    until(lambda: "handled" not in page.inner_text("#kinds") and not Notes([bag]).path.exists())


@pytest.mark.long
def test_keys_step_through_frames_and_findings(page: Page) -> None:
    """They do nothing while the user types; the sheet of keys has the legend, too."""
    page.keyboard.press("End")
    until(lambda: frame(page) == FRAMES - 1)
    page.keyboard.press("Home")
    until(lambda: frame(page) == 0)
    page.keyboard.press(",")
    page.keyboard.press("ArrowRight")
    until(lambda: frame(page) == 1)
    chosen = subject(page)["at"]
    page.keyboard.press("/")
    page.keyboard.type("n.")
    assert (page.input_value("#search"), frame(page), subject(page)["at"]) == ("n.", 1, chosen)
    page.keyboard.press("Escape")
    page.keyboard.press("ArrowLeft")
    until(lambda: frame(page) == 0)

    def current() -> str:
        return str(page.locator("#found li:has([aria-current=true])").get_attribute("data-key"))

    page.keyboard.press("n")
    until(lambda: verdict(page) and subject(page))
    first = current()
    page.keyboard.press("n")
    until(lambda: current() != first)
    until(lambda: verdict(page) and subject(page))
    asked_second = subject(page)
    page.keyboard.press("p")
    until(lambda: current() == first and verdict(page))
    page.go_back()
    until(lambda: verdict(page) and subject(page) == asked_second)
    page.go_forward()
    until(lambda: verdict(page) and subject(page) != asked_second)
    page.keyboard.press("?")
    until(page.locator("#help").is_visible)
    text = page.inner_text("#help")
    assert "next, previous finding" in text and "person" in text and "missed" in text
    page.keyboard.press("Escape")
    until(page.locator("#help").is_hidden)


def test_a_drive_is_played_and_a_span_is_marked(page: Page, bag: Path) -> None:
    """With the keys, wherever the focus is. A span is noted and run alone, and stays over a reload."""
    page.keyboard.press("Home")
    until(lambda: frame(page) == 0)
    page.select_option("#speed", "4")
    page.click("#grouped")
    page.click("#grouped")
    page.keyboard.press("Space")
    until(lambda: frame(page) == FRAMES - 1 and page.get_attribute("#play", "aria-label") == "play")
    page.keyboard.press("l")
    page.keyboard.press("Space")
    until(lambda: frame(page) == 1)
    page.click("#play")
    assert f"of {(FRAMES - 1) / 10:.2f} s" in page.inner_text("#clock")
    page.focus("#words")
    page.keyboard.type("a b")
    assert page.input_value("#words") == "a b"

    canvas = page.locator("#events").bounding_box()
    assert canvas is not None
    width = (canvas["width"] - 64) / FRAMES
    start = canvas["x"] + 64 + 1.5 * width
    page.mouse.move(start, canvas["y"] + 6)
    page.mouse.down()
    page.mouse.move(start + 2 * width, canvas["y"] + 6, steps=4)
    page.mouse.up()
    assert page.inner_text("#span-text") == "0.10 to 0.30 s marked"
    page.click("#note")
    until(lambda: page.locator("#found .note").count())
    (note,) = Notes([bag])
    assert note.end - note.stamp == pytest.approx(0.2e9, abs=1e6)
    assert note.about == subject_name(page)
    page.click("#verdict")
    page.keyboard.press("x")
    assert page.locator("#span").is_hidden()
    page.locator("#found button", has=page.locator(".note")).click()
    until(lambda: page.inner_text("#span-text") == "0.10 to 0.30 s marked")
    page.fill("#search", "clustering.eps")
    control = page.locator("[id='control-clustering.eps']")
    control.fill("0.3")
    control.press("Enter")
    page.click("#drive-span")
    until(lambda: "clustering.eps=0.3; of 0.10 to 0.30 s" in page.inner_text("#trial-set"))
    until(lambda: "; 3 frames" in page.inner_text("#trial-text"))
    page.reload()
    until(lambda: page.locator("#span-text").is_visible())
    assert page.inner_text("#span-text") == "0.10 to 0.30 s marked"
    assert page.input_value("#speed") == "4"
    page.locator("#found").get_by_label("remove this note").click()
    until(lambda: not Notes([bag]).path.exists())


def subject_name(page: Page) -> str:
    """Return the name of the object that the answer is about."""
    return page.inner_text("#where").split(" · ")[0].removeprefix("the ")


def test_a_click_and_a_row_are_answered_with_what_would_help(page: Page) -> None:
    """The first rows show remarks without a click. A hint does what it says."""
    page.evaluate("window.clickInViewer({ entity_path: '/nowhere', instance_id: 0 })")
    until(lambda: verdict(page) == "Nothing can be asked about /nowhere.")
    assert page.locator("#chain li").count() == 0
    image = entities.IMAGE.path("zed")
    page.evaluate(f"window.clickInViewer({{ entity_path: '{image}', position: [20, 20] }})")
    until(lambda: page.locator("#chain li").count() > 0)
    assert page.inner_text("#where").startswith("what is at pixel 19.5, 19.5 · frame ")

    first = page.locator("#found li > button:first-child").all()[:10]
    until(lambda: all((one.get_attribute("title") or "").endswith(".") for one in first))
    assert page.locator("#found .chip.hint").count()
    choose_missed(page, with_hints=False)
    sentence = page.inner_text("#hints")
    assert sentence.startswith(("No ", "Nothing ")) and sentence.endswith(".")
    chosen = page.locator("#found [aria-current=true]")
    until(lambda: str(chosen.get_attribute("title")).endswith(sentence))
    assert "hint" not in chosen.inner_text()
    *similar, report = page.locator("#steps button").all_inner_texts()
    assert report.startswith("hand it on") and len(similar) <= 2
    assert all(text.startswith("see a similar case: ") for text in similar)
    choose_missed(page, with_hints=True)
    button = page.locator("#hints button").first
    settings = button.inner_text().splitlines()[0].removeprefix("try ")
    button.click()
    until(lambda: "fixed: " in page.inner_text("#effect"))
    until(lambda: "reported" in (page.locator("#answer").get_attribute("class") or ""))
    assert ", ".join(state(page)["set"]) == settings
    page.keyboard.press("b")
    until(
        lambda: (
            page.inner_text("#side") == "shown: before"
            and "missed" in (page.locator("#answer").get_attribute("class") or "")
        )
    )
    assert state(page)["side"] == ["before"]


def choose_missed(page: Page, *, with_hints: bool) -> None:
    """Click rows of missed objects until one is answered with hints, or without."""
    missed = page.locator("#found li", has=page.locator(".missed"))
    for row in range(missed.count()):
        missed.nth(row).locator("button").first.click()
        until(lambda: verdict(page) and not page.inner_text("#hints").startswith("Trying"))
        assert "missed" in (page.locator("#answer").get_attribute("class") or "")
        assert subject(page)["kind"] == "truth"
        if (page.locator("#hints button").count() > 0) == with_hints:
            return
    pytest.fail("there is no such row")


@pytest.mark.long
def test_a_box_is_drawn_kept_and_removed(browser: Browser, tmp_path: Path) -> None:
    """Its form follows what is typed. The answer is that of ground truth as long as its note is kept."""
    bag = tmp_path / "street.mcap"
    topics = ["/rslidar_points", "/zed2/*", "/odom"]
    assert main(["cut", str(BAG), "--end", "0.15", "--topics", *topics, "-o", str(bag)]) == 0
    with served(bag) as address, opened(browser, address) as page:
        until(lambda: page.inner_text("#run") == "2 frames")
        page.keyboard.press("Home")
        step = page.locator("#steps .label")
        click = {"entity_path": entities.IMAGE.path("zed"), "position": [20, 20]}
        page.evaluate(f"window.clickInViewer({json.dumps(click)})")
        until(lambda: step.count() and "draw its box" in step.inner_text())
        step.click()
        until(lambda: page.input_value("#label-class") == "person")
        numbers = page.locator("#label-numbers input")
        numbers.first.fill("")
        until(lambda: page.inner_text("#label-text") == "Each field needs a number.")
        for number, value in enumerate(("9", "2", "0", "4", "2", "2", "30")):
            numbers.nth(number).fill(value)
        until(lambda: page.inner_text("#label-text").endswith(" points in it."))
        page.fill("#label-class", "car")
        page.click("#label >> text=keep as truth")
        until(
            lambda: page.inner_text("#label-text").startswith(f"Kept in {bag}.notes.json: the car at 9.2 m")
        )
        (note,) = Notes([bag])
        assert (note.label, note.box) == ("car", (9, 2, 0, 4, 2, 2, 0.524))
        until(lambda: step.count() and "change its label" in step.inner_text())
        assert verdict(page).startswith("The car")
        step.click()
        until(lambda: page.input_value("#label-class") == "car" and numbers.nth(6).input_value() == "30")
        page.click("#label-cancel")
        page.locator("#found li", has_text="car at 9.2 m").locator("[title='remove this note']").click()
        until(lambda: not list(Notes([bag])))
        until(lambda: step.count() and "draw its box" in step.inner_text())


@pytest.mark.long
def test_parameters_are_tried_and_taken_back(page: Page) -> None:
    """By a field, a list and a slider, with undo and reset. The keys work on a slider, too."""
    page.keyboard.press("/")
    page.keyboard.type("min_cluster_points")
    control = page.locator("[id='control-clustering.min_cluster_points']")
    assert control.input_value() == "10"
    control.fill("100000")
    control.press("Enter")
    until(lambda: "broken: " in page.inner_text("#effect"))
    assert state(page)["set"] == ["clustering.min_cluster_points=100000"]
    assert page.evaluate("document.activeElement.id") == "control-clustering.min_cluster_points"
    assert "F1" in page.inner_text("#effect")
    assert viewer_line(page) == "tried"
    assert "min_cluster_points%3D100000" in (page.get_attribute("#save", "href") or "")
    page.keyboard.press("Escape")
    page.keyboard.press("u")
    until(lambda: "As it was opened" in page.inner_text("#effect"))
    assert "set" not in state(page)
    control.fill("-3")
    control.press("Enter")
    until(lambda: "must be greater than or equal to 1" in page.inner_text("#effect"))

    page.fill("#search", "")
    page.locator("#controls summary", has_text="bev").click()
    page.locator("[id='control-bev.channels'] label", has_text="height").locator("input").check()
    until(lambda: state(page).get("set") == ['bev.channels=["height","occupancy"]'])
    until(lambda: "changes nothing that is reported" in page.inner_text("#effect"))
    page.locator("#controls summary", has_text="clustering").click()
    slider = page.get_by_label("clustering.eps, slider")
    slider.evaluate("(e) => { e.value = 0.9; e.dispatchEvent(new Event('change')); }")
    until(lambda: "clustering.eps=0.9" in state(page).get("set", []))
    assert "1 changed" in page.inner_text("#controls")
    slider.press("u")
    until(lambda: state(page).get("set") == ['bev.channels=["height","occupancy"]'])
    page.click("#reset")
    until(lambda: "As it was opened" in page.inner_text("#effect"))


@pytest.mark.long
def test_the_drive_is_run_with_other_values(page: Page) -> None:
    """Runs are kept and compared; a search is cancelled."""
    page.fill("#search", "clustering.eps")
    for value in ("0.3", "0.9"):
        control = page.locator("[id='control-clustering.eps']")
        control.fill(value)
        control.press("Enter")
        page.keyboard.press("Escape")
        page.keyboard.press("r")
        until(lambda: f"eps={value}" in page.inner_text("#trial-set"))  # noqa: B023
        until(lambda: page.locator("#drive-cancel").is_hidden())
        assert page.inner_text("#trial-text").startswith("F1 ")
    until(lambda: page.locator("#runs button").count() >= 2)  # Another test may have run a span.
    page.locator("#runs button", has_text="0.3").last.click()
    until(lambda: state(page).get("set") == ["clustering.eps=0.3"])
    until(lambda: "eps=0.3" in page.inner_text("#trial-set"))
    assert "differences of clustering.eps=0.9" in page.inner_text("#trial-listed")

    page.click("#fix")
    until(page.locator("#fix-cancel").is_visible)
    assert page.locator("#fix").is_disabled()
    until(lambda: "settings tried" in page.inner_text("#fix-text"))
    page.click("#fix-cancel")
    until(lambda: page.inner_text("#fix-text") == "Cancelled.")
    assert page.locator("#fix").is_enabled() and page.locator("#fix-use").is_hidden()


def test_the_timeline_goes_to_findings_and_shows_the_camera(page: Page) -> None:
    """A click or Enter on a mark chooses its finding at that frame. The camera at the pointer is above it."""
    box = page.locator("#events").bounding_box()
    assert box is not None and box["height"] > 10
    page.mouse.click(box["x"] + box["width"] - 20, box["y"] + 8)
    until(lambda: frame(page) == FRAMES - 1 and verdict(page))
    assert page.locator("#found [aria-current=true]").count() == 1
    page.focus("#events")
    page.keyboard.press("Home")
    until(lambda: frame(page) == 0 and "0.00 s" in (page.get_attribute("#events", "aria-valuetext") or ""))
    page.keyboard.press("Enter")
    until(lambda: "frame 0" in page.inner_text("#where"))
    page.keyboard.press("End")
    until(lambda: frame(page) == FRAMES - 1)
    page.mouse.move(box["x"] + box["width"] - 18, box["y"] + 8)
    until(page.locator("#thumbnail").is_visible)
    assert page.evaluate("document.querySelector('#thumbnail img').naturalWidth") == WIDTH
    assert page.inner_text("#thumbnail") == f"{(FRAMES - 1) / 10:.2f} s"
    page.mouse.move(100, 100)
    until(page.locator("#thumbnail").is_hidden)


@pytest.mark.long
def test_an_address_and_a_shared_link_open_the_same(
    page: Page, bag: Path, browser: Browser, tmp_path: Path
) -> None:
    """After a reload, and where a server has the same bag elsewhere. A link to another bag is told."""
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    late = page.locator("#found button", has=page.locator(".missed")).filter(has_not_text="0.00 s").first
    late.click()
    text = until(lambda: verdict(page))
    held, chain = state(page), page.inner_text("#chain")
    page.reload()
    until(lambda: verdict(page) == text)
    assert (state(page), page.inner_text("#chain")) == (held, chain)
    page.click("#share")
    link = urlsplit(page.evaluate("navigator.clipboard.readText()"))
    assert link.path == "/shared" and "token" not in link.geturl()
    copy = tmp_path / bag.name
    shutil.copy(bag, copy)
    with served(copy) as other, opened(browser, other, 700, 500) as there:
        there.goto(link._replace(netloc=urlsplit(other).netloc).geturl())
        until(lambda: verdict(there) == text)
        assert there.locator("#linked").is_hidden()
        there.goto(other)
        until(lambda: page.inner_text("#where"))
        there.evaluate(PASTE, link.geturl())
        until(lambda: verdict(there) == text and state(there) == held)
        strange = link.fragment.replace(bag.name, "another.mcap")
        there.goto(link._replace(netloc=urlsplit(other).netloc, fragment=strange).geturl())
        until(lambda: "The link is about another.mcap" in there.inner_text("#linked"))
    stranger = browser.new_context().new_page()
    stranger.goto(link.geturl())
    assert "Start bevviz open with the same bag" in stranger.inner_text("body")
    stranger.context.close()


PASTE = """(text) => {
  const clipboardData = new DataTransfer();
  clipboardData.setData("text", text);
  document.body.dispatchEvent(new ClipboardEvent("paste", { clipboardData, bubbles: true }));
}"""


@pytest.mark.long
def test_two_pages_find_a_server_again_that_was_killed(bag: Path, browser: Browser) -> None:
    """Each page has its own question. The next server of the same drive shows the same."""
    with (
        serving(str(bag)) as (address, server),
        opened(browser, address) as page,
        opened(browser, address) as other,
    ):
        until(lambda: all(one.locator("#found [aria-current=true]").count() for one in (page, other)))
        page.keyboard.press("n")
        text, held = new_verdict(page, verdict(page)), state(page)
        assert text not in verdict(other)
        until(lambda: page.inner_text("#found-title") == other.inner_text("#found-title"))
        assert page.locator("#gone").is_hidden()
        server.kill()
        until(lambda: "The server is gone" in page.inner_text("#gone"))
        server.wait()
        with serving("open", str(bag), "--port", str(urlsplit(address).port)) as (again, again_server):
            assert again == address
            until(lambda: page.locator("#gone").is_hidden() and verdict(page) == text)
            assert state(page) == held
            until(lambda: other.locator("#gone").is_hidden() and listed(other))
            again_server.kill()
            until(lambda: "The server is gone" in page.inner_text("#gone"))
            again_server.wait()
            page.keyboard.press("n")
            until(lambda: verdict(page) == "The server is away: this is asked when it is back.")
            with serving("open", str(bag), "--port", str(urlsplit(address).port)):
                new_verdict(page, verdict(page))
                assert state(page)["at"] != held["at"] or state(page)["pick"] != held["pick"]


def test_a_phone_has_the_panel_below_the_viewer(browser: Browser, address: str) -> None:
    with opened(browser, address, 390, 844) as page:
        viewer, panel = (page.locator(name).bounding_box() for name in ("#viewer", "aside"))
        assert viewer is not None and panel is not None
        assert viewer["width"] == panel["width"] == 390
        assert viewer["height"] > 300 and panel["y"] >= viewer["y"] + viewer["height"]
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        until(lambda: listed(page))
        page.locator("#found button", has=page.locator(".missed")).first.click()
        until(lambda: verdict(page) and page.locator("#chain li").count())
        findings, answer = (page.locator(name).bounding_box() for name in ("#findings", "#verdict"))
        assert findings is not None and answer is not None
        assert findings["y"] == pytest.approx(0, abs=2)
        assert findings["height"] - 2 <= answer["y"] < 700
