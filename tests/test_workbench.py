"""The workbench in a real browser, against the real server."""

from __future__ import annotations

import json
import re
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
import pytest

import bevviz
from bevviz.cli import main
from bevviz.config import changed_config
from bevviz.errors import UserError
from bevviz.evaluate import match, truth_of
from bevviz.findings.frame_findings import find_findings
from bevviz.model import geometry
from bevviz.model.frame import Frame
from bevviz.model.results import FrameResult
from bevviz.pipeline.notes import Note, Notes
from bevviz.pipeline.session import Session
from bevviz.recording import blueprints, entities
from bevviz.stages.robot_results import in_points_frame
from bevviz.why import FrameExplainer, Selection
from bevviz.why.click import select_click
from bevviz.why.subject import projected_box, single_box
from bevviz.workbench.access import persistent_token
from bevviz.workbench.buffers import RecordingBuffer
from bevviz.workbench.page_messages import controls
from bevviz.workbench.recorded_drive import RecordedDrive
from bevviz.workbench.session import WorkbenchSession
from tests.support.small_disk import small_disk
from tests.support.waiting import PATIENCE
from tests.support.workbench_pages import (
    FRAMES,
    POLL,
    Talk,
    chromium,
    demo_bag,
    events,
    listed,
    opened,
    serving,
    state,
    until,
    verdict,
)

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

CLICK = 20.0  # seconds that it has to say what was clicked, before it is clicked again


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return demo_bag(tmp_path_factory.mktemp("workbench"))


@pytest.fixture(scope="module")
def result() -> Iterator[FrameResult]:
    with bevviz.simulate(frames=3, set={"clustering.min_cluster_points": 30}) as drive:  # some are set aside
        yield drive.at(frame=1)


@pytest.fixture(scope="module")
def address(bag: Path) -> Iterator[str]:
    with serving(str(bag)) as (address, _):
        yield address


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


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
            time.sleep(POLL / 2)
        return selected()

    found: dict[str, Any] = until(tried)
    return found


def subject(page: Page) -> dict[str, Any]:
    """Return the identity of the object that the page's address holds."""
    identity: dict[str, Any] = json.loads(state(page)["pick"][0])
    return identity


def new_verdict(page: Page, before: str) -> str:
    """Wait for the next verdict and return it."""
    until(lambda: verdict(page) not in ("", before))
    return verdict(page)


# --- the whole way, in a browser ----------------------------------------------------------------


def test_a_click_is_answered(browser: Browser, address: str, bag: Path) -> None:
    """On an image, on the line around what was missed in it, and in space."""
    pick, (u, v), image = missed_line(bag)
    with opened(browser, address, 1000, 620) as page:  # a small picture is drawn sooner
        before = verdict(page)

        def answered_at(x: float, y: float) -> dict[str, Any]:
            nonlocal before
            clicked = click(page, x, y)
            before = new_verdict(page, before)
            assert "cannot" not in before.split()[:4]
            assert page.locator("#chain li").count() > 0
            return clicked

        # A pixel that nothing is drawn over tells where the image is, which is as wide as its view.
        at = answered_at(316, 110)["position"]
        width = page.evaluate("document.getElementById('viewer').clientWidth / 2")
        scale = width / 640
        assert subject(page)
        missed = answered_at(316 + scale * (u - at[0]), 110 + scale * (v - at[1]))
        assert missed["entity_path"] == f"{image}/missed"
        assert subject(page)["id"] == pick
        answered_at(150, 300)
        assert subject(page).get("id") != pick


def test_the_viewer_shows_the_frame_of_the_panel(browser: Browser, address: str, bag: Path) -> None:
    """Soon after the last frame was chosen, although the viewer reads all of them without a graphics card."""
    with bevviz.open(bag) as drive:
        images = [cameras[0].image for n in range(FRAMES) if (cameras := drive.raw(n).cameras)]
    with opened(browser, address) as page:
        until(lambda: listed(page))
        for _ in range(FRAMES - 1):
            page.keyboard.press(".")
        until(lambda: f"Frame {FRAMES - 1}" in page.inner_text("body"))
        width = page.evaluate("document.getElementById('viewer').clientWidth / 2")

        def shown() -> int:
            """Return the number of the frame whose image is most like a part of the page."""
            data = page.screenshot(timeout=1000 * PATIENCE)
            picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            assert picture is not None
            likeness = []
            for image in images:
                assert image is not None
                height, scale = image.bgr.shape[0], width / image.bgr.shape[1]
                small = cv2.resize(
                    image.bgr, (int(width), round(scale * height)), interpolation=cv2.INTER_AREA
                )
                part = small[10:-10, 10:-20]
                likeness.append(float(cv2.matchTemplate(picture, part, cv2.TM_CCOEFF_NORMED).max()))
            return int(np.argmax(likeness))

        until(lambda: shown() == FRAMES - 1)


def missed_line(bag: Path) -> tuple[str, tuple[float, float], str]:
    """Id of what was missed in the first frame, a pixel of the line around it, the entity of the image."""
    with bevviz.open(bag, model="demo") as drive:
        result = drive.at(frame=0)
    assert result.frame.truth is not None
    (camera,), boxes = result.frame.cameras, in_points_frame(result.frame, result.frame.truth)
    around = {
        str(find.selection): [float(p) for p in box]
        for find in find_findings(FrameExplainer(result))
        if find.what == "missed"
        and find.selection.truth is not None
        and (box := projected_box(single_box(boxes, find.selection.truth), camera)) is not None
    }
    inside = [pick for pick, box in around.items() if box[0] > 20 and box[2] < 620]
    # The one whose left line is farthest from every other line.
    others = [u for box in around.values() for u in (box[0], box[2])]
    pick = max(inside, key=lambda one: sorted(abs(around[one][0] - u) for u in others)[1])
    left, top, _, bottom = around[pick]
    id_ = result.frame.truth.ids[Selection.parse(pick).row]
    return id_, (left, (top + bottom) / 2), entities.IMAGE.path(camera.name)


