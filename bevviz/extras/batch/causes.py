"""Causes of a batch: what missed and false objects and anomalies have in common, in words."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import zip_longest
from pathlib import Path
from typing import Annotated

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from bevviz.bags.source import iso
from bevviz.errors import UserError
from bevviz.extras.batch.condition_search import LEAST_UNITS, Attribute, Condition, Slice, find_slices
from bevviz.extras.batch.findings import FINDINGS
from bevviz.model.frame import F32, I64, Bool
from bevviz.model.reasons import ReasonKind, facts_of
from bevviz.support import table as text_table
from bevviz.support.json_form import LEFT_OUT, WhereKnown, json_form, rounded

MOST = 30  # causes of one kind
# Limits of a cause. A condition below them says which objects are hard, and not why they are lost.
ONE_REASON = 0.5  # least share of its findings that have the same reason
HARD = frozenset({"points", "range_m"})  # attributes that alone make an object hard, in any drive
LEAST_LIFT, PLAIN_LIFT = 3.0, 5.0  # least ratio to the usual rate: where it is the rule, and elsewhere
THE_RULE = 0.5  # rate under the condition from which it is the rule there
EXAMPLES = 3
SAME_OBJECT = 10  # consecutive frames whose findings of one class count as one object, where no id is known
CHANGED = 2.0  # ratio of rates from which a cause has come or gone between two batches
SURE = 6.6  # twice the log-likelihood ratio from which two rates differ: 1 % of chance

BASES = {  # outcome of a finding -> the outcome that it is compared with; empty: nothing is like it
    "missed": "found",
    "false": "found",
    "contradicted": "found",
    "doubtful": "found",
    "lost": "found",
    "unexplained": "found",
    "unnamed": "",
    "anomaly": "quiet",
}


def _decades(low: int, high: int) -> F32:
    """Return 1, 1.5, 2, 3, 5, 7 times each power of ten."""
    return np.array([m * 10.0**k for k in range(low, high) for m in (1, 1.5, 2, 3, 5, 7)], np.float32)


def _steps(low: float, high: float, step: float) -> F32:
    """Return the multiples of a step from ``low`` to below ``high``."""
    return np.array([round(low + i * step, 3) for i in range(round((high - low) / step))], np.float32)


@dataclass(frozen=True, slots=True)
class Scale:
    """Bins of a number, and its words.

    Attributes:
        edges: ascending lower edges of all bins but the first.
        words: text for above, below and between bounds; ``{a}`` and ``{b}`` are the bounds.
        factor: factor of the bounds in words.
    """

    edges: F32
    words: tuple[str, str, str]
    factor: float = 1.0

    def text(self, low: float | None, high: float | None) -> str:
        """Return the words for an interval. None: open."""
        above, below, between = self.words
        pattern = between if low is not None and high is not None else above if high is None else below
        bounds = {n: f"{v * self.factor:,.6g}" for n, v in (("a", low), ("b", high)) if v is not None}
        if low is not None:
            bounds["c"] = f"{(1 - low) * self.factor:g}"
        return pattern.format(**bounds)


class _Bearing(Scale):
    """Angle from straight ahead, positive to the left."""

    def text(self, low: float | None, high: float | None) -> str:
        def side(angle: float) -> str:
            return f"{abs(angle):g}° {'left' if angle > 0 else 'right'}" if angle else "straight ahead"

        if high is None and low is not None:
            return f"more than {low:g}° to the left" if low > 0 else f"left of {side(low)}"
        if low is None and high is not None:
            return f"more than {-high:g}° to the right" if high < 0 else f"right of {side(high)}"
        assert low is not None and high is not None
        return f"from {side(low)} to {side(high)}"


SCALES: Mapping[str, Scale] = {
    "range_m": Scale(_steps(2.5, 100, 2.5), ("beyond {a} m", "nearer than {b} m", "{a} to {b} m away")),
    "bearing_deg": _Bearing(_steps(-175, 180, 5), ("", "", "")),
    "length_m": Scale(
        np.array(
            [0.3, 0.4, 0.5, 0.6, 0.8, 1, 1.25, 1.5, 2, 2.5, 3, 3.5, 4, 4.5, 5, 6, 8, 10, 15], np.float32
        ),
        ("longer than {a} m", "shorter than {b} m", "{a} to {b} m long"),
    ),
    "height_m": Scale(_steps(0.3, 4, 0.1), ("higher than {a} m", "lower than {b} m", "{a} to {b} m high")),
    "points": Scale(
        _decades(0, 5), ("with {a} points or more", "with fewer than {b} points", "with {a} to {b} points")
    ),
    "gap_m": Scale(
        np.array([0.5, 0.75, 1, 1.25, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10, 15, 20], np.float32),
        (
            "with no other object within {a} m",
            "with another object within {b} m",
            "with the next object {a} to {b} m off",
        ),
    ),
    "u": Scale(
        _steps(0.05, 1, 0.05),
        (
            "in the right {c} % of the image",
            "in the left {b} % of the image",
            "at {a} to {b} % of the image's width",
        ),
        100,
    ),
    "v": Scale(
        _steps(0.05, 1, 0.05),
        (
            "in the lower {c} % of the image",
            "in the upper {b} % of the image",
            "at {a} to {b} % of the image's height",
        ),
        100,
    ),
    "score": Scale(
        _steps(0.05, 1, 0.05),
        ("with a score above {a}", "with a score below {b}", "with a score of {a} to {b}"),
    ),
    "brightness": Scale(
        _steps(10, 255, 10),
        (
            "in images brighter than {a} of 255",
            "in images darker than {b} of 255",
            "in images of brightness {a} to {b} of 255",
        ),
    ),
    "scan_points": Scale(
        _decades(2, 6),
        (
            "in scans of {a} points or more",
            "in scans of fewer than {b} points",
            "in scans of {a} to {b} points",
        ),
    ),
    "scan_range_m": Scale(
        _steps(5, 120, 5),
        (
            "in scans with 5 % of the points beyond {a} m",
            "in scans with 95 % of the points within {b} m",
            "in scans with 95 % of the points within {a} to {b} m",
        ),
    ),
    "speed_mps": Scale(
        _steps(0.5, 40, 0.5), ("at more than {a} m/s", "at less than {b} m/s", "at {a} to {b} m/s")
    ),
    "time_s": Scale(
        np.array([0.5, 1, 1.5, 2, 3, 4, 5, 7, 10, 15, 20, 30, 45, 60, 90, *range(120, 3600, 60)], np.float32),
        ("after {a} s of the drive", "in the first {b} s of the drive", "{a} to {b} s into the drive"),
    ),
    "hour": Scale(_steps(1, 24, 1), ("after {a}:00 UTC", "before {b}:00 UTC", "from {a}:00 to {b}:00 UTC")),
}
NAMES: Mapping[str, str] = {  # attributes without an order, with their words
    "class": "{}",
    "camera": "in camera {}",
    "folder": "in drives from {}",
    "recording": "in drive {}",
}
OF_FRAMES = (
    *("brightness", "scan_points", "scan_range_m", "speed_mps", "time_s", "hour", "folder", "recording"),
)
ORDER = ("class", *SCALES, *NAMES)  # of the words in a sentence


@dataclass(frozen=True, slots=True)
class Bound:
    """Condition on one attribute: a value, or an interval."""

    attribute: str
    value: str | None = None
    low: float | None = None
    """null: open"""
    high: float | None = None
    """null: open"""

    @property
    def text(self) -> str:
        """The condition in words."""
        if self.value is not None:
            return NAMES[self.attribute].format(self.value)
        return SCALES[self.attribute].text(self.low, self.high)

    def holds(self, findings: Findings) -> Bool:
        """Return (N,) whether the condition holds. It does not where the attribute is unknown."""
        if self.value is not None:
            names, codes = findings.words(self.attribute)
            return np.asarray(codes == (names.index(self.value) if self.value in names else -2), bool)
        number = findings.number(self.attribute)
        low = -np.inf if self.low is None else self.low
        with np.errstate(invalid="ignore"):
            return np.asarray((number >= low) & (number < (np.inf if self.high is None else self.high)), bool)


class Findings:
    """Table of findings, with its columns as arrays.

    Args:
        table: rows as in ``findings.parquet``.
        folder: folder of the batch.
    """

    def __init__(self, table: pa.Table, folder: Path) -> None:
        self.table, self.folder = table, folder
        self._numbers: dict[str, F32] = {}
        self._words: dict[str, tuple[list[str], NDArray[np.int32]]] = {}

    @classmethod
    def load(cls, folder: Path, named: Path | None = None) -> Findings:
        """Read the findings of a batch.

        Args:
            folder: folder of the batch.
            named: the folder in commands; None: as it is.

        Raises:
            UserError: there are none, or they cannot be read.
        """
        path = folder / f"{FINDINGS}.parquet"
        if not path.is_file():
            raise UserError(
                f"{folder}: no {path.name} in it; 'bevviz batch BAGS -o {folder}' writes it, and of an older "
                f"batch 'bevviz batch BAGS -o {folder} --force'"
            )
        try:
            return cls(pq.read_table(path), folder if named is None else named)
        except (OSError, ValueError, pa.ArrowException) as error:
            raise UserError(
                f"{path}: cannot be read ({error}); 'bevviz batch -o {folder}' writes it anew"
            ) from None

    def __len__(self) -> int:
        return int(self.table.num_rows)

    @property
    def count(self) -> int:
        """Number of findings, without found objects and quiet frames."""
        return sum(int(self.is_word("outcome", kind).sum()) for kind in BASES)

    def number(self, name: str) -> F32:
        """Return the (N,) numbers of a column, NaN where unknown."""
        if name not in self._numbers:
            self._numbers[name] = self.table[name].to_numpy().astype(np.float32)
        return self._numbers[name]

    def words(self, name: str) -> tuple[list[str], NDArray[np.int32]]:
        """Return the different words of a column, and the (N,) index of each row, -1: none."""
        if name not in self._words:
            column = self.table["bag" if name == "folder" else name].combine_chunks()
            coded = column.dictionary_encode()
            names, codes = coded.dictionary.to_pylist(), coded.indices.fill_null(-1).to_numpy()
            if name == "folder":
                folders = [Path(bag).parent.name for bag in names]
                names = sorted(set(folders))
                codes = np.array([names.index(f) for f in folders] + [-1], np.int32)[codes]
            codes = codes.astype(np.int32)
            if "" in names:
                codes[codes == names.index("")] = -1
            self._words[name] = names, codes
        return self._words[name]

    def is_word(self, name: str, word: str) -> Bool:
        """Return (N,) whether a column has this word."""
        names, codes = self.words(name)
        return np.asarray(codes == (names.index(word) if word in names else -2), bool)

    def reasons(self) -> Counter[str]:
        """Return the number of missed and false objects by reason."""
        wrong = self.is_word("outcome", "missed") | self.is_word("outcome", "false")
        return _reasons(self, np.flatnonzero(wrong))

    @cached_property
    def units(self) -> I64:
        """(N,) number of the object of each row. Findings of one object in several frames share it."""
        _, drive = self.words("recording")
        names, objects = self.words("object")
        _, classes = self.words("class")
        frame = self.table["frame"].to_numpy().astype(np.int64)
        piece = np.where(objects >= 0, objects, len(names) + 1 + frame // SAME_OBJECT * 64 + classes % 64)
        _, units = np.unique(np.stack([drive.astype(np.int64), piece]), axis=1, return_inverse=True)
        return np.asarray(units.ravel(), np.int64)


@dataclass(frozen=True, slots=True)
class ListedFinding:
    """One finding."""

    kind: str
    recording: str
    frame: int
    reason: str
    label: str
    """class"""
    range_m: float | None
    text: str
    command: str
    """opens the frame in the workbench"""


@dataclass(frozen=True, slots=True)
class Cause:
    """Findings with a condition in common."""

    kind: str
    """missed, false, contradicted, doubtful, lost, unexplained or anomaly"""
    reason: str
    """of all findings, or of most"""
    text: str
    """conditions in words"""
    conditions: Sequence[Bound]
    count: int
    drives: int
    among: int
    """findings and what they are compared with, under the conditions"""
    lift: Annotated[float, rounded(3)]
    """ratio to the usual rate"""
    reasons: Mapping[str, int]
    examples: Sequence[ListedFinding]
    rows: Annotated[I64, LEFT_OUT]  # of the findings

    @property
    def title(self) -> str:
        """Number, outcome and conditions in one sentence."""
        why = f" ({self.reason})" if self.reason else ""
        outcome = f"{self.count} {self.kind if self.count == 1 or self.kind != 'anomaly' else 'anomalies'}"
        return f"{outcome}{why} in {self.drives} drive{'s' * (self.drives != 1)}: {self.text}"

    @property
    def decided_by(self) -> str:
        """The stage of its reason and the parameter that decides, in words; empty: an anomaly."""
        stage = facts_of(self.reason).stage
        parameter = "" if self.reason == ReasonKind.NOT_DETECTED else facts_of(self.reason).decides
        return f"stage {stage}{f', {parameter} decides' if parameter else ''}" if stage else ""


@dataclass(frozen=True, slots=True)
class ComparedCause:
    """Cause of one batch, and its counts in the other."""

    state: str
    """new, gone or as before"""
    kind: str
    reason: str
    text: str
    count: int
    among: int
    other: int
    other_among: int
    title: Annotated[str, LEFT_OUT]


@json_form
@dataclass(frozen=True, slots=True)
class CausesResult:
    """Causes of a batch."""

    batch: str
    findings: Mapping[str, int]
    """number by kind"""
    causes: Sequence[Cause]
    """largest first"""
    rest: Mapping[str, Mapping[str, int]]
    """number of the other findings by kind and reason"""
    compared: WhereKnown[Sequence[ComparedCause]] = None
    """with --against"""


@dataclass(frozen=True)
class Causes:
    """Causes of a batch, the largest first.

    Attributes:
        findings: table of the batch.
        causes: groups with a common condition.
        rest: number of the other findings by kind and reason.
    """

    findings: Findings
    causes: tuple[Cause, ...]
    rest: Mapping[str, Counter[str]]

    @property
    def totals(self) -> Mapping[str, int]:
        """Number of all findings by kind."""
        return {kind: int(self.findings.is_word("outcome", kind).sum()) for kind in BASES}

    def lines(self, top: int) -> Iterator[str]:
        """Yield the causes for the terminal."""
        drives = len(set(self.findings.words("recording")[1].tolist()))
        totals = self.totals
        counts = [f"{n} {kind}" for kind, n in totals.items() if n]
        yield f"{drives} drives; {', '.join(counts) or 'nothing missed, nothing false, no anomaly'}"
        for number, cause in enumerate(self.causes[:top], 1):
            yield ""
            yield f"{number}. {cause.title}"
            share = 100 * cause.count / max(totals[cause.kind], 1)
            if cause.decided_by:
                yield f"   {cause.decided_by}"
            yield (
                f"   {share:.0f} % of all {cause.kind}; {100 * cause.count / cause.among:.0f} % under this "
                f"condition, {cause.lift:.1f} times the usual rate"
            )
            if len(cause.reasons) > 1:
                yield "   " + ", ".join(
                    f"{n} {reason or 'other'}" for reason, n in list(cause.reasons.items())[:4]
                )
            for example in cause.examples:
                yield f"   {example.command}"
        if self.causes[top:]:
            yield f"\n{len(self.causes) - top} more causes: --top {len(self.causes)}"
        rest = [
            (kind, reason or "-", str(n))
            for kind, reasons in self.rest.items()
            for reason, n in reasons.most_common()
        ]
        if rest:
            yield "\nwithout a condition in common:"
            yield from text_table.lines([("kind", "reason", "number"), *rest])

    def listed(self, most: int) -> list[ListedFinding]:
        """Return findings for a page: as many of each cause, then others."""
        kinds = [self.findings.is_word("outcome", kind) for kind in BASES]
        caused = np.concatenate([*(cause.rows for cause in self.causes), np.zeros(0, np.int64)])
        others = np.setdiff1d(np.flatnonzero(np.logical_or.reduce(kinds)), caused)
        turns = [_spread(self.findings, cause.rows, most).tolist() for cause in self.causes]
        in_turn = [row for turn in zip_longest(*turns) for row in turn if row is not None]
        rows = [*in_turn[:most], *_spread(self.findings, others, max(0, most - len(in_turn))).tolist()]
        return _findings_at(self.findings, np.array(rows, np.int64))

    def result(self, top: int, compared: Sequence[ComparedCause] | None = None) -> CausesResult:
        """Return the first causes, and the comparison with another batch."""
        rest = {kind: dict(reasons.most_common()) for kind, reasons in self.rest.items()}
        return CausesResult(str(self.findings.folder), self.totals, self.causes[:top], rest, compared)


def _spread(findings: Findings, rows: I64, most: int) -> I64:
    """Return some of the rows, of as many drives as possible."""
    drives = findings.words("recording")[1][rows]
    # The n-th finding of each drive comes before the (n + 1)-th of any.
    order = np.argsort(drives, kind="stable")
    first = np.flatnonzero(np.r_[True, np.diff(drives[order]) != 0]) if len(rows) else order
    turn = np.arange(len(order)) - np.repeat(first, np.diff(np.r_[first, len(order)]))
    return np.asarray(rows[order[np.argsort(turn, kind="stable")[:most]]], np.int64)


def _findings_at(findings: Findings, rows: I64) -> list[ListedFinding]:
    """Return findings with the command that opens each."""
    columns = ["recording", "frame", "stamp", "outcome", "reason", "class", "range_m", "text"]
    chosen = findings.table.select(columns).take(pa.array(rows))
    chosen = chosen.set_column(2, "stamp", chosen["stamp"].cast(pa.int64()))
    opened = []
    for row in chosen.to_pylist():
        recording, distance = row["recording"], row["range_m"]
        opened.append(
            ListedFinding(
                kind=row["outcome"],
                recording=recording,
                frame=row["frame"],
                reason=row["reason"] or "",
                label=row["class"] or "",
                range_m=None if distance is None or math.isnan(distance) else round(distance, 1),
                text=row["text"] or "",
                command=f"bevviz open {findings.folder / f'{recording}.rrd'} --at {iso(row['stamp'])}",
            )
        )
    return opened


def find_causes(findings: Findings) -> Causes:
    """Find the causes of a batch."""
    causes, rest = list[Cause](), dict[str, Counter[str]]()
    for kind, base in BASES.items():
        outcomes = findings.is_word("outcome", kind)
        bases = findings.is_word("outcome", base)
        if not outcomes.any():
            continue
        rows = np.flatnonzero(outcomes | bases)
        found = _causes_of(findings, kind, rows) if bases.any() else []
        causes += found
        left = np.setdiff1d(np.flatnonzero(outcomes), np.concatenate([*(c.rows for c in found), rows[:0]]))
        if len(left):
            rest[kind] = _reasons(findings, left)
    return Causes(findings, tuple(sorted(causes, key=lambda cause: -cause.count)), rest)


def _causes_of(findings: Findings, kind: str, rows: I64) -> list[Cause]:
    """Return the causes of one kind of findings.

    Args:
        findings: of the batch.
        kind: kind of the findings.
        rows: rows of these and of what they are compared with.
    """
    positive = findings.is_word("outcome", kind)[rows]
    units = findings.units[rows]
    names, reasons = findings.words("reason")
    targets = {"": positive}
    for code, reason in enumerate(names):
        of_reason = positive & (reasons[rows] == code)
        if len(np.unique(units[of_reason])) >= LEAST_UNITS:
            targets[reason] = of_reason
    scales = [*_attributes(findings, kind, rows, positive)]

    def accepts(found: Slice) -> bool:
        rate = len(found.positives) / len(found.rows)
        lift = rate / float(targets[found.target].mean())
        is_plain = lift >= (LEAST_LIFT if rate >= THE_RULE else PLAIN_LIFT)
        [(reason, most)] = _reasons(findings, rows[found.positives]).most_common(1)
        named = {condition.attribute for condition in found.conditions} - {"class"}
        # A far object of few points is lost by any detector. That is a cause where another stage loses it.
        is_hard = bool(named) and named <= HARD and facts_of(reason).stage in ("", "sensors", "detector")
        return is_plain and most >= ONE_REASON * len(found.positives) and not is_hard

    slices = find_slices([attribute for attribute, _ in scales], targets, units, MOST, accepts)
    resolve = {attribute.name: resolve for attribute, resolve in scales}
    return [_cause(findings, kind, rows, found, resolve, targets) for found in slices]


def _cause(
    findings: Findings,
    kind: str,
    rows: I64,
    found: Slice,
    resolve: Mapping[str, Callable[[Condition], Bound]],
    targets: Mapping[str, Bool],
) -> Cause:
    """Return a slice as a cause."""
    positives = rows[found.positives]
    conditions = [resolve[condition.attribute](condition) for condition in found.conditions]
    reasons = dict(_reasons(findings, positives).most_common())
    return Cause(
        kind=kind,
        reason=next(iter(reasons)),
        text=_text(kind, conditions),
        conditions=conditions,
        count=len(positives),
        drives=len(np.unique(findings.words("recording")[1][positives])),
        among=len(found.rows),
        lift=len(positives) / len(found.rows) / float(targets[found.target].mean()),
        reasons=reasons,
        examples=_findings_at(findings, _spread(findings, positives, EXAMPLES)),
        rows=positives,
    )


def _text(kind: str, conditions: Sequence[Bound]) -> str:
    """Return conditions in words."""
    texts = {bound.attribute: bound.text for bound in conditions}
    name = texts.pop("class", "")
    noun = f"{name}{'es' if name.endswith(('s', 'x', 'ch', 'sh')) else 's'}" if name else "all objects"
    if kind == "anomaly":
        noun = "all frames"
    return ", ".join([noun, *(texts[name] for name in ORDER if name in texts)])


def _reasons(findings: Findings, rows: I64) -> Counter[str]:
    names, codes = findings.words("reason")
    counts = Counter(codes[rows].tolist())
    return Counter({names[code] if code >= 0 else "": n for code, n in counts.items()})


def _attributes(
    findings: Findings, kind: str, rows: I64, positive: Bool
) -> Iterator[tuple[Attribute, Callable[[Condition], Bound]]]:
    """Yield the attributes that are known of both sides and vary, with the words for their conditions."""
    for name, scale in SCALES.items():
        number = findings.number(name)[rows]
        known = np.isfinite(number)
        if (kind == "anomaly" and name not in OF_FRAMES) or not _is_known(known, positive):
            continue
        codes = np.where(known, np.digitize(number, scale.edges), -1).astype(np.int16)
        if codes[known].min() == codes[known].max():
            continue
        yield (
            Attribute(name, codes, len(scale.edges) + 1, ordered=True),
            _interval(name, scale, int(codes[known].min()), int(codes[known].max())),
        )
    for name in NAMES:
        words, all_codes = findings.words(name)
        codes = all_codes[rows].astype(np.int16)
        if (kind == "anomaly" and name not in OF_FRAMES) or not _is_known(codes >= 0, positive):
            continue
        if len(np.unique(codes[codes >= 0])) > 1:
            yield Attribute(name, codes, len(words), ordered=False), _named(name, words)


def _is_known(known: Bool, positive: Bool) -> bool:
    """Return whether an attribute is about as often known with the outcome as without it."""
    return bool(positive.any() and known[positive].mean() > 0.5 and known[~positive].mean() > 0.5)


def _interval(name: str, scale: Scale, lowest: int, highest: int) -> Callable[[Condition], Bound]:
    """Return a function from bins to an interval. It is open where there is no row beyond."""

    def resolve(condition: Condition) -> Bound:
        low = None if condition.first <= lowest else float(scale.edges[condition.first - 1])
        high = None if condition.last >= highest else float(scale.edges[condition.last])
        return Bound(name, low=_short(low), high=_short(high))

    return resolve


def _short(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.6g}")


def _named(name: str, words: Sequence[str]) -> Callable[[Condition], Bound]:
    return lambda condition: Bound(name, value=words[condition.first])


# --- two batches -------------------------------------------------------------------------------


def compare_causes(new: Causes, old: Causes) -> list[ComparedCause]:
    """Return the new causes, those that are gone, and the others."""
    compared = [_compared(cause, old.findings, "new") for cause in new.causes]
    gone = [_compared(cause, new.findings, "gone") for cause in old.causes]
    return sorted(
        [*compared, *(c for c in gone if c.state == "gone")],
        key=lambda c: (["new", "gone", "as before"].index(c.state), -c.count),
    )


def _compared(cause: Cause, other: Findings, changed: str) -> ComparedCause:
    """Look for a cause in another batch. It has changed if its rate there is plainly lower."""
    inside = other.is_word("outcome", cause.kind) | other.is_word("outcome", BASES[cause.kind])
    for bound in cause.conditions:
        # Drives of another batch have other names.
        inside &= bound.holds(other) if bound.attribute != "recording" else True
    hits = inside & other.is_word("outcome", cause.kind)
    if len(cause.reasons) == 1 and cause.reason:
        hits &= other.is_word("reason", cause.reason)
    n, p = int(inside.sum()), int(hits.sum())
    rate, other_rate = cause.count / cause.among, p / max(n, 1)
    sure = _rates_differ(cause.count, cause.among, p, n)
    is_changed = rate > CHANGED * other_rate and (sure or not n)
    return ComparedCause(
        state=changed if is_changed else "as before",
        kind=cause.kind,
        reason=cause.reason,
        text=cause.text,
        count=cause.count,
        among=cause.among,
        other=p,
        other_among=n,
        title=cause.title,
    )


def _rates_differ(p: int, n: int, q: int, m: int) -> bool:
    """Return whether p of n and q of m differ by more than chance."""

    def likelihood(hits: int, number: int) -> float:
        return sum(k * math.log(k / number) for k in (hits, number - hits) if k)

    if not n or not m:
        return False
    return 2 * (likelihood(p, n) + likelihood(q, m) - likelihood(p + q, n + m)) > SURE


def comparison_lines(compared: Sequence[ComparedCause]) -> Iterator[str]:
    """Yield the comparison for the terminal."""
    counts = Counter(c.state for c in compared)
    yield ", ".join(f"{counts[state]} causes {state}" for state in ("new", "gone", "as before"))
    for c in compared:
        here = f"{c.count} of {c.among}"
        there = f"{c.other} of {c.other_among}" if c.other_among else "nothing to compare with"
        pair = f"{here} -> {there}" if c.state == "gone" else f"{there} -> {here}"
        yield f"{c.state}: {c.title} ({pair})"
