"""How often ``bevviz why`` names the cause of a missed object, and how often its hints cure it.

``python -m benchmarks.ideal`` asks about objects that ``evaluate`` counts as missed, with several
configurations. The judge is in ``benchmarks/ideal_stages.py``: one or two stages get the ideal result at the
object, and the others run. It shares no rule, order or constant with ``bevviz.why``.

To judge another version: ``PYTHONPATH=TREE python -P benchmarks/ideal.py``, with this folder copied there.

With ``--blind`` the labels are hidden, and the question is the box around what the image shows of the object.

An answer may have ``restored_by``, its own list of what restores the object. An item is one alternative: the
name of a stage, or several names joined by "and", "+" or "," or in a list.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.ideal_data import DataSet, LabelledFrame, data_sets
from benchmarks.ideal_stages import CLUSTERING, DETECTION, FUSION, GROUND, MissedObject, counts, missed_rows
from benchmarks.pages import write_section
from bevviz.config import Config, changed_config, load
from bevviz.model.frame import Frame
from bevviz.model.results import FrameResult
from bevviz.pipeline.perceive import add_explanations, perceive
from bevviz.pipeline.stage_log import Memo
from bevviz.why import FrameExplainer, Selection

DATA = Path(os.environ.get("BEVVIZ_DATA") or Path(__file__).resolve().parents[2] / "shared/data")
SEEDS, QUICK_SEEDS = range(8000, 8012), range(7000, 7006)  # methods are chosen on the quick run
HEADING = "## Answers of `bevviz why`"
SIMULATED = ("drives", "demo")  # of the other data sets each frame is another place
DRAWS = 2000  # of whole drives, for the intervals

PRESETS = ("default", "reference")
PLANTED = {  # settings of mis-tuned configurations
    "min_iou": ("fusion.min_iou=0.35",),
    "points": ("clustering.min_points=25",),
    "conf": ("detector.conf_threshold=0.6",),
    "ground+size": ("ground.distance_threshold=0.5", "clustering.min_cluster_points=25"),
    "depth+nms": ("fusion.max_depth=15", "detector.iou_threshold=0.1"),
}
CONFIGURATIONS = (*PRESETS, *PLANTED)

STAGE_OF = {  # stage that an answer blames with a kind of reason; the other kinds blame no stage
    "ground": GROUND,
    "noise": CLUSTERING,
    "no cluster": CLUSTERING,
    "too small": CLUSTERING,
    "too large": CLUSTERING,
    "merged": CLUSTERING,
    "split": CLUSTERING,
    "detector not run": DETECTION,
    "not detected": DETECTION,
    "below threshold": DETECTION,
    "suppressed": DETECTION,
    "misnamed": DETECTION,
    "not fused": FUSION,
    "low overlap": FUSION,
    "too few points": FUSION,
    "too far": FUSION,
    "taken": FUSION,
    "misfit": FUSION,
    "other cluster": FUSION,
    "misplaced": FUSION,
    "borrowed name": FUSION,
    "shared box": FUSION,
    "wrong depth": FUSION,
    "wall in the frustum": FUSION,
    "duplicate": FUSION,
}
STAGE_WORDS = {  # stage by the first letters of its names
    "ground": GROUND,
    "cluster": CLUSTERING,
    "detect": DETECTION,
    "fus": FUSION,
}


@dataclass
class TriedHint:
    """A hint of an answer, run by the benchmark.

    Attributes:
        settings: its settings.
        restores: whether the object is found with it.
        gain: right objects minus false ones, compared with before, in the frame itself.
        beside: the same in each neighbouring frame.
    """

    settings: list[str]
    restores: bool
    gain: int
    beside: list[int]


@dataclass
class Miss:
    """A missed object, what restores it, and what the answer says.

    Attributes:
        alone: ideal stages that restore it alone.
        pairs: ideal pairs that restore it, where no stage does alone.
        reason: kind of the answer's reason.
        blamed: stage of that reason; empty: none.
        named: alternatives that the answer says restore it, each with its stages.
        cured: whether the object is found once the planted parameters are set back.
        question: seconds of a question about a new frame; None: not the first question.
        search: seconds of the search for hints; None: not the first question.
    """

    data: str
    drive: str
    frame: int
    half: str
    configuration: str
    row: int
    label: str
    alone: list[str]
    pairs: list[tuple[str, str]]
    reason: str
    blamed: str
    text: str
    named: list[list[str]]
    planted: list[str]
    cured: bool
    hints: list[TriedHint] = field(default_factory=list)
    question: float | None = None
    search: float | None = None

    @property
    def curable(self) -> bool:
        """Whether one ideal stage, or two, restore the object."""
        return bool(self.alone or self.pairs)

    @property
    def reason_holds(self) -> bool:
        """Whether the stage of the answer's reason restores the object alone."""
        return self.blamed in self.alone

    @property
    def named_hold(self) -> list[bool]:
        """Whether each alternative that the answer names restores the object, as far as it was judged."""
        right = [{stage} for stage in self.alone] + [set(pair) for pair in self.pairs]
        return [set(stages) in right for stages in self.named]

    @property
    def cause_holds(self) -> bool:
        """Whether the answer names a stage that restores the object alone, or the pair that does."""
        return self.reason_holds or any(self.named_hold)


