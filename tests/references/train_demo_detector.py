"""Train the small network that detects people, cars and cyclists in the synthetic drive's images.

Everything is made here: images and exact boxes of their visible objects by the simulator, over seeds far
from the demo's; an anchor-free single-stage network; task-aligned assignment (Feng et al., TOOD, 2021) as
YOLOv8 uses it; and the ONNX file with the metadata and output layout of an Ultralytics YOLOv8 export:
[1, 4 + classes, N] with centre, size in input pixels, then class scores.

Besides bevviz this needs PyTorch and onnx, which bevviz itself does not:

    python -m pip install torch onnx
    python tests/references/train_demo_detector.py --work /tmp/demo_detector

Images are kept in ``--work`` and made once. The figures for streets never seen before are printed at the end.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from bevviz.extras.demo.sensors import Caster, PinholeCamera, RaycastView, optical
from bevviz.extras.demo.world import SECTION, World
from bevviz.model import geometry
from bevviz.model.frame import F32, I32, U8

NAMES = ("person", "car", "cyclist")
WIDTH, HEIGHT = 640, 384  # of the exported input
STRIDES = (8, 16, 32)
CROP = (320, 192)  # trained on windows of this size: the network is fully convolutional
TRAIN_SEED, VALIDATION_SEED, TEST_SEED = 10_000, 90_000, 95_000  # first of each set
PER_SEED = 20  # images of one street
DURATION = 12.0  # seconds of traffic in it

# --- data --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Labels:
    xyxy: F32  # (K, 4) around the visible pixels
    kind: I32  # (K,) row of NAMES, or -1: too small or hidden to be asked for, no mistake to be found


def street_images(seed: int) -> list[tuple[U8, Labels]]:
    """Images from random places of one street, the camera turned and shifted at random."""
    rng = np.random.default_rng((seed, 1))
    camera, world = PinholeCamera(), World(seed, DURATION)
    static = lru_cache(lambda section: Caster(world.static(section)))
    found = []
    for _ in range(PER_SEED):
        t, s = rng.uniform(0, DURATION), rng.uniform(0, world.length)
        base = world.street.pose(s, rng.normal(-1.7, 0.7), turn=rng.normal(0, 0.12), upright=False)
        pose = base @ optical((0.7, 0.06, rng.normal(1.55, 0.08)), np.radians(rng.normal(3.0, 1.0)))
        centre = pose[:3, 3]
        view = RaycastView(static(int(s // SECTION)), world.moving(t, centre, 120.0))
        picture = camera.picture(view, pose, world.light, rng)
        boxes, kinds = [], []
        for actor, mesh, _ in world.objects(t, centre, 120.0):
            v, u = np.nonzero(picture.object == actor.number)
            if len(u) < 12:
                continue
            box = np.array([u.min(), v.min(), u.max() + 1, v.max() + 1], np.float32)
            uv, depth = geometry.project(
                geometry.apply(geometry.inverse(pose), mesh.vertices), camera.intrinsics
            )
            whole = np.clip(uv[depth > 0.1], 0, (camera.width, camera.height))
            share = np.prod(box[2:] - box[:2]) / max(np.prod(np.ptp(whole, axis=0)), 1.0)
            clear = (
                share > 0.45 and len(u) > 0.3 * np.prod(box[2:] - box[:2]) * share and box[3] - box[1] >= 9
            )
            boxes.append(box)
            kinds.append(NAMES.index(actor.label) if clear else -1)
        labels = Labels(np.array(boxes, np.float32).reshape(-1, 4), np.array(kinds, np.int32))
        found.append((picture.bgr, labels))
    return found


def dataset(folder: Path, name: str, first_seed: int, seeds: int, workers: int) -> list[tuple[U8, Labels]]:
    """Images by the simulator, one npz file a street, which a second call reads back."""
    folder = folder / name
    folder.mkdir(parents=True, exist_ok=True)
    missing = [s for s in range(first_seed, first_seed + seeds) if not (folder / f"{s}.npz").exists()]
    with ProcessPoolExecutor(workers) as pool:
        for seed, images in zip(missing, pool.map(street_images, missing), strict=True):
            columns: dict[str, Any] = {"images": np.stack([bgr for bgr, _ in images])}
            for i, (_, labels) in enumerate(images):
                columns |= {f"xyxy{i}": labels.xyxy, f"kind{i}": labels.kind}
            np.savez(folder / f"{seed}.npz", **columns)
            print(f"{name}: seed {seed}", flush=True)
    found = []
    for seed in range(first_seed, first_seed + seeds):
        with np.load(folder / f"{seed}.npz") as file:
            stack = file["images"]
            found += [(stack[i], Labels(file[f"xyxy{i}"], file[f"kind{i}"])) for i in range(len(stack))]
    return found


def crop(rng: np.random.Generator, image: U8, labels: Labels, size: tuple[int, int]) -> tuple[U8, Labels]:
    """Cut a scaled, flipped, recoloured window of ``size`` (width, height). Every other one has an object."""
    width, height = size
    scale = np.exp(rng.uniform(np.log(0.6), np.log(1.6)))
    middle = rng.uniform((0, 0), image.shape[1::-1])
    asked = np.flatnonzero(labels.kind >= 0)
    if len(asked) and rng.random() < 0.5:
        x0, y0, x1, y1 = labels.xyxy[rng.choice(asked)]
        middle = np.array([x0 + x1, y0 + y1]) / 2 + rng.normal(0, 0.2, 2) * size / scale
    flip = -1.0 if rng.random() < 0.5 else 1.0
    m = np.array(
        [[flip * scale, 0, width / 2 - flip * scale * middle[0]], [0, scale, height / 2 - scale * middle[1]]]
    )
    window = cv2.warpAffine(image, m, size, borderValue=(114, 114, 114)).astype(np.float32)
    window = (window - 110) * rng.uniform(0.75, 1.25) + 110 + rng.uniform(-25, 25)
    window = window * rng.uniform(0.9, 1.1, 3) + rng.normal(0, rng.uniform(0, 4), window.shape)
    xyxy = labels.xyxy * np.array([m[0, 0], scale] * 2) + np.tile(m[:, 2], 2)
    xyxy[:, [0, 2]] = np.sort(xyxy[:, [0, 2]], axis=1)
    area = np.prod(xyxy[:, 2:] - xyxy[:, :2], axis=1)
    xyxy = np.clip(xyxy, 0, (width, height, width, height)).astype(np.float32)
    left = np.prod(xyxy[:, 2:] - xyxy[:, :2], axis=1)
    kind = np.where((left > 0.4 * area) & (xyxy[:, 3] - xyxy[:, 1] > 8), labels.kind, -1).astype(np.int32)
    inside = left > 4
    return np.clip(window, 0, 255).astype(np.uint8), Labels(xyxy[inside], kind[inside])


def batches(
    data: Sequence[tuple[U8, Labels]], size: tuple[int, int], batch: int, rng: np.random.Generator
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Endless: images (B, 3, H, W), boxes (B, G, 4) and kinds (B, G), padded with -2."""
    while True:
        picked = (data[i] for i in rng.integers(len(data), size=batch))
        chosen = [crop(rng, image, labels, size) for image, labels in picked]
        most = max(1, *(len(labels.kind) for _, labels in chosen))
        xyxy, kind = torch.zeros(batch, most, 4), torch.full((batch, most), -2)
        for b, (_, labels) in enumerate(chosen):
            n = len(labels.kind)
            xyxy[b, :n], kind[b, :n] = torch.from_numpy(labels.xyxy), torch.from_numpy(labels.kind).long()
        yield tensor([image for image, _ in chosen]), xyxy, kind


