"""Numbers of points, clusters, detections and the like in a frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from bevviz.model.frame import Frame
from bevviz.model.results import Decision, FrameResult, Opinion

# Opinions of cameras on objects of a 3D detector or of the robot.
OPINIONS = ("confirmed", "named_otherwise", "contradicted", "unseen", "missed")


def count_results(result: FrameResult, last: Frame | None = None) -> Mapping[str, int]:
    """Return the number of points, clusters, detections ... by name. A stage that did not run has no number.

    Args:
        result: result of the frame.
        last: the frame before it. None: no frame was skipped.
    """
    frame = result.frame
    counts: Counter[str] = Counter(
        points=len(frame.points),
        invalid_points=sum(cloud.dropped for cloud in frame.clouds),
        problems=len(frame.problems) + sum(len(c.camera.problems) for c in result.cameras),
        failures=len(result.failures),
        skipped_frames=max(0, frame.index - last.index - 1) if last is not None else 0,
    )
    if result.voxels is not None:
        counts["voxels"] = len(result.voxels.points)
    if result.obstacles is not None:
        counts["obstacle_points"] = len(result.obstacles)
    if result.clusters is not None:
        counts["clusters"] = int(result.clusters.kept.sum())
    for camera in result.cameras:
        if camera.detections is not None:
            counts["detections"] += int(camera.detections.kept.sum())
        if camera.fusion is not None:
            counts["matches"] += int((camera.fusion.detection_decision == Decision.MATCHED).sum())
    counts.update(count_opinions(result))
    return counts


def count_opinions(result: FrameResult) -> Mapping[str, int]:
    """Return the number of objects for each opinion of cameras. Objects of our fusion have no opinions."""
    if (opinions := result.opinions) is None:
        return {}
    numbers = Counter(Opinion(value).word.replace(" ", "_") for value in opinions.opinion.tolist())
    numbers["missed"] = int(opinions.missed.sum())
    return {name: numbers[name] for name in OPINIONS}