def configuration(name: str, settings: Sequence[str]) -> Config:
    """Return a configuration by name, with the settings of a data set."""
    planted = PLANTED.get(name, ())
    if name == "reference":
        return load(settings=[*settings, *planted], preset="reference")
    return load(settings=[*settings, *planted])


def alternatives(restored_by: Any) -> list[list[str]]:
    """Return the alternatives that an answer's ``restored_by`` names, each with its stages."""
    if not restored_by:
        return []
    items = list(restored_by) if isinstance(restored_by, list | tuple) else [restored_by]
    found = [_stages_in(item) for item in items]
    return [stages for stages in found if stages]


def _stages_in(item: Any) -> list[str]:
    """Return the stages that one alternative names."""
    if isinstance(item, dict):
        item = item.get("stages") or item.get("stage") or ""
    elif not isinstance(item, str) and not isinstance(item, Iterable):
        item = getattr(item, "stages", None) or getattr(item, "stage", "")
    words = re.findall(r"[a-z]+", item.lower()) if isinstance(item, str) else [str(word) for word in item]
    stages = [
        stage for word in words for start, stage in STAGE_WORDS.items() if word.lower().startswith(start)
    ]
    return list(dict.fromkeys(stages))


class FrameBenchmark:
    """Questions about one frame with one configuration.

    Args:
        data: the data set.
        position: of the frame in it.
        name: name of the configuration.
        memo: results of stages on the frame.
        blind: whether the labels are hidden.
    """

    def __init__(self, data: DataSet, position: int, name: str, memo: Memo, *, blind: bool = False) -> None:
        self.blind = blind
        self.data, self.name, self.memo = data, name, memo
        self.labelled, self.half = data.frames[position], data.half(position)
        self._beside = [(frame, Memo()) for frame in data.neighbours(position)]
        self.config = configuration(name, data.settings)
        self.stages = data.loader.load(self.config)
        self.result = add_explanations(
            perceive(self.labelled.frame, self.config, self.stages, memo), seen=False
        )
        self._counts: dict[tuple[int, tuple[str, ...]], tuple[int, int]] = {}

    def misses(self, most: int) -> Iterator[Miss]:
        """Ask about some of the missed objects.

        Args:
            most: most objects that are asked about. They are chosen by chance. A mis-tuned configuration is
                asked about one object that is missed without the mis-tuning, too; the others are cured.
        """
        missed, rng = missed_rows(self.result, self.labelled), np.random.default_rng(self.labelled.number)
        cured = {row: self.name in PLANTED and self._is_found("default", row) for row in missed}
        chosen = rng.permutation(missed).tolist()
        if self.name in PLANTED:
            others = [row for row in chosen if not cured[row]]
            chosen = [row for row in chosen if cured[row]][: most - 1] + others[:1]
        rows = chosen[:most]
        start = time.process_time()
        explainer = FrameExplainer(
            self._asked_result(), self.data.loader, self.data.classes, neighbours=self._asked_beside
        )
        for number, row in enumerate(rows):
            judge = MissedObject(self.labelled, row, self.result, self.stages, self.data.classes, self.memo)
            selection = self._selection(judge)
            if selection is None:
                continue
            explainer.ask(selection)
            question = time.process_time() - start
            start = time.process_time()
            answer = explainer.explain(selection, 1, everything=True)[0]
            search = time.process_time() - start
            alone, pairs = judge.restored_by()
            kind = answer.verdict.kind.value
            yield Miss(
                data=self.data.name,
                drive=self.labelled.drive,
                frame=self.labelled.number,
                half=self.half,
                configuration=self.name,
                row=row,
                label=self.labelled.truth.labels[row],
                alone=alone,
                pairs=pairs,
                reason=kind,
                blamed=STAGE_OF.get(kind, ""),
                text=answer.text,
                named=alternatives(getattr(answer, "restored_by", None)),
                planted=[setting.partition("=")[0] for setting in PLANTED.get(self.name, ())],
                cured=cured[row],
                hints=[self.tried(list(hint.settings), row) for hint in answer.hints],
                question=None if number else question,
                search=None if number else search,
            )

    def _asked_result(self) -> FrameResult:
        """Return the result that the question is about."""
        if not self.blind:
            return self.result
        return replace(self.result, frame=replace(self.result.frame, truth=None))

    def _asked_beside(self) -> list[Frame]:
        """Return the neighbouring frames that hints may be tried on."""
        beside = [labelled.frame for labelled, _ in self._beside]
        return [replace(frame, truth=None) for frame in beside] if self.blind else beside

    def _selection(self, missed: MissedObject) -> Selection | None:
        """Return how the object is selected: by its label, or by the image box that shows most of it.

        The result is None if no image shows it.
        """
        if not self.blind:
            return Selection(truth=missed.row)
        boxes = [
            (camera.name, missed.image_boxes(camera)[missed.row]) for camera in self.labelled.frame.cameras
        ]
        shown = [(name, box) for name, box in boxes if np.isfinite(box).all()]
        if not shown:
            return None
        camera, box = max(shown, key=lambda pair: float(pair[1][2] - pair[1][0]))
        return Selection(box=tuple(box.tolist()), camera=camera)

    def _is_found(self, name: str, row: int) -> bool:
        """Return whether an object is found with another configuration."""
        config = configuration(name, self.data.settings)
        stages = self.data.loader.load(config)
        return row not in missed_rows(perceive(self.labelled.frame, config, stages, self.memo), self.labelled)

    def tried(self, settings: list[str], row: int) -> TriedHint:
        """Run a hint on the frame and on its neighbours."""
        config = changed_config(self.config, settings)
        stages = self.data.loader.load(config)
        result = perceive(self.labelled.frame, config, stages, self.memo)
        gains = [
            self._gain(frame, memo, settings) for frame, memo in ((self.labelled, self.memo), *self._beside)
        ]
        return TriedHint(settings, row not in missed_rows(result, self.labelled), gains[0], gains[1:])

    def _gain(self, frame: LabelledFrame, memo: Memo, settings: list[str]) -> int:
        """Return how many more objects of a frame are right than false with some settings than without."""
        (right, false), (right_then, false_then) = (
            self._counted(frame, memo, tuple(some)) for some in ((), settings)
        )
        return right_then - right - (false_then - false)

    def _counted(self, frame: LabelledFrame, memo: Memo, settings: tuple[str, ...]) -> tuple[int, int]:
        """Count the right and false objects of a frame with some settings, once."""
        key = frame.number, settings
        if key not in self._counts:
            config = changed_config(self.config, settings) if settings else self.config
            stages = self.data.loader.load(config)
            self._counts[key] = counts(frame, self.data.judged, config, stages, memo)
        return self._counts[key]


