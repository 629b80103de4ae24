"""Summary of a batch: a table of the frames of all bags, worst first, and its page, one HTML file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bevviz.bags.source import iso
from bevviz.extras.batch.causes import Causes, Findings, find_causes
from bevviz.extras.batch.findings import FINDINGS, write_findings
from bevviz.extras.batch.table import NAME, SCHEMA, SEVERITIES, RunInfo, severity
from bevviz.support.files import atomic_write, save_text
from bevviz.support.html import render

SHOWN = 6  # number of remarks shown for a frame
LISTED = 1000  # findings on the page, so that it opens at once

Link = Callable[[str, int], str]  # recording ID, frame -> address that opens it


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
    false_causes: str = ""  # number of false objects by cause, in words

    @property
    def start(self) -> str:
        """Date and time of the first frame, to the second."""
        return iso(self.first)[:19].replace("T", " ")


def page(
    title: str,
    bags: Sequence[BagTotals],
    worst: Sequence[Mapping[str, Any]],
    failed: Sequence[tuple[str, str]],
    viewer: str,
    causes: Causes,
) -> str:
    """Return the page as HTML.

    Args:
        title: of the batch.
        bags: totals of each bag.
        worst: rows of the table of frames, worst first.
        failed: name and error of each failed bag.
        viewer: address of a web viewer for the links to frames; empty: there is none.
        causes: causes of the batch.
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
        causes=causes,
        findings=causes.listed(LISTED),
        total=causes.findings.count,
    )


def _worst_frame(row: Mapping[str, Any], viewer: str) -> dict[str, Any]:
    """Return a row of the page. ``address`` opens the frame in a browser, ``command`` in a terminal."""
    stamp = iso(row["stamp"])
    address, command = _opened_by(row["link"], row["recording"], stamp, viewer)
    return {
        "kind": severity(row),
        "badness": row["badness"],
        "recording": row["recording"],
        "number": row["frame"],
        "stamp": stamp,
        "clocks": f"sync {_ms(row['sync_error_ms'])}, TF {_ms(row['tf_age_ms'])}",
        "remarks": row["remarks"][:SHOWN],
        "more": max(0, len(row["remarks"]) - SHOWN),
        "address": address,
        "command": command,
        "picture": row["picture"],
        "above": row["above"],
    }


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


def collect(results: Sequence[tuple[Path, RunInfo]], link: Link | None) -> tuple[pa.Table, list[BagTotals]]:
    """Return the frames of all bags, worst first, and the totals of each bag in the given order.

    Args:
        results: table and description of each bag.
        link: fills the column ``link``; None: the column stays empty.
    """
    tables, bags = [], []
    for path, info in results:
        bag_frames = pq.read_table(path, schema=SCHEMA)
        bags.append(_totals(path.stem, info, bag_frames))
        links = [link(info.recording_id, f) if link else None for f in bag_frames["frame"].to_pylist()]
        tables.append(bag_frames.drop_columns(FINDINGS).append_column("link", pa.array(links, pa.string())))
    columns = [field for field in SCHEMA if field.name != FINDINGS]
    empty = pa.schema([*columns, pa.field("link", pa.string())]).empty_table()
    frames = pa.concat_tables([empty, *(p.replace_schema_metadata(None) for p in tables)])
    order = [("badness", "descending"), ("recording", "ascending"), ("frame", "ascending")]
    return frames.sort_by(order), bags


def _totals(name: str, info: RunInfo, bag_frames: pa.Table) -> BagTotals:
    stamps = np.sort(bag_frames["stamp"].to_numpy().astype(np.int64))
    times = bag_frames["time_ms_total"].to_numpy()
    counts = [field.name for field in SCHEMA if field.type == pa.int32()]
    columns = ["failures", "problems", "missed", "false", "anomalies", "unmatched"]
    kinds = Counter(severity(row) for row in bag_frames.select(columns).to_pylist())
    return BagTotals(
        name=name,
        info=info,
        first=int(stamps[0]),
        duration=float(stamps[-1] - stamps[0]) / 1e9,
        totals={count: int(bag_frames[count].to_numpy().sum(dtype=np.int64)) for count in counts},
        median_ms=float(np.median(times)),
        p95_ms=float(np.percentile(times, 95)),
        kinds={kind: kinds[kind] for kind in SEVERITIES},
        false_causes=_false_causes(bag_frames),
        worst=float(bag_frames["badness"].to_numpy().max()),
    )


def _false_causes(bag_frames: pa.Table) -> str:
    """Return the number of false objects of a bag by cause, the most frequent first."""
    causes = Counter(cause for of_frame in bag_frames["false_causes"].to_pylist() for cause in of_frame or ())
    return ", ".join(f"{count} {cause}" for cause, count in causes.most_common())


def write_summary(
    folder: Path,
    results: Sequence[tuple[Path, RunInfo]],
    failed: Sequence[tuple[str, str]],
    top: int,
    link: Link | None,
    viewer: str,
) -> Path:
    """Write table and page. Return the path of the page.

    Args:
        folder: target.
        results: table and description of each bag.
        failed: name and error of each failed bag.
        top: number of worst frames on the page.
        link: makes the address of a frame; None: the recordings are in no catalog.
        viewer: address of a web viewer; empty: there is none.
    """
    frames, bags = collect(results, link)
    path = folder / f"{NAME}.html"
    stamp_column = frames.schema.get_field_index("stamp")
    in_nanoseconds = frames.set_column(stamp_column, "stamp", frames["stamp"].cast(pa.int64()))
    columns = ["bag", "recording", "frame", "stamp", FINDINGS]
    write_findings(folder, (pq.read_table(table, columns=columns) for table, _ in results))
    causes = find_causes(Findings.load(folder, named=Path()))
    worst = in_nanoseconds.slice(0, top).to_pylist()
    text = page(folder.resolve().name, bags, worst, failed, viewer, causes)
    with atomic_write(folder / f"{NAME}.parquet", "summary") as file:
        pq.write_table(frames, file.path)
    save_text(path, text, "-o")
    return path
