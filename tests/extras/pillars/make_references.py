"""Make what the tests hold 3D detectors on pillars to: references/*.npz.

Each file of a head holds maps as a network might answer them, drawn with a fixed seed, and the boxes that the
head's own code takes from them: AnchorHeadSingle and CenterHead of OpenPCDet, Anchor3DHead and CenterHead of
mmdetection3d. ``features.npz`` holds points, the pillars that spconv makes of them and what OpenPCDet's
PillarVFE shows its network. ``params`` are those of ``objects.params`` for each.

What these need of CUDA alone is not loaded; the suppression of turned boxes, which both have in CUDA, is done
by areas of shapely instead. Besides checkouts of both this needs, in an environment of their own:

    python -m pip install torch shapely spconv easydict pyyaml scipy numba mmengine mmdet mmcv-lite==2.1.0
    python tests/extras/pillars/make_references.py --openpcdet OpenPCDet --mmdetection3d mmdetection3d
"""

from __future__ import annotations

import argparse
import importlib
import importlib.machinery
import json
import math
import sys
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from shapely import Polygon
from torch import Tensor

FOLDER = Path(__file__).with_name("references")
RANGE = (0.0, -8.0, -3.0, 24.0, 8.0, 1.0)
VOXEL = (0.5, 0.5, 4.0)
GRID = (48, 32)
STRIDE = 2
CLASSES = ("Car", "Pedestrian", "Cyclist")
SIZES = ((3.9, 1.6, 1.56), (0.8, 0.6, 1.73), (1.76, 0.6, 1.73))
BOTTOMS = (-1.78, -0.6, -0.6)
COMMON = {
    "point_range": RANGE,
    "voxel_size": VOXEL,
    "features": ("x", "y", "z", "intensity"),
    "classes": CLASSES,
}

Array = NDArray[Any]


class Empty(types.ModuleType):
    """A module that has any class, so that importing what is not used does not fail."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.__path__: list[str] = []

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        made = type(name, (), {})
        setattr(self, name, made)
        return made


class WithoutCuda:
    """Finds modules that are compiled for CUDA, all of them empty."""

    def __init__(self, *names: str) -> None:
        self.names = names

    def find_spec(self, name: str, path: object = None, target: object = None) -> Any:
        if any(name == one or name.startswith(f"{one}.") for one in self.names):
            return importlib.machinery.ModuleSpec(name, self, is_package=True)  # type: ignore[arg-type]
        return None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> types.ModuleType:
        return Empty(spec.name)

    def exec_module(self, module: types.ModuleType) -> None:
        pass


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--openpcdet", type=Path, required=True, help="checkout")
    parser.add_argument("--mmdetection3d", type=Path, required=True, help="checkout")
    options = parser.parse_args()
    compiled = "mmcv.ops", "mmcv._ext", "pcdet.ops.iou3d_nms.iou3d_nms_cuda", "pcdet.utils.spconv_utils"
    more = "SharedArray", "pcdet.ops.roiaware_pool3d.roiaware_pool3d_cuda"
    sys.meta_path.insert(0, WithoutCuda(*compiled, *more))
    torch.Tensor.cuda = lambda self, *args, **kwargs: self
    _packages_of(options.openpcdet)
    sys.path.insert(0, str(options.mmdetection3d))
    FOLDER.mkdir(exist_ok=True)
    openpcdet_anchors(options.openpcdet)
    openpcdet_centers(options.openpcdet)
    mmdetection3d_anchors()
    mmdetection3d_centers()
    features()


def _packages_of(checkout: Path) -> None:
    """OpenPCDet's packages without what they import when they are loaded."""
    for folder in (
        *("", "models", "models/backbones_3d", "models/backbones_3d/vfe", "models/dense_heads", "utils"),
        *("models/dense_heads/target_assigner", "models/model_utils", "ops", "ops/iou3d_nms"),
        "ops/roiaware_pool3d",
    ):
        package = types.ModuleType(".".join(["pcdet", *filter(None, folder.split("/"))]))
        package.__path__ = [str(checkout / "pcdet" / folder)]
        sys.modules[package.__name__] = package


# --- suppression -------------------------------------------------------------------------------


def _outline(x: float, y: float, length: float, width: float, yaw: float) -> Polygon:
    c, s = math.cos(yaw), math.sin(yaw)
    ends = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    return Polygon(
        [
            (x + (c * a * length - s * b * width) / 2, y + (s * a * length + c * b * width) / 2)
            for a, b in ends
        ]
    )