# --- figures -----------------------------------------------------------------------------------

Share = Callable[[Miss], Sequence[bool]]

SHARES: dict[str, tuple[str, Share]] = {
    "cause": (
        "the answer names a stage that restores it alone, or the pair that does",
        lambda m: [m.cause_holds],
    ),
    "cause, restorable": (
        "the same, of those that one or two ideal stages restore",
        lambda m: [m.cause_holds] * m.curable,
    ),
    "reason": ("the stage of the reason restores it alone", lambda m: [m.reason_holds]),
    "named": ("alternatives of `restored_by` that hold", lambda m: m.named_hold),
    "planted": (
        "the first hint uses a planted parameter, of those that setting all planted ones back cures",
        lambda m: [_uses_planted(m)] * m.cured,
    ),
    "planted, hinted": (
        "the same, of those with a hint",
        lambda m: [_uses_planted(m)] * (m.cured and bool(m.hints)),
    ),
    "hint": ("a hint restores it", lambda m: [any(hint.restores for hint in m.hints)]),
    "first hint": ("the first hint restores it", lambda m: [any(hint.restores for hint in m.hints[:1])]),
    "beside": (
        "hints that make more objects right than wrong on the neighbouring frames",
        lambda m: [sum(hint.beside) > 0 for hint in m.hints if hint.beside],
    ),
    "beside, no loss": (
        "hints that make at least as many right as wrong there",
        lambda m: [sum(hint.beside) >= 0 for hint in m.hints if hint.beside],
    ),
}
Time = Callable[[Miss], float | None]

