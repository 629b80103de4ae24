"""A parameter or two over a range: every value on the same frames, counted, timed and held against truth."""

from __future__ import annotations

import csv
import itertools
import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from bevviz import table
from bevviz.config import Config
from bevviz.counts import counts_of
from bevviz.errors import UserError
from bevviz.evaluate import Score, Truth
from bevviz.frame import F64, Frame, FrameResult
from bevviz.logging import entities
from bevviz.logging.pieces import document
from bevviz.text import markdown, printable
from bevviz.variants import Variants, check_same_frames

MOST = 500  # combinations of values
STAGES = ("voxel", "ground", "clustering", "fusion")  # whose times are told one by one
COUNTS = ("clusters", "detections", "matches", "objects")
SCORES = ("precision", "recall", "F1", "error m")
BAR = 0.8  # of the distance between two values

_NUMBER = r"[-+]?[\d.]+(?:[eE][-+]?\d+)?"
_RANGE = re.compile(rf"\s*({_NUMBER})\s*:\s*({_NUMBER})\s*:\s*({_NUMBER})\s*")

Values = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Parameter:
    """A dotted key and the values that it takes in turn, as they are written."""

    key: str
    values: Values

    @property
    def numbers(self) -> F64:
        """Where the values are on an axis: the numbers that they are, else 0, 1, 2 ..."""
        try:
            return np.array([float(value) for value in self.values])
        except ValueError:
            return np.arange(len(self.values), dtype=np.float64)


def parse(settings: Sequence[str]) -> tuple[list[Parameter], list[str]]:
    """Split ``key=value`` settings: with a range ``a:b:step`` or a list ``x,y,z``, and constant ones.

    Raises:
        UserError: a range that leads nowhere, none at all, more than two, or too many values.
    """
    swept, constant = [], []
    for text in settings:
        key, _, value = text.partition("=")
        found = _RANGE.fullmatch(value)
        if found:
            swept.append(Parameter(key.strip(), _range(text, *map(float, found.groups()))))
        elif "," in value and value.strip()[0] not in "[{\"'":
            swept.append(Parameter(key.strip(), tuple(part.strip() for part in value.split(","))))
        else:
            constant.append(text)
    if not swept:
        raise UserError("sweep: over what? Give a range or a list, e.g. --set clustering.eps=0.3:0.9:0.1")
    if len(swept) > 2:
        raise UserError(f"sweep: two parameters at most, not {len(swept)}: {', '.join(p.key for p in swept)}")
    number = math.prod(len(parameter.values) for parameter in swept)
    if number > MOST:
        raise UserError(f"sweep: {number} combinations are more than {MOST}; take larger steps")
    return swept, constant


def _range(text: str, first: float, last: float, step: float) -> Values:
    if step <= 0 or last < first:
        raise UserError(f"--set {text}: expected first:last:step with last >= first and step > 0")
    number = int((last - first) / step + 1e-6) + 1
    if number > MOST:
        raise UserError(f"--set {text}: {number} values are more than {MOST}; take larger steps")
    return tuple(f"{first + i * step:.10g}" for i in range(number))


@dataclass
class Outcome:
    """What one combination of values has made of the frames."""

    frames: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))  # by stage
    failures: int = 0
    judged: int = 0  # frames with truth
    score: Score = field(default_factory=Score)

    def add(self, result: FrameResult, truth: Truth | None) -> None:
        self.frames += 1
        self.failures += len(result.failures)
        self.counts.update(counts_of(result))
        self.counts["objects"] += 0 if result.objects is None else len(result.objects)
        for stage in STAGES:
            self.seconds[stage].append(result.timings.get(stage, 0.0))
        if truth is not None and result.objects is not None:
            self.judged += 1
            self.score.add(result.objects, truth)

    @property
    def metrics(self) -> dict[str, float]:
        """Means of a frame; medians of the LiDAR stages' milliseconds, spared or not; scores."""
        frames = max(self.frames, 1)
        found = {what: self.counts[what] / frames for what in COUNTS}
        # The first frame pays for what is loaded with it: no means.
        times = {f"{stage} ms": float(np.median(self.seconds[stage] or [0.0])) * 1e3 for stage in STAGES}
        found |= {"time ms": sum(times.values()), **times}
        if self.judged:
            errors = self.score.errors
            error = float(np.median(errors)) if errors else math.nan
            scores = (self.score.precision, self.score.recall, self.score.f1, error)
            found |= dict(zip(SCORES, scores, strict=True))
        return found


