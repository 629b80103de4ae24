"""Foreign detectors, held to what their exporters' own code makes of the same image.

The references are made by tests/references/make_detector_references.py, which says how.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bevviz.config import DetectorConfig
from bevviz.errors import UserError
from bevviz.model.results import DetectionState
from bevviz.stages.detector import Detector
from tests.support import onnx_networks

FOLDER = Path(__file__).parent / "references"
NAMES = sorted(path.stem for path in FOLDER.glob("*.npz"))
ORIENTED = [name for name in NAMES if "-obb" in name]
UPRIGHT = [name for name in NAMES if "-obb" not in name]
TYPES = {"tensor(float)": onnx_networks.FLOAT, "tensor(float16)": onnx_networks.FLOAT16}
# Fractions of the image are known as such, but not which way to lay the image in; further columns may be
# key points or an angle.
NOT_WITHOUT_METADATA = {"rtdetr", "yolo11n-pose", "yolo11n-pose_nms", "yolo26n-pose_e2e"}


class Reference:
    def __init__(self, name: str) -> None:
        with np.load(FOLDER / f"{name}.npz") as file:
            self.about: dict[str, Any] = json.loads(str(file["about"]))
            self.image, self.input, self.boxes = file["image"], file["input"], file["boxes"]
            self.masks = file.get("masks", np.zeros((0, 0, 0), np.uint8))
            self.outputs = {k.removeprefix("output_"): file[k] for k in file if k.startswith("output_")}

    def detector(self, folder: Path, metadata: bool = True) -> Detector:
        """Of a network that has the inputs and metadata of the exported one, and its answer."""
        inputs = [(name, shape, TYPES[kind]) for name, shape, kind in self.about["inputs"]]
        about = self.about["metadata"] if metadata else {}
        model = onnx_networks.answer(folder / "model.onnx", self.outputs, inputs, about)
        score, iou = self.about["thresholds"]
        return Detector(
            DetectorConfig(
                model=model, threads=1, conf_threshold=score, iou_threshold=iou, max_candidates=10_000
            )
        )


def kept(detector: Detector, image: NDArray[np.uint8]) -> NDArray[Any]:
    """(N, 6) corners counted from that of the first pixel, score and class."""
    found = detector(image)
    rows = found.state == DetectionState.KEPT
    return np.column_stack([found.xyxy[rows] + 0.5, found.score[rows], found.class_id[rows]])


def in_image(boxes: NDArray[Any], image: NDArray[np.uint8]) -> NDArray[Any]:
    """Clip the boxes to the image and sort them in a fixed order. Drop the boxes outside."""
    height, width = image.shape[:2]
    clipped = boxes.copy()
    clipped[:, :4] = np.clip(boxes[:, :4], 0, [width, height, width, height])
    clipped = clipped[(clipped[:, 2:4] > clipped[:, :2]).all(axis=1)]
    return np.asarray(clipped[np.lexsort((*np.rint(clipped[:, :2].T * 10), clipped[:, 5], -clipped[:, 4]))])


def test_there_are_references_of_every_exporter() -> None:
    exporters = {Reference(name).about["exporter"].split()[0] for name in NAMES}
    assert exporters == {"ultralytics", "yolov5", "yolox", "rfdetr", "torchvision"}
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) < 2e6


@pytest.mark.parametrize("name", UPRIGHT)
def test_boxes_are_those_of_the_exporter(name: str, tmp_path: Path) -> None:
    reference = Reference(name)
    found = kept(reference.detector(tmp_path), reference.image)
    ours, theirs = in_image(found, reference.image), in_image(reference.boxes, reference.image)
    assert len(ours) > 3
    assert len(ours) == len(found), "what cannot be seen is not kept"
    assert len(ours) == len(theirs)
    np.testing.assert_array_equal(ours[:, 5], theirs[:, 5])
    np.testing.assert_allclose(ours[:, 4], theirs[:, 4], atol=1e-6)
    np.testing.assert_allclose(ours[:, :4], theirs[:, :4], atol=1e-3)


@pytest.mark.parametrize("name", UPRIGHT)
def test_the_network_sees_what_the_exporter_shows_it(name: str, tmp_path: Path) -> None:
    reference = Reference(name)
    blob, _ = reference.detector(tmp_path).prepare(reference.image)
    step = reference.about["step"]
    # RF-DETR resamples with floats, which OpenCV and PyTorch add up in another order.
    tolerance = 1e-4 if name.startswith("rfdetr") else 0
    np.testing.assert_allclose(blob[..., ::step, ::step], reference.input, rtol=0, atol=tolerance)


@pytest.mark.parametrize("name", [name for name in UPRIGHT if "dynamic" not in name])  # of another size then
def test_a_model_without_metadata_is_refused_or_read_alike(name: str, tmp_path: Path) -> None:
    reference = Reference(name)
    if name in NOT_WITHOUT_METADATA:
        with pytest.raises(UserError, match=r"detector\.model .*: (read as|no detector).*; its outputs: "):
            reference.detector(tmp_path, metadata=False)
        return
    ours = in_image(kept(reference.detector(tmp_path, metadata=False), reference.image), reference.image)
    theirs = in_image(reference.boxes, reference.image)
    assert ours.shape == theirs.shape
    np.testing.assert_allclose(ours, theirs, atol=1e-3)


@pytest.mark.parametrize("metadata", [True, False])
@pytest.mark.parametrize("name", ORIENTED)
def test_oriented_boxes_are_refused(name: str, metadata: bool, tmp_path: Path) -> None:
    said = "a model for the task 'obb': export one for detect" if metadata else "read as|no detector"
    with pytest.raises(UserError, match=said):
        Reference(name).detector(tmp_path, metadata)


@pytest.mark.parametrize("name", [name for name in NAMES if "_masks" in name])
def test_masks_are_those_of_the_exporter(name: str, tmp_path: Path) -> None:
    reference = Reference(name)
    found = reference.detector(tmp_path)(reference.image)
    assert found.masks is not None
    height, width = reference.about["inputs"][0][1][2:]
    theirs = np.unpackbits(reference.masks, axis=-1)[..., :width].astype(bool)
    kept = np.flatnonzero(found.kept)
    covered = 0
    for box, expected in zip(reference.boxes, theirs, strict=True):
        ours_all = np.column_stack([found.xyxy[kept] + 0.5, 1e3 * found.score[kept], found.class_id[kept]])
        away = np.abs(ours_all - box * [1, 1, 1, 1, 1e3, 1]).max(axis=1)
        d = int(kept[away.argmin()])
        if away.min() > 1e-3:  # what lies outside of the image
            continue
        column, row, columns, rows = found.masks.place[d]
        ours = np.zeros((height, width), bool)
        if found.masks.has(d):
            ours[row : row + rows, column : column + columns] = found.masks.cells(d)
        np.testing.assert_array_equal(ours, expected)
        covered += int(expected.sum())
    assert covered > 500