TIMES: dict[str, tuple[str, Time, float]] = {  # column: what it is, the time, the quantile
    "question": (
        "median s of processor time of the first question about a frame",
        lambda m: m.question,
        0.5,
    ),
    "search": ("median s of processor time of the search for its hints", lambda m: m.search, 0.5),
    "search, 95 %": ("95 % of these searches take at most this", lambda m: m.search, 0.95),
}


def _uses_planted(miss: Miss) -> bool:
    """Return whether the first hint changes a planted parameter."""
    return any(
        setting.partition("=")[0] in miss.planted for hint in miss.hints[:1] for setting in hint.settings
    )


def share(misses: Sequence[Miss], values: Share) -> tuple[int, int, float, float]:
    """Return how many cases hold, of how many, and the 95 % interval by drawing whole drives."""
    by_drive: dict[str, list[bool]] = defaultdict(list)
    for miss in misses:
        by_drive[f"{miss.data}/{miss.drive if miss.data in SIMULATED else miss.frame}"] += values(miss)
    held = np.array([sum(cases) for cases in by_drive.values()], float)
    total = np.array([len(cases) for cases in by_drive.values()], float)
    if not total.sum():
        return 0, 0, float("nan"), float("nan")
    draws = np.random.default_rng(0).integers(0, len(held), (DRAWS, len(held)))
    of = np.maximum(total[draws].sum(axis=1), 1)
    low, high = np.quantile(held[draws].sum(axis=1) / of, (0.025, 0.975))
    return int(held.sum()), int(total.sum()), float(low), float(high)


def figures(misses: Sequence[Miss]) -> dict[str, dict[str, Any]]:
    """Return the shares with their intervals and the median times, of all and of each group of misses."""
    groups = {"all": list(misses)}
    for key in ("half", "data", "configuration"):
        values = dict.fromkeys(getattr(miss, key) for miss in misses)
        for value in values if len(values) > 1 else ():
            groups[value] = [miss for miss in misses if getattr(miss, key) == value]
    found: dict[str, dict[str, Any]] = {}
    for group, some in groups.items():
        found[group] = {"misses": len(some), "restorable": sum(miss.curable for miss in some)}
        found[group] |= {name: share(some, values) for name, (_, values) in SHARES.items()}
        for name, (_, value, quantile) in TIMES.items():
            seconds = [number for miss in some if (number := value(miss)) is not None]
            found[group][name] = float(np.quantile(seconds, quantile)) if seconds else None
    return found


def table(misses: Sequence[Miss]) -> str:
    """Format the figures as a Markdown table, and what its columns are."""
    found = figures(misses)
    names = [*next(iter(found.values()))]
    lines = [f"| | {' | '.join(names)} |", "| --- |" + " ---: |" * len(names)]
    for group, values in found.items():
        lines.append(f"| {group} | " + " | ".join(map(_cell, values.values())) + " |")
    legend = {name: text for name, (text, *_) in (*SHARES.items(), *TIMES.items())}
    return "\n".join([*lines, "", *(f"- {name}: {text}" for name, text in legend.items())])


def _cell(value: Any) -> str:
    """Format a number of misses, a share with its interval, or a time."""
    if value is None:
        return "-"
    if isinstance(value, tuple):
        held, total, low, high = value
        return f"{100 * held / total:.0f} % of {total} ({100 * low:.0f}-{100 * high:.0f})" if total else "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def section(misses: Sequence[Miss], half: str, seeds: Sequence[int], *, blind: bool = False) -> str:
    """Format the section of benchmarks/RESULTS.md."""
    where = f"the {half} half of the frames" if half else "all frames"
    command = "python -m benchmarks.ideal" + " --blind" * blind
    data = ", ".join(f"`{name}`" for name in dict.fromkeys(miss.data for miss in misses))
    hidden = " The labels are hidden: the question is the box around what the image shows." if blind else ""
    return f"""{HEADING}{" without labels" * blind}

`{command}` asks about objects that `evaluate` counts as missed, on {where} of {data}: synthetic drives
{seeds[0]} to {seeds[-1]} with noisy boxes (`drives`) or the demo network (`demo`), KITTI with YOLOX or the
labels' boxes, SUSTechPOINTS (`sus`). One stage, or two, get the ideal result at the object, and the other
stages run. An answer is right if it names a stage that restores the object so, or the pair that does. KITTI's
neighbouring frames are other places. Brackets hold 95 % intervals.{hidden}

{table(misses)}
"""