def test_missed_objects_are_listed_and_opened(browser: Browser, address: str) -> None:
    """A row of the list moves the viewer to its time and is answered; the address opens the same again."""
    with opened(browser, address) as page:
        until(lambda: f"{FRAMES} frames" in page.inner_text("#run"))
        rows = page.locator("#found button")
        shown_first = ("0.00 s", "")
        late = until(
            lambda: next(
                (row for row in rows.all() if row.locator(".time").inner_text() not in shown_first), None
            )
        )  # of another frame than that which is shown
        assert late.locator(".missed").inner_text() == "missed"
        shown = len(events(page, "time_update"))
        late.click()
        until(lambda: "missed" in (page.locator("#answer").get_attribute("class") or ""))
        text = until(lambda: verdict(page))
        assert "was not reported" in text or "shares" in text or "cluster" in text
        until(lambda: len(events(page, "time_update")) > shown)
        held, url = state(page), page.url
        assert subject(page)["kind"] == "truth"
        chain = page.inner_text("#chain")
    with opened(browser, url) as again:
        until(lambda: again.inner_text("#chain") == chain)
        assert state(again) == held


def test_the_page_shows_what_was_tried_in_vain(browser: Browser, address: str) -> None:
    """Below the answer and in the row of the list, where no hint helps."""
    with opened(browser, address) as page:
        until(lambda: listed(page))
        for row in page.locator("#found li", has=page.locator(".missed")).all():
            row.locator("button").click()
            until(lambda: "busy" not in (page.locator("#answer").get_attribute("class") or ""))
            until(lambda: not page.inner_text("#hints").startswith("Trying"))
            if not page.locator("#hints button").count():
                break
        sentence = page.inner_text("#hints")
        assert sentence.startswith(("No ", "Nothing ")) and sentence.endswith(".")
        until(lambda: page.locator("#found [aria-current=true] small").last.inner_text() == sentence)


def test_the_first_rows_show_a_hint_or_a_sentence(browser: Browser, address: str) -> None:
    """Nobody has to click for it."""
    with opened(browser, address) as page:
        until(lambda: listed(page))
        rows = page.locator("#found li").all()[:10]
        remarks = [row.locator("small").last for row in rows]  # The first one may list the frames.
        until(lambda: all(one.count() and one.inner_text().endswith(".") for one in remarks))
        texts = [one.inner_text() for one in remarks]
        assert any(text.startswith("Change ") for text in texts)


def test_parameters_are_tried_on_the_shown_frame(browser: Browser, address: str) -> None:
    """A control changes the picture's counts; undo takes it back; what is wrong is said in a line."""
    with opened(browser, address) as page:
        until(lambda: f"{FRAMES} frames" in page.inner_text("#run"))
        page.keyboard.press("/")
        page.keyboard.type("min_cluster_points")
        control = page.locator("[id='control-clustering.min_cluster_points']")
        assert control.input_value() == "10"
        control.fill("100000")
        control.press("Enter")
        until(lambda: "loses" in page.inner_text("#effect"))
        assert state(page)["set"] == ["clustering.min_cluster_points=100000"]
        assert page.evaluate("document.activeElement.id") == "control-clustering.min_cluster_points"
        assert "F1" in page.inner_text("#effect")
        page.keyboard.press("Escape")
        page.keyboard.press("u")
        until(lambda: "As it was opened" in page.inner_text("#effect"))
        assert "set" not in state(page)
        control = page.locator("[id='control-clustering.min_cluster_points']")
        control.fill("-3")
        control.press("Enter")
        until(lambda: "must be greater than or equal to 1" in page.inner_text("#effect"))


def test_two_pages_on_one_drive(browser: Browser, address: str) -> None:
    """In one browser and in another: each has its own question, both the same list."""
    with opened(browser, address) as page, opened(browser, address) as other:
        until(lambda: listed(page) and listed(other))  # to a page without a list the key says nothing
        page.keyboard.press("n")
        text = new_verdict(page, verdict(page))
        assert text not in verdict(other)
        until(lambda: page.inner_text("#found-title") == other.inner_text("#found-title"))


def test_a_server_that_was_killed_is_found_again(bag: Path, browser: Browser) -> None:
    """The page says that it is gone, finds the next one of the same drive, and shows what it showed."""
    with serving("open", str(bag)) as (address, server), opened(browser, address) as page:
        until(lambda: page.locator("#found button .missed").count())
        page.keyboard.press("n")
        text, held = new_verdict(page, verdict(page)), state(page)
        assert page.locator("#gone").is_hidden()
        server.kill()
        until(lambda: "The server is gone" in page.inner_text("#gone"))
        server.wait()
        with serving("open", str(bag), "--port", str(urlsplit(address).port)) as (again, _):
            assert again == address
            until(lambda: page.locator("#gone").is_hidden() and verdict(page) == text)
            assert state(page) == held


# --- the whole way, as the page talks -----------------------------------------------------------


@pytest.fixture
def talk(address: str) -> Iterator[Talk]:
    with Talk(address) as talk:
        yield talk


def hints_of_missed(talk: Talk) -> Iterator[tuple[int, str, dict[str, Any]]]:
    """Yield time and pick of each missed object, and the message with its hints."""
    for entry in talk.of("missed"):
        _, stamp, _, pick, *_ = entry["sights"][0]
        yield int(stamp), pick, talk.asked("hints", type="ask", time=int(stamp), set=[], pick=pick)


