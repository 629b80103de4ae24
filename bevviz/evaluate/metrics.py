"""Names of the metrics (``METRIC[.CLASS][@RANGE]``), limits for them, and JUnit XML with the outcome."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal
from xml.etree import ElementTree

from pydantic import PlainSerializer

from bevviz.errors import UserError
from bevviz.evaluate.average_precision import OVERLAPS, VIEWS
from bevviz.evaluate.ground_truth import RANGE
from bevviz.support.text import did_you_mean

EDGES = (0, 10, 20, 30, int(RANGE))  # metres, limits of the ranges that are counted separately

METRICS = {  # name without class and range -> meaning
    "recall": "share of the objects that had to be found",
    "precision": "share of the objects that were reported",
    "f1": "harmonic mean of recall and precision",
    "missed": "objects that had to be found and were not",
    "false": "objects that are nothing",
    "missed_per_frame": "the same, mean of a frame",
    "false_per_frame": "the same, mean of a frame",
    "error_m": "metres between the centres, median",
    "error_90_m": "metres that nine in ten stay below",
    **{f"ap_{v}_{o}": f"average precision, IoU {o} {v}" for v in VIEWS for o in OVERLAPS},
    "hota": "higher order tracking accuracy",
    "deta": "its detection part",
    "assa": "its association part",
    "mota": "CLEAR MOT accuracy",
    "motp_m": "CLEAR MOT precision, metres",
    "idf1": "F1 of identities",
    "id_switches": "times that an object got another track",
    "fragmentations": "times that a track was broken",
    "detection_recall": "image boxes found, IoU 0.5",
    "detection_precision": "image boxes that are right",
    "ground_precision": "points called ground that are",
    "ground_recall": "points of the ground called so",
    "ground_iou": "intersection over union of the two",
    "object_points_kept": "points of objects not called ground",
}


def base_of(name: str) -> str | None:
    """Return METRIC of ``METRIC[.CLASS][@RANGE]``. None: there is no such metric."""
    fitting = [base for base in METRICS if name == base or name.startswith((f"{base}.", f"{base}@"))]
    return max(fitting, key=len, default=None)


def ranges() -> Iterator[tuple[int, int]]:
    """Yield start and end of each range, in metres."""
    return itertools.pairwise(EDGES)


@dataclass(frozen=True, slots=True)
class Limit:
    """Limit for a metric, as in ``--min recall.person=0.8``."""

    metric: str
    side: Literal["min", "max"]
    value: float

    def __str__(self) -> str:
        return f"{self.metric} {'>=' if self.side == 'min' else '<='} {self.value:g}"


@dataclass(frozen=True, slots=True)
class LimitResult:
    """A limit of the gate."""

    limit: Annotated[Limit, PlainSerializer(str, return_type=str)]
    kept: bool
    reason: str
    """empty: it is kept"""


def parse_limits(least: Sequence[str], most: Sequence[str]) -> list[Limit]:
    """Parse the values of ``--min`` and ``--max``.

    Raises:
        UserError: a value is not NAME=NUMBER, or there is no metric of that name.
    """
    values: list[tuple[Literal["min", "max"], str]] = [("min", text) for text in least]
    values += [("max", text) for text in most]
    return [_limit(side, text) for side, text in values]


def _limit(side: Literal["min", "max"], text: str) -> Limit:
    name, equals, number = text.partition("=")
    name = name.strip()
    if base_of(name) is None:
        base = name.partition("@")[0]
        hint = did_you_mean(base.partition(".")[0], METRICS) or ";"
        known = ", ".join(METRICS)
        raise UserError(
            f"--{side} {text}: no metric '{base}'{hint} There are {known}; each may have .CLASS and @RANGE"
        )
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not equals or math.isnan(value):
        raise UserError(f"--{side} {text}: expected METRIC=NUMBER, for example --{side} {name}=0.8")
    return Limit(name, side, value)


def check(limits: Sequence[Limit], metrics: Mapping[str, float]) -> list[LimitResult]:
    """Compare the metrics with the limits. A limit whose metric could not be measured is not kept."""
    return [_check_limit(limit, metrics) for limit in limits]


def _check_limit(limit: Limit, metrics: Mapping[str, float]) -> LimitResult:
    value = metrics.get(limit.metric, math.nan)
    if math.isnan(value):
        base, ranged = base_of(limit.metric), "@" in limit.metric
        measured = [name for name in metrics if base_of(name) == base and (ranged or "@" not in name)]
        reason = f"measured were {', '.join(measured)}" if measured else f"nothing there has a {base}"
        return LimitResult(limit, False, f"{limit.metric} could not be measured: {reason}")
    kept = value >= limit.value if limit.side == "min" else value <= limit.value
    return LimitResult(limit, kept, "" if kept else f"{limit.metric} is {value:.4g}, asked for {limit}")


def write_junit(path: Path, suites: Mapping[str, list[LimitResult] | str]) -> None:
    """Write a test suite for each drive with a test case for each limit.

    Args:
        path: the file.
        suites: name of the drive -> outcome of its limits, or the reason why it could not be run.

    Raises:
        UserError: the file cannot be written.
    """
    root = ElementTree.Element("testsuites", name="bevviz evaluate")
    for drive, results in suites.items():
        suite = ElementTree.SubElement(root, "testsuite", name=_plain(drive))
        if isinstance(results, str):
            case = ElementTree.SubElement(suite, "testcase", classname=_plain(drive), name="run")
            ElementTree.SubElement(case, "error", message=_plain(results))
            suite.attrib |= {"tests": "1", "failures": "0", "errors": "1"}
            continue
        failures = sum(bool(result.reason) for result in results)
        suite.attrib |= {"tests": str(len(results)), "failures": str(failures), "errors": "0"}
        for result in results:
            case = ElementTree.SubElement(suite, "testcase", classname=_plain(drive), name=str(result.limit))
            if result.reason:
                ElementTree.SubElement(case, "failure", message=_plain(result.reason))
    ElementTree.indent(root)
    try:
        ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
    except OSError as error:
        raise UserError(f"--junit {path}: cannot be written: {error.strerror}") from None


def _plain(text: str) -> str:
    """Replace characters that XML does not allow."""
    return "".join(c if c.isprintable() else "?" for c in text)
