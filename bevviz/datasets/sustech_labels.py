"""Labels of SUSTechPOINTS (Li et al. 2020): a JSON file of 3D boxes beside each cloud, in ``label``."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bevviz.datasets.dataset import Stream
from bevviz.datasets.ground_truth import truth_boxes, truth_stream
from bevviz.datasets.kitti_labels import TURN
from bevviz.errors import UserError
from bevviz.model.frame import I64, Boxes3D, LabelledBoxes3D
from bevviz.support.files import read_text
from bevviz.support.limits import TABLE_LIMIT

FOLDER = "label"


def truth_streams(root: Path, lidar: str, clouds: Sequence[Path], times: I64) -> list[Stream]:
    """Return the stream of ground truth in the frame of a LiDAR, or no stream without labels."""
    files = _label_files(root, clouds)
    rows = list(files)
    return [truth_stream(times[rows], lidar, lambda row: read_labels(files[rows[row]]))] if files else []


def _label_files(root: Path, clouds: Sequence[Path]) -> dict[int, Path]:
    """Return the label file of each cloud that has one, by the number of the cloud.

    The folder counts only if its first file has boxes of SUSTechPOINTS.
    """
    files = {row: root / FOLDER / f"{cloud.stem}.json" for row, cloud in enumerate(clouds)}
    files = {row: file for row, file in files.items() if file.is_file()}
    first = next(iter(files.values()), None)
    if first is None:
        return {}
    try:
        objects = json.loads(read_text(first, TABLE_LIMIT))
    except ValueError:
        return {}
    is_ours = isinstance(objects, list) and all(isinstance(o, Mapping) and "psr" in o for o in objects)
    return files if is_ours else {}


def read_labels(file: Path) -> LabelledBoxes3D:
    """Read the boxes of a frame: ``psr`` has position, scale and rotation, ``obj_type`` the class.

    Raises:
        UserError: the file has no such boxes.
    """
    try:
        objects = json.loads(read_text(file, TABLE_LIMIT))
        values = [[_xyz(o["psr"][key]) for key in ("position", "scale", "rotation")] for o in objects]
        labels = [str(o["obj_type"]) for o in objects]
        ids = [str(o.get("obj_id", "")) for o in objects]
        array = np.array(values, np.float64).reshape(-1, 3, 3)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise UserError(f"{file}: no boxes with psr and obj_type: {error!r}") from None
    largest = np.abs(array[:, 2]).max(initial=0)
    if largest > TURN:
        raise UserError(f"{file}: a rotation of {largest:.0f} is no angle in radians: is it in degrees?")
    boxes = Boxes3D(
        array[:, 0].astype(np.float32), array[:, 1].astype(np.float32), array[:, 2, 2].astype(np.float32)
    )
    return truth_boxes(boxes, labels, ids, file.name)


def _xyz(values: Any) -> list[float]:
    """Return the numbers of an object with x, y and z."""
    return [float(values[axis]) for axis in "xyz"]