def helped(talk: Talk) -> tuple[int, str, dict[str, Any]]:
    """Time and pick of a missed object, and a hint that helps it."""
    for stamp, pick, message in hints_of_missed(talk):
        if message["hints"]:
            return stamp, pick, message["hints"][0]
    pytest.fail("no change helps any missed object")


def test_one_missed_object_is_one_entry(talk: Talk) -> None:
    """However many frames it lasts; no two entries have the same object of a frame."""
    missed = talk.of("missed")
    assert any(len(entry["sights"]) > 2 for entry in missed)
    sights = [(frame, pick) for entry in missed for frame, _, _, pick, *_ in entry["sights"]]
    assert len(sights) == len(set(sights))
    for entry in missed:
        numbers = [frame for frame, *_ in entry["sights"]]
        assert numbers == sorted(set(numbers))
        assert all(sight[5] for sight in entry["sights"]), "its reason"


def test_rows_of_the_list_agree_with_their_answers(talk: Talk) -> None:
    """One kind, subject, distance and reason, whether it is read in the list or asked for."""
    for entry in talk.of("missed", "false"):
        for _, stamp, distance, pick, tried, reason, *_ in entry["sights"]:
            answer = talk.asked("answer", type="ask", time=int(stamp), set=[], pick=pick)
            address = f"{answer['kind']}/{answer['camera']}/{answer['row']}"
            assert (address, answer["label"].lower(), answer["reason"]) == (
                pick,
                entry["name"],
                reason,
            )
            assert abs(answer["distance"] - distance) <= 0.06 and not tried
            assert answer["reported"] == answer["false"] == (entry["what"] == "false")


def test_empty_ground_and_several_things_are_told(talk: Talk) -> None:
    stamp = next(iter(talk.of("missed")))["sights"][0][1]
    ground = talk.asked("answer", type="ask", time=int(stamp), set=[], pick="point//6,0,-1.6")
    assert re.search(r"only ground .*: \d+ points, all ground", ground["verdict"])
    answers = [
        talk.asked("answer", type="ask", time=int(stamp), set=[], pick=f"pixel/zed/{u},140")
        for u in range(100, 640, 60)
    ]
    several = [answer for answer in answers if answer["beside"]]
    assert several
    other = several[0]["beside"][0]
    again = talk.asked("answer", type="ask", time=int(stamp), set=[], pick=other["pick"])
    assert again["name"] == other["name"]


def test_the_subject_is_followed_over_frames(talk: Talk) -> None:
    """An object is asked by its row in one frame, and found by its id in each other one."""
    _, stamp, _, pick, *_ = talk.of("missed")[0]["sights"][0]
    first = talk.asked("answer", type="ask", time=int(stamp), set=[], pick=pick)
    identity = json.loads(first["pick"])
    for frame in range(FRAMES):
        time_ = int(stamp) + (frame - first["frame"]) * 100_000_000
        values = ["clustering.eps=0.9"] if frame % 2 else []
        message = talk.asked("answer", type="ask", time=time_, set=values, pick=first["pick"])
        assert (message["frame"], message["set"]) == (frame, values)
        assert json.loads(message["pick"])["id"] == identity["id"]
        assert message["label"].lower() == identity["label"]
    gone = json.dumps({**identity, "id": "nobody"})
    absent = talk.asked("absent", type="ask", time=int(stamp), set=[], pick=gone)
    assert f"is not in frame {first['frame']}: the ground truth has no" in absent["text"]


def test_rows_are_valid_in_their_own_frame_only(talk: Talk) -> None:
    """A row of the list that is asked with tried values is the object of the list."""
    for entry in talk.of("false"):
        frame, stamp, _, pick, *_ = entry["sights"][0]
        origin = {"time": int(stamp), "set": []}
        opened = talk.asked("answer", type="ask", time=int(stamp), set=[], pick=pick)
        wanted = {"type": "ask", "time": int(stamp), "pick": pick, "from": origin}
        tried = talk.asked("answer|absent", **wanted, set=["detector.conf_threshold=0.5"])
        assert tried["frame"] == frame
        if tried["type"] == "absent":
            assert opened["label"] in tried["text"] and "with these values" in tried["text"]
            continue
        assert tried["kind"] == "cluster" or tried["label"] == opened["label"]
        assert tried["position"][:2] == pytest.approx(opened["position"][:2], abs=1.5)


def test_a_hint_has_the_promised_effect(talk: Talk) -> None:
    """What it was said to do to the frame is what the panel says when it is pressed, name by name."""
    stamp, pick, hint = helped(talk)
    tried = talk.asked("tried", type="try", time=stamp, set=hint["settings"], pick=pick)
    assert tried["effects"] == {key: hint[key] for key in tried["effects"]}
    assert hint["fixed"]
    assert tried["f1"][1] > tried["f1"][0]


def test_without_a_hint_a_sentence_names_the_tried_changes(talk: Talk) -> None:
    sentences = []
    for _, _, message in hints_of_missed(talk):
        assert message["hints"] or re.match(r"(No tried|The one tried|Nothing was tried)", message["remark"])
        sentences += [] if message["hints"] else [message["remark"]]
    assert any(re.fullmatch(r"No tried change helps: with \w+\.\w+=.*'\.", text) for text in sentences)