def confusion(misses: Sequence[Miss]) -> str:
    """Format, for each reason, which ideal stages restore the objects."""
    by_reason: dict[str, list[Miss]] = defaultdict(list)
    for miss in misses:
        by_reason[miss.reason].append(miss)
    lines = ["\nreason: misses; restored alone by ground, clustering, detection, fusion; pairs only; neither"]
    for reason, some in sorted(by_reason.items(), key=lambda item: -len(item[1])):
        alone = [
            sum(stage in miss.alone for miss in some) for stage in (GROUND, CLUSTERING, DETECTION, FUSION)
        ]
        pairs, neither = sum(bool(m.pairs) for m in some), sum(not m.curable for m in some)
        lines.append(f"  {reason}: {len(some)}; {', '.join(map(str, alone))}; {pairs}; {neither}")
    return "\n".join(lines)


# --- the run -----------------------------------------------------------------------------------


def measure(
    data: DataSet, names: Sequence[str], half: str, most: int, *, blind: bool = False
) -> Iterator[Miss]:
    """Ask about the missed objects of a data set with each configuration."""
    positions = data.asked(half)
    for position in positions[:1]:  # Compile the loops before the first question is timed.
        list(FrameBenchmark(data, position, "default", Memo()).misses(1))
    for position in positions:
        memo = Memo(600)
        for name in names:
            yield from FrameBenchmark(data, position, name, memo, blind=blind).misses(most)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = [*data_sets(DATA, [0])]
    parser.add_argument("--data", nargs="+", choices=names, default=names)
    parser.add_argument("--folder", type=Path, default=DATA, help="folder with the real frames")
    parser.add_argument("--seeds", type=int, nargs="+", help="synthetic drives")
    parser.add_argument("--configurations", nargs="+", choices=CONFIGURATIONS, default=CONFIGURATIONS)
    parser.add_argument("--half", choices=("seen", "unseen"), default="", help="ask about half of the frames")
    parser.add_argument("--most", type=int, default=3, help="objects of a frame and configuration")
    parser.add_argument("--quick", action="store_true", help="about a minute: few drives, frames and objects")
    parser.add_argument("--wrong", action="store_true", help="list the answers that do not name the cause")
    parser.add_argument("--blind", action="store_true", help="hide the labels, and ask by image boxes")
    parser.add_argument("--write", type=Path, metavar="PAGE", help="replace the section of this page")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write each miss and the figures")
    options = parser.parse_args(arguments)
    options.seeds = options.seeds or list(QUICK_SEEDS if options.quick else SEEDS)
    most = options.most
    if options.quick:
        most = min(most, 2)
        options.data = [name for name in options.data if name in ("drives", "kitti")]
    misses: list[Miss] = []
    for name, make in data_sets(options.folder, options.seeds).items():
        if name not in options.data:
            continue
        start, before = time.perf_counter(), len(misses)
        misses += measure(make(), options.configurations, options.half, most, blind=options.blind)
        print(f"{name}: {len(misses) - before} misses, {time.perf_counter() - start:.0f} s", flush=True)
        if options.json:
            tree = {"misses": [asdict(miss) for miss in misses], "figures": figures(misses)}
            options.json.write_text(json.dumps(tree, indent=1))
    if options.wrong:
        for m in misses:
            if not m.cause_holds:
                said = " or ".join(m.alone or [" and ".join(pair) for pair in m.pairs]) or "nothing"
                where = f"{m.data} {m.drive} {m.frame} {m.configuration} row {m.row}"
                print(f"{where}: restored by {said}: {m.text}")
    print(table(misses), confusion(misses), sep="\n")
    if options.write:
        write_section(options.write, section(misses, options.half, options.seeds, blind=options.blind))


if __name__ == "__main__":
    main()
