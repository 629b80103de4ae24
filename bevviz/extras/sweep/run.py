"""Swept parameters, and the outcome of every combination of their values on the same frames."""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bevviz.config import Config
from bevviz.errors import UserError, printable
from bevviz.evaluate import ObjectScore, Truth, rates
from bevviz.evaluate.f1_change import f1_change
from bevviz.model import counts
from bevviz.model.counts import count_results
from bevviz.model.frame import F64, Frame
from bevviz.model.results import FrameResult
from bevviz.pipeline.session import Variants, check_same_frames
from bevviz.support import table
from bevviz.support.json_form import json_form

MOST = 500  # combinations of values, at most

_NUMBER = r"[-+]?[\d.]+(?:[eE][-+]?\d+)?"
_RANGE = re.compile(rf"\s*({_NUMBER})\s*:\s*({_NUMBER})\s*:\s*({_NUMBER})\s*")

Values = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Parameter:
    """A dotted key and the values that it takes in turn, as text."""

    key: str
    values: Values

    @property
    def numbers(self) -> F64:
        """(N,) positions of the values on an axis: the values as numbers, or 0, 1, 2 ... for words."""
        try:
            return np.array([float(value) for value in self.values])
        except ValueError:
            return np.arange(len(self.values), dtype=np.float64)

    def place(self, value: str) -> float | None:
        """Return the position of a value on the axis; None: off the axis."""
        if value in self.values:
            return float(self.numbers[self.values.index(value)])
        try:
            number, *others = (float(word) for word in (value, *self.values))
        except ValueError:  # A word that is not in the list has no position.
            return None
        return number if min(others) <= number <= max(others) else None


def parse(settings: Sequence[str]) -> tuple[list[Parameter], list[str]]:
    """Split ``key=value`` settings into swept ones and constant ones.

    A swept setting has a range ``a:b:step`` or a list ``x,y,z``.

    Raises:
        UserError: an empty range, no swept parameter, more than two, or too many values.
    """
    swept, constant = [], []
    for text in settings:
        key, _, value = text.partition("=")
        match = _RANGE.fullmatch(value)
        if match:
            swept.append(Parameter(key.strip(), _range(text, *map(float, match.groups()))))
        elif "," in value and value.strip()[0] not in "[{\"'":
            swept.append(Parameter(key.strip(), tuple(part.strip() for part in value.split(","))))
        else:
            constant.append(text)
    if not swept:
        raise UserError("sweep: over what? Give a range or a list, e.g. --set clustering.eps=0.3:0.9:0.1")
    if len(swept) > 2:
        keys = ", ".join(parameter.key for parameter in swept)
        raise UserError(f"sweep: two parameters at most, not {len(swept)}: {keys}")
    number = math.prod(len(parameter.values) for parameter in swept)
    if number > MOST:
        raise UserError(f"sweep: {number} combinations are more than {MOST}; take larger steps")
    return swept, constant


def _range(text: str, first: float, last: float, step: float) -> Values:
    """Return the values of a range, both ends included."""
    if step <= 0 or last < first:
        raise UserError(f"--set {text}: expected first:last:step with last >= first and step > 0")
    number = int((last - first) / step + 1e-6) + 1
    if number > MOST:
        raise UserError(f"--set {text}: {number} values are more than {MOST}; take larger steps")
    return tuple(f"{first + i * step:.10g}" for i in range(number))


def combine(parameters: Sequence[Parameter], load: Callable[[list[str]], Config]) -> dict[Values, Config]:
    """Return the configuration of every combination of values.

    Args:
        parameters: one or two parameters.
        load: returns the configuration with further settings.

    Raises:
        UserError: an unknown key, a value out of range, or a key that changes how frames are made.
    """
    configs = {}
    for values in itertools.product(*(parameter.values for parameter in parameters)):
        stated = zip(parameters, values, strict=True)
        configs[values] = load([f"{parameter.key}={value}" for parameter, value in stated])
    check_same_frames({" ".join(values): config for values, config in configs.items()})
    return configs


# --- the run -----------------------------------------------------------------------------------

STAGES = ("voxel", "ground", "clustering", "fusion")  # stages that are timed one by one
COUNTS = ("clusters", "detections", "matches", "objects")
OPINIONS = {what: what.replace("_", " ") for what in counts.OPINIONS}
SCORES = ("precision", "recall", "F1", "error m")