def suppressed(boxes: Tensor, scores: Tensor, threshold: float) -> Tensor:
    """Rows that stay of (N, 5) x, y, length, width, yaw, best first."""
    order = scores.sort(0, descending=True)[1]
    outlines = [_outline(*row) for row in boxes[order].double().tolist()]
    kept: list[int] = []
    for i, one in enumerate(outlines):
        shared = [(one.intersection(outlines[k]).area, outlines[k].area) for k in kept]
        if all(part <= threshold * (one.area + area - part) for part, area in shared):
            kept.append(i)
    return order[kept]


def _nms_gpu(boxes: Tensor, scores: Tensor, thresh: float, **_: Any) -> tuple[Tensor, None]:
    return suppressed(boxes[:, [0, 1, 3, 4, 6]], scores, thresh), None


def _nms_rotated(boxes: Tensor, scores: Tensor, thresh: float, *_: Any) -> tuple[None, Tensor]:
    return None, suppressed(boxes, scores, thresh)


def _put(module: str, **functions: Any) -> None:
    """In place of those that are compiled for CUDA."""
    vars(importlib.import_module(module)).update(functions)


# --- heads -------------------------------------------------------------------------------------


def maps(seed: int, channels: Sequence[tuple[str, int, float, float]]) -> dict[str, Tensor]:
    """Make maps (1, C, y, x) by name, each with its number of channels, mean and spread."""
    draw = np.random.default_rng(seed)
    shape = GRID[1] // STRIDE, GRID[0] // STRIDE
    return {
        name: torch.from_numpy(  # numbers that pack well
            draw.normal(mean, spread, (1, count, *shape)).astype(np.float16).astype(np.float32)
        )
        for name, count, mean, spread in channels
    }


def save(
    name: str, params: dict[str, Any], outputs: dict[str, Tensor], boxes: Tensor, score: Tensor, label: Tensor
) -> None:
    arrays = {f"output_{key}": value.numpy().astype(np.float16) for key, value in outputs.items()}
    found = {"boxes": boxes[:, :7].numpy(), "score": score.numpy(), "label": label.numpy().astype(np.int64)}
    np.savez_compressed(FOLDER / f"{name}.npz", params=json.dumps({**COMMON, **params}), **arrays, **found)
    print(f"{name}: {len(boxes)} boxes")


ANCHOR_MAPS = (("cls_score", 18, -5.0, 2.0), ("bbox_pred", 42, 0.0, 0.25), ("dir_cls_pred", 12, 0.0, 1.0))


def _settings(checkout: Path, file: str) -> Any:
    from easydict import EasyDict

    return EasyDict(yaml.safe_load((checkout / "tools/cfgs" / file).read_text())).MODEL


def openpcdet_anchors(checkout: Path) -> None:
    head_module = importlib.import_module("pcdet.models.dense_heads.anchor_head_single")
    rules = importlib.import_module("pcdet.models.model_utils.model_nms_utils")
    _put("pcdet.ops.iou3d_nms.iou3d_nms_utils", nms_gpu=_nms_gpu)
    model = _settings(checkout, "kitti_models/pointpillar.yaml")
    head = head_module.AnchorHeadSingle(
        model.DENSE_HEAD, 8, 3, CLASSES, np.array([*GRID, 1]), np.array(RANGE, np.float32)
    )
    given = maps(1, ANCHOR_MAPS)
    outputs = {
        name: given[old].permute(0, 2, 3, 1).contiguous()
        for name, old in (
            ("cls_preds", "cls_score"),
            ("box_preds", "bbox_pred"),
            ("dir_cls_preds", "dir_cls_pred"),
        )
    }
    scores, boxes = head.generate_predicted_boxes(1, *outputs.values())
    score, label = torch.sigmoid(scores[0]).max(-1)
    post = model.POST_PROCESSING
    rows, chosen = rules.class_agnostic_nms(score, boxes[0], post.NMS_CONFIG, post.SCORE_THRESH)
    params = {
        "anchors": [(*size, bottom) for size, bottom in zip(SIZES, BOTTOMS, strict=True)],
        "anchor_places": "edge_to_edge",
        "direction_offset": model.DENSE_HEAD.DIR_OFFSET,
        "score_threshold": post.SCORE_THRESH,
        "nms": "all",
        "nms_iou": post.NMS_CONFIG.NMS_THRESH,
        "nms_candidates": post.NMS_CONFIG.NMS_PRE_MAXSIZE,
    }
    save("openpcdet_anchors", params, outputs, boxes[0][rows], chosen, label[rows])


