"""Comparison of single frames with those of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bevviz.bags.source import BagSource
from bevviz.config import load
from bevviz.model.frame import Frame


def assert_as_in_the_run(paths: Sequence[Path], *settings: str, at_most: int = 12) -> list[Frame]:
    """Check that each of some frames, read alone, is that of the run. Return the frames of the run."""
    with BagSource(paths, load(settings=list(settings))) as source:
        run = list(source)
        for frame in run[:: max(1, len(run) // at_most)]:
            single = source.frame(frame.index)
            assert single is not None
            assert summary(single) == summary(frame)
            np.testing.assert_array_equal(single.points, frame.points)
    return run


def summary(frame: Frame) -> dict[str, object]:
    """Return what messages a frame took, and where it placed them."""
    return {
        "number": (frame.index, frame.stamp, frame.received),
        "clouds": [(cloud.topic, cloud.stamp) for cloud in frame.clouds],
        "images": [
            (c.name, c.image and c.image.stamp, c.sync_error, c.problems, c.intrinsics is not None)
            for c in frame.cameras
        ],
        "poses": [None if m is None else m.round(9).tolist() for m in _poses(frame)],
        "boxes": [(boxes.topic, boxes.stamp, len(boxes.boxes)) for boxes in frame.robot_boxes],
        "detections": [(boxes.topic, boxes.stamp) for boxes in frame.robot_detections],
        "truth": frame.truth and (frame.truth.topic, frame.truth.stamp),
        "problems": frame.problems,
    }


def _poses(frame: Frame) -> list[np.ndarray | None]:
    return [frame.world_from_points, *(camera.camera_from_points for camera in frame.cameras)]