@dataclass
class SweepOutcome:
    """Counts, times and scores of one combination of values, over all frames."""

    frames: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))  # by stage and frame
    failures: int = 0
    judged: int = 0  # frames with ground truth
    score: ObjectScore = field(default_factory=ObjectScore)

    def add(self, result: FrameResult, truth: Truth | None = None) -> None:
        """Add the result of one frame."""
        self.frames += 1
        self.failures += len(result.failures)
        self.counts.update(count_results(result))
        self.counts["objects"] += 0 if result.objects is None else len(result.objects)
        for stage in STAGES:
            self.seconds[stage].append(result.timings.get(stage, 0.0))
        if truth is not None and result.objects is not None:
            self.judged += 1
            self.score.add(result.objects, truth, result.cameras)

    @property
    def metrics(self) -> dict[str, float]:
        """Means of a frame, median milliseconds of each LiDAR stage, and scores.

        A stage that several combinations share counts its full time in each of them.
        """
        frames = max(self.frames, 1)
        metrics = {metric: self.counts[metric] / frames for metric in COUNTS}
        metrics |= {
            OPINIONS[metric]: self.counts[metric] / frames for metric in OPINIONS if metric in self.counts
        }
        # The first frame also loads the stages, so times are medians.
        times = {f"{stage} ms": float(np.median(self.seconds[stage] or [0.0])) * 1e3 for stage in STAGES}
        metrics |= {"time ms": sum(times.values()), **times}
        if self.judged:
            shares, errors = rates(self.score.total), self.score.errors()
            error = float(np.median(errors)) if errors else math.nan
            scores = (shares["precision"], shares["recall"], shares["f1"], error)
            metrics |= dict(zip(SCORES, scores, strict=True))
        return metrics


@dataclass(frozen=True, slots=True)
class ClassCounts:
    """Counts of one class, over all frames."""

    tp: int
    """true objects"""
    fp: int
    """false objects"""
    fn: int
    """missed objects"""


@dataclass(frozen=True, slots=True)
class SweepRun:
    """One combination of values."""

    values: Values
    """in the order of the parameters"""
    frames: int
    metrics: Mapping[str, float | None]
    """mean of a frame; times: median in milliseconds; precision, recall and F1: of all frames"""
    classes: Mapping[str, ClassCounts]
    """with ground truth"""
    failures: int
    """failed stages"""


@json_form
@dataclass(frozen=True, slots=True)
class SweepResult:
    """Metrics of each combination of values."""

    parameters: Sequence[str]
    """their keys"""
    runs: Sequence[SweepRun]
    best: Values | None
    """values with the greatest F1; null: none within the noise"""