def test_the_drive_is_run_with_other_values(talk: Talk, address: str) -> None:
    """Every frame, with what it makes better and worse; another page is told the same; it can be ended."""
    stamp, pick, hint = helped(talk)
    with Talk(address) as other:
        talk.say(type="drive", set=hint["settings"])
        trials = [
            one.until("progress", lambda m: m["trials"] and m["trials"][-1]["state"] == "over")["trials"][-1]
            for one in (talk, other)
        ]
        assert trials[0] == trials[1]
    trial = trials[0]
    assert trial["done"] == trial["total"] == len(trial["strip"]) == FRAMES
    assert trial["f1"][0] != trial["f1"][1]
    fixed = [(int(s[1]), s[3]) for entry in talk.of("fixed") for s in entry["sights"]]
    assert (stamp, pick) in fixed
    assert len(fixed) == trial["counts"]["fixed"]
    good = sum(len(e["sights"]) for e in talk.of("fixed", "false gone"))
    assert sum(frame[1] for frame in trial["strip"]) == good
    talk.say(type="drive", set=["clustering.eps=0.7"])
    talk.say(type="cancel", what="drive")
    ended = talk.until("progress", lambda m: m["trials"][-1]["settings"] == ["clustering.eps=0.7"])["trials"][
        -1
    ]
    while ended["state"] in ("waiting", "running"):
        ended = talk.until("progress")["trials"][-1]
    assert ended["state"] in ("cancelled", "over")
    assert "nothing is changed" in talk.asked("never", type="drive", set=[])["text"]
    assert "clustering.epps" in talk.asked("never", type="drive", set=["clustering.epps=1"])["text"]


def test_notes_are_kept_beside_the_bag(talk: Talk, bag: Path) -> None:
    _, stamp, _, pick, *_ = talk.of("missed")[0]["sights"][0]
    pick = talk.asked("answer", type="ask", time=int(stamp), set=[], pick=pick)["pick"]
    talk.say(type="note", time=int(stamp), pick=pick, text=" look here ")
    (note,) = talk.until("notes", lambda message: message["notes"])["notes"]
    assert (note["stamp"], note["pick"], note["text"]) == (stamp, pick, "look here")
    assert [str(one) for one in Notes([bag])] == [f"{note['about']}: look here"]
    assert "characters" in talk.asked("noted", type="note", time=int(stamp), pick="", text="  ")["text"]
    talk.say(type="unnote", stamp=stamp, text="look here")
    talk.until("notes", lambda message: not message["notes"])
    assert not Notes([bag]).path.exists()


def test_a_note_about_a_place_names_it_as_the_answer_does(talk: Talk) -> None:
    stamp = int(talk.of("missed")[0]["sights"][0][1])
    answer = talk.asked("answer", type="ask", time=stamp, set=[], pick="pixel/zed/20,20")
    said = talk.asked("noted", type="note", time=stamp, pick=answer["pick"], text="empty road")
    assert said["text"].startswith("Noted about what is at pixel 20, 20 in frame ")
    talk.say(type="unnote", stamp=str(stamp), text="empty road")
    talk.until("notes", lambda message: not message["notes"])


def test_a_report_has_what_was_asked_tried_and_noted(talk: Talk, address: str, bag: Path) -> None:
    """The verdict of the drive as it was run comes first; beside the bag; for who has the token."""
    stamp, pick, hint = helped(talk)
    before = talk.asked("answer", type="ask", time=stamp, set=[], pick=pick)
    after = talk.asked("answer", type="ask", time=stamp, set=hint["settings"], pick=pick)
    assert after["reported"] and not before["reported"]
    talk.say(type="note", time=stamp, pick=pick, text="a note of mine")
    talk.until("noted")
    said = {"before": 0.2, "after": 0.1, "text": "it is plainly there", "set": hint["settings"]}
    talk.say(type="report", time=stamp, **said)
    made = talk.until("progress", lambda m: m["reports"] and m["reports"][-1]["state"] != "running")[
        "reports"
    ][-1]
    assert made["state"] == "over", made["error"]
    assert made["done"] == made["total"] > 0
    assert made["settings"] == hint["settings"]
    assert Path(made["folder"]) == bag.parent
    assert {file["name"] for file in made["files"]} <= {path.name for path in bag.parent.iterdir()}
    site, token = address.split("/?")
    (page,) = [file["name"] for file in made["files"] if file["name"].endswith(".html")]
    link = f"{site}/report/{made['number']}/{page}"
    assert answered(link) == 403
    assert answered(f"{site}/report/{made['number']}/..%2f..%2fetc%2fpasswd?{token}") == 404
    with urllib.request.urlopen(f"{link}?{token}", timeout=PATIENCE) as response:
        text = response.read().decode()
    assert "it is plainly there" in text
    assert "a note of mine" in text
    assert f"<code>{', '.join(hint['settings'])}</code>" in text
    told = " ".join(re.sub(r"<[^>]*>", " ", unescape(text)).split())
    places = [
        told.index(part) for part in ("Missed: the", before["verdict"], "What was tried", after["verdict"])
    ]
    assert places == sorted(places)
    assert f"{' '.join(hint['settings'])} {after['verdict']}" in told
    assert "--set-b" in told
    assert hint["settings"][0].partition("=")[0] not in told[told.index("How it was made") :]
    talk.say(type="unnote", stamp=str(stamp), text="a note of mine")
    assert "up to 600" in talk.asked("never", type="report", time=stamp, before=1e9, after=0, text="")["text"]


def test_a_report_has_the_notes_of_its_window(bag: Path, tmp_path: Path) -> None:
    copy = tmp_path / "drive.mcap"
    copy.hardlink_to(bag)
    with bevviz.open(copy) as drive:
        frames = [drive.raw(number) for number in (1, 5)]
    for frame, text in zip(frames, ("in the window", "outside of it"), strict=True):
        Notes([copy]).add(Note(frame.stamp, frame.received, text))
    output = tmp_path / "bug.rrd"
    options = ["--at", "0.1", "--before", "0", "--after", "0.1", "-o", str(output)]
    assert main(["report", str(copy), *options]) == 0
    page = output.with_suffix(".html").read_text()
    assert "in the window" in page
    assert "outside of it" not in page


