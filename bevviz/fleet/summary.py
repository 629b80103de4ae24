"""One table of the frames of all bags, worst first, and the page that shows it."""

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
from bevviz.support.files import save, written

NAME = "summary"

Link = Callable[[str, int], str]  # recording id, frame -> what opens it


def collect(results: Sequence[tuple[Path, RunInfo]], link: Link | None) -> tuple[pa.Table, list[BagTotals]]:
    """The frames of all bags, worst first, and the totals of each bag in the order given.

    Args:
        results: table and its description for each bag.
        link: fills the column ``link``; None leaves it empty.
    """
    parts, bags = [], []
    for path, info in results:
        part = pq.read_table(path, schema=SCHEMA)
        bags.append(_totals(path.stem, info, part))
        links = [link(info.recording_id, f) if link else None for f in part["frame"].to_pylist()]
        parts.append(part.append_column("link", pa.array(links, pa.string())))
    empty = SCHEMA.append(pa.field("link", pa.string())).empty_table()
    frames = pa.concat_tables([empty, *(p.replace_schema_metadata(None) for p in parts)])
    order = [("badness", "descending"), ("recording", "ascending"), ("frame", "ascending")]
    return frames.sort_by(order), bags


def head(frames: pa.Table, count: int) -> list[dict[str, Any]]:
    """The first rows; stamps in nanoseconds."""
    at = frames.schema.get_field_index("stamp")
    stamps = frames["stamp"].cast(pa.int64())
    rows: list[dict[str, Any]] = frames.set_column(at, "stamp", stamps).slice(0, count).to_pylist()
    return rows


def _totals(name: str, info: RunInfo, part: pa.Table) -> BagTotals:
    stamps = np.sort(part["stamp"].to_numpy().astype(np.int64))
    times = part["time_ms_total"].to_numpy()
    counts = [field.name for field in SCHEMA if field.type == pa.int32()]
    return BagTotals(
        name=name,
        info=info,
        first=int(stamps[0]),
        duration=float(stamps[-1] - stamps[0]) / 1e9,
        totals={count: int(part[count].to_numpy().sum(dtype=np.int64)) for count in counts},
        median_ms=float(np.median(times)),
        p95_ms=float(np.percentile(times, 95)),
        kinds=_kinds(part),
        worst=float(part["badness"].to_numpy().max()),
    )


def _kinds(part: pa.Table) -> dict[str, int]:
    columns = ["failures", "problems", "missed", "false", "anomalies", "unmatched"]
    found = Counter(severity(row) for row in part.select(columns).to_pylist())
    return {kind: found[kind] for kind in SEVERITIES}


def write_summary(
    folder: Path,
    results: Sequence[tuple[Path, RunInfo]],
    failed: Sequence[tuple[str, str]],
    top: int,
    link: Link | None,
    viewer: str,
) -> Path:
    """Write both. Returns where the page is.

    Args:
        folder: where to.
        results: table and its description for each bag.
        failed: name of each bag that failed, and why.
        top: worst frames on the page.
        link: what opens a frame; None: recordings are in no catalog.
        viewer: address of a web viewer; empty: none is served.
    """
    frames, bags = collect(results, link)
    path = folder / f"{NAME}.html"
    text = page(folder.resolve().name, bags, head(frames, top), failed, viewer)
    with written(folder / f"{NAME}.parquet", "summary") as file:
        pq.write_table(frames, file.path)
    save(path, text, "-o")
    return path
