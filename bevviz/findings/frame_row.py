"""Row of a frame in the table of a drive: counts, times and problems."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from bevviz.evaluate import position_text
from bevviz.findings.frame_findings import Finding
from bevviz.model.counts import count_results
from bevviz.model.results import Decision, DetectionState, FrameResult
from bevviz.recording.decisions import problem_lines

# Decisions that are possible for a kept detection.
DECISIONS = tuple(d.name.lower() for d in Decision if d.value in (0, 1, 2, 3, 4, 8))
STAGES = (
    *("odometry", "voxel", "ground", "clustering", "detector", "projection", "fusion", "tracking", "bev"),
    *("explain", "total"),
)
COUNTS = (
    *("points", "invalid_points", "voxels", "ground_points", "obstacle_points", "clusters", "set_aside"),
    *("detections", "below_threshold", "suppressed", *DECISIONS, "not_compared", "objects"),
    *("problems", "failures", "anomalies"),
)

FAILURE, PROBLEM = 10.0, 3.0  # severities beside those of the findings


def row(result: FrameResult, findings: Sequence[Finding], *, evaluated: bool) -> dict[str, Any]:
    """Return the row of a frame, without ``bag`` and ``recording``.

    ``sync_error_ms`` and ``tf_age_ms`` are those of the worst sensor. None: no sensor has a value.

    Args:
        result: result of the frame.
        findings: its findings.
        evaluated: whether they were found by ground truth.
    """
    frame, config = result.frame, result.config
    counts: Counter[str] = Counter(dict.fromkeys(COUNTS, 0))
    counts.update(count_results(result))
    if result.ground is not None:
        counts["ground_points"] = int(result.ground.mask.sum())
    if result.clusters is not None:
        counts["set_aside"] = int((~result.clusters.kept).sum())
    if result.objects is not None:
        counts["objects"] = len(result.objects)
    counts["anomalies"] = len(result.anomalies)
    for camera in result.cameras:
        if camera.detections is None:
            continue
        for d, state in enumerate(camera.detections.state.tolist()):
            if state != DetectionState.KEPT:
                counts[DetectionState(state).name.lower()] += 1
            elif camera.fusion is None:
                counts["not_compared"] += 1
            else:
                counts[Decision(int(camera.fusion.detection_decision[d])).name.lower()] += 1
    sync = _worst([abs(c.camera.sync_error) for c in result.cameras])
    tf_age = _worst([frame.tf_age, *(c.camera.tf_age for c in result.cameras)])
    badness = (
        FAILURE * counts["failures"]
        + PROBLEM * counts["problems"]
        + sum(finding.severity for finding in findings)
        + (sync or 0) / config.sync.tolerance
        + (tf_age or 0) / max(config.sync.tf_tolerance, 0.001)
    )
    return {
        "frame": frame.index,
        "stamp": frame.stamp,
        **{name: counts[name] for name in COUNTS},
        "sync_error_ms": None if sync is None else 1e3 * sync,
        "tf_age_ms": None if tf_age is None else 1e3 * tf_age,
        **{f"time_ms_{s}": 1e3 * result.timings[s] for s in STAGES if s in result.timings},
        "unmatched": [finding.name for finding in findings if finding.what == "unmatched"],
        "remarks": [*(text for _, text in problem_lines(result)), *_remarks(findings)],
        "badness": round(badness, 6),
        "missed": sum(finding.what == "missed" for finding in findings) if evaluated else None,
        "false": sum(finding.what == "false" for finding in findings) if evaluated else None,
        "false_causes": [f.reason for f in findings if f.what == "false" and f.reason],
    }


def _remarks(findings: Sequence[Finding]) -> list[str]:
    """Return one sentence for each finding, the gravest first, and one for all clusters without a name."""
    gravest = sorted(findings, key=lambda finding: -finding.severity)
    remarks = [_remark(finding) for finding in gravest if finding.what != "unnamed"]
    unnamed = len(findings) - len(remarks)
    return [*remarks, f"{unnamed} near clusters without a name"] if unnamed else remarks


def _remark(finding: Finding) -> str:
    """Return a finding as text, as ``missed person at 12.3 m, 4° left: ground``."""
    if finding.what == "anomaly":
        return finding.text
    shape, reason = finding.shape, f": {finding.reason}" if finding.reason else ""
    place = f"at {finding.distance:.1f} m" if shape is None else position_text(shape, 0)
    return f"{finding.what} {finding.name} {place}{reason}"


def _worst(seconds: Sequence[float]) -> float | None:
    known = [s for s in seconds if np.isfinite(s)]
    return max(known) if known else None
