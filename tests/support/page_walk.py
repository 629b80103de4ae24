"""A random walk over the workbench's page. Each sentence is held against the same drive, asked in Python.

The oracle knows the drive and what the walk did: which row, which value, which key. Of the page it reads only
the sentences, and of the viewer only the times and the clicks that it reports.
"""

from __future__ import annotations

import random
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import bevviz
from bevviz.config import changed_config
from bevviz.evaluate import truth_of
from bevviz.model import geometry
from bevviz.pipeline.session import Session
from bevviz.recording.labels import EYE
from bevviz.stages.robot_results import in_points_frame
from bevviz.why import Answer, FrameExplainer, Selection
from bevviz.why.resolve import select_subjects
from bevviz.why.subject import Subject, points_in_box, projected_box
from bevviz.workbench.trials import RUNS, trial_effects
from tests.support.workbench_pages import kill_browsers, watched_page

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

Values = tuple[str, ...]  # settings such as clustering.eps=0.9
Asked = tuple[Answer, int]  # an answer and the number of its frame

PATIENCE = 90.0  # seconds until the page has to be at rest
REST = 1.0  # seconds in which nothing changes on a page that is at rest
SAME_BOX = 0.2  # IoU of the image boxes of one detection in two frames in a row
OPENING = 300.0  # seconds until every frame has been run, on a machine that compiles the stages first
ONE_STEP = 600.0  # seconds of a step and its checks, after which the browser counts as hanging
MISS = 8.0  # seconds that the viewer has to report a click, which may have hit nothing
WRONG = "-3"  # a value that is refused
VALUES = [f"clustering.eps={one}" for one in ("0.3", "0.7", "0.9")]
VALUES += [f"clustering.min_cluster_points={one}" for one in ("5", "40", WRONG)]
VALUES += ["ground.distance_threshold=0.4", "detector.conf_threshold=0.1", "detector.conf_threshold=0.6"]
SLIDES = (0.12, 0.3)  # parts of a slider's range
SLIDE = """(slider, part) => {
  slider.value = Number(slider.min) + part * (slider.max - slider.min);
  for (const type of ["input", "change"]) slider.dispatchEvent(new Event(type));
  return slider.value;
}"""
TRIED = ("fixed", "broken", "new false")  # kinds of rows that are about the newest run with other values
STEPS = ["step", "row", "line", "click", "beside", "value", "hint", "undo", "flip", "reload", "note", "drive"]
RESTED = ("row", "line", "click")  # steps that end on a page at rest
WEIGHTS = [20, 24, 12, 10, 5, 12, 6, 6, 5, 4, 5, 2]
PAGE = """() => {
  const IDS = ["shown", "verdict", "where", "of", "hints", "effect", "noted", "side",
    "trial-set", "trial-listed"];
  const $ = (id) => document.getElementById(id);
  const texts = (query) => [...document.querySelectorAll(query)].map((one) => one.innerText);
  const shown = (id) => ($(id).offsetParent ? $(id).innerText.trim() : "");
  const of = (type) => window.seen.filter((one) => one.type === type).at(-1);
  return {
    ...Object.fromEntries(IDS.map((id) => [id, shown(id)])),
    state: $("answer").className.split(" ").find((one) => ["reported", "missed"].includes(one)) ?? "",
    chain: texts("#chain li"), helps: texts("#hints button"), changes: texts("#changes li"),
    beside: texts("#beside button"),
    fields: [...document.querySelectorAll(".control.changed")].map(({ children: [label, input] }) => (
      `${label.textContent}=${input.type === "checkbox" ? input.checked : input.value}`)),
    rows: [...document.querySelectorAll("#found li:not(.group) > button:first-child")].map((row) => ({
      time: row.querySelector(".time").innerText, kind: row.children[2].innerText,
      text: [["", ".name"], [" at ", ".away"], [": ", ".reason"]]
        .map(([before, part]) => [before, row.querySelector(part).textContent])
        .filter(([, text]) => text).flat().join(""),
      small: row.title.split("\\n").at(-1),
      current: row.getAttribute("aria-current") === "true",
    })),
    busy: $("answer").matches(".busy") || shown("hints").startsWith("Trying")
      || shown("try-cancel") + shown("drive-cancel") !== "",
    time: of("time_update")?.time ?? of("timeline_change")?.time ?? 0,
    line: of("timeline_change")?.timeline ?? "stamp",
  };
}"""


