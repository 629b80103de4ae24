"""How right ``bevviz why`` is: every object of synthetic drives is asked about, with three configurations.

Each verdict is held against the rule of ``benchmarks.truth``, which the simulator answers; each hint is run
by itself, the network included, and judged by the same rule.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.pages import write_section
from benchmarks.truth import Cause, Rule, Scene, scene_of
from bevviz.config import Config, changed_config, load
from bevviz.evaluate import MIN_HITS, RANGE
from bevviz.extras.demo.drive import Snapshot, SyntheticSource
from bevviz.model.reasons import ReasonKind
from bevviz.pipeline.session import Session
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.why import Answer, FrameExplainer, Selection
from bevviz.why.verdict import HOPELESS

CLASSES = ("person", "cyclist", "car")
MIN_HEIGHT = 20  # visible pixels in height of what is asked for by its place in the image
MISTUNED = (
    "clustering.eps=0.9",
    "clustering.min_cluster_points=25",
    "detector.conf_threshold=0.5",
    "fusion.min_iou=0.35",
)
HEADING = "## Answers of `bevviz why`\n"


def configurations() -> dict[str, Config]:
    """By name. The last one is badly tuned, so that what is rare otherwise is asked about, too."""
    model = "detector.model=demo"
    return {
        "reference": load(settings=[model], preset="reference"),
        "default": load(settings=[model]),
        "mistuned": load(settings=[model, *MISTUNED]),
    }


@dataclass
class Tally:
    """Counts of one configuration."""

    verdicts: dict[ReasonKind, Counter[str]] = field(
        default_factory=lambda: defaultdict(Counter)
    )  # by the rule's
    near: Counter[str] = field(default_factory=Counter)  # of what ought to be seen
    hints: Counter[str] = field(default_factory=Counter)
    places: Counter[str] = field(default_factory=Counter)
    blind: Counter[str] = field(default_factory=Counter)  # asked without a ground truth
    wrong: list[str] = field(default_factory=list)  # each in words
    seconds: list[float] = field(default_factory=list)  # of processor time, of a question
    hint_seconds: list[float] = field(default_factory=list)

    def of(self, reasons: Sequence[ReasonKind]) -> Counter[str]:
        """Verdicts on what the rule gives one of these reasons for."""
        return sum((self.verdicts[reason] for reason in reasons), Counter())


class Bench:
    """Asks about every object of frames, and judges the answers.

    Args:
        config: that the frames are run with.
        loader: that has the network.
    """

    def __init__(self, config: Config, loader: StageLoader) -> None:
        self.config, self.loader, self.tally = config, loader, Tally()
        self._session = Session(config, loader=loader)

    def frame(self, shot: Snapshot, scene: Scene, where: str) -> None:
        """All of one frame.

        Raises:
            SystemExit: a stage failed.
        """
        result = self._session.run(shot.frame)
        if result.failures:
            raise SystemExit(f"{where}: {result.failures}")
        unlabelled = replace(result, frame=replace(result.frame, truth=None))
        known, blind = (FrameExplainer(r, self.loader, CLASSES) for r in (result, unlabelled))
        rule, again = Rule(shot, scene, result), _Again(shot, scene, self.config, self.loader)
        for row in range(len(scene.number)):
            about = f"{where}, row {row}"
            cause = rule.cause(row)
            answer = self._asked(known, Selection(truth=row))
            self._verdict(answer, cause, about)
            if answer.verdict.kind is not ReasonKind.REPORTED and answer.verdict.kind not in HOPELESS:
                self._hint(known, answer, again, row, about)
            x0, y0, x1, y1 = scene.pixels[row].tolist()
            if y1 - y0 >= MIN_HEIGHT:
                self._place(known, shot, scene, row, about)
                if answer.near:
                    self._blind(blind, (x0, y0, x1, y1), cause, about)

    def _asked(self, questioner: FrameExplainer, selection: Selection) -> Answer:
        start = time.process_time()
        answer = questioner.ask(selection)[0]
        self.tally.seconds.append(time.process_time() - start)
        return answer

    def _verdict(self, answer: Answer, cause: Cause, about: str) -> None:
        right = (answer.verdict.kind, answer.verdict.reported) == (cause.reason, cause.reported)
        for counts in (
            self.tally.verdicts[cause.reason],
            *([self.tally.near] if _is_near(answer, cause) else []),
        ):
            counts.update(asked=1, right=int(right))
        if not right:
            self.tally.wrong.append(f"{about}: {_said(cause)}, not: {answer.verdict.text}")

    def _hint(self, known: FrameExplainer, answer: Answer, again: _Again, row: int, about: str) -> None:
        start = time.process_time()
        hints = known.search(answer).hints
        self.tally.hint_seconds.append(time.process_time() - start)
        if not hints:
            self.tally.hints.update(none=1)
            return
        after = again.with_settings(hints[0].settings).cause(row)
        stated = f"'{after.reason.value}'" in hints[0].text  # a fault that the hint tells
        holds = after.reported and (after.reason is ReasonKind.REPORTED or stated)
        self.tally.hints.update(given=1, hold=int(holds))
        if not holds:
            self.tally.wrong.append(f"{about}: {', '.join(hints[0].settings)} leaves it {_said(after)}")

    def _place(self, known: FrameExplainer, shot: Snapshot, scene: Scene, row: int, about: str) -> None:
        """Whether a question about its place in the image is answered for it."""
        ys, xs = np.nonzero(shot.pixel_object == scene.number[row])
        middle = np.argmin((xs - xs.mean()) ** 2 + (ys - ys.mean()) ** 2)
        pixel = (float(xs[middle]), float(ys[middle]))
        for kind, box in (("pixel", pixel), ("box", tuple(scene.pixels[row].tolist()))):
            subject = self._asked(known, Selection(box=box)).subject
            right = (subject.kind, subject.row) == ("truth", row)
            self.tally.places.update({f"{kind} asked": 1, f"{kind} right": int(right)})
            if not right:
                self.tally.wrong.append(f"{about}: the {kind} {box} is answered for {subject.name}")

    def _blind(self, blind: FrameExplainer, box: tuple[float, ...], cause: Cause, about: str) -> None:
        """As somebody asks who draws a box around it in a recording that has no ground truth."""
        verdict = self._asked(blind, Selection(box=box)).verdict
        reported = verdict.reported == cause.reported
        right = reported and verdict.kind is cause.reason
        self.tally.blind.update(asked=1, reported=int(reported), right=int(right))
        if not right:
            self.tally.wrong.append(f"{about}, without truth: {_said(cause)}, not: {verdict.text}")


def _is_near(answer: Answer, cause: Cause) -> bool:
    return answer.near and cause.reason not in HOPELESS


def _said(cause: Cause) -> str:
    return f"{cause.reason.value}{', reported' if cause.reported else ''}"


class _Again:
    """The rule on the same frame with other settings, everything run anew."""

    def __init__(self, shot: Snapshot, scene: Scene, config: Config, loader: StageLoader) -> None:
        self._shot, self._scene, self._config, self._loader = shot, scene, config, loader
        self._rules: dict[tuple[str, ...], Rule] = {}

    def with_settings(self, settings: tuple[str, ...]) -> Rule:
        if settings not in self._rules:
            session = Session(changed_config(self._config, settings), loader=self._loader)
            self._rules[settings] = Rule(self._shot, self._scene, session.run(self._shot.frame))
        return self._rules[settings]


def ask_all(seeds: Sequence[int], frames: int, every: int) -> dict[str, Tally]:
    """Return the tally of each configuration over the drives."""
    loader = StageLoader()
    benches = {name: Bench(config, loader) for name, config in configurations().items()}
    sources = {seed: SyntheticSource(frames, seed) for seed in seeds}
    shots = [(seed, index) for seed in seeds for index in range(0, frames, every)]
    for seed, index in tqdm(shots, unit="frame", disable=None):
        shot = sources[seed].snapshot(index)
        scene = scene_of(sources[seed], shot)
        for name, bench in benches.items():
            bench.frame(shot, scene, f"seed {seed}, frame {index}, {name}")
    return {name: bench.tally for name, bench in benches.items()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seeds",
        type=int,
        nargs="+",
        default=[1030, 1031, 1032],  # the rules of why were written on 1020 to 1022
        help="drives",
    )
    parser.add_argument("--frames", type=int, default=100, help="length of each drive in scans")
    parser.add_argument("--every", type=int, default=20, help="each N-th scan is asked about")
    parser.add_argument("--wrong", action="store_true", help="also say each wrong answer")
    parser.add_argument("--write", type=Path, help="page whose section is replaced, instead of printing it")
    options = parser.parse_args()
    tallies = ask_all(options.seeds, options.frames, options.every)
    if options.wrong:
        print("\n".join(text for tally in tallies.values() for text in tally.wrong))
    number = len(options.seeds) * len(range(0, options.frames, options.every))
    section = section_of(
        tallies, f"{number} frames, seeds {options.seeds}, Python {platform.python_version()}."
    )
    if options.write:
        write_section(options.write, section)
    else:
        print(section, details_of(tallies), sep="\n")


def section_of(tallies: Mapping[str, Tally], what: str) -> str:
    """Format the section of benchmarks/RESULTS.md."""
    visible = [reason for reason in ReasonKind if reason not in HOPELESS]
    mistuned = ", ".join(f"`{setting}`" for setting in MISTUNED)
    lines = [
        HEADING,
        "`python -m benchmarks.why` asks about every object of synthetic drives. An answer is right if an",
        "independent rule (`benchmarks/truth.py`), which knows the object of each point and pixel, gives the",
        "same reason. A hint holds if the object is reported with it. `mistuned` is the default with",
        f"{mistuned}.",
        f"{what}\n",
        f"| right answers, of objects | {' | '.join(tallies)} |",
        "| --- |" + " ---: |" * len(tallies),
    ]
    asked = {
        "in view, with points": [tally.of(visible) for tally in tallies.values()],
        f"of these within {RANGE:.0f} m, {MIN_HITS} points or more": [
            tally.near for tally in tallies.values()
        ],
        "out of view, hidden or without points": [tally.of([*HOPELESS]) for tally in tallies.values()],
    }
    for what_asked, counts in asked.items():
        lines.append(f"| {what_asked} | " + " | ".join(map(_share, counts)) + " |")
    lines += ["\n| hints | given | hold | none was found |", "| --- | ---: | ---: | ---: |"]
    for name, tally in tallies.items():
        given = tally.hints["given"]
        holding = f"{tally.hints['hold'] / given:.3f}" if given else "-"
        lines.append(f"| {name} | {given} | {holding} | {tally.hints['none']} |")
    seconds = [s for tally in tallies.values() for s in tally.seconds]
    hinted = [s for tally in tallies.values() for s in tally.hint_seconds]
    lines.append(
        f"\nA question takes {_times(seconds)} of processor time, looking for a hint {_times(hinted)} more."
    )
    return "\n".join(lines) + "\n"


def details_of(tallies: Mapping[str, Tally]) -> str:
    """Format the answers by a place in the image and by reason."""
    lines = [
        f"Objects with {MIN_HEIGHT} px of visible height, asked about by a pixel or by the box around them.",
        "Without ground truth: is the verdict reported or not right, and is the reason?\n",
    ]
    lines += ["| asked by | configuration | objects | right |", "| --- | --- | ---: | ---: |"]
    for name, tally in tallies.items():
        for kind in ("pixel", "box"):
            counts = Counter(asked=tally.places[f"{kind} asked"], right=tally.places[f"{kind} right"])
            lines.append(f"| {kind} | {_row(name, counts)}")
        lines.append(f"| box, no truth: reported or not | {_row(name, tally.blind, 'reported')}")
        lines.append(f"| box, no truth: the reason, too | {_row(name, tally.blind)}")
    lines += ["\n| reason, by the rule | " + " | ".join(f"{name} | right" for name in tallies) + " |"]
    lines.append("| --- |" + " ---: | ---: |" * len(tallies))
    for reason in ReasonKind:
        known = [tally.verdicts[reason] for tally in tallies.values()]
        if any(counts["asked"] for counts in known):
            cells = " | ".join(f"{counts['asked']} | {counts['right']}" for counts in known)
            lines.append(f"| {reason.value} | {cells} |")
    return "\n".join(lines) + "\n"


def _share(counts: Counter[str]) -> str:
    """Format the share of right answers and the number of objects."""
    return f"{counts['right'] / counts['asked']:.3f} of {counts['asked']}" if counts["asked"] else "-"


def _row(name: str, counts: Counter[str], right: str = "right") -> str:
    """Format the last cells of a row: configuration, number asked, share of right answers."""
    asked = counts["asked"]
    return f"{name} | {asked} | {counts[right] / asked:.3f} |" if asked else f"{name} | 0 | - |"


def _times(seconds: Sequence[float]) -> str:
    if not seconds:
        return "-"
    middle, most = np.quantile(seconds, (0.5, 0.95)) * 1e3
    return f"{middle:.0f} ms (95 % within {most:.0f} ms)"


if __name__ == "__main__":
    main()