def test_the_frame_that_is_looked_at_comes_first(address: str) -> None:
    """A page that acknowledges no piece gets a few pieces, and the one that it asks for."""
    from websockets.sync.client import connect
    from websockets.typing import Origin

    with Talk(address) as talk:
        last = max(int(s[1]) for entry in talk.of("missed", "false") for s in entry["sights"])
    parts = urlsplit(address)
    url, origin = f"ws://{parts.netloc}/recording?{parts.query}", Origin(f"http://{parts.netloc}")

    def pieces(start: int, words: Callable[[], str], first: str = "") -> list[bytes]:
        found = []
        with connect(f"{url}&from={start}", origin=origin, max_size=None) as channel:
            if first:
                channel.send(first)
            with suppress(TimeoutError):
                while True:
                    found.append(channel.recv(timeout=1.5, decode=False))
                    if word := words():
                        channel.send(word)
        return found

    whole = pieces(0, lambda: "got it")
    assert len(whole) > FRAMES
    few = pieces(0, lambda: "")
    assert whole[: len(few)] == few
    assert whole[FRAMES] not in few
    asked = pieces(0, lambda: "", str(last))
    assert len(set(asked)) == len(asked) == len(few)
    assert whole[FRAMES] in asked


# --- who is let in ------------------------------------------------------------------------------


def answered(url: str, **headers: str) -> int:
    """Status of the answer."""
    request = urllib.request.Request(url, headers={k.replace("_", "-"): v for k, v in headers.items()})
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE) as response:
            return int(response.status)
    except urllib.error.HTTPError as error:
        return error.code


def test_only_clients_with_the_token_are_admitted(address: str) -> None:
    parts = urlsplit(address)
    site = f"http://{parts.netloc}"
    token = parse_qs(parts.query)["token"][0]
    assert answered(address) == 200
    assert answered(f"{site}/") == 403
    assert answered(f"{site}/?token=wrong") == 403
    assert answered(f"{site}/page/panel.js?token={token}") == 200
    assert answered(f"{site}/page/panel.js") == 403
    assert answered(f"{site}/page/..%2fserver.py?token={token}") == 404
    assert answered(f"{site}/config.yaml?token={token}&set=clustering.eps=0.7") == 200
    assert answered(f"{site}/config.yaml?token={token}&set=clustering.eps=-1") == 400


def test_other_hosts_and_origins_are_refused(address: str) -> None:
    """A name that somebody else lets lead here, and a page of another site that knows the token."""
    parts = urlsplit(address)
    assert answered(address, Host="evil.example") == 403
    assert answered(address, Host=f"evil.example:{parts.port}") == 403
    assert answered(address, Origin="http://evil.example") == 403
    assert answered(address, Origin=f"http://{parts.netloc}") == 200


def test_a_server_that_stops_cancels_waiting_requests_quietly(capfd: pytest.CaptureFixture[str]) -> None:
    """A page waits for the drive to be opened when the user ends the server."""
    import asyncio
    import threading

    from starlette.types import Receive, Scope, Send
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect
    from websockets.typing import Origin

    from bevviz.workbench.access import Guard
    from bevviz.workbench.server import Server, bound_socket

    async def waits(scope: Scope, receive: Receive, send: Send) -> None:
        await receive()
        await send({"type": "websocket.accept"})
        await asyncio.sleep(PATIENCE)

    with bound_socket(0) as listening:
        place, ready = f"127.0.0.1:{listening.getsockname()[1]}", threading.Event()
        server = Server(Guard(waits, "token", listening.getsockname()[1]), ready.set)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        assert ready.wait(PATIENCE)
        with connect(f"ws://{place}/?token=token", origin=Origin(f"http://{place}")) as channel:
            server.end()
            with pytest.raises(ConnectionClosed):
                channel.recv(timeout=PATIENCE)
        thread.join(PATIENCE)
    assert not thread.is_alive()
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("path", ["/talk", "/recording"])
def test_channels_are_guarded(address: str, path: str) -> None:
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect
    from websockets.typing import Origin

    parts = urlsplit(address)
    url, own = f"ws://{parts.netloc}{path}?{parts.query}", f"http://{parts.netloc}"
    with connect(url, origin=Origin(own), max_size=None) as channel:
        assert channel.recv(timeout=PATIENCE)
    for bad in (
        {"uri": url, "origin": "http://evil.example"},
        {"uri": url, "origin": None},
        {"uri": f"ws://{parts.netloc}{path}", "origin": own},
    ):
        with pytest.raises(InvalidStatus) as refused:
            connect(**bad)
        assert refused.value.response.status_code == 403


def test_invalid_messages_are_answered(address: str) -> None:
    from websockets.sync.client import connect
    from websockets.typing import Origin

    parts = urlsplit(address)
    url = f"ws://{parts.netloc}/talk?{parts.query}"
    with connect(url, origin=Origin(f"http://{parts.netloc}"), max_size=None) as channel:

        def answer(message: str) -> str:
            channel.send(message)
            while True:
                found = json.loads(channel.recv(timeout=PATIENCE))
                if found["type"] == "error":
                    return str(found["text"])

        assert answer("{") == "that message cannot be understood"
        assert answer("[]") == "that message cannot be understood"
        assert answer('{"id": 1, "type": "ask", "time": "x"}') == "that message cannot be understood"
        until(lambda: "no frame" not in answer('{"id": 2, "type": "ask", "time": 0, "pick": "truth//999"}'))
        assert "nothing that can be asked" in answer('{"id": 3, "type": "ask", "time": 0, "pick": "car"}')
        assert "of number 999" in answer('{"id": 4, "type": "ask", "time": 0, "pick": "truth//999"}')
        assert "clustering.epps" in answer(
            '{"id": 5, "type": "try", "time": 0, "set": ["clustering.epps=1"]}'
        )