class Sweep:
    """A run of every combination of values on each frame.

    Args:
        parameters: one or two parameters.
        configs: configurations from ``combine``.
        truth: returns the ground truth of a frame, None where it is unknown.

    Raises:
        UserError: a detector cannot be used.
    """

    def __init__(
        self,
        parameters: Sequence[Parameter],
        configs: Mapping[Values, Config],
        truth: Callable[[Frame], Truth | None] | None = None,
    ) -> None:
        self.parameters, self.configs = parameters, configs
        self.outcomes = {values: SweepOutcome() for values in configs}
        self.truth = truth
        self._variants = Variants()
        for config in configs.values():
            self._variants.check(config)

    def perceive(self, frame: Frame, network: Executor | None = None) -> FrameResult:
        """Run every combination on the frame. Return the result of the first one."""
        truth, results = None if self.truth is None else self.truth(frame), []
        for values, config in self.configs.items():
            results.append(self._variants.perceive(frame, config, network))
            self.outcomes[values].add(results[-1], truth)
        return results[0]

    def finish(self, result: FrameResult) -> FrameResult:
        """Finish the result of the first combination in frame order."""
        return self._variants.session(next(iter(self.configs.values()))).finish(result)

    @property
    def best(self) -> Values | None:
        """Values with the highest F1, of equal ones with the smallest error.

        None without ground truth, and if no other value is worse by more than the noise.
        """
        alike = self.alike
        return alike[0] if len(alike) == 1 or len(alike) < len(self._rated) else None

    @property
    def alike(self) -> Sequence[Values]:
        """Values that are the best within the noise, the one with the highest F1 first."""
        rated = self._rated
        if not rated:
            return ()
        best = self.outcomes[rated[0]].score.frames
        return [
            values for values in rated if not f1_change(self.outcomes[values].score.frames, best).is_better
        ]

    @property
    def _rated(self) -> Sequence[Values]:
        """Values with an F1, the best first."""
        rated: dict[Values, tuple[float, float]] = {}
        for values, outcome in self.outcomes.items():
            f1, errors = rates(outcome.score.total)["f1"], outcome.score.errors()
            if not math.isnan(f1):
                rated[values] = -f1, float(np.median(errors)) if errors else math.inf
        return sorted(rated, key=lambda values: rated[values])

    @property
    def title(self) -> str:
        """Title of the sweep, with its parameters."""
        return "Sweep over " + " and ".join(parameter.key for parameter in self.parameters)

    def table(self) -> str:
        """Return the table for the terminal."""
        frames = max(outcome.frames for outcome in self.outcomes.values())
        lines = [f"{frames} frames; means of a frame, median milliseconds", ""]
        lines += table.lines([*self.rows("time ms")])
        if (verdict := self.verdict) is not None:
            lines += ["", printable(verdict)]
        failures = sum(outcome.failures for outcome in self.outcomes.values())
        return "\n".join([*lines, *([f"{failures} stages failed"] if failures else [])])

    @property
    def verdict(self) -> str | None:
        """One sentence about the best values. None without ground truth."""
        rated, alike, best = self._rated, self.alike, self.best
        if not rated:
            return None
        high, low = (rates(self.outcomes[values].score.total)["f1"] for values in (rated[0], rated[-1]))
        if best is None:
            return f"no value is best within the noise: F1 {low:.3f} to {high:.3f}"
        where = ", ".join(
            f"{parameter.key} = {value}" for parameter, value in zip(self.parameters, best, strict=True)
        )
        others = f"; {len(alike) - 1} more as good within the noise" if alike[1:] else ""
        return f"best F1: {high:.3f} at {where}{others}"

    def rows(self, last: str) -> Iterator[tuple[str, ...]]:
        """Yield the header and a row for each combination. Of the times, it has ``last`` only."""
        names = [name for name in self._metrics() if not name.endswith(" ms") or name == last]
        yield (*(parameter.key for parameter in self.parameters), *names)
        for values, outcome in self.outcomes.items():
            metrics = outcome.metrics
            yield (*values, *(_number(name, metrics.get(name, math.nan)) for name in names))

    def _metrics(self) -> list[str]:
        """Return the names of all metrics."""
        return max((list(outcome.metrics) for outcome in self.outcomes.values()), key=len)

    def result(self) -> SweepResult:
        """Return every metric of the table, the time of each stage, and the counts by class."""
        runs = []
        for values, outcome in self.outcomes.items():
            classes = {
                name: ClassCounts(counts["true"], counts["false"], counts["missed"])
                for name, counts in sorted(outcome.score.classes.items())
            }
            runs.append(SweepRun(values, outcome.frames, outcome.metrics, classes, outcome.failures))
        return SweepResult([parameter.key for parameter in self.parameters], runs, self.best)

    def write_csv(self, path: Path) -> None:
        """Write a row for each combination: all metrics of the table, stage times, counts by class.

        Raises:
            UserError: the file cannot be written.
        """
        names = self._metrics()
        classes = sorted({name for outcome in self.outcomes.values() for name in outcome.score.classes})
        kinds = {"tp": "true", "fp": "false", "fn": "missed"}
        header = [parameter.key for parameter in self.parameters] + ["frames", *names]
        header += [f"{name} {kind}" for name in classes for kind in kinds]
        rows: list[Sequence[object]] = [header]
        for values, outcome in self.outcomes.items():
            metrics = outcome.metrics
            class_counts = outcome.score.classes
            by_class = [
                class_counts.get(name, Counter())[kind] for name in classes for kind in kinds.values()
            ]
            rounded = (f"{metrics.get(name, math.nan):.6g}" for name in names)
            rows.append([*values, outcome.frames, *rounded, *by_class])
        table.save_csv(path, rows, "--csv")


def _number(name: str, value: float) -> str:
    """Return a metric as text, with the decimals of its kind."""
    if math.isnan(value):
        return "-"
    return f"{value:.3f}" if name in SCORES[:3] else f"{value:.2f}" if name == "error m" else f"{value:.1f}"
