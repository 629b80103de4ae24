"""Make the references that the tests hold the reading of foreign detectors to: tests/references/*.npz.

Each holds an image, what an exporter's own code shows the network of it, what the network that it exported
answers, and which boxes its own post-processing takes from that. No weights are needed or kept: networks are
built from their plans with a fixed seed, and their last layers are scaled so that scores and boxes look like
those of a trained one: few objects in much background, neighbours that overlap.

Besides bevviz this needs the exporters, in an environment of their own:

    python -m pip install torch torchvision ultralytics==8.4.190 onnx onnxruntime onnxslim rfdetr==1.11.2
    python -m pip install "setuptools<80" pandas seaborn requests fire loguru thop psutil tabulate pycocotools
    python -m pip install --no-deps --no-build-isolation yolox==0.3.0 yolov5==7.0.14
    python tests/references/make_detector_references.py --work /tmp/references
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import onnxruntime as ort
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

os.environ.update(YOLO_AUTOINSTALL="false", YOLO_OFFLINE="true")

FOLDER = Path(__file__).parent
SIZE = (96, 128)  # height, width of the inputs where a family leaves the choice
IMAGE = (113, 197)  # of the image: no multiples of anything, so that rounding shows
CLASSES = 5
THRESHOLDS = (0.25, 0.45)  # score and IoU
STEP = 7  # of the pixels of the input that are kept, a prime so that all phases of the resampling are there

Array = NDArray[Any]


@dataclass(frozen=True)
class Reference:
    """What an exporter makes of one image."""

    input: Array  # of the network
    outputs: dict[str, Array]
    boxes: Array  # (N, 6) corners in pixels of the image, score, class
    masks: Array | None = None  # (N, height, width) of the input, where they are kept


def picture() -> NDArray[np.uint8]:
    """Make a BGR image of coloured blocks, each with a slope. It packs well, and no two places are equal."""
    height, width = IMAGE
    blocks = np.random.default_rng(0).integers(0, 225, (-(-height // 16), -(-width // 16), 3))
    slope = np.add.outer(np.arange(height) % 16, np.arange(width) % 16)[..., None]
    return (blocks.repeat(16, axis=0).repeat(16, axis=1)[:height, :width] + slope).astype(np.uint8)


def input_of(size: Sequence[int] = SIZE) -> Tensor:
    """Return the picture as most families want it. The last layers are scaled by it."""
    canvas = np.full((1, *size, 3), 114, np.uint8)
    height = int(IMAGE[0] * size[1] / IMAGE[1])
    top = (size[0] - height) // 2
    canvas[0, top : top + height] = cv2.resize(picture(), (size[1], height))[..., ::-1]
    return torch.from_numpy(canvas.transpose(0, 3, 1, 2)).contiguous().float() / 255


def save(name: str, exporter: str, model: Path, image: NDArray[np.uint8], reference: Reference) -> None:
    loaded = onnx.load(model, load_external_data=False)
    session = ort.InferenceSession(model)
    about = {
        "exporter": exporter,
        "metadata": {p.key: p.value for p in loaded.metadata_props if p.key != "date"},
        "inputs": [[i.name, i.shape, i.type] for i in session.get_inputs()],
        "thresholds": THRESHOLDS,
        "step": STEP,
    }
    FOLDER.mkdir(exist_ok=True)
    arrays: dict[str, Any] = {f"output_{key}": value for key, value in reference.outputs.items()}
    if reference.masks is not None:
        arrays["masks"] = np.packbits(reference.masks.astype(bool), axis=-1)
    np.savez_compressed(
        FOLDER / f"{name}.npz",
        about=json.dumps(about),
        image=image,
        input=reference.input[..., ::STEP, ::STEP],
        boxes=reference.boxes.astype(np.float32),
        **arrays,
    )
    size = (FOLDER / f"{name}.npz").stat().st_size
    print(f"{name}: {len(reference.boxes)} boxes, {size / 1000:.0f} kB")


# --- networks that look trained ----------------------------------------------------------------


def settle(net: nn.Module, run: Callable[[], object]) -> None:
    """Statistics of the batch norms from this image, so that features neither vanish nor grow."""
    norms = [module for module in net.modules() if isinstance(module, nn.BatchNorm2d)]
    for norm in norms:
        norm.momentum = None
        norm.reset_running_stats()
        norm.train()
    with torch.no_grad():
        run()
    net.eval()


def values_of(layer: nn.Module, run: Callable[[], object]) -> Tensor | None:
    """(N, channels) of what a last layer says to this image, None where it has no part in the export."""
    seen: list[Tensor] = []
    hook = layer.register_forward_hook(lambda _, __, output: seen.append(output.detach()))
    with torch.no_grad():
        run()
    hook.remove()
    channel = 1 if isinstance(layer, nn.Conv2d) else -1
    return torch.cat([value.movedim(channel, -1).flatten(0, -2) for value in seen]) if seen else None


def scale(layer: Any, run: Callable[[], object], mean: Tensor, deviation: Tensor) -> None:
    """Let each channel of a last layer have that mean and standard deviation over this image."""
    values = values_of(layer, run)
    if values is None:
        return
    factor = deviation / values.std(0).clamp(min=1e-6)
    with torch.no_grad():
        layer.weight.mul_(factor.reshape(-1, *[1] * (layer.weight.ndim - 1)))
        layer.bias.copy_((layer.bias - values.mean(0)) * factor + mean)


def let_few_score(layer: Any, run: Callable[[], object]) -> None:
    """Shift the scores so that one cell in eight has a class above the threshold."""
    values = values_of(layer, run)
    if values is not None:
        with torch.no_grad():
            layer.bias.add_(-1.1 - values.amax(1).quantile(7 / 8))


def noise(count: int, seed: int) -> Tensor:
    return torch.randn(count, generator=torch.Generator().manual_seed(seed))


# --- Ultralytics -------------------------------------------------------------------------------


def ultralytics(
    name: str,
    plan: str,
    work: Path,
    classes: int = CLASSES,
    size: Sequence[int] = SIZE,
    masks: bool = False,
    **options: Any,
) -> None:
    """``masks``: with the prototypes that they are made of, and what is made of them."""
    import ultralytics
    from ultralytics import RTDETR, YOLO
    from ultralytics.cfg import ROOT
    from ultralytics.nn.backends.onnx import ONNXBackend
    from ultralytics.utils import YAML, ops

    torch.manual_seed(0)
    is_detr = "rtdetr" in plan
    found = next((ROOT / "cfg/models").rglob(f"{plan}.yaml"), None) or _scaled(ROOT / "cfg/models", plan)
    values = {**YAML.load(found), "nc": classes}
    if plan[-1] in "nt" or "-" in plan:
        values["scale"] = "n"
    file = work / f"{plan}.yaml"
    YAML.save(file, values)
    model = (RTDETR if is_detr else YOLO)(file)
    net, images = model.model, input_of(size)

    def run() -> object:
        return net(images)

    settle(net, run)
    head = net.model[-1]
    if is_detr:
        for layer in head.dec_score_head:
            scale(layer, run, torch.full((classes,), -2.0), torch.tensor(1.5))
        for mlp in head.dec_bbox_head:
            scale(mlp.layers[-1], run, torch.zeros(4), torch.tensor(0.5))
    else:
        for layer, kind in _last_layers(head):
            count = layer.out_channels
            if kind == "box" and count == 4:  # distances themselves, no distribution of them
                scale(layer, run, torch.full((4,), 3.0), torch.tensor(0.7))
            elif kind == "box":
                scale(layer, run, noise(count, 1), torch.tensor(0.7))
            elif kind == "class":
                scale(layer, run, noise(count, 2), torch.tensor(1.5))
                let_few_score(layer, run)
            else:
                scale(layer, run, torch.zeros(count), torch.tensor(1.0))

    net.pt_path = model.ckpt_path = net.yaml_file = str(work / f"{name}.pt")
    exported = Path(model.export(format="onnx", imgsz=list(size), verbose=False, **options))
    seen: list[tuple[Any, Any]] = []
    forward = ONNXBackend.forward

    def watched(self: Any, im: Any) -> Any:
        outputs = forward(self, im)
        seen.append((im.cpu().numpy(), [np.array(o) for o in outputs]))
        return outputs

    # Boxes whose mask is empty are dropped where masks are wanted; here they are not.
    made: list[Array] = []
    process_mask = ops.process_mask

    def watched_masks(prototypes: Tensor, weights: Tensor, *args: Any, **options: Any) -> Tensor:
        made.append(process_mask(prototypes, weights, *args, **options).numpy())
        return torch.ones(len(weights), 1, 1)

    ops.process_mask = watched_masks
    ONNXBackend.forward = watched
    score, iou = THRESHOLDS
    predictor = (RTDETR if is_detr else YOLO)(exported)
    result = predictor.predict(
        picture(), imgsz=list(size), conf=score, iou=iou, device="cpu", verbose=False, save=False
    )[0]
    ONNXBackend.forward, ops.process_mask = forward, process_mask
    boxes = result.boxes.data if result.obb is None else result.obb.data[:, [0, 1, 2, 3, 5, 6]]
    blob, outputs = seen[-1]
    names = [o.name for o in ort.InferenceSession(exported).get_outputs()]
    # Of prototypes only the shape matters to the boxes.
    kept = {n: o if masks or o.ndim == 3 else np.zeros_like(o) for n, o in zip(names, outputs, strict=True)}
    reference = Reference(blob, kept, boxes.cpu().numpy(), made[-1] if masks else None)
    save(name, f"ultralytics {ultralytics.__version__}", exported, picture(), reference)


def _scaled(folder: Path, plan: str) -> Path:
    """Return the plan that a name with a size, such as yolov8n-seg, is scaled from."""
    family, _, task = plan.partition("-")
    return next(folder.rglob(f"{family[:-1]}{'-' if task else ''}{task}.yaml"))


def _last_layers(head: nn.Module) -> Iterator[tuple[nn.Conv2d, str]]:
    for name, kind in (("cv2", "box"), ("cv3", "class"), ("cv4", "more")):
        for branch in (name, f"one2one_{name}"):
            for layers in getattr(head, branch, None) or ():
                if isinstance(layers, nn.Sequential) and isinstance(layers[-1], nn.Conv2d):
                    yield layers[-1], kind


# --- YOLOv5 and YOLOX --------------------------------------------------------------------------


def yolov5(name: str, plan: str, work: Path) -> None:
    import yolov5
    from ultralytics.utils import ops
    from yolov5.models.yolo import DetectionModel, SegmentationModel
    from yolov5.utils.augmentations import letterbox
    from yolov5.utils.general import non_max_suppression

    torch.manual_seed(0)
    kind = SegmentationModel if "seg" in plan else DetectionModel
    net = kind(str(Path(yolov5.__file__).parent / "models" / plan), ch=3, nc=CLASSES).eval()
    images = input_of()

    def run() -> object:
        return net(images)

    settle(net, run)
    head = net.model[-1]
    for layer in head.m:
        mean, deviation = torch.zeros(head.na, head.no), torch.full((head.na, head.no), 0.8)
        mean[:, 4], deviation[:, 4:] = -4.0, 1.5
        scale(layer, run, mean.reshape(-1), deviation.reshape(-1))
    head.export, head.inplace = True, False
    exported = work / f"{name}.onnx"
    outputs = ["output0", "output1"] if "seg" in plan else ["output0"]
    torch.onnx.export(
        net, (images,), str(exported), input_names=["images"], output_names=outputs, dynamo=False
    )
    loaded = onnx.load(exported)
    metadata = {"stride": str(int(max(net.stride))), "names": str({i: f"thing{i}" for i in range(CLASSES)})}
    onnx.helper.set_model_props(loaded, metadata)
    onnx.save(loaded, exported)

    blob = letterbox(picture(), SIZE, auto=False)[0][..., ::-1].transpose(2, 0, 1)
    blob = (torch.from_numpy(np.ascontiguousarray(blob)).float() / 255)[None].numpy()
    found = dict(zip(outputs, ort.InferenceSession(exported).run(outputs, {"images": blob}), strict=True))
    score, iou = THRESHOLDS
    masks = 32 if "seg" in plan else 0
    boxes = non_max_suppression(torch.from_numpy(found["output0"].copy()), score, iou, nm=masks)[0]
    # Back to the image as Ultralytics does it today: the package takes one ratio for both axes.
    boxes[:, :4] = ops.scale_boxes(SIZE, boxes[:, :4], IMAGE)
    kept = {n: o if o.ndim == 3 else np.zeros_like(o) for n, o in found.items()}
    reference = Reference(blob, kept, boxes[:, :6].numpy())
    save(name, f"yolov5 {yolov5.__version__}", exported, picture(), reference)


def yolox(name: str, work: Path, classes: int, decoded: bool) -> None:
    import yolox
    from yolox.data.data_augment import preproc
    from yolox.models import YOLOPAFPN, YOLOX, YOLOXHead
    from yolox.utils import demo_postprocess, postprocess

    torch.manual_seed(0)
    net = YOLOX(YOLOPAFPN(0.33, 0.25), YOLOXHead(classes, 0.25)).eval()
    images = torch.from_numpy(preproc(picture(), SIZE)[0][None])

    def run() -> object:
        return net(images)

    settle(net, run)
    for k in range(3):
        scale(net.head.cls_preds[k], run, noise(classes, 3), torch.tensor(1.0))
        scale(net.head.obj_preds[k], run, torch.tensor([-3.0]), torch.tensor(1.5))
        scale(net.head.reg_preds[k], run, torch.tensor([0.5, 0.5, 0.7, 0.7]), torch.tensor(0.7))
    net.head.decode_in_inference = decoded
    exported = work / f"{name}.onnx"
    torch.onnx.export(
        net, (images,), str(exported), input_names=["images"], output_names=["output"], dynamo=False
    )
    blob, ratio = preproc(picture(), SIZE)
    output = ort.InferenceSession(exported).run(["output"], {"images": blob[None]})[0]
    everything = output if decoded else demo_postprocess(output.copy(), SIZE)
    score, iou = THRESHOLDS
    rows = postprocess(torch.from_numpy(everything.copy()), classes, score, iou)[0].numpy()
    # Back to the image by what the resizing did to each axis: the package takes the ratio from before each
    # side was cut to whole pixels.
    scales = [int(side * ratio) / side for side in IMAGE[::-1]]
    boxes = np.column_stack([rows[:, :4] / np.tile(scales, 2), rows[:, 4] * rows[:, 5], rows[:, 6]])
    reference = Reference(blob[None], {"output": output}, boxes)
    save(name, f"yolox {yolox.__version__}", exported, picture(), reference)


# --- transformers and torchvision --------------------------------------------------------------


def rfdetr(name: str, classes: int, work: Path) -> None:
    from importlib.metadata import version

    from PIL import Image
    from rfdetr import RFDETRNano
    from rfdetr.export._runtime.decode import decode_detections
    from rfdetr.export._runtime.preprocess import preprocess_to_nchw

    torch.manual_seed(0)
    model = RFDETRNano(pretrain_weights=None, device="cpu", num_classes=classes, num_queries=60)
    net = model.model.model
    with torch.no_grad():
        net.class_embed.weight.mul_(4)
        net.class_embed.bias.add_(1.0)
    model.export(output_dir=str(work / name), verbose=False)
    exported = next((work / name).rglob("*.onnx"))
    session = ort.InferenceSession(exported)
    image = Image.fromarray(np.ascontiguousarray(picture()[..., ::-1]))
    blob = preprocess_to_nchw(image, *session.get_inputs()[0].shape[2:])
    dets, labels = session.run(["dets", "labels"], {"input": blob})
    background = None if labels.shape[2] == 91 else -1  # as the package has it for COCO's own weights
    found = decode_detections(
        dets[0], labels[0], image.size, threshold=THRESHOLDS[0], background_class_id=background
    )
    boxes = np.column_stack([found.xyxy, found.confidence, found.class_id])
    reference = Reference(blob, {"dets": dets, "labels": labels}, boxes)
    save(name, f"rfdetr {version('rfdetr')}", exported, picture(), reference)


def torchvision(name: str, work: Path) -> None:
    import torchvision
    from torchvision.models.detection import ssdlite320_mobilenet_v3_large

    torch.manual_seed(1)
    net = ssdlite320_mobilenet_v3_large(
        weights=None, weights_backbone=None, num_classes=CLASSES + 1, score_thresh=0.05, detections_per_img=60
    ).eval()
    blob = torch.from_numpy(picture()[..., ::-1].transpose(2, 0, 1).copy()).float() / 255
    settle(net, lambda: net([blob, blob.flip(2)]))
    exported = work / f"{name}.onnx"
    axes = {"image": {1: "height", 2: "width"}}
    torch.onnx.export(net, ([blob],), str(exported), input_names=["image"], dynamic_axes=axes, dynamo=False)
    session = ort.InferenceSession(exported)
    names = [o.name for o in session.get_outputs()]
    outputs = dict(zip(names, session.run(names, {"image": blob.numpy()}), strict=True))
    by_shape = {(o.ndim, o.dtype.kind): o for o in outputs.values()}
    boxes = np.column_stack([by_shape[2, "f"], by_shape[1, "f"], by_shape[1, "i"]])
    boxes = boxes[boxes[:, 4] >= THRESHOLDS[0]]
    reference = Reference(blob[None].numpy(), outputs, boxes)
    save(name, f"torchvision {torchvision.__version__}", exported, picture(), reference)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for the networks")
    parser.add_argument("names", nargs="*", help="of references to make again; all by default")
    options = parser.parse_args()
    work: Path = options.work
    work.mkdir(parents=True, exist_ok=True)
    makers: dict[str, Callable[[str], None]] = {}
    for plan in ("yolov3-tiny", "yolov5n", "yolov8n", "yolov9t", "yolov10n", "yolo11n", "yolo12n", "yolo26n"):
        makers[plan] = lambda name, plan=plan: ultralytics(name, plan, work)  # type: ignore[misc]
    for plan in ("yolov8n-seg", "yolo11n-pose", "yolov8n-obb"):
        makers[plan] = lambda name, plan=plan: ultralytics(name, plan, work)  # type: ignore[misc]
    for plan in ("yolov10n", "yolo26n", "yolo26n-seg", "yolo26n-pose", "yolo26n-obb"):
        makers[f"{plan}_e2e"] = lambda name, plan=plan: ultralytics(  # type: ignore[misc]
            name, plan, work, nms=False, max_det=60
        )
    for plan in ("yolo11n", "yolov8n-seg", "yolo11n-pose", "yolov8n-obb"):
        makers[f"{plan}_nms"] = lambda name, plan=plan: ultralytics(  # type: ignore[misc]
            name, plan, work, nms=True, max_det=60
        )
    makers |= {
        "yolo11n-seg_masks": lambda name: ultralytics(name, "yolo11n-seg", work, masks=True),
        "yolov8n-seg_masks_nms": lambda name: ultralytics(
            name, "yolov8n-seg", work, masks=True, nms=True, max_det=60
        ),
        "yolo26n-seg_masks_e2e": lambda name: ultralytics(
            name, "yolo26n-seg", work, masks=True, nms=False, max_det=60
        ),
        "yolov8n_80": lambda name: ultralytics(name, "yolov8n", work, classes=80),
        "yolov8n_half": lambda name: ultralytics(name, "yolov8n", work, quantize=16),
        "yolo11n_dynamic": lambda name: ultralytics(name, "yolo11n", work, dynamic=True),
        "yolov8n-p2": lambda name: ultralytics(name, "yolov8-p2", work, size=(96, 128)),
        "yolov8n-p6": lambda name: ultralytics(name, "yolov8-p6", work, size=(128, 192)),
        "rtdetr": lambda name: ultralytics(name, "yolov8-rtdetr", work, size=(128, 128)),
        "yolov5_repository": lambda name: yolov5(name, "yolov5n.yaml", work),
        "yolov5_repository-seg": lambda name: yolov5(name, "segment/yolov5n-seg.yaml", work),
        "yolox": lambda name: yolox(name, work, CLASSES, decoded=False),
        "yolox_80_decoded": lambda name: yolox(name, work, 80, decoded=True),
        "rfdetr": lambda name: rfdetr(name, CLASSES, work),
        "rfdetr_coco": lambda name: rfdetr(name, 90, work),
        "torchvision": lambda name: torchvision(name, work),
    }
    for name in options.names or makers:
        makers[name](name)


if __name__ == "__main__":
    main()
