"""Summary of a batch: a table of the frames of all bags, worst first, and its page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bevviz.fleet.page import BagTotals, page
from bevviz.fleet.table import SCHEMA, SEVERITIES, RunInfo, severity
from bevviz.support.files import atomic_write, save_text

NAME = "summary"

Link = Callable[[str, int], str]  # recording ID, frame -> address that opens it


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
        tables.append(bag_frames.append_column("link", pa.array(links, pa.string())))
    empty = SCHEMA.append(pa.field("link", pa.string())).empty_table()
    frames = pa.concat_tables([empty, *(p.replace_schema_metadata(None) for p in tables)])
    order = [("badness", "descending"), ("recording", "ascending"), ("frame", "ascending")]
    return frames.sort_by(order), bags


def head(frames: pa.Table, count: int) -> list[dict[str, Any]]:
    """Return the first rows, with stamps in nanoseconds."""
    at = frames.schema.get_field_index("stamp")
    stamps = frames["stamp"].cast(pa.int64())
    rows: list[dict[str, Any]] = frames.set_column(at, "stamp", stamps).slice(0, count).to_pylist()
    return rows


def _totals(name: str, info: RunInfo, bag_frames: pa.Table) -> BagTotals:
    stamps = np.sort(bag_frames["stamp"].to_numpy().astype(np.int64))
    times = bag_frames["time_ms_total"].to_numpy()
    counts = [field.name for field in SCHEMA if field.type == pa.int32()]
    return BagTotals(
        name=name,
        info=info,
        first=int(stamps[0]),
        duration=float(stamps[-1] - stamps[0]) / 1e9,
        totals={count: int(bag_frames[count].to_numpy().sum(dtype=np.int64)) for count in counts},
        median_ms=float(np.median(times)),
        p95_ms=float(np.percentile(times, 95)),
        kinds=_kinds(bag_frames),
        worst=float(bag_frames["badness"].to_numpy().max()),
    )


def _kinds(bag_frames: pa.Table) -> dict[str, int]:
    columns = ["failures", "problems", "missed", "false", "anomalies", "unmatched"]
    counts = Counter(severity(row) for row in bag_frames.select(columns).to_pylist())
    return {kind: counts[kind] for kind in SEVERITIES}


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
    text = page(folder.resolve().name, bags, head(frames, top), failed, viewer)
    with atomic_write(folder / f"{NAME}.parquet", "summary") as file:
        pq.write_table(frames, file.path)
    save_text(path, text, "-o")
    return path