def test_two_drives_at_once(bag: Path, address: str) -> None:
    """A path alone opens one; each has a port and a token of its own."""
    with serving(str(bag)) as (other, _):
        assert answered(other) == 200
        assert urlsplit(other).port != urlsplit(address).port
        assert urlsplit(other).query != urlsplit(address).query
        assert answered(f"{other.split('?')[0]}?{urlsplit(address).query}") == 403


def test_a_damaged_bag_is_opened_as_far_as_it_goes(bag: Path, tmp_path: Path) -> None:
    """What could be read is run and asked about; what was lost is said."""
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(bag.read_bytes()[: bag.stat().st_size // 2])
    with serving("open", str(cut)) as (address, _), Talk(address) as talk:
        assert 0 < talk.over["done"] < FRAMES
        assert talk.over["warnings"]
        assert talk.entries


def test_a_token_outlives_a_server_that_was_killed_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with persistent_token(1, "drive") as first:
        (kept,) = tmp_path.glob("bevviz/*")
        assert kept.stat().st_mode & 0o077 == 0
        left = kept.read_bytes()
    assert not kept.exists()
    kept.write_bytes(left)
    with persistent_token(1, "drive") as readable_by_others:
        assert readable_by_others != first
    kept.touch(mode=0o600)
    kept.chmod(0o600)
    kept.write_bytes(left)
    with persistent_token(1, "another drive") as other:
        assert other != first
    kept.touch(mode=0o600)
    kept.write_bytes(left)
    with persistent_token(1, "drive") as again:
        assert again == first


def test_a_file_that_is_no_bag_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"no bag")
    assert main(["open", str(broken), "--no-browser"]) == 2
    assert "broken.mcap" in capsys.readouterr().err


# --- what a click is on -------------------------------------------------------------------------


def test_rows_of_what_is_drawn_are_rows_of_the_result(result: FrameResult) -> None:
    """The viewer tells the row of what was logged, of which some things are left out."""
    camera = result.cameras[0]
    name, found = camera.camera.name, camera.detections
    assert found is not None
    assert result.objects is not None
    assert result.clusters is not None
    kept = [row for row, is_kept in enumerate(found.kept) if is_kept]
    weak = [row for row, is_kept in enumerate(found.kept) if not is_kept]
    aside = [row for row, is_kept in enumerate(result.clusters.kept) if not is_kept]
    assert kept and weak and aside and len(result.objects)
    assert select_click(result, None, entities.DETECTIONS.path(name), len(kept) - 1, ()) == Selection(
        detection=kept[-1], camera=name
    )
    assert select_click(result, None, entities.WEAK.path(name), 0, ()) == Selection(
        detection=weak[0], camera=name
    )
    assert select_click(result, None, entities.FUSED, 0, (1, 2, 3)) == Selection(object=0)
    assert select_click(result, None, entities.OUTLINES.path(entities.FUSED), 0, (1, 2, 3)) == Selection(
        object=0
    )
    assert select_click(
        result, None, entities.NAMES.path(entities.DETECTIONS.path(name)), 0, ()
    ) == select_click(result, None, entities.DETECTIONS.path(name), 0, ())
    assert select_click(result, None, entities.TRUTH, 2, ()) == Selection(truth=2)
    lidar = result.frame.lidar
    assert select_click(result, None, entities.SET_ASIDE.path(lidar), 0, ()) == Selection(cluster=aside[0])
    assert select_click(result, None, entities.IMAGE.path(name), None, (10.5, 20.5)) == Selection(
        box=(10.0, 20.0), camera=name
    )
    pose, intrinsics = camera.camera.camera_from_points, camera.camera.intrinsics
    assert pose is not None and intrinsics is not None
    shown = geometry.apply(geometry.inverse(pose), np.array([[0.1, 0.05, 0.5]]))  # an image in the 3D view
    pixel = intrinsics.K @ (0.2, 0.1, 1)
    in_image = select_click(result, None, entities.IMAGE.path(name), None, shown[0].tolist())
    assert in_image is not None and in_image.box == pytest.approx(pixel[:2], abs=0.01)
    below = geometry.apply(geometry.inverse(pose), np.array([[0.0, 1.0, 0.5]]))  # a line of its frustum
    assert select_click(result, None, entities.SENSOR.path(name), None, below[0].tolist()) is None
    assert select_click(result, None, entities.BEV, None, (12.7, 3.2)) == Selection(cell=(3, 12))
    point = result.frame.points[5]
    assert select_click(result, None, entities.POINTS.path(lidar), 5, ()) == Selection(
        point=tuple(map(float, point))
    )
    in_space = select_click(result, None, entities.OBSTACLES.path(lidar), None, tuple(point.tolist()))
    assert in_space is not None
    assert in_space.place == pytest.approx(point, abs=1e-4)
    measured = result.objects.measured
    assert measured is not None
    drawn = [row for row, one in enumerate(measured.size != result.objects.boxes.size) if one.any()]
    last = len(drawn) - 1
    assert select_click(result, None, entities.MEASURED, last, ()) == Selection(object=drawn[last])
    center = result.objects.boxes.center[0].tolist()
    assert select_click(result, None, "/world/anything", None, center) == Selection(object=0)
    assert select_click(result, None, entities.FUSED, 10_000, ()) is None
    assert select_click(result, None, "/health/time_ms/total", None, ()) is None


@pytest.mark.parametrize(
    "one",
    [
        Selection(truth=3),
        Selection(detection=0, camera="a/b"),
        Selection(box=(1.5, 2.0), camera="zed"),
        Selection(cell=(3, 12)),
    ],
)
def test_selections_stand_in_an_address(one: Selection) -> None:
    assert Selection.parse(str(one)) == one


@pytest.mark.parametrize("text", ["", "car", "truth//", "truth//nan", "pixel/zed/1", "point//1,2", "x//1"])
def test_an_invalid_pick_is_one_line(text: str) -> None:
    with pytest.raises(UserError, match="nothing that can be asked"):
        Selection.parse(text)


# --- what is worth a look -----------------------------------------------------------------------


def test_objects_missed_against_the_truth_are_listed(result: FrameResult) -> None:
    """Every object that has to be found is found by an object of its class within 2 m, or is listed."""
    frame: Frame = result.frame
    assert frame.truth is not None
    assert result.objects is not None
    truth = truth_of(frame, frame.truth)
    missed = {find.selection.truth for find in find_findings(FrameExplainer(result)) if find.what == "missed"}
    assert missed
    for row, (label, must) in enumerate(zip(truth.labels, truth.must, strict=True)):
        near = [
            name.lower() == label.lower()
            and float(((center[:2] - truth.boxes.center[row, :2]) ** 2).sum()) <= 4
            for name, center in zip(result.objects.names, result.objects.boxes.center, strict=True)
        ]
        if row in missed:
            assert must
        elif must:
            assert any(near)


def test_without_truth_unexplained_objects_are_listed(result: FrameResult) -> None:
    few = changed_config(
        result.config, ["detector.conf_threshold=0.6"]
    )  # so that not every near cluster has a name
    unlabelled = Session(few).run(replace(result.frame, truth=None))
    listed = find_findings(FrameExplainer(unlabelled))
    assert {find.what for find in listed} <= {"doubtful", "unmatched", "unnamed"}
    assert any(find.what == "unnamed" for find in listed)
    assert all(not find.distance > 40 for find in listed)


# --- what is shown with other values ------------------------------------------------------------


def test_other_values_are_beside_what_the_drive_makes(bag: Path, tmp_path: Path) -> None:
    """On a timeline of its own: what was there is as it was, the sensors' data are there on both."""
    from rerun.chunk import RrdReader

    with bevviz.open(bag, model="demo") as drive, bevviz.open(bag, model="demo") as again:
        bench = RecordedDrive(drive, again.frames)
        session = WorkbenchSession(bench)
        bench.observe(drive.at(frame=0))
        overlay, other = bench.open_overlay(), bench.open_overlay()
        told = session.try_values(0, ("clustering.min_cluster_points=100000",), attempt=overlay.attempt())
        recoloured = session.try_values(0, ("ground.distance_threshold=0.5",), attempt=overlay.attempt())
        session.try_values(0, ("detector.conf_threshold=0.9",), attempt=overlay.attempt())
        result = drive.at(frame=0)
        pieces = [
            recording[row]
            for recording in (bench.recording.rows, overlay.buffer)
            for row in range(len(recording))
        ]
        assert len(other.buffer) == 0, "another page shows nothing of it"
        bench.close()
    assert result.objects is not None
    assert result.frame.truth is not None
    assert len(told["effects"]["lost"]) == len(result.objects)
    found, _ = match(result.objects, truth_of(result.frame, result.frame.truth))
    assert len(told["effects"]["right"]) == (found >= 0).sum() > 0
    assert recoloured["effects"] != told["effects"]
    rows: dict[str, list[tuple[set[str], bool]]] = {}
    for number, piece in enumerate(pieces):  # each is a whole file
        (path := tmp_path / f"{number}.rrd").write_bytes(piece)
        for chunk in RrdReader(path).stream():
            if not chunk.is_static:
                cleared = any("Clear" in str(name) for name in chunk.to_record_batch().schema.names)
                rows.setdefault(chunk.entity_path, []).append((set(chunk.timeline_names), cleared))
    fused = rows[entities.FUSED]
    assert ({"stamp", "tried", "frame", "received"}, False) in fused
    assert ({"tried"}, True) in fused, "no object is left"
    assert not any("stamp" in timelines and cleared for timelines, cleared in fused)
    lidar, camera = result.frame.lidar, result.cameras[0].camera.name
    for path_of_input in (
        entities.POINTS.path(lidar),
        entities.IMAGE.path(camera),
        entities.SENSOR.path(camera),
    ):
        assert not any(cleared for _, cleared in rows[path_of_input])
    assert sum(timelines == {"tried"} for timelines, _ in rows[entities.POINTS.path(lidar)]) == 2, (
        "it is put back"
    )


def test_a_stopped_try_shows_nothing(bag: Path) -> None:
    """The next try begins anew."""
    with bevviz.open(bag, model="demo") as drive, bevviz.open(bag, model="demo") as again:
        bench = RecordedDrive(drive, again.frames)
        bench.observe(drive.at(frame=0))
        overlay = bench.open_overlay()
        attempt = overlay.attempt()
        overlay.stop()
        with pytest.raises(UserError, match="cancelled"):
            overlay.add_tried(attempt)
        assert len(overlay.buffer) == 0
        bench.try_values(0, ("clustering.eps=0.9",), overlay.attempt())
        assert len(overlay.buffer) == 1
        bench.close()


def test_a_slow_try_keeps_no_question_waiting(talk: Talk) -> None:
    """It can be cancelled; its own answer comes never, that of the next try at once."""
    slow, entry = ["bev.resolution=0.02"], talk.of("missed")[0]
    _, stamp, _, pick, *_ = entry["sights"][0]
    talk.say(type="try", time=int(stamp), set=slow, pick=pick)
    talk.say(type="ask", time=int(stamp), set=[], pick=pick)
    first = talk.until("tried|answer")
    assert first["type"] == "answer" and first["set"] == []
    talk.say(type="try", time=int(stamp), set=["bev.resolution=0.025"], pick=pick)
    talk.say(type="cancel", what="try")
    talk.say(type="try", time=int(stamp), set=["clustering.eps=0.9"], pick=pick)
    tried = talk.until("tried")
    while tried["type"] == "error":
        assert tried["text"] == "the try was cancelled"
        tried = talk.until("tried")
    assert tried["set"] == ["clustering.eps=0.9"]


def test_a_question_about_a_cancelled_try_is_answered(talk: Talk) -> None:
    values, entry = ["bev.resolution=0.03"], talk.of("missed")[0]
    _, stamp, _, pick, *_ = entry["sights"][0]
    talk.say(type="try", time=int(stamp), set=values, pick=pick)
    talk.say(type="ask", time=int(stamp), set=values, pick=pick)
    talk.say(type="cancel", what="try")
    answer = talk.until("answer")
    while answer["type"] == "error":
        assert answer["text"] == "the try was cancelled"
        answer = talk.until("answer")
    assert answer["set"] == values


def test_a_frame_that_has_not_been_run_yet_is_meant_by_its_time(bag: Path) -> None:
    """A page that is opened again asks for what it showed, long before the run is there."""
    with bevviz.open(bag, model="demo") as drive, bevviz.open(bag, model="demo") as again:
        stamps = [drive.raw(number).stamp for number in range(FRAMES)]
        bench = RecordedDrive(drive, again.frames, first=2)
        with pytest.raises(UserError, match="no frame"):
            bench.number_at(stamps[0])
        bench.show(bench.look(2), ())
        for ran in range(3):
            assert [bench.number_at(stamp) for stamp in stamps] == list(range(FRAMES)), f"{ran} were run"
            middle = (stamps[3] + stamps[4]) // 2
            assert bench.number_at(middle) == 3
            assert bench.number_at(stamps[-1] + 10**9) == FRAMES - 1
            bench.observe(drive.at(frame=ran))
        bench.close()


def test_a_frame_shows_nothing_of_frames_before_it(bag: Path, tmp_path: Path) -> None:
    """It was drawn before all others, or came before those just before it."""
    from rerun.chunk import RrdReader

    def blind(result: FrameResult) -> FrameResult:
        cameras = tuple(replace(c, detections=None, fusion=None) for c in result.cameras)
        return replace(result, cameras=cameras, objects=None, splits=None)

    def left(pieces: list[bytes], stamp: int) -> list[bool]:
        """Whether the last detections up to that time are cleared, for each timeline of the stamp."""
        rows = []
        for number, piece in enumerate(pieces):
            (path := tmp_path / f"{number}.rrd").write_bytes(piece)
            for chunk in RrdReader(path).stream():
                if chunk.entity_path == seen and not chunk.is_static:
                    batch = chunk.to_record_batch()
                    cleared = any("Clear" in name for name in batch.schema.names)
                    rows += [(at.value, cleared) for at in batch.column("stamp") if at.value <= stamp]
        return [cleared for at, cleared in rows if at == max(rows)[0]]

    with bevviz.open(bag, model="demo") as drive, bevviz.open(bag, model="demo") as again:
        results = [drive.at(frame=number) for number in range(4)]
        seen = entities.DETECTIONS.path(results[0].cameras[0].camera.name)
        bench = RecordedDrive(drive, again.frames, first=3)
        bench.show(blind(results[3]), ())
        for result in (results[0], blind(results[1]), blind(results[2])):
            bench.observe(result)
        first, *others = [bench.recording.rows[row] for row in range(len(bench.recording.rows))]
        application = blueprints.application_id("workbench", drive.scene, drive.config)
        bench.close()
    (whole := tmp_path / "first.rrd").write_bytes(first)
    assert {store.application_id for store in RrdReader(whole).recordings()} == {application}
    assert left([first, others[0]], results[3].frame.stamp) == [True]
    assert left([others[0], others[2]], results[2].frame.stamp) == [True]
    assert left([others[0]], results[0].frame.stamp) == [False]


# --- parts --------------------------------------------------------------------------------------


def test_pieces_of_a_recording_are_read_back_unchanged() -> None:
    told = []
    with RecordingBuffer() as recording:
        end = recording.news.listen(lambda: told.append(len(recording)))
        for piece in (b"one", b"", None, b"two" * 1000):
            recording.add(piece)
        end()
        recording.add(b"three")
        assert [recording[row] for row in range(len(recording))] == [b"one", b"two" * 1000, b"three"]
        assert told == [1, 2]
        with pytest.raises(IndexError):
            recording[3]


def test_controls_are_made_of_the_fields() -> None:
    from bevviz.config import load

    made = {control["key"]: control for control in controls(load())}
    eps = made["clustering.eps"]
    assert (eps["value"], eps["unit"], eps["low"], eps["high"]) == (0.5, "metres", 0, 20)
    assert made["clustering.boxes"]["choices"] == ["oriented", "axis_aligned"]
    assert made["voxel.average"]["kind"] == "switch"
    assert made["clustering.max_cluster_points"]["kind"] == "whole"
    assert not any(key.startswith("live.") for key in made)


def test_a_full_temporary_disk_is_told_with_its_folder(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with small_disk(tmp_path / "small", "1m") as small:
        monkeypatch.setenv("TMPDIR", str(small))
        with serving(str(bag)) as (address, _), Talk(address) as talk:
            error = talk.over["error"] if talk.over["type"] == "progress" else talk.over["text"]
    full = (
        f"{small}: the disk is full: make room there, or name another folder for temporary files with TMPDIR"
    )
    assert error == full
