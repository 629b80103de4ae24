"""Page with the summary of a batch: one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote, urlsplit

from bevviz.bags.source import iso
from bevviz.fleet.table import SEVERITIES, RunInfo, severity
from bevviz.support.html import render

SHOWN = 6  # number of remarks shown for a frame


@dataclass(frozen=True, slots=True)
class BagTotals:
    """Totals of one bag."""

    name: str
    info: RunInfo
    first: int  # stamp of the first frame in nanoseconds
    duration: float  # seconds between the first and the last stamp
    totals: Mapping[str, int]  # sum of each count
    median_ms: float
    p95_ms: float
    kinds: Mapping[str, int]  # number of frames by severity
    worst: float

    @property
    def start(self) -> str:
        """Date and time of the first frame, to the second."""
        return iso(self.first)[:19].replace("T", " ")


@dataclass(frozen=True, slots=True)
class WorstFrame:
    """Row of the page. ``address`` and ``command`` open the frame in a browser and in a terminal."""

    kind: str
    badness: float
    recording: str
    number: int
    stamp: str
    clocks: str
    remarks: Sequence[str]
    more: int  # number of remarks not shown
    address: str
    command: str
    picture: bytes | None  # JPEG of the first camera
    above: bytes | None  # JPEG of the bird's-eye view


def page(
    title: str,
    bags: Sequence[BagTotals],
    worst: Sequence[Mapping[str, Any]],
    failed: Sequence[tuple[str, str]],
    viewer: str,
) -> str:
    """Return the page as HTML.

    Args:
        title: of the batch.
        bags: totals of each bag.
        worst: rows of the table of frames, worst first.
        failed: name and error of each failed bag.
        viewer: address of a web viewer for the links to frames; empty: there is none.
    """
    return render(
        "batch.html",
        title=title,
        bags=bags,
        evaluated=any(bag.info.metrics is not None for bag in bags),
        frames=sum(bag.info.frames for bag in bags),
        minutes=sum(bag.duration for bag in bags) / 60,
        severities=SEVERITIES,
        kinds={kind: sum(bag.kinds[kind] for bag in bags) for kind in SEVERITIES},
        failed=failed,
        warnings=[(bag.name, text) for bag in bags for text in bag.info.warnings],
        worst=[_worst_frame(row, viewer) for row in worst],
    )


def _worst_frame(row: Mapping[str, Any], viewer: str) -> WorstFrame:
    stamp = iso(row["stamp"])
    address, command = _opened_by(row["link"], row["recording"], stamp, viewer)
    return WorstFrame(
        kind=severity(row),
        badness=row["badness"],
        recording=row["recording"],
        number=row["frame"],
        stamp=stamp,
        clocks=f"sync {_ms(row['sync_error_ms'])}, TF {_ms(row['tf_age_ms'])}",
        remarks=row["remarks"][:SHOWN],
        more=max(0, len(row["remarks"]) - SHOWN),
        address=address,
        command=command,
        picture=row["picture"],
        above=row["above"],
    )


def _opened_by(link: str | None, recording: str, stamp: str, viewer: str) -> tuple[str, str]:
    """Return address and command that open a frame. The one that does not apply is empty."""
    if not link:
        return "", f"bevviz open {recording}.rrd --at {stamp}"
    if urlsplit(link).scheme not in ("rerun", "rerun+http", "rerun+https"):
        raise ValueError(f"{link}: no address of a recording")
    if viewer:
        return f"{viewer}/?url={quote(link, safe='')}", ""
    return link, f"rerun '{link}'"


def _ms(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.1f} ms"
