"""The summary as a web page that needs nothing but itself."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any
from urllib.parse import quote, urlsplit

from bevviz.bags.source import iso
from bevviz.batch.table import RunInfo


@dataclass(frozen=True, slots=True)
class BagTotals:
    """The totals of one bag."""

    name: str
    info: RunInfo
    first: int  # stamp of the first frame
    duration: float  # seconds between the first and the last stamp
    totals: Mapping[str, int]  # of each count
    median_ms: float
    p95_ms: float
    bad: int  # frames in which something went wrong
    worst: float

    @property
    def matched(self) -> float:
        """Part of the detections that found a cluster; NaN where there were none."""
        kept = self.totals["detections"]
        return self.totals["matched"] / kept if kept else math.nan


SHOWN = 6  # remarks of one frame

STYLE = """
:root { color-scheme: light dark; --line: #8884; --soft: #8882; --faint: #777; --bad: #c0392b; }
@media (prefers-color-scheme: dark) { :root { --faint: #999; --bad: #ff7b6b; } }
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 90rem; padding: 0 1.5rem; }
h1 { font-size: 1.5rem; margin: 0; } h2 { font-size: 1.1rem; margin: 2.2rem 0 .6rem; }
p { margin: .3rem 0; } .faint { color: var(--faint); } .bad { color: var(--bad); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; }
th { text-align: left; font-weight: 600; color: var(--faint); font-size: .85rem; vertical-align: bottom; }
th, td { padding: .35rem .7rem .35rem 0; border-bottom: 1px solid var(--line); }
td { vertical-align: top; } .n { text-align: right; font-variant-numeric: tabular-nums; }
ul { margin: 0; padding-left: 1.1rem; }
code { font-size: .85rem; background: var(--soft); padding: .1rem .3rem; }
.open { white-space: nowrap; } a { color: inherit; }
"""

EXPLAINED = (
    "Badness of a frame: 10 for each failed stage, 3 for each problem (no image, no transform ...), 0.5 for "
    "each anomaly, for each detection without a match its score times 2 (no cluster), 1.5 (too few points), "
    "1 (low overlap, taken) or 0.5 (too far), and the sync error and the age of the transform as parts of "
    "what is tolerated."
)


def render(
    title: str,
    drives: Sequence[BagTotals],
    worst: Sequence[Mapping[str, Any]],
    failed: Sequence[tuple[str, str]],
    viewer: str,
) -> str:
    """The page.

    Args:
        title: of the batch.
        drives: totals of each bag.
        worst: rows of the table of frames, worst first.
        failed: name of each bag that failed, and why.
        viewer: address of a web viewer for the links of the frames; empty: none is served.
    """
    frames = sum(drive.info.frames for drive in drives)
    minutes = sum(drive.duration for drive in drives) / 60
    bad = sum(drive.bad for drive in drives)
    body = [
        f"<h1>{escape(title)}</h1>",
        f"<p class=faint>{len(drives)} bags, {frames} frames, {minutes:.1f} min; "
        f"something went wrong in {bad} frames</p>",
    ]
    if failed:
        items = "".join(f"<li><b>{escape(name)}</b>: {escape(why)}</li>" for name, why in failed)
        body.append(f"<h2 class=bad>{len(failed)} failed</h2><ul>{items}</ul>")
    body += ["<h2>Bags</h2>", _table(_DRIVE_HEADS, map(_drive, drives))]
    if warnings := [(d.name, text) for d in drives for text in d.info.warnings]:
        items = "".join(f"<li><b>{escape(name)}</b>: {escape(text)}</li>" for name, text in warnings)
        body.append(f"<h2>Warnings</h2><ul>{items}</ul>")
    if worst:
        body.append(f"<h2>Worst frames</h2><p class=faint>{EXPLAINED}</p>")
        body.append(_table(_FRAME_HEADS, (_frame(row, viewer) for row in worst)))
    return (
        "<!doctype html><html lang=en><meta charset=utf-8>"
        "<meta name=viewport content='width=device-width, initial-scale=1'>"
        f"<title>{escape(title)}</title><style>{STYLE}</style><body>{''.join(body)}</body></html>\n"
    )


_DRIVE_HEADS = (
    *("bag", "start", "-frames", "-s", "-with remarks", "-failures", "-problems", "-clusters a frame"),
    *("-detections", "-matched", "-no cluster", "-median ms", "-95 % ms", "-worst badness"),
)
_FRAME_HEADS = ("-badness", "bag", "-frame", "stamp", "what is wrong", "open")


def _drive(drive: BagTotals) -> list[str]:
    totals, frames = drive.totals, drive.info.frames
    matched = "" if math.isnan(drive.matched) else f"{drive.matched:.0%}"
    return [
        f"<span title='{escape(drive.info.bag)}'>{escape(drive.name)}</span>",
        iso(drive.first)[:19].replace("T", " "),
        f"{frames}",
        f"{drive.duration:.1f}",
        f"{drive.bad}",
        _alarm(totals["failures"]),
        _alarm(totals["problems"]),
        f"{totals['clusters'] / frames:.1f}",
        f"{totals['detections']}",
        matched,
        f"{totals['no_cluster']}",
        f"{drive.median_ms:.0f}",
        f"{drive.p95_ms:.0f}",
        f"{drive.worst:.2f}",
    ]


def _frame(row: Mapping[str, Any], viewer: str) -> list[str]:
    remarks = [f"<li>{escape(text)}</li>" for text in row["remarks"][:SHOWN]]
    if (more := len(row["remarks"]) - SHOWN) > 0:
        remarks.append(f"<li class=faint>{more} more</li>")
    timing = f"sync {_ms(row['sync_error_ms'])}, TF {_ms(row['tf_age_ms'])}"
    return [
        f"{row['badness']:.2f}",
        escape(row["recording"]),
        f"{row['frame']}",
        f"<span title='{timing}'>{iso(row['stamp'])}</span>",
        f"<ul>{''.join(remarks)}</ul>" if remarks else f"<span class=faint>{timing}</span>",
        _open(row, viewer),
    ]


def _open(row: Mapping[str, Any], viewer: str) -> str:
    link = row["link"]
    if not link:
        return f"<code>rerun {escape(row['recording'])}.rrd</code>"
    if urlsplit(link).scheme not in ("rerun", "rerun+http", "rerun+https"):
        raise ValueError(f"{link}: no address of a recording")
    if viewer:
        address = f"{viewer}/?url={quote(link, safe='')}"
        return f"<a class=open href='{escape(address)}'>in the viewer</a>"
    return f"<a class=open href='{escape(link)}'>in the viewer</a><br><code>rerun '{escape(link)}'</code>"


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A heading that begins with - is that of numbers."""
    kinds = [" class=n" if head.startswith("-") else "" for head in heads]
    top = "".join(f"<th{k}>{escape(h.removeprefix('-'))}</th>" for k, h in zip(kinds, heads, strict=True))
    lines = (
        "<tr>" + "".join(f"<td{k}>{cell}</td>" for k, cell in zip(kinds, row, strict=True)) + "</tr>"
        for row in rows
    )
    return f"<div class=scroll><table><tr>{top}</tr>{''.join(lines)}</table></div>"


def _alarm(count: int) -> str:
    return f"<b class=bad>{count}</b>" if count else "0"


def _ms(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.1f} ms"