def mmdetection3d_anchors() -> None:
    heads = importlib.import_module("mmdet3d.models.dense_heads")
    boxes_of = importlib.import_module("mmdet3d.structures").LiDARInstance3DBoxes
    _put("mmdet3d.models.layers.box3d_nms", nms_rotated=_nms_rotated)
    from mmengine.config import ConfigDict

    order = (1, 2, 0)  # as its configuration for KITTI has the classes
    post = {"use_rotate_nms": True, "nms_thr": 0.1, "score_thr": 0.1, "nms_pre": 100, "max_num": 50}
    head = heads.Anchor3DHead(
        num_classes=3,
        in_channels=8,
        feat_channels=8,
        anchor_generator={
            "type": "AlignedAnchor3DRangeGenerator",
            "ranges": [[*RANGE[:2], BOTTOMS[k], *RANGE[3:5], BOTTOMS[k]] for k in order],
            "sizes": [list(SIZES[k]) for k in order],
            "rotations": [0, 1.57],
            "reshape_out": False,
        },
        bbox_coder={"type": "DeltaXYZWLHRBBoxCoder"},
        loss_cls={"type": "mmdet.FocalLoss", "use_sigmoid": True},
        test_cfg=ConfigDict(post),
    )
    outputs = {f"{name}0": value for name, value in maps(2, ANCHOR_MAPS).items()}
    found = head.predict_by_feat(*([one] for one in outputs.values()), [{"box_type_3d": boxes_of}])[0]
    params = {
        "classes": [CLASSES[k] for k in order],
        "anchors": [(*SIZES[k], BOTTOMS[k]) for k in order],
        "anchor_places": "cell_centers",
        "direction_offset": head.dir_offset,
        "score_threshold": post["score_thr"],
        "labels": "each",
        "nms": "class",
        "nms_iou": post["nms_thr"],
        "nms_candidates": post["nms_pre"],
        "max_objects": post["max_num"],
    }
    save("mmdetection3d_anchors", params, outputs, *_parts(found))


