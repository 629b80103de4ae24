"""Findings of a batch: a row for each missed, false and found object, with attributes to group them by.

A table of frames holds the findings of each frame. ``findings.parquet`` has those of all bags.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from bevviz.evaluate.evaluation import Evaluation
from bevviz.evaluate.matching import Matches
from bevviz.model import geometry
from bevviz.model.box_points import inside_each
from bevviz.model.frame import F64, Boxes3D
from bevviz.model.reasons import Reason
from bevviz.model.results import FrameResult
from bevviz.recording.images import unexplained_detections
from bevviz.support.files import atomic_write
from bevviz.why import Answer, FrameExplainer, Selection
from bevviz.why.subject import projected_box, single_box

FINDINGS = "findings"  # name of the table of all bags, and of the column in a table of frames

Finding: TypeAlias = dict[str, Any]

# ``outcome`` is one of these:
#   found, missed, false   objects, where there is ground truth
#   found, unexplained     where there is none: objects; detections without an object
#   anomaly, quiet         an anomaly of the frame; a frame without any
TEXTS = ("outcome", "reason", "text", "class", "object", "camera")
NUMBERS = (
    *("range_m", "bearing_deg", "length_m", "height_m", "points", "gap_m", "u", "v", "score"),
    *("brightness", "scan_points", "scan_range_m", "speed_mps", "time_s", "hour"),
)
FINDING = pa.struct([*((name, pa.string()) for name in TEXTS), *((name, pa.float32()) for name in NUMBERS)])
_FRAME = ("bag", "recording", "frame", "stamp")


class FindingCollector:
    """Collector of the findings of a drive, frame by frame.

    Args:
        evaluation: evaluation of the same run, which observes each frame first; None: no ground truth.
    """

    def __init__(self, evaluation: Evaluation | None) -> None:
        self._evaluation = evaluation
        self._start: int | None = None
        self._place: tuple[int, F64] | None = None  # stamp and position of the frame before
        self._speed = math.nan

    def of_frame(self, explainer: FrameExplainer) -> list[Finding]:
        """Return the findings of the next frame. The explainer has the ground truth of the evaluation."""
        result = explainer.traces.result
        shared = self._frame_attributes(result)
        findings: list[Finding] = []
        if self._evaluation is not None and self._evaluation.last is not None:
            findings += judged_findings(explainer, self._evaluation.last[2], self._evaluation.causes)
        elif self._evaluation is None:
            findings += _unjudged(explainer)
        findings += [
            {
                "outcome": "anomaly",
                "reason": anomaly.kind.replace("_", " "),
                "text": anomaly.text,
                "object": f"{anomaly.subject}, {anomaly.since}",  # A lasting anomaly is one object.
            }
            for anomaly in result.anomalies
        ] or [{"outcome": "quiet"}]
        return [{**shared, **finding} for finding in findings]

    def _frame_attributes(self, result: FrameResult) -> Finding:
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


def judged_findings(
    explainer: FrameExplainer, matches: Matches, causes: Mapping[int, Reason]
) -> Iterator[Finding]:
    """Yield the found, missed and false objects of a frame with ground truth.

    Args:
        explainer: of the frame.
        matches: objects matched with its ground truth.
        causes: causes of the false objects, by row.
    """
    result, truth = explainer.traces.result, explainer.traces.labels_in_evaluate
    assert truth is not None
    wanted = np.flatnonzero(truth.must)
    rows = {
        int(row): finding for row, finding in zip(wanted, _boxes(result, truth.boxes, wanted), strict=True)
    }
    for row, finding in rows.items():
        finding |= {"outcome": "found", "class": truth.labels[row].lower()}
        finding["object"] = truth.ids[row] if truth.ids else ""
        if matches.missed[row]:
            finding |= {"outcome": "missed", **_explained(explainer.about(Selection(truth=row)))}
        yield finding
    objects, false = result.objects, np.flatnonzero(matches.false)
    if objects is None:
        return
    for row, finding in zip(false.tolist(), _boxes(result, objects.boxes, false), strict=True):
        cause = causes.get(row)
        name = objects.names[row].lower()
        finding |= {"outcome": "false", "class": name, "score": float(objects.score[row])}
        finding["reason"] = "" if cause is None else cause.kind.value
        finding["text"] = f"false {name} at {objects.boxes.distance[row]:.1f} m"
        yield finding


def _unjudged(explainer: FrameExplainer) -> Iterator[Finding]:
    """Yield the objects of a frame, and the kept detections that no object explains."""
    result = explainer.traces.result
    objects = result.objects
    if objects is not None:
        rows = np.arange(len(objects))
        for row, finding in zip(rows.tolist(), _boxes(result, objects.boxes, rows), strict=True):
            finding |= {"outcome": "found", "class": objects.names[row].lower()}
            yield finding | {"score": float(objects.score[row])}
    for camera in result.cameras:
        detections, image = camera.detections, camera.camera.image
        if detections is None or camera.fusion is None:
            continue
        for row in unexplained_detections(camera).tolist():
            name = camera.camera.name
            lost: Finding = {"outcome": "unexplained", "class": detections.names[row].lower()}
            lost |= {"camera": name, "score": float(detections.score[row])}
            lost |= _explained(explainer.about(Selection(detection=row, camera=name)))
            if image is not None:
                x0, y0, x1, y1 = detections.xyxy[row].tolist()
                height, width = image.bgr.shape[:2]
                lost |= {"u": (x0 + x1) / 2 / width, "v": (y0 + y1) / 2 / height}
            yield lost


def _explained(answer: Answer) -> Finding:
    """Return the reason why a subject was lost, in the words of ``why``, without hints."""
    explained: Finding = {"reason": answer.verdict.kind.value, "text": answer.verdict.text}
    if answer.subject.kind == "detection":
        explained |= {"points": float(answer.evidence.raw), "range_m": answer.distance}
        if answer.center is not None:
            explained["bearing_deg"] = math.degrees(math.atan2(answer.center[1], answer.center[0]))
    return explained


def _boxes(
    result: FrameResult, boxes: Boxes3D, rows: Sequence[int] | np.ndarray[Any, Any]
) -> Iterator[Finding]:
    """Yield place and size of some of the boxes.

    Args:
        result: of the frame.
        boxes: all boxes of the frame, as the gap is the distance to the nearest other one.
        rows: rows of the boxes in question.
    """
    chosen = boxes.chosen(rows)
    hits = [len(inside) for _, inside in inside_each(result.frame.points, chosen)]
    for count, row in zip(hits, np.asarray(rows).tolist(), strict=True):
        x, y = boxes.center[row, :2].tolist()
        gaps = np.linalg.norm(boxes.center[:, :2] - boxes.center[row, :2], axis=1)
        gaps[row] = np.inf
        finding: Finding = {
            "range_m": math.hypot(x, y),
            "bearing_deg": math.degrees(math.atan2(y, x)),
            "length_m": float(boxes.size[row, :2].max()),
            "height_m": float(boxes.size[row, 2]),
            "points": float(count),
            "gap_m": float(gaps.min(initial=np.inf)),
        }
        yield finding | _place_in_image(result, single_box(boxes, row))


def _place_in_image(result: FrameResult, box: Boxes3D) -> Finding:
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


def judged_names(findings: Sequence[Mapping[str, Any]], evaluation: Evaluation) -> list[Finding]:
    """Return the findings without false objects whose name no label of the drive accepts."""
    return [dict(f) for f in findings if f["outcome"] != "false" or evaluation.judges(f["class"])]
