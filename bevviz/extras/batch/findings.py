"""Findings of a batch: a row for each finding and each found object, with attributes to group them by.

A table of frames holds the findings of each frame. ``findings.parquet`` has those of all bags.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from bevviz.findings.frame_findings import Finding
from bevviz.model import geometry
from bevviz.model.box_points import inside_each
from bevviz.model.frame import F64, Boxes3D
from bevviz.model.results import FrameResult
from bevviz.support.files import atomic_write
from bevviz.why import Selection
from bevviz.why.frame_index import FrameIndex
from bevviz.why.subject import projected_box

FINDINGS = "findings"  # name of the table of all bags, and of the column in a table of frames

Row: TypeAlias = dict[str, Any]

# ``outcome`` is ``found``, ``quiet`` (a frame without an anomaly), or the kind of a finding. The kind
# ``unmatched`` has the outcome ``unexplained``.
OUTCOMES = {"unmatched": "unexplained"}
TEXTS = ("outcome", "kind", "reason", "text", "class", "object", "camera")
NUMBERS = (
    *("range_m", "bearing_deg", "length_m", "height_m", "points", "gap_m", "u", "v", "score"),
    *("severity", "brightness", "scan_points", "scan_range_m", "speed_mps", "time_s", "hour"),
)
FINDING = pa.struct([*((name, pa.string()) for name in TEXTS), *((name, pa.float32()) for name in NUMBERS)])
_FRAME = ("bag", "recording", "frame", "stamp")


class FindingCollector:
    """Collector of the findings of a drive and of what they are compared with, frame by frame."""

    def __init__(self) -> None:
        self._start: int | None = None
        self._place: tuple[int, F64] | None = None  # stamp and position of the frame before
        self._speed = math.nan

    def of_frame(self, traces: FrameIndex, findings: Sequence[Finding]) -> list[Row]:
        """Return the rows of the next frame: its findings, and the objects and frames without any."""
        shared = self._frame_attributes(traces.result)
        rows = [*_objects(traces, findings), *_others(traces, findings)]
        if not traces.result.anomalies:
            rows.append({"outcome": "quiet"})
        return [{**shared, **row} for row in rows]

    def _frame_attributes(self, result: FrameResult) -> Row:
        """Return the attributes that all findings of a frame share."""
        frame = result.frame
        self._start = frame.stamp if self._start is None else self._start
        position = frame.pose[:3, 3]
        if self._place is not None and frame.stamp > self._place[0] and frame.world_from_points is not None:
            seconds = (frame.stamp - self._place[0]) * 1e-9
            self._speed = float(np.linalg.norm(position - self._place[1])) / seconds
        self._place = frame.stamp, position
        image = next((c.image for c in frame.cameras if c.image is not None), None)
        ranges = np.hypot(frame.points[:, 0], frame.points[:, 1])
        time = datetime.fromtimestamp(frame.stamp * 1e-9, UTC)
        return {
            "brightness": math.nan if image is None else float(np.median(image.bgr[::8, ::8])),
            "scan_points": float(len(ranges)),
            "scan_range_m": float(np.percentile(ranges, 95)) if len(ranges) else math.nan,
            "speed_mps": self._speed,
            "time_s": (frame.stamp - self._start) * 1e-9,
            "hour": time.hour + time.minute / 60,
        }


def _objects(traces: FrameIndex, findings: Sequence[Finding]) -> Iterator[Row]:
    """Yield the findings that have a box, and the found objects: those to be found, or all."""
    result, truth = traces.result, traces.labels_in_evaluate
    about = {finding.selection: finding for finding in findings}
    if truth is not None:
        lost = truth.must if traces.matches is None else traces.matches.missed
        # Without a detector no object is a finding, and none is found.
        must = np.flatnonzero(truth.must).tolist()
        wanted = [row for row in must if not lost[row] or Selection(truth=row) in about]
        for row, values in zip(wanted, _boxes(result, truth.boxes, wanted), strict=True):
            values |= {"class": truth.labels[row].lower(), "object": truth.ids[row] if truth.ids else ""}
            yield values | _outcome(about.get(Selection(truth=row)))
    if (objects := result.objects) is not None:
        rows = [j for j in range(len(objects)) if truth is None or Selection(object=j) in about]
        for row, values in zip(rows, _boxes(result, objects.boxes, rows), strict=True):
            values |= {"class": objects.names[row].lower(), "score": float(objects.score[row])}
            yield values | _outcome(about.get(Selection(object=row)))
    unnamed = [f.selection.row for f in findings if f.what == "unnamed" and f.selection is not None]
    if unnamed and result.clusters is not None:
        boxes = result.clusters.boxes(result.config.clustering)
        for row, values in zip(unnamed, _boxes(result, boxes, unnamed), strict=True):
            yield values | _outcome(about[Selection(cluster=row)])


def _others(traces: FrameIndex, findings: Sequence[Finding]) -> Iterator[Row]:
    """Yield the findings that are detections, and the anomalies."""
    for finding in findings:
        selection = finding.selection
        if selection is None:
            yield {**_outcome(finding), "object": finding.number}  # A lasting anomaly is one object.
        elif selection.detection is not None:
            camera = traces.result.camera(selection.camera)
            assert camera is not None and camera.detections is not None
            row, x, y = selection.detection, *_in_points_frame(traces.result, finding)
            values: Row = {
                "class": finding.name.lower(),
                "camera": selection.camera,
                "score": float(camera.detections.score[row]),
                "points": float(finding.points),
                "range_m": finding.distance,
                "bearing_deg": math.degrees(math.atan2(y, x)),
            }
            if (image := camera.camera.image) is not None:
                x0, y0, x1, y1 = camera.detections.xyxy[row].tolist()
                height, width = image.bgr.shape[:2]
                values |= {"u": (x0 + x1) / 2 / width, "v": (y0 + y1) / 2 / height}
            yield values | _outcome(finding)


def _in_points_frame(result: FrameResult, finding: Finding) -> tuple[float, float]:
    """Return x and y of a finding in the frame of the points, NaN if unknown."""
    if finding.position is None:
        return math.nan, math.nan
    position = np.asarray(finding.position, np.float64)[None]
    x, y = geometry.apply(geometry.inverse(result.frame.pose), position)[0, :2].tolist()
    return x, y


def _outcome(finding: Finding | None) -> Row:
    """Return outcome and reason of a finding. None: the object is found."""
    if finding is None:
        return {"outcome": "found"}
    outcome = OUTCOMES.get(finding.what, finding.what)
    return {
        "outcome": outcome,
        "kind": finding.what,
        "reason": finding.reason,
        "text": finding.text,
        "severity": finding.severity,
    }


def _boxes(result: FrameResult, boxes: Boxes3D, rows: Sequence[int]) -> Iterator[Row]:
    """Yield place and size of some of the boxes.

    Args:
        result: of the frame.
        boxes: all boxes of the frame, as the gap is the distance to the nearest other one.
        rows: rows of the boxes in question.
    """
    chosen = boxes.chosen(rows)
    hits = [len(inside) for _, inside in inside_each(result.frame.points, chosen)]
    for count, row in zip(hits, rows, strict=True):
        x, y = boxes.center[row, :2].tolist()
        gaps = np.linalg.norm(boxes.center[:, :2] - boxes.center[row, :2], axis=1)
        gaps[row] = np.inf
        values: Row = {
            "range_m": math.hypot(x, y),
            "bearing_deg": math.degrees(math.atan2(y, x)),
            "length_m": float(boxes.size[row, :2].max()),
            "height_m": float(boxes.size[row, 2]),
            "points": float(count),
            "gap_m": float(gaps.min(initial=np.inf)),
        }
        yield values | _place_in_image(result, boxes.chosen([row]))


def _place_in_image(result: FrameResult, box: Boxes3D) -> Row:
    """Return the first camera that shows the middle of a box, and the place there from 0 to 1."""
    for camera in (c.camera for c in result.cameras):
        if camera.intrinsics is None or camera.camera_from_points is None:
            continue
        around = projected_box(box, camera)
        uv, _ = geometry.project(geometry.apply(camera.camera_from_points, box.center), camera.intrinsics)
        u, v = uv[0, 0] / camera.intrinsics.width, uv[0, 1] / camera.intrinsics.height
        if around is not None and 0 <= u <= 1 and 0 <= v <= 1:
            return {"camera": camera.name, "u": float(u), "v": float(v)}
    return {}


# --- the table of all bags ---------------------------------------------------------------------

SCHEMA = pa.schema(
    [
        ("bag", pa.string()),
        ("recording", pa.string()),
        ("frame", pa.int64()),
        ("stamp", pa.timestamp("ns", "UTC")),
        *FINDING,
    ]
)


def flatten(frames: pa.Table) -> pa.Table:
    """Return the findings of a table of frames, a row each."""
    column = frames[FINDINGS].combine_chunks()
    parents = pc.list_parent_indices(column)
    of_frame = [frames[name].take(parents).combine_chunks() for name in _FRAME]
    return pa.Table.from_arrays([*of_frame, *pc.list_flatten(column).flatten()], schema=SCHEMA)


def write_findings(folder: Path, frames: Iterator[pa.Table]) -> None:
    """Write the findings of all bags, one bag at a time."""
    path = folder / f"{FINDINGS}.parquet"
    with atomic_write(path, FINDINGS) as file, pq.ParquetWriter(file.path, SCHEMA) as writer:
        for table in frames:
            writer.write_table(flatten(table))