def _parts(found: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Its boxes about their centres, which it keeps about the centres of their lower faces."""
    boxes = found.bboxes_3d
    rows = torch.cat([boxes.gravity_center, boxes.dims, boxes.yaw[:, None]], 1)
    return rows, found.scores_3d, found.labels_3d


PARTS = (("reg", 2, 0.5, 0.3), ("height", 1, -0.9, 0.3), ("dim", 3, 0.6, 0.4), ("rot", 2, 0.0, 1.0))


def openpcdet_centers(checkout: Path) -> None:
    head_module = importlib.import_module("pcdet.models.dense_heads.center_head")
    _put("pcdet.ops.iou3d_nms.iou3d_nms_utils", nms_gpu=_nms_gpu)
    settings = _settings(checkout, "nuscenes_models/cbgs_dyn_pp_centerpoint.yaml").DENSE_HEAD
    groups = [["Car"], ["Pedestrian", "Cyclist"]]
    settings.CLASS_NAMES_EACH_HEAD = groups
    settings.SEPARATE_HEAD_CFG.HEAD_ORDER = ["center", "center_z", "dim", "rot"]
    settings.SEPARATE_HEAD_CFG.HEAD_DICT.pop("vel")
    settings.TARGET_ASSIGNER_CONFIG.FEATURE_MAP_STRIDE = STRIDE
    settings.POST_PROCESSING.MAX_OBJ_PER_SAMPLE = 100
    head = head_module.CenterHead(
        settings, 8, 3, CLASSES, np.array([*GRID, 1]), np.array(RANGE, np.float32), VOXEL, False
    )
    names = {"reg": "center", "height": "center_z", "dim": "dim", "rot": "rot"}
    heads = []
    for number, group in enumerate(groups):
        made = maps(3 + number, (("hm", len(group), -4.0, 1.5), *PARTS))
        heads.append({names.get(key, key): value for key, value in made.items()})
    found = head.generate_predicted_boxes(1, heads)[0]
    post = settings.POST_PROCESSING
    params = {
        "groups": groups,
        "boxes": "lwh",
        "rotation": "cos_sin",
        "score_threshold": post.SCORE_THRESH,
        "labels": "each",
        "nms": "group",
        "nms_iou": post.NMS_CONFIG.NMS_THRESH,
        "nms_candidates": post.MAX_OBJ_PER_SAMPLE,
    }
    outputs = {f"{key}_{number}": value for number, one in enumerate(heads) for key, value in one.items()}
    save(
        "openpcdet_centers",
        params,
        outputs,
        found["pred_boxes"],
        found["pred_scores"],
        found["pred_labels"] - 1,
    )


def mmdetection3d_centers() -> None:
    """With its maps joined as mmdeploy's export joins them."""
    heads = importlib.import_module("mmdet3d.models.dense_heads")
    boxes_of = importlib.import_module("mmdet3d.structures").LiDARInstance3DBoxes
    _put("mmdet3d.models.layers.box3d_nms", nms_rotated=_nms_rotated)
    from mmengine.config import ConfigDict

    groups = [["Car"], ["Pedestrian", "Cyclist"]]
    limits = [-100.0, -100.0, -10.0, 100.0, 100.0, 10.0]
    post = {"nms_type": "rotate", "nms_thr": 0.2, "score_threshold": 0.1, "pre_max_size": 1000}
    head = heads.CenterHead(
        in_channels=8,
        tasks=[{"num_class": len(group), "class_names": group} for group in groups],
        common_heads={"reg": (2, 2), "height": (1, 2), "dim": (3, 2), "rot": (2, 2), "vel": (2, 2)},
        bbox_coder={
            "type": "CenterPointBBoxCoder",
            "pc_range": RANGE[:2],
            "out_size_factor": STRIDE,
            "voxel_size": VOXEL[:2],
            "post_center_range": limits,
            "max_num": 100,
            "score_threshold": 0.1,
            "code_size": 9,
        },
        separate_head={"type": "SeparateHead", "init_bias": -2.19, "final_kernel": 3},
        test_cfg=ConfigDict(**post, post_max_size=83, post_center_limit_range=limits),
    )
    tasks = [
        maps(5 + k, (("heatmap", len(group), -4.0, 1.5), *PARTS, ("vel", 2, 0.0, 1.0)))
        for k, group in enumerate(groups)
    ]
    found = head.predict_by_feat([[one] for one in tasks], [{"box_type_3d": boxes_of}])[0]
    joined = {
        "cls_score0": torch.cat([one["heatmap"] for one in tasks], 1),
        "bbox_pred0": torch.cat([one[key] for one in tasks for key in ("reg", "height", "dim", "vel")], 1),
        "dir_cls_pred0": torch.cat([one["rot"] for one in tasks], 1),
    }
    params = {
        "groups": groups,
        "boxes": "lwh",
        "rotation": "sin_cos",
        "score_threshold": 0.1,
        "labels": "each",
        "nms": "group",
        "nms_iou": post["nms_thr"],
        "nms_candidates": 100,
    }
    save("mmdetection3d_centers", params, joined, *_parts(found))


# --- pillars -----------------------------------------------------------------------------------


def features() -> None:
    """Pillars of points of chance, and what OpenPCDet shows its network of them."""
    from cumm import tensorview
    from easydict import EasyDict
    from spconv.utils import Point2VoxelCPU3d

    draw = np.random.default_rng(7)
    points = draw.normal((8, 0, -1, 0.4), (5, 3, 1.2, 0.2), (1500, 4)).astype(np.float16).astype(np.float32)
    make = Point2VoxelCPU3d(
        vsize_xyz=list(VOXEL),
        coors_range_xyz=list(RANGE),
        num_point_features=4,
        max_num_points_per_voxel=4,
        max_num_voxels=300,
    )
    voxels, cells, counts = (one.numpy().copy() for one in make.point_to_voxel(tensorview.from_numpy(points)))
    settings = EasyDict(USE_NORM=True, WITH_DISTANCE=True, USE_ABSLOTE_XYZ=True, NUM_FILTERS=[8])
    module = importlib.import_module("pcdet.models.backbones_3d.vfe.pillar_vfe")
    encoder = module.PillarVFE(settings, 4, list(VOXEL), list(RANGE)).eval()
    shown: list[Tensor] = []
    encoder.pfn_layers[0].register_forward_pre_hook(lambda _, given: shown.append(given[0].clone()))
    with_batch = np.concatenate([np.zeros((len(cells), 1), cells.dtype), cells], 1)
    given = {"voxels": voxels, "voxel_num_points": counts, "voxel_coords": with_batch}
    encoder({key: torch.from_numpy(value) for key, value in given.items()})
    np.savez_compressed(
        FOLDER / "features.npz",
        points=points.astype(np.float16),
        counts=counts,
        cells=cells[:, [2, 1]],
        shown=shown[0].numpy(),
    )
    print(f"features: {len(counts)} pillars")


if __name__ == "__main__":
    with torch.no_grad():
        main()