class Oracle:
    """A bag of the demo, asked in Python. Its results and answers are computed once."""

    def __init__(self, bag: Path) -> None:
        self.drive = bevviz.open(bag, model="demo")
        self.frames = [self.drive.raw(number) for number in range(len(self.drive))]
        self.times = [f"{(frame.stamp - self.frames[0].stamp) / 1e9:.2f} s" for frame in self.frames]
        self.explainer, self.hints = cache(self._explainer), cache(self._hints)
        self.effect, self.row = cache(self._effect), cache(self._row)

    def frame_at(self, stamp: float) -> int:
        """Return the number of the frame that a viewer shows at a stamp."""
        return max(sum(frame.stamp <= stamp + 1000 for frame in self.frames) - 1, 0)

    def _explainer(self, number: int, values: Values) -> FrameExplainer:
        loader = self.drive.session.loader
        session = Session(changed_config(self.drive.config, values), loader=loader)
        names, beside = session.stages.class_names, self.frames[max(number - 1, 0) : number + 2]
        neighbours = [frame for frame in beside if frame is not self.frames[number]]
        result = session.run_single(self.frames[number])
        return FrameExplainer(result, loader, names, neighbours=lambda: neighbours)

    def answers(self, number: int, values: Values, wanted: Callable[[Subject], bool]) -> list[Answer]:
        """Return the answers about the wanted objects, clusters, detections and labels of a frame."""
        explainer = self.explainer(number, values)
        result = explainer.traces.result
        assert result.frame.truth is not None and result.objects is not None and result.clusters is not None
        counts = [("truth", len(result.frame.truth.boxes), ""), ("object", len(result.objects), "")]
        counts += [("cluster", len(result.clusters), "")]
        counts += [("detection", len(one.detections or ()), one.camera.name) for one in result.cameras]
        selections = [Selection.of(kind, row, name) for kind, size, name in counts for row in range(size)]
        return [
            explainer.about(one) for one in selections if wanted(select_subjects(explainer.traces, one)[0])
        ]

    def named(self, number: int, values: Values, name: str) -> list[Asked]:
        """Return the answers about the subjects of a name."""
        return [(one, number) for one in self.answers(number, values, lambda subject: subject.name == name)]

    def _row(self, number: int, values: Values, kind: str, text: str) -> list[Asked]:
        """Return the answers that a row of the list can be about."""
        name, away, reason = re.fullmatch(r"(.*) at (.*) m: (.*)", text).groups()  # type: ignore[union-attr]
        is_truth, matches = (
            kind in ("missed", "fixed", "broken"),
            self.explainer(number, values).traces.matches,
        )

        def wanted(subject: Subject) -> bool:
            fits = (subject.kind == "truth") == is_truth and (subject.label or subject.kind).lower() == name
            return fits and (kind != "missed" or matches is None or bool(matches.missed[subject.row]))

        return [
            (one, number)
            for one in self.answers(number, values, wanted)
            if one.verdict.kind.value == reason and abs(one.distance - float(away)) < 0.06
        ]

    def _hints(self, number: int, values: Values, selection: Selection) -> Answer:
        explainer = self.explainer(number, values)
        return explainer.with_hints(explainer.about(selection))

    def _effect(self, number: int, values: Values) -> list[str]:
        """Return the words that tell what values do to a frame."""
        (before, after), frame = (
            (self.explainer(number, one).traces.result for one in ((), values)),
            self.frames[number],
        )
        assert frame.truth is not None
        made = trial_effects(before, after, truth_of(frame, frame.truth))
        effects: dict[str, Any] = asdict(made["effects"])
        changed = effects.pop("changed")
        words = {name for names in effects.values() for name in names}
        words |= {" → ".join("–" if one is None else f"{one:g}" for one in made["f1"].values())}  # noqa: RUF001
        return sorted(words | ({f"changes {changed}"} if changed else set()), key=len, reverse=True)

    def owner(self, asked: Asked) -> str:
        """Return the id of the label at the centre of a subject; empty: there is none."""
        answer, frame = asked[0], self.frames[asked[1]]
        truth = frame.truth
        assert truth is not None
        if answer.subject.kind == "truth" or answer.center is None:
            return truth.ids[answer.subject.row] if answer.subject.kind == "truth" else ""
        away = np.hypot(*(in_points_frame(frame.pose, truth).center[:, :2] - np.array(answer.center)[:2]).T)
        return truth.ids[int(away.argmin())] if away.min() < 0.4 else ""

    def same(self, one: Asked, other: Asked) -> bool:
        """Whether two answers can be about one object."""
        kinds, owners = {one[0].subject.kind, other[0].subject.kind}, {self.owner(one), self.owner(other)}
        if "truth" in kinds:
            return kinds == {"truth"} and len(owners) == 1
        if kinds == {"detection"} and abs(one[1] - other[1]) <= 1:
            boxes = [np.array([a.subject.xyxy]) for a, _ in (one, other)]
            if one[0].subject.camera == other[0].subject.camera and geometry.iou(*boxes)[0, 0] >= SAME_BOX:
                return True  # Without a cluster the centre is anywhere in the frustum.
        if one[0].center is None or other[0].center is None:
            return "cluster" in kinds or one[0].subject.label == other[0].subject.label
        places = [geometry.apply(self.frames[n].pose, np.array([a.center]))[0] for a, n in (one, other)]
        away = float(np.hypot(*(places[0] - places[1])[:2]))
        return len(owners - {""}) < 2 and away <= 1.5 + 2.0 * abs(one[1] - other[1])

    def holds(self, asked: Asked, click: dict[str, Any]) -> bool:
        """Whether the subject of an answer is where a view was clicked. From above, its centre is near."""
        (answer, number), place = asked, [one for one in click.get("position") or () if one is not None]
        frame, subject, path = self.frames[number], answer.subject, click["entity_path"]
        camera = next((one for one in frame.cameras if f"/{one.name}" in path), None)
        if len(place) == 3:
            inside = np.array([place], np.float32)  # 3D views show the frame of the points
            near = answer.center is not None and np.linalg.norm(inside[0] - answer.center) <= 3
            is_label = np.linalg.norm(inside[0] - EYE) < 0.01  # Labels are reported at the eye.
            in_box = subject.box is not None and points_in_box(subject.box, inside, 0.5).any()
            return bool(near or is_label or in_box)
        if camera is None and place and answer.center is not None:
            bev = self.drive.config.bev
            x, y = bev.range_x - place[1] * bev.resolution, bev.range_y - place[0] * bev.resolution
            near = np.hypot(x - answer.center[0], y - answer.center[1]) <= 4
            cell = np.array([(x, y, answer.center[2])], np.float32)
            return bool(near or (subject.box is not None and points_in_box(subject.box, cell, 1.0).any()))
        if camera is None or not place:
            return True
        boxes = [subject.xyxy, None if subject.box is None else projected_box(subject.box, camera)]
        around = [np.add(box, (-12, -12, 12, 12)) for box in boxes if box is not None]
        return any((box[:2] <= place).all() and (place <= box[2:]).all() for box in around)


