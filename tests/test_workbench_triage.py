"""The table of findings in a real browser: sorted, filtered, marked; runs, parameters and shared links."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from bevviz.errors import UserError
from bevviz.pipeline.notes import HandledFinding, Note, Notes
from bevviz.workbench.thumbnails import MOST, WIDTH, Thumbnails
from tests.support.logged_frames import frame_with_image
from tests.support.workbench_pages import (
    FRAMES,
    chromium,
    demo_bag,
    listed,
    opened,
    serving,
    state,
    until,
    verdict,
)

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return demo_bag(tmp_path_factory.mktemp("triage"))


@pytest.fixture(scope="module")
def address(bag: Path) -> Iterator[str]:
    with serving(str(bag)) as (address, _):
        yield address


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def page(browser: Browser, address: str) -> Iterator[Page]:
    """Yield one page for all tests. Each leaves it without filters and values."""
    with opened(browser, address, 1000, 700) as page:
        until(lambda: listed(page) and page.locator("#bar").is_hidden())
        yield page


def rows(page: Page) -> list[str]:
    """Return the texts of the findings in the table."""
    return page.locator("#found li:not(.group)").all_inner_texts()


def number(page: Page) -> int:
    """Return the number of findings that the heading states."""
    return int(page.inner_text("#found-title").rpartition(": ")[2])


# --- the table ----------------------------------------------------------------------------------


def test_severe_findings_come_first(page: Page) -> None:
    """Each dot is a reason that its title states."""
    dots = page.locator("#found .dots").all()
    counts = [dot.inner_text().count("●") for dot in dots]
    titles = [dot.get_attribute("title") or "" for dot in dots]
    assert counts == sorted(counts, reverse=True) and counts[0] > 0
    assert all(len(title.split("; ")) == count for title, count in zip(titles, counts, strict=True) if count)
    assert any("nearer than 10 m" in title for title in titles)


def test_the_table_is_filtered_and_grouped(page: Page, tmp_path: Path) -> None:
    """By class, reason, distance and text; the CSV has the rows that are left."""
    whole = number(page)
    page.select_option("#class", "person")
    until(lambda: all("person" in text for text in rows(page)))
    people = number(page)
    reason = str(page.locator("#reason option").nth(1).get_attribute("value"))
    page.select_option("#reason", reason)
    until(lambda: number(page) <= people and all(reason in text for text in rows(page)))
    page.select_option("#reason", "")
    page.select_option("#within", "20")
    until(lambda: 0 < number(page) < people)
    near = number(page)
    with page.expect_download() as waiting:
        page.click("#csv")
    waiting.value.save_as(tmp_path / "findings.csv")
    table = list(csv.DictReader((tmp_path / "findings.csv").read_text().splitlines()))
    assert len(table) == near
    assert all(row["class"] == "person" and float(row["distance_m"]) <= 20 for row in table)
    for select in ("#class", "#within"):
        page.select_option(select, "")
    page.fill("#find", "MISSED person")
    until(lambda: all("missed" in text and "person" in text for text in rows(page)))
    page.fill("#find", "")
    page.check("#grouped")
    until(lambda: page.locator("#found .group").count() > 1)
    heads = page.locator("#found .group").all_inner_texts()
    assert sum(int(head.rpartition(": ")[2]) for head in heads) == number(page) == whole
    page.uncheck("#grouped")
    until(lambda: page.locator("#found .group").count() == 0)


def test_a_finding_is_marked_beside_the_bag(page: Page, bag: Path, browser: Browser, address: str) -> None:
    """It leaves the table in all pages and after a reload, and can be listed again."""
    whole = number(page)
    page.locator("#found li button").first.click()
    chosen = until(lambda: page.locator("#found li:has([aria-current=true])"))
    text = chosen.locator(".what").inner_text().splitlines()[0]
    chosen.locator("input").fill("parked, of no concern")
    chosen.get_by_text("ignore", exact=True).click()
    until(lambda: number(page) == whole - 1)
    assert "handled 1" in page.inner_text("#kinds")
    (kept,) = json.loads(Notes([bag]).path.read_text())["findings"]
    assert (kept["state"], kept["text"]) == ("ignored", "parked, of no concern")
    assert kept["name"] in text and Notes([bag]).handled() == [HandledFinding(**kept)]
    with opened(browser, address, 700, 500) as other:
        until(lambda: listed(other) and number(other) == whole - 1)
    page.get_by_text("handled 1").click()
    until(lambda: number(page) == whole)
    last = page.locator("#found li").last
    assert text in last.inner_text() and "ignored: parked" in last.inner_text()
    last.get_by_text("reopen").click()
    until(lambda: "handled" not in page.inner_text("#kinds") and not Notes([bag]).path.exists())


def test_marks_and_notes_share_a_file(tmp_path: Path) -> None:
    notes = Notes([tmp_path / "drive.mcap"])
    done = HandledFinding(1, "missed", "person", "truth//3", 6.3, "done")
    notes.handle(done)
    notes.add(note := Note(5, 6, "a note"))
    notes.handle(HandledFinding(1, "missed", "person", "truth//3", 6.3, "ignored", "why"))
    assert list(notes) == [note]
    assert [(one.state, one.text) for one in notes.handled()] == [("ignored", "why")]
    notes.remove(note)
    notes.handle(HandledFinding(1, "missed", "person", "truth//3", 6.3, ""))
    assert not notes.path.exists()
    with pytest.raises(UserError, match="done or ignored, not 'lost'"):
        notes.handle(HandledFinding(1, "missed", "person", "truth//3", 6.3, "lost"))


# --- the rest of the page -----------------------------------------------------------------------


def test_the_sheet_of_keys_and_the_legend(page: Page) -> None:
    page.keyboard.press("?")
    until(lambda: page.locator("#help").is_visible())
    text = page.inner_text("#help")
    assert "next, previous finding" in text and "person" in text and "missed" in text
    page.keyboard.press("Escape")
    until(lambda: page.locator("#help").is_hidden())


def test_frames_are_stepped_one_by_one(page: Page) -> None:
    shown = page.inner_text("#shown")
    first = int(shown.split()[1])
    key, back = (".", ",") if first == 0 else (",", ".")
    page.keyboard.press(key)
    until(lambda: page.inner_text("#shown").split()[1] == str(first + (1 if key == "." else -1)))
    page.keyboard.press(back)
    until(lambda: page.inner_text("#shown") == shown)


def test_parameters_are_browsed_by_stage(page: Page) -> None:
    """A slider and the boxes of a list change them. The keys work there."""
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


def run_with(page: Page, eps: str) -> None:
    """Run the drive with another value of the parameter that is searched for."""
    control = page.locator("[id='control-clustering.eps']")
    control.fill(eps)
    control.press("Enter")
    page.keyboard.press("Escape")
    page.click("#drive")
    until(lambda: f"eps={eps}" in page.inner_text("#trial-set"))
    until(lambda: page.locator("#drive-cancel").is_hidden() and "frames" in page.inner_text("#trial-text"))


def test_runs_are_kept_and_compared(page: Page) -> None:
    page.fill("#search", "eps")
    run_with(page, "0.3")
    run_with(page, "0.9")
    until(lambda: page.locator("#runs button").count() == 2)
    page.locator("#runs button", has_text="0.3").click()
    until(lambda: state(page).get("set") == ["clustering.eps=0.3"])
    until(lambda: "eps=0.3" in page.inner_text("#trial-set"))
    assert "differences of clustering.eps=0.9" in page.inner_text("#trial-listed")
    page.click("#reset")
    page.fill("#search", "")


def test_a_fix_is_searched_until_it_is_cancelled(page: Page) -> None:
    page.click("#fix")
    until(page.locator("#fix-cancel").is_visible)
    assert page.locator("#fix").is_disabled()
    until(lambda: "settings tried" in page.inner_text("#fix-text"))
    page.click("#fix-cancel")
    until(lambda: page.inner_text("#fix-text") == "Cancelled.")
    assert page.locator("#fix").is_enabled() and page.locator("#fix-use").is_hidden()


def test_the_timeline_goes_to_a_finding(page: Page) -> None:
    """A click on a mark chooses its finding at that frame."""
    box = page.locator("#events").bounding_box()
    assert box is not None and box["height"] > 10
    first = page.inner_text("#shown").split()[1] == "0"
    page.mouse.click(box["x"] + (box["width"] - 20 if first else 90), box["y"] + 8)
    until(lambda: (page.inner_text("#shown").split()[1] == "0") != first)
    until(lambda: verdict(page))
    assert page.locator("#found [aria-current=true]").count() == 1


def test_the_timeline_shows_the_camera_at_the_pointer(page: Page) -> None:
    box = page.locator("#events").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] - 20, box["y"] + 8)
    page.mouse.move(box["x"] + box["width"] - 18, box["y"] + 8)
    until(page.locator("#thumbnail").is_visible)
    assert page.evaluate("document.querySelector('#thumbnail img').naturalWidth") == WIDTH
    assert page.inner_text("#thumbnail") == f"{(FRAMES - 1) / 10:.2f} s"
    page.mouse.move(100, 100)
    until(page.locator("#thumbnail").is_hidden)


def test_thumbnails_are_bounded() -> None:
    """A long drive has one for each of its parts, the first frame of the part that came."""
    thumbnails = Thumbnails(10 * MOST)
    for number in range(0, 10 * MOST, 3):
        thumbnails.add(frame_with_image(number, np.full((2 * WIDTH, 4 * WIDTH, 3), number % 256, np.uint8)))
    shown = [thumbnails.near(number) for number in range(10 * MOST)]
    assert len({id(picture) for picture in shown}) == MOST
    picture = cv2.imdecode(np.frombuffer(shown[25] or b"", np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None and picture.shape == (WIDTH // 2, WIDTH, 3)
    assert abs(picture.mean() - 21) < 2  # frames 20 to 29 are a part
    assert Thumbnails(10).near(3) is None


def test_a_shared_link_opens_on_another_machine(
    page: Page, bag: Path, browser: Browser, tmp_path: Path
) -> None:
    """Another server has the same bag elsewhere; one with another bag says so and shows nothing of it."""
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.keyboard.press("n")
    text = until(lambda: verdict(page))
    page.click("#share")
    link = urlsplit(page.evaluate("navigator.clipboard.readText()"))
    assert link.path == "/shared" and "token" not in link.geturl()
    copy = tmp_path / bag.name
    shutil.copy(bag, copy)
    with serving(str(copy)) as (other, _), opened(browser, other, 700, 500) as there:
        there.goto(link._replace(netloc=urlsplit(other).netloc).geturl())
        until(lambda: verdict(there) == text)
        assert there.locator("#linked").is_hidden()
        strange = link.fragment.replace(bag.name, "another.mcap")
        there.goto(link._replace(netloc=urlsplit(other).netloc, fragment=strange).geturl())
        until(lambda: "The link is about another.mcap" in there.inner_text("#linked"))
    stranger = browser.new_context().new_page()
    stranger.goto(link.geturl())
    assert "Start bevviz open with the same bag" in stranger.inner_text("body")
    stranger.context.close()


def test_a_phone_has_the_panel_below_the_viewer(browser: Browser, address: str) -> None:
    with opened(browser, address, 390, 844) as page:
        viewer, panel = (page.locator(name).bounding_box() for name in ("#viewer", "aside"))
        assert viewer is not None and panel is not None
        assert viewer["width"] == panel["width"] == 390
        assert viewer["height"] > 300 and panel["y"] >= viewer["y"] + viewer["height"]
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