def combine(parameters: Sequence[Parameter], load: Callable[[list[str]], Config]) -> dict[Values, Config]:
    """Every combination of values.

    Args:
        parameters: one or two.
        load: makes the configuration of further settings.

    Raises:
        UserError: an unknown key, a value out of range, or a key that changes what frames are made of.
    """
    configs = {}
    for values in itertools.product(*(parameter.values for parameter in parameters)):
        stated = zip(parameters, values, strict=True)
        configs[values] = load([f"{parameter.key}={value}" for parameter, value in stated])
    check_same_frames({" ".join(values): config for values, config in configs.items()})
    return configs


class Sweep:
    """Runs every combination of values on each frame.

    Args:
        parameters: one or two.
        configs: of ``combine``.
        truth: what is really there in a frame, where that is known.

    Raises:
        UserError: a detector that cannot be used.
    """

    def __init__(
        self,
        parameters: Sequence[Parameter],
        configs: Mapping[Values, Config],
        truth: Callable[[Frame], Truth | None] | None = None,
    ) -> None:
        self.parameters, self.configs = parameters, configs
        self.outcomes = {values: Outcome() for values in configs}
        self._truth = truth
        self._variants = Variants()
        for config in configs.values():
            self._variants.prepare(config)

    def add(self, frame: Frame) -> None:
        """Run everything on the frame."""
        truth = self._truth(frame) if self._truth else None
        for values, config in self.configs.items():
            result = self._variants.run(frame, config, draw=False)
            self.outcomes[values].add(result, truth)

    @property
    def best(self) -> Values | None:
        """The values with the greatest F1; None where nothing could be judged."""
        rated = {v: o.score.f1 for v, o in self.outcomes.items() if o.judged and not math.isnan(o.score.f1)}
        return max(rated, key=lambda values: rated[values]) if rated else None

    def table(self) -> str:
        """For the terminal."""
        frames = max(outcome.frames for outcome in self.outcomes.values())
        lines = [f"{frames} frames; means of a frame, median milliseconds", ""]
        lines += table.lines([*self._rows("time ms")])
        if self.best is not None:
            where = ", ".join(f"{p.key} = {v}" for p, v in zip(self.parameters, self.best, strict=True))
            lines += ["", f"best F1: {self.outcomes[self.best].score.f1:.3f} at {printable(where)}"]
        failures = sum(outcome.failures for outcome in self.outcomes.values())
        return "\n".join([*lines, *([f"{failures} stages failed"] if failures else [])])

    def _rows(self, last: str) -> Iterator[tuple[str, ...]]:
        """The header and a row for each combination; of the times only ``last``."""
        names = [n for n in self._metrics() if not n.endswith(" ms") or n == last]
        yield (*(parameter.key for parameter in self.parameters), *names)
        for values, outcome in self.outcomes.items():
            metrics = outcome.metrics
            yield (*values, *(_number(name, metrics.get(name, math.nan)) for name in names))

    def _metrics(self) -> list[str]:
        return max((list(outcome.metrics) for outcome in self.outcomes.values()), key=len)

    def write_csv(self, path: Path) -> None:
        """A row for each combination: every number of the table, each stage's time, counts by class.

        Raises:
            UserError: the file cannot be written.
        """
        names = self._metrics()
        classes = sorted({name for o in self.outcomes.values() for name in o.score.names})
        kinds = ("tp", "fp", "fn")
        header = [p.key for p in self.parameters] + ["frames", *names]
        header += [f"{name} {kind}" for name in classes for kind in kinds]
        try:
            with path.open("w", newline="") as file:
                writer = csv.writer(file)
                writer.writerow(header)
                for values, outcome in self.outcomes.items():
                    metrics = outcome.metrics
                    by_class = [outcome.score.classes[name][kind] for name in classes for kind in kinds]
                    rounded = (f"{metrics.get(name, math.nan):.6g}" for name in names)
                    writer.writerow([*values, outcome.frames, *rounded, *by_class])
        except OSError as error:
            raise UserError(f"--csv {path}: cannot be written: {error.strerror}") from None

    # --- plots ---------------------------------------------------------------------------------

    def log(self, recording: rr.RecordingStream, name: str) -> None:
        """The table, and every number over the parameter: bars, or over two parameters a heat map."""
        recording.send_recording_name(name)
        columns = table.markdown([*self._rows("time ms")])
        page = f"# {self.title}\n\n{markdown(name)}\n\n{columns}"
        recording.log(entities.SWEEP, document(page), static=True)
        for series in self._plots().values():
            for place, metric in enumerate(series):
                values = [o.metrics.get(metric, math.nan) for o in self.outcomes.values()]
                self._log_metric(recording, metric, np.array(values), place, len(series))

    def _log_metric(
        self, recording: rr.RecordingStream, metric: str, values: F64, place: int, series: int
    ) -> None:
        path = entities.sweep(metric)
        if len(self.parameters) == 2:
            shape = [len(parameter.values) for parameter in self.parameters]
            names = [f"{p.key}: {p.values[0]} ... {p.values[-1]}" for p in self.parameters]
            known = values[np.isfinite(values)]
            low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
            span = [low, high if high > low else low + 1.0]
            tensor = rr.Tensor(values.reshape(shape), dim_names=names, value_range=span)
            recording.log(path, tensor, static=True)
            return
        at = self.parameters[0].numbers
        step = float(np.diff(at).min()) if len(at) > 1 else 1.0
        width = BAR * abs(step) / series
        at = at + (place - (series - 1) / 2) * width  # beside each other
        widths = np.full(len(at), width)
        recording.log(path, rr.BarChart(np.nan_to_num(values), abscissa=at, widths=widths), static=True)

    @property
    def title(self) -> str:
        return "Sweep over " + " and ".join(parameter.key for parameter in self.parameters)

    def layout(self) -> rrb.Blueprint:
        """The plots beside the table."""
        plots: list[rrb.View] = []
        for name, series in self._plots().items():
            if len(self.parameters) == 2:
                plots += [
                    rrb.TensorView(
                        name=metric,
                        origin=entities.sweep(metric),
                        scalar_mapping=rrb.TensorScalarMapping(colormap="viridis", mag_filter="nearest"),
                        view_fit="fill",
                    )
                    for metric in series
                ]
            else:
                paths = [entities.sweep(metric) for metric in series]
                plots.append(rrb.BarChartView(name=name, origin=entities.SWEEP, contents=paths))
        table = rrb.TextDocumentView(name="Table", origin=entities.SWEEP, contents=["$origin"])
        return rrb.Blueprint(
            rrb.Horizontal(rrb.Grid(*plots, grid_columns=2), table, column_shares=[3, 2]),
            rrb.TimePanel(state="hidden"),
            rrb.BlueprintPanel(state="collapsed"),
            rrb.SelectionPanel(state="collapsed"),
        )

    def _plots(self) -> Mapping[str, Sequence[str]]:
        """What is shown in one plot."""
        one = len(self.parameters) == 1
        plots: dict[str, Sequence[str]] = {}
        if self._truth:
            plots["Precision, recall, F1"] = SCORES[:3]
        plots["Detections, matches, objects"] = COUNTS[1:] if one else COUNTS[3:]
        plots["Clusters"] = COUNTS[:1]
        plots["Time, ms"] = [f"{stage} ms" for stage in STAGES] if one else ["time ms"]
        return plots


def _number(name: str, value: float) -> str:
    if math.isnan(value):
        return "-"
    return f"{value:.3f}" if name in SCORES[:3] else f"{value:.2f}" if name == "error m" else f"{value:.1f}"