@dataclass
class Pane:
    """One page, and what it has to show after all that was done to it."""

    page: Page
    frame: int = 0
    values: Values = ()
    undo: list[Values] = field(default_factory=list)
    before: bool = False  # the side without the values is shown
    subject: list[Asked] = field(default_factory=list)  # what was asked about can be any of these
    known: int = 0  # frame in which it was seen last
    called: set[str] = field(default_factory=set)  # names of its class since it was asked about
    content: dict[str, Any] = field(default_factory=dict)  # the newest content that was read
    changed: float = 0.0  # time at which it was read first

    @property
    def side(self) -> Values:
        return () if self.before else self.values

    def ask(self, subject: list[Asked], known: int) -> None:
        self.called = set()
        self.follow(subject, known)

    def follow(self, subject: list[Asked], known: int) -> None:
        self.subject, self.known = subject, known
        self.called |= {(one.subject.label or one.subject.kind).lower() for one, _ in subject}


class Walk:
    """A walk over two pages of a server. ``wrong`` has the sentences about another object, frame or value.

    Args:
        browser: the browser that shows both pages.
        address: address of the server.
        oracle: the same drive, asked in Python.
        seed: seed of the walk.
        pictures: folder for a screenshot of each page that is wrong. None: none is saved.
    """

    def __init__(
        self, browser: Browser, address: str, oracle: Oracle, seed: int, pictures: Path | None = None
    ) -> None:
        self.browser, self.address, self.oracle = browser, address, oracle
        self.seed, self.pictures, self.taken = seed, pictures, 0
        self.rng, self.wrong, self.done = random.Random(seed), list[str](), "open"
        self.runs: list[Values] = []  # values of the runs over the drive, the newest last
        self.notes: list[str] = []  # rows of the notes
        self.panes: list[Pane] = []
        self.acted = 0.0  # time of the newest action on any page

    def go(self, steps: int, within: float = np.inf) -> int:
        """Take so many steps, or as many as so many seconds allow. The second page comes after a third.

        Return the number of steps taken.
        """
        end = time.monotonic() + within
        for number in range(steps):
            if time.monotonic() > end:
                return number
            with killed_after(ONE_STEP):
                self._go_on(number, opens=number in (0, steps // 3))
        return steps

    def _go_on(self, number: int, opens: bool) -> None:
        """Take a step on one of the pages, and check all pages. Save a picture of a page that is wrong."""
        start, known, pane = time.monotonic(), len(self.wrong), None
        self.done = f"seed {self.seed}, step {number}"
        try:
            if opens:
                self._open()
            pane, (name,) = self.rng.choice(self.panes), self.rng.choices(STEPS, WEIGHTS)
            self.done += f", page {self.panes.index(pane)}: {name}"
            self.done += f" {getattr(self, f'_{name}')(pane)}"
            if name not in RESTED:
                self.acted = time.monotonic()
            for checked in sorted(self.panes, key=lambda one: one is not pane):
                self.check(checked)
                if len(self.wrong) > known:
                    known = len(self.wrong)
                    self.save_picture(checked, number)
        except Exception as error:
            self.expect(False, f"{type(error).__name__}: {error}")
            if pane is not None:
                self.save_picture(pane, number)
            raise
        self.taken += 1
        print(f"{self.done} ({time.monotonic() - start:.1f} s)", flush=True)

    def _open(self) -> None:
        page = watched_page(self.browser, 1100, 700)
        page.set_default_timeout(PATIENCE * 1000)
        page.goto(self.address)
        page.keyboard.press("Shift")  # The page begins at a finding by itself unless the user acts.
        self.panes.append(Pane(page))
        run = self.wait(page.locator("#bar").is_hidden, OPENING)
        assert run, "the frames have not been run"
        self.rest(self.panes[-1])

    def save_picture(self, pane: Pane, number: int) -> None:
        """Save a screenshot of a page, named after the seed, the step and the page."""
        from playwright.sync_api import Error

        if self.pictures is not None:
            self.pictures.mkdir(parents=True, exist_ok=True)
            file = self.pictures / f"seed_{self.seed}_step_{number}_page_{self.panes.index(pane)}.png"
            with suppress(Error):  # A browser without a graphics card may be too slow.
                pane.page.screenshot(path=file)

    @property
    def run(self) -> Values:
        """Values of the newest run over the drive. Empty: there is none."""
        return self.runs[-1] if self.runs else ()

    # --- steps ---------------------------------------------------------------------------------

    def _step(self, pane: Pane) -> str:
        pane.page.keyboard.press(key := self.rng.choice(".,"))
        if "has not been run yet" in pane.page.inner_text("#shown"):  # A slow page learns of the frame late.
            pane.page.wait_for_timeout(3000)
            pane.page.keyboard.press(key)
        pane.frame = min(max(pane.frame + (1 if key == "." else -1), 0), len(self.oracle.frames) - 1)
        return key

    def _row(self, pane: Pane) -> str:
        """Choose a row by a click or a key, and take over what it is about."""
        rows = pane.page.evaluate(PAGE)["rows"]
        index, again = self.rng.randrange(min(len(rows), 30)), False
        if self.rng.random() < 0.7:
            again = rows[index]["current"]  # its next frame
            pane.page.locator("#found li:not(.group) > button:first-child").nth(index).click()
        else:
            pane.page.keyboard.press(self.rng.choice("np"))
        content = self.rest(pane)
        (row,) = [one for one in content["rows"] if one["current"]]
        at, kind = self.oracle.times.index(row["time"]), row["kind"]
        if kind in TRIED or kind.endswith("gone"):
            if pane.values != self.run:
                self._try(pane, self.run)
            pane.before = kind not in TRIED
        pane.frame, subject = self.oracle.frame_at(content["time"]) if again else at, list[Asked]()
        if kind == "note":
            subject = self.oracle.named(at, (), f"the {row['text'].rpartition(': ')[0]}")
        elif kind != "anomaly":
            subject = self.oracle.row(at, self.run if kind in TRIED else (), kind, row["text"])
        pane.ask(subject, at)
        return f"{row['time']} {kind} {row['text']}"

    def _line(self, pane: Pane) -> str:
        """Click into a time line: that of the viewer, or that of the findings below it."""
        own = self.rng.random() < 0.4 and pane.page.locator("#events").is_visible()
        box = pane.page.locator("#events" if own else "#viewer").bounding_box()
        assert box is not None
        x = (
            64 + self.rng.random() * (box["width"] - 66)
            if own
            else self.rng.uniform(0.42, 0.62) * box["width"]
        )
        count = pane.page.evaluate("window.seen.length")
        y = box["y"] + (1 if own else box["height"] - 14)
        pane.page.mouse.move(box["x"] + x, y)
        pane.page.wait_for_timeout(1500)  # A slow viewer would select what was under the pointer before.
        pane.page.mouse.click(box["x"] + x, y, delay=60)
        moved = f"window.seen.slice({count}).some((one) => one.type === 'time_update')"
        self.wait(lambda: pane.page.evaluate(moved), MISS)
        pane.frame = self.oracle.frame_at(self.rest(pane)["time"])
        return f"to frame {pane.frame}"

    def _click(self, pane: Pane) -> str:
        width, height = pane.page.evaluate("[viewer.clientWidth, viewer.clientHeight]")
        x, y = self.rng.uniform(0.02, 0.98) * width, self.rng.uniform(0.08, 0.88) * height
        picked = f"window.seen.slice({pane.page.evaluate('window.seen.length')})"
        picked += ".filter((one) => one.type === 'selection_change').flatMap((one) => one.items)"
        pane.page.mouse.move(x - 3, y)
        pane.page.mouse.move(x, y)
        pane.page.wait_for_timeout(1500)  # It finds what is under the pointer a picture or two later.
        pane.page.mouse.click(x, y, delay=60)
        self.wait(lambda: pane.page.evaluate(f"{picked}.length"), MISS)
        clicks = [item for item in pane.page.evaluate(picked) if item["type"] == "entity"]
        if not clicks:
            self.acted = time.monotonic()
            return "on nothing"
        name = self.rest(pane)["where"].partition(" · ")[0]
        named = self.oracle.named(pane.frame, pane.side, name)
        pane.ask([one for one in named if self.oracle.holds(one, clicks[-1])], pane.frame)
        self.expect(
            bool(pane.subject) or not name or "what is" in name, f"{clicks[-1]} is answered with {name}"
        )
        return f"on {clicks[-1]['entity_path']}: {name}"

    def _beside(self, pane: Pane) -> str:
        if not (buttons := pane.page.locator("#beside button").all()):
            return "none"
        name = (button := self.rng.choice(buttons)).inner_text().rpartition(": ")[0]
        pane.ask(self.oracle.named(pane.frame, pane.side, name), pane.frame)
        button.click()
        return name

    def _value(self, pane: Pane) -> str:
        key, _, value = (setting := self.rng.choice(VALUES)).partition("=")
        pane.page.fill("#search", key)
        if self.rng.random() < 0.3:
            return self._slide(pane, key, self.rng.choice(SLIDES))
        control = pane.page.locator(f"[id='control-{key}']")
        if control.input_value() == value:
            pane.page.evaluate("document.activeElement.blur()")
            return "none"
        control.fill(value)
        control.press("Enter")
        pane.page.evaluate("document.activeElement.blur()")
        pane.before = False
        if value != WRONG:
            self._try(pane, (*(one for one in pane.values if not one.startswith(f"{key}=")), setting))
        return setting

    def _slide(self, pane: Pane, key: str, part: float) -> str:
        """Move the slider of a parameter to a part of its range."""
        slider = pane.page.locator(f"input[aria-label='{key}, slider']")
        setting = f"{key}={slider.evaluate(SLIDE, part)}"
        pane.page.evaluate("document.activeElement.blur()")
        self._try(pane, (*(one for one in pane.values if not one.startswith(f"{key}=")), setting))
        return f"slider of {setting}"

    def _try(self, pane: Pane, values: Values) -> None:
        pane.undo.append(pane.values)
        pane.values, pane.before = values, False

    def _hint(self, pane: Pane) -> str:
        if not (buttons := pane.page.locator("#hints button:enabled").all()):
            return "none"
        settings = (
            (button := self.rng.choice(buttons)).inner_text().splitlines()[0].removeprefix("try ").split(", ")
        )
        button.click()
        keys = {one.partition("=")[0] for one in settings}
        self._try(pane, (*(one for one in pane.values if one.partition("=")[0] not in keys), *settings))
        return str(settings)

    def _undo(self, pane: Pane) -> Values:
        pane.page.keyboard.press("u")
        pane.values = pane.undo.pop() if pane.undo else pane.values
        return pane.values

    def _flip(self, pane: Pane) -> bool:
        pane.page.keyboard.press("b")
        pane.before ^= bool(pane.values)
        return pane.before

    def _reload(self, pane: Pane) -> str:
        pane.page.reload()
        pane.undo, pane.before = [()] if pane.values else [], pane.before and bool(pane.values)
        self.wait(lambda: pane.page.evaluate("window.seen.some((one) => one.type === 'time_update')"))
        return ""

    def _note(self, pane: Pane) -> str:
        """Note something about the subject, or remove a note."""
        if (remove := pane.page.locator("#found button[aria-label='remove this note']")).count() > 1:
            row = remove.first.locator("xpath=..")
            self.notes.remove(f"{row.locator('.time').inner_text()} {row.locator('.what').inner_text()}")
            remove.first.click()
            return "removed"
        pane.page.evaluate("document.getElementById('noted').textContent = ''")
        pane.page.fill("#words", words := f"words {self.rng.random():.4f}")
        pane.page.click("#note")
        noted = self.wait(lambda: pane.page.inner_text("#noted")) or ""
        about = noted.removeprefix("Noted about ").partition(" in frame ")[0]
        self.expect(
            noted == f"Noted about {about} in frame {pane.frame}.", f"{noted} It is frame {pane.frame}"
        )
        there = [one for one in pane.subject if self.owner_is_in(one, pane.frame)]
        subjects = self.oracle.named(pane.frame, (), about)
        good = (
            any(self.oracle.same(a, b) for a in subjects for b in pane.subject)
            or (not there and about == "the frame")
            or (
                about.startswith("what is at") and about == pane.page.inner_text("#where").partition(" · ")[0]
            )
        )
        self.expect(good, f"{noted} The subject is {names(pane)}")
        self.notes.append(f"{self.oracle.times[pane.frame]} {about.removeprefix('the ')}: {words}")
        return noted

    def owner_is_in(self, asked: Asked, number: int) -> bool:
        """Whether a frame has the label that was asked about."""
        truth = self.oracle.frames[number].truth
        return (
            asked[0].subject.kind == "truth" and truth is not None and self.oracle.owner(asked) in truth.ids
        )

    def _drive(self, pane: Pane) -> Values:
        if pane.values:
            pane.page.keyboard.press("r")
            self.runs = [*self.runs, pane.values][-RUNS:]
            pane.page.wait_for_timeout(1000)
        return pane.values

    # --- checks --------------------------------------------------------------------------------

    def check(self, pane: Pane) -> None:
        """Hold every sentence of a page against the oracle."""
        oracle, line = self.oracle, "tried" if pane.side else "stamp"
        self.wait(lambda: pane.page.evaluate(PAGE)["line"] == line)  # A slow viewer changes it late.
        content = self.rest(pane, again=True)
        seconds = (float(content["time"]) - oracle.frames[0].stamp) / 1e9  # in doubles, as the page counts
        wanted = {"shown": f"Frame {pane.frame} at {seconds:.2f} s", "frame": pane.frame, "of": ""}
        wanted |= {"changes": [*pane.values], "notes": sorted(self.notes)}
        wanted |= {"line": line, "side": "", "fields": sorted(pane.values)}
        if pane.values:
            wanted["side"] = "shown: before" if pane.before else "shown: after"
        if self.runs:
            ran, newest = (", ".join(one) for one in (pane.values, self.run))
            wanted["trial-set"] = ran if pane.values in self.runs else newest
            other = f"The table of findings has the differences of {newest}."
            wanted["trial-listed"] = "" if wanted["trial-set"] == newest else other
        notes = sorted(f"{one['time']} {one['text']}" for one in content["rows"] if one["kind"] == "note")
        said = {**content, "frame": oracle.frame_at(content["time"]), "notes": notes}
        said["fields"] = sorted(content["fields"])
        for key, value in wanted.items():
            self.expect(said[key] == value, f"{key} is {said[key]}, not {value}")
        self.check_answer(pane, content)
        self.check_beside(pane, content["beside"])
        self.check_effect(pane, content["effect"])
        for number, row in enumerate(content["rows"]):
            if row["kind"] not in ("note", "anomaly") and (number < 12 or row["current"]):
                self.check_row(pane, row)

    def check_answer(self, pane: Pane, content: dict[str, Any]) -> None:
        verdict, where, oracle = content["verdict"], content["where"], self.oracle
        about = f"'{verdict}' at '{where}', and the subject is {names(pane)} at {pane.frame} with {pane.side}"
        parts = re.fullmatch(r"(.*?) · frame (\d+)(?: · ([\d.]+) m away)?(?: · .*)?", where)
        gone = re.fullmatch(
            r"(The .*) of frame (\d+) is not in frame (\d+)(?: with these values)?: .*\.", verdict
        )
        if not pane.subject:
            nothing = ("Click a", "Nothing can be asked", "There is", "What is", "Cannot tell")
            self.expect(verdict.startswith(nothing), about)
        elif gone:
            named = any(label in gone[1].lower() for label in pane.called) and int(gone[2]) == pane.known
            there = any(self.owner_is_in(one, pane.frame) for one in pane.subject)
            self.expect(named and not there and int(gone[3]) == pane.frame, about)
        else:
            found = (
                oracle.named(pane.frame, pane.side, parts[1]) if parts and int(parts[2]) == pane.frame else []
            )
            found = [
                one
                for one in found
                if one[0].text == verdict and any(oracle.same(one, old) for old in pane.subject)
            ]
            self.expect(bool(found), about)
            if not found or parts is None:
                return
            pane.follow(found, pane.frame)
            answer = found[0][0]
            chain = [" ".join(f"{step.stage}: {step.text}".split()) for step in answer.steps]
            self.expect(
                [" ".join(one.split()) for one in content["chain"]] == chain, f"{about}: {content['chain']}"
            )
            self.expect(parts[3] is None or abs(answer.distance - float(parts[3])) < 0.011, about)
            good = answer.verdict.reported and answer.verdict.kind.value != "contradicted"
            self.expect(
                content["state"] == ("reported" if good else "missed"), f"{about} looks {content['state']}"
            )
            if answer.selection is not None and not answer.verdict.reported:
                helped = oracle.hints(pane.frame, pane.side, answer.selection)
                helps = [one.splitlines()[0].removeprefix("try ") for one in content["helps"]]
                wanted = [", ".join(hint.settings) for hint in helped.hints]
                good = helps == wanted if wanted else content["hints"] == helped.remark
                self.expect(good, f"{about}: '{content['hints']}', not {wanted} '{helped.remark}'")

    def check_beside(self, pane: Pane, texts: list[str]) -> None:
        """Hold the buttons of the other subjects at the place against the shown frame."""
        for text in texts:
            name, _, reason = text.rpartition(": ")
            named = self.oracle.named(pane.frame, pane.side, name)
            reasons = {one.verdict.kind.value for one, _ in named}
            self.expect(
                reason in reasons, f"also there is '{text}' in {pane.frame} with {pane.side}: {reasons}"
            )

    def check_effect(self, pane: Pane, text: str) -> None:
        if not pane.values or "must be" in text:
            self.expect(text in ("", "As it was opened.") or "must be" in text, f"'{text}' without values")
            return
        frame, _, said = text.removeprefix("Frame ").partition(": ")
        self.expect(
            frame == str(pane.frame) or (pane.before and frame.isdigit()), f"'{text}' at {pane.frame}"
        )
        words = self.oracle.effect(int(frame), pane.values) if frame.isdigit() else []
        self.expect(all(word in said for word in words), f"'{text}' of {pane.values} lacks some of {words}")
        for word in words:
            said = said.replace(word, "")
        self.expect(
            not re.search(r"\d", said.replace("F1", "")), f"'{text}' of {pane.values} has more than {words}"
        )

    def check_row(self, pane: Pane, row: dict[str, Any]) -> None:
        at, values = self.oracle.times.index(row["time"]), self.run if row["kind"] in TRIED else ()
        answers = self.oracle.row(at, values, row["kind"], row["text"])
        self.expect(bool(answers), f"the row {row} is about nothing of frame {at}")
        same = any(self.oracle.same(one, old) for one in answers for old in pane.subject)
        self.expect(same or not row["current"], f"the row {row} is chosen, and the subject is {names(pane)}")
        if answers and row["small"].endswith(".") and row["kind"] in ("missed", "false"):
            told = [self.oracle.hints(at, (), one.selection).remark for one, _ in answers if one.selection]
            self.expect(row["small"] in told, f"the row {row} does not say {told}")

    # --- waiting -------------------------------------------------------------------------------

    def rest(self, pane: Pane, *, again: bool = False) -> dict[str, Any]:
        """Wait until nothing changes any more, and the viewer is where the page says.

        Args:
            pane: the page.
            again: nothing was done since the last wait, whose time counts, too.
        """
        if not again:
            self.acted = time.monotonic()

        def rested() -> bool:
            if (content := pane.page.evaluate(PAGE)) != pane.content:
                pane.content, pane.changed = content, time.monotonic()
            there = content["time"] > 0 and content["shown"].startswith(
                f"Frame {self.oracle.frame_at(content['time'])} "
            )
            quiet = time.monotonic() - max(pane.changed, self.acted)
            return quiet > REST and there and not content["busy"]

        brief = ("shown", "verdict", "hints", "effect", "busy", "time")
        self.expect(bool(self.wait(rested)), f"never at rest: {[pane.content[key] for key in brief]}")
        return pane.content

    def wait(self, done: Callable[[], Any], patience: float = PATIENCE) -> Any:
        """Wait until ``done`` returns a true value, and return it; None: it never did."""
        end = time.monotonic() + patience
        while not (found := done()) and time.monotonic() < end:
            time.sleep(0.25)
        return found

    def expect(self, condition: bool, text: str) -> None:
        if not condition:
            self.wrong.append(f"{self.done}: {text}")
            print(f"WRONG {self.wrong[-1]}", flush=True)


@contextmanager
def killed_after(seconds: float) -> Iterator[None]:
    """Kill the browsers when the block takes longer. Playwright waits for a hanging page without a limit."""
    timer = threading.Timer(seconds, kill_browsers)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def names(pane: Pane) -> list[str]:
    """Return the names of what a page can be about."""
    return sorted({f"{one.subject.name} of frame {number}" for one, number in pane.subject})