def tensor(images: Sequence[U8]) -> Tensor:
    """(B, 3, H, W) RGB, 0 to 1."""
    stack = np.stack(images)[..., ::-1].transpose(0, 3, 1, 2)
    return torch.from_numpy(np.ascontiguousarray(stack, np.float32) / 255)


# --- network -----------------------------------------------------------------------------------


def conv(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(True),
    )


class Residual(nn.Module):  # type: ignore[misc]
    def __init__(self, width: int) -> None:
        super().__init__()
        self.body = nn.Sequential(conv(width, width // 2, 1), conv(width // 2, width))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.body(x)


class Network(nn.Module):  # type: ignore[misc]
    """Five halvings, a feature pyramid (Lin et al. 2017) over the last three, one decoupled head for all."""

    def __init__(self, widths: Sequence[int] = (16, 24, 48, 80, 112), neck: int = 48, head: int = 40) -> None:
        super().__init__()
        w = widths
        self.low = nn.Sequential(conv(3, w[0], stride=2), conv(w[0], w[1], stride=2), Residual(w[1]))
        self.stages = nn.ModuleList(
            nn.Sequential(conv(a, b, stride=2), Residual(b), Residual(b)) for a, b in pairwise(w[1:])
        )
        self.lateral = nn.ModuleList(conv(c, neck, 1) for c in w[2:])
        self.smooth = nn.ModuleList(conv(neck, neck) for _ in w[2:])
        self.scores = nn.Sequential(conv(neck, head), nn.Conv2d(head, len(NAMES), 1))
        self.sides = nn.Sequential(conv(neck, head), nn.Conv2d(head, 4, 1))
        self.scale = nn.Parameter(torch.ones(len(STRIDES)))
        nn.init.constant_(self.scores[1].bias, -4.6)  # one location in a hundred, at the start

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (B, N, classes), and left, top, right, bottom (B, N, 4) in strides."""
        x, features = self.low(x), []
        for stage in self.stages:
            x = stage(x)
            features.append(x)
        above, levels = None, list[Tensor]()
        for i in (2, 1, 0):
            level = self.lateral[i](features[i])
            if above is not None:
                level = level + F.interpolate(above, scale_factor=2.0, mode="nearest")
            above = self.smooth[i](level)
            levels.insert(0, above)
        logits = torch.cat([self.scores(p).flatten(2) for p in levels], 2).transpose(1, 2)
        sides = [F.softplus(self.sides(p) * self.scale[i] + 1.0).flatten(2) for i, p in enumerate(levels)]
        return logits, torch.cat(sides, 2).transpose(1, 2)


def anchors(width: int, height: int) -> tuple[Tensor, Tensor]:
    """Centres (N, 2) in pixels and strides (N, 1) of every location."""
    centres, strides = [], []
    for s in STRIDES:
        v, u = torch.meshgrid(torch.arange(height // s), torch.arange(width // s), indexing="ij")
        centres.append((torch.stack([u, v], -1).reshape(-1, 2) + 0.5) * s)
        strides.append(torch.full((len(centres[-1]), 1), float(s)))
    return torch.cat(centres), torch.cat(strides)


def corners(sides: Tensor, centres: Tensor, strides: Tensor) -> Tensor:
    reach = sides * strides
    return torch.cat([centres - reach[..., :2], centres + reach[..., 2:]], -1)


class Exported(nn.Module):  # type: ignore[misc]
    """The network with its boxes decoded, as a YOLOv8 export has them."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network
        self.centres, self.strides = anchors(WIDTH, HEIGHT)

    def forward(self, images: Tensor) -> Tensor:
        logits, sides = self.network(images)
        box = corners(sides, self.centres, self.strides)
        low, high = box[..., :2], box[..., 2:]
        return torch.cat([(low + high) / 2, high - low, logits.sigmoid()], -1).transpose(1, 2)


# --- loss --------------------------------------------------------------------------------------


def overlap(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """IoU and generalised IoU (Rezatofighi et al. 2019), broadcast over the leading axes."""
    inter = (
        (torch.minimum(a[..., 2:], b[..., 2:]) - torch.maximum(a[..., :2], b[..., :2])).clamp(min=0).prod(-1)
    )
    union = (a[..., 2:] - a[..., :2]).prod(-1) + (b[..., 2:] - b[..., :2]).prod(-1) - inter
    hull = (torch.maximum(a[..., 2:], b[..., 2:]) - torch.minimum(a[..., :2], b[..., :2])).prod(-1)
    iou = inter / union.clamp(min=1e-6)
    return iou, iou - (hull - union) / hull.clamp(min=1e-6)


@torch.no_grad()
def assign(
    scores: Tensor, boxes: Tensor, centres: Tensor, xyxy: Tensor, kind: Tensor, top: int = 10
) -> tuple[Tensor, Tensor, Tensor]:
    """Task-aligned assignment: each object takes the ``top`` locations inside it of highest score^0.5 IoU^6.

    Returns:
        owner (B, N): the object of each location, or -1. quality (B, N): its target score.
        ignored (B, N): inside an object that is not to be asked for.
    """
    c = centres[None, None]
    inside = ((c > xyxy[:, :, None, :2]) & (c < xyxy[:, :, None, 2:])).all(-1)  # (B, G, N)
    iou = overlap(boxes[:, None], xyxy[:, :, None])[0]
    score = scores.transpose(1, 2).gather(1, kind.clamp(min=0)[..., None].expand(-1, -1, scores.shape[1]))
    metric = score.sqrt() * iou.pow(6) * inside * (kind >= 0)[..., None]
    least = metric.topk(top, -1).values[..., -1:].clamp(min=1e-9)
    taken = metric >= least
    best = (iou * taken).argmax(1)  # (B, N) object of the highest overlap where several claim a location
    owner = torch.where(taken.any(1), best, -1)
    highest = metric.amax(-1, keepdim=True).clamp(min=1e-9)
    aligned = metric / highest * (iou * taken).amax(-1, keepdim=True)
    quality = aligned.gather(1, best[:, None])[:, 0] * (owner >= 0)
    ignored = (inside & (kind == -1)[..., None]).any(1) & (owner < 0)
    return owner, quality, ignored


def loss(network: Network, images: Tensor, xyxy: Tensor, kind: Tensor) -> Tensor:
    with torch.autocast("cpu", torch.bfloat16):
        logits, sides = network(images)
    logits, sides = logits.float(), sides.float()
    centres, strides = anchors(images.shape[3], images.shape[2])
    boxes = corners(sides, centres, strides)
    owner, quality, ignored = assign(logits.sigmoid(), boxes, centres, xyxy, kind)
    picked = owner >= 0
    target = torch.zeros_like(logits)
    own_kind = kind.gather(1, owner.clamp(min=0)).clamp(min=0)
    target.scatter_(2, own_kind[..., None], (quality * picked)[..., None])
    weight = ~ignored[..., None]
    total = quality.sum().clamp(min=1.0)
    classes = (F.binary_cross_entropy_with_logits(logits, target, reduction="none") * weight).sum() / total
    own_box = xyxy.gather(1, owner.clamp(min=0)[..., None].expand(-1, -1, 4))
    giou = overlap(boxes[picked], own_box[picked])[1]
    return classes + 2.5 * ((1 - giou) * quality[picked]).sum() / total


def train(
    network: Network, data: Sequence[tuple[U8, Labels]], minutes: float, batch: int, seed: int
) -> Network:
    """AdamW with warm-up and cosine decay over the time given, and an average of the weights."""
    network = network.to(memory_format=torch.channels_last).train()
    average = torch.optim.swa_utils.AveragedModel(
        network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(0.99), use_buffers=True
    )
    optimiser = torch.optim.AdamW(network.parameters(), lr=0.0, weight_decay=0.02)
    started, recent = time.time(), 0.0
    stream = batches(data, CROP, batch, np.random.default_rng(seed))
    for step, (images, xyxy, kind) in enumerate(stream):
        done = (time.time() - started) / (60 * minutes)
        if done >= 1:
            break
        rate = 3e-3 * min(1.0, (step + 1) / 50) * (0.02 + 0.98 * (1 + np.cos(np.pi * done)) / 2)
        for group in optimiser.param_groups:
            group["lr"] = rate
        value = loss(network, images.contiguous(memory_format=torch.channels_last), xyxy, kind)
        optimiser.zero_grad()
        value.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimiser.step()
        average.update_parameters(network)
        recent = value.item() if step == 0 else 0.95 * recent + 0.05 * value.item()
        if step % 20 == 0:
            print(
                f"step {step}  {100 * done:.0f} %  loss {recent:.3f}  {time.time() - started:.0f} s",
                flush=True,
            )
    trained: Network = average.module.eval()
    return trained


# --- export and evaluation ---------------------------------------------------------------------


def export(network: Network, path: Path) -> None:
    torch.onnx.export(
        Exported(network).eval(),
        (torch.zeros(1, 3, HEIGHT, WIDTH),),
        str(path),
        input_names=["images"],
        output_names=["output0"],
        opset_version=17,
        dynamo=False,
    )
    model = onnx.load(path)
    facts = {
        "names": str(dict(enumerate(NAMES))),
        "stride": str(max(STRIDES)),
        "task": "detect",
        "imgsz": str([HEIGHT, WIDTH]),
        "description": "bevviz synthetic drive, made by tests/references/train_demo_detector.py",
    }
    onnx.helper.set_model_props(model, facts)
    onnx.checker.check_model(model)
    onnx.save(model, path)


def evaluate(path: Path, data: Sequence[tuple[U8, Labels]], threshold: float = 0.25) -> dict[str, Any]:
    """Precision and recall at IoU 0.5 through bevviz's own detector, for objects higher than 20 pixels."""
    from bevviz.config import DetectorConfig
    from bevviz.model.results import DetectionState
    from bevviz.stages.detector import Detector

    detector = Detector(DetectorConfig(model=str(path), conf_threshold=threshold))
    asked, hit = np.zeros(len(NAMES), int), np.zeros(len(NAMES), int)
    right, wrong, seconds = 0, 0, 0.0
    for image, labels in data:
        started = time.perf_counter()
        found = detector(image)
        seconds += time.perf_counter() - started
        kept = found.state == DetectionState.KEPT
        boxes, kinds = found.xyxy[kept], found.class_id[kept]
        iou = geometry.iou(boxes, labels.xyxy)
        same = (iou >= 0.5) & (kinds[:, None] == labels.kind[None])
        matched = np.zeros(len(labels.kind), bool)
        for d in range(len(boxes)):  # best score first
            free = np.flatnonzero(same[d] & ~matched)
            if len(free):
                matched[free[np.argmax(iou[d, free])]] = True
                right += 1
            elif not np.any((labels.kind == -1) & (iou[d] > 0.3)):
                wrong += 1
        tall = labels.xyxy[:, 3] - labels.xyxy[:, 1] > 20
        for k in range(len(NAMES)):
            asked[k] += np.sum(tall & (labels.kind == k))
            hit[k] += np.sum(tall & (labels.kind == k) & matched)
    return {
        "images": len(data),
        "precision": right / max(right + wrong, 1),
        "recall": float(hit.sum() / asked.sum()),
        **{f"recall {name}": f"{hit[k]}/{asked[k]}" for k, name in enumerate(NAMES)},
        "milliseconds": 1e3 * seconds / len(data),
    }


def calibrate(
    network: Network, path: Path, data: Sequence[tuple[U8, Labels]], precision: float = 0.9
) -> None:
    """Shift the scores so that the usual threshold of 0.25 gives the precision asked for on ``data``."""
    for threshold in np.arange(0.25, 0.7, 0.05):
        reached = evaluate(path, data, float(threshold))["precision"]
        print(f"precision {reached:.3f} at {threshold:.2f}")
        if reached >= precision:
            break
    with torch.no_grad():
        network.scores[1].bias += float(np.log(0.25 / 0.75) - np.log(threshold / (1 - threshold)))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path, required=True, help="folder for the images, about 700 kB each")
    parser.add_argument("--out", type=Path, default=Path("bevviz/data/demo_detector.onnx"))
    parser.add_argument("--streets", type=int, default=23, help=f"training streets, {PER_SEED} images each")
    parser.add_argument("--minutes", type=float, default=38.0, help="of training, on two cores")
    parser.add_argument("--start", type=Path, help="weights to go on from: network.pt of an earlier --work")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    validation = dataset(options.work, "validation", VALIDATION_SEED, 6, options.threads)
    network = Network().eval()
    if options.start:
        network.load_state_dict(torch.load(options.start))
    if options.minutes > 0:
        data = dataset(options.work, "train", TRAIN_SEED, options.streets, options.threads)
        network = train(network, data, options.minutes, options.batch, options.seed)
        torch.save(network.state_dict(), options.work / "network.pt")
    export(network, options.out)
    calibrate(network, options.out, validation)
    export(network, options.out)
    count = sum(p.numel() for p in network.parameters())
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB, {count} parameters")
    held_out = dataset(options.work, "test", TEST_SEED, 5, options.threads)
    for name, value in evaluate(options.out, held_out).items():
        print(f"  {name}: {value}")


if __name__ == "__main__":
    main()
