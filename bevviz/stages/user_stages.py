"""User-defined stages: call them, check what they return, derive the other fields of the result."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bevviz.config import ClusteringConfig, Config, is_stage_file, method_label, method_of, plugin_of
from bevviz.config.plugins import Plugin, describe_exception
from bevviz.errors import FunctionError, StageError, UserError, interrupt_in
from bevviz.model.box_points import inside_each
from bevviz.model.frame import F32, I32, Bool, Boxes3D
from bevviz.model.results import Clusters, Detections, DetectionState, Ground, Objects
from bevviz.stages.clustering import describe_clusters

CELL = 1.0  # metres: edge of a cell of the ground level, which is derived from ground points
ROUNDING = 1e-3  # of a network in half precision, by which a score may leave 0 to 1
REACH = 200.0  # metres around the origin within which that level is stored


@dataclass(frozen=True, slots=True, eq=False)
class UserStage:
    """A user's function with its parameters.

    Attributes:
        plugin: the function or class.
        call: the function with its parameters, or the instance of the class.
        name: ``module:function``, or the name of the file that the stage reads.
        provider: what the stage runs on, of the attribute ``provider`` of its class; empty: it has none.
        identity: what its results depend on beside the array, its files and its code, of the attribute
            ``identity`` of its class. Results of a stage with this text may be kept; empty: it has none.
    """

    plugin: Plugin
    call: Callable[..., Any]
    name: str
    provider: str = ""
    identity: str = ""

    def __call__(self, array: NDArray[Any], stamp: int, number: int, sensor: str) -> Any:
        """Call the function with a copy of the array, so that it cannot change the frame.

        Args:
            array: points or image.
            stamp: nanoseconds, of the frame.
            number: number of the frame.
            sensor: name of the LiDAR or the camera.

        Raises:
            FunctionError: the function raised an exception, or wanted to end the process.
            KeyboardInterrupt: the user wants to end, even if the function turned that into another error.
        """
        facts = {"stamp": stamp, "number": number, "sensor": sensor}
        try:
            return self.call(array.copy(), **{name: facts[name] for name in self.plugin.facts})
        except (UserError, StageError):
            raise
        except (Exception, SystemExit) as error:
            if interrupt_in(error):
                raise KeyboardInterrupt from error
            reason = describe_exception(error, self.plugin.file)
            raise FunctionError(f"{self.name} raised {reason}") from error


def load_user_stage(config: Config, section: str) -> UserStage | None:
    """Return the user's function that a stage's section names; None if the section names a built-in method.

    Raises:
        UserError: the function cannot be imported, or its class cannot be instantiated.
    """
    plugin = plugin_of(config, section)
    if plugin is None:
        return None
    label, params = method_label(config, section), []
    if plugin.takes_params and plugin.params is not None:
        params.append(plugin.params.model_validate(getattr(config, section).params))
    if not isinstance(plugin.target, type):
        return UserStage(plugin, lambda array, **facts: plugin.target(array, *params, **facts), label)
    settings: dict[str, Any] = {"provider": config.detector.provider, "threads": config.detector.threads}
    if is_stage_file(section, method := method_of(config, section)):
        settings["file"] = Path(method)
    try:
        instance = plugin.target(
            *params, **{name: settings[name] for name in plugin.settings if name in settings}
        )
    except UserError:
        raise
    except (Exception, SystemExit) as error:  # A user's class may raise anything.
        reason = describe_exception(error, plugin.file)
        raise UserError(f"{section}: {plugin.name} cannot be made: {reason}") from error
    if not callable(instance):
        raise UserError(f"{section}: {plugin.name} makes a {type(instance).__name__} that cannot be called")
    provider, identity = (str(getattr(instance, name, "")) for name in ("provider", "identity"))
    return UserStage(plugin, instance, label, provider, identity)


# --- the stages --------------------------------------------------------------------------------


def ground_of(points: F32, returned: Any, name: str) -> Ground:
    """Make Ground from the returned (N,) bool mask. The heights above the ground are derived.

    Raises:
        StageError: the function returned something else.
    """
    mask = _check_array(name, returned, "a mask", (len(points),), "b")
    return Ground(mask.astype(np.bool_), heights_above_ground(points, mask))


def clusters_of(points: F32, config: ClusteringConfig, returned: Any, name: str) -> Clusters:
    """Make Clusters from the returned (P,) int labels, -1 for noise. Counts, boxes and sizes are derived.

    Raises:
        StageError: the function returned something else.
    """
    labels = _check_array(name, returned, "labels", (len(points),), "iu").astype(np.int64)
    if len(labels) and labels.min() < -1:
        raise StageError(f"{name} returned label {labels.min()}: -1 is noise, 0 the first")
    return describe_clusters(points, _renumber(labels), config)


def detections_of(threshold: float, returned: Any, name: str) -> Detections:
    """Make Detections from the returned ``xyxy (D, 4), score (D,), names``, best score first.

    The function was called with a (H, W, 3) BGR image.

    Raises:
        StageError: the function returned something else.
    """
    xyxy, score, names = _unpack_three(name, returned, "xyxy, score and class names")
    xyxy = _check_array(name, xyxy, "boxes xyxy", (-1, 4), "fiu").astype(np.float32)
    score, names = _check_scores(name, len(xyxy), score, names)
    _check_corners(name, xyxy)
    order = np.argsort(-score, kind="stable")
    kept = score[order] >= threshold
    return Detections(
        xyxy=xyxy[order],
        score=score[order],
        class_id=np.array([zlib.crc32(names[d].encode()) >> 1 for d in order], np.int32),
        names=tuple(names[d] for d in order),
        state=np.where(kept, DetectionState.KEPT, DetectionState.BELOW_THRESHOLD).astype(np.int32),
        suppressed_by=np.full(len(order), -1, np.int32),
        overlap=np.zeros(len(order), np.float32),
    )


def objects_of(returned: Any, name: str, obstacles: F32 | None, clusters: Clusters | None) -> Objects:
    """Make Objects from the returned ``boxes (K, 7), score (K,), names``.

    The function was called with an (N, 4) array of x, y, z, intensity. A box is x, y, z of its centre,
    length, width, height and yaw, in metres and radians. The cluster of each object is derived.

    Raises:
        StageError: the function returned something else.
    """
    rows, score, names = _unpack_three(name, returned, "boxes, score and class names")
    rows = _check_array(name, rows, "boxes", (-1, 7), "fiu").astype(np.float32)
    if (rows[:, 3:6] <= 0).any():
        raise StageError(f"{name} returned a box without a volume: its columns are x y z l w h yaw")
    score, names = _check_scores(name, len(rows), score, names)
    return make_objects(Boxes3D(rows[:, :3], rows[:, 3:6], rows[:, 6]), names, score, obstacles, clusters)


def with_intensity(points: F32, intensity: NDArray[Any] | None) -> F32:
    """Return (N, 4) x, y, z and intensity, 0 for a sensor without intensity."""
    cloud = np.zeros((len(points), 4), np.float32)
    cloud[:, :3] = points
    if intensity is not None:
        cloud[:, 3] = intensity
    return cloud


def make_objects(
    boxes: Boxes3D, names: Sequence[str], score: F32, obstacles: F32 | None, clusters: Clusters | None
) -> Objects:
    """Make objects from boxes without detections. An object's cluster has the most points in its box.

    Only kept clusters count. An object without such a cluster gets -1.
    """
    cluster = np.full(len(boxes), -1, np.int32)
    if obstacles is not None and clusters is not None:
        kept = np.append(clusters.kept, False)
        candidates = np.flatnonzero(kept[clusters.labels])  # noise has label -1, the last element
        points, labels = obstacles[candidates], clusters.labels[candidates]
        for k, rows in inside_each(points, boxes):
            if len(rows):
                cluster[k] = np.bincount(labels[rows]).argmax()
    detection = np.full(len(boxes), -1, np.int32)
    return Objects(boxes, tuple(names), score, cluster, ("",) * len(boxes), detection)


def heights_above_ground(points: F32, ground: Bool) -> F32:
    """Return (N,) metres above the ground near each point, derived from the ground points.

    The ground level of a square metre is the mean of its ground points. Without ground points it is that of
    the nearest square metre with some. All heights are NaN if there is no ground.
    """
    if not ground.any():
        return np.full(len(points), np.nan, np.float32)
    size = int(2 * REACH / CELL)
    cells = np.clip((points[:, :2] + REACH) / CELL, 0, size - 1).astype(np.int32)
    cell = cells[:, 1] * size + cells[:, 0]
    count = np.bincount(cell[ground], minlength=size * size)
    total = np.bincount(cell[ground], points[ground, 2], minlength=size * size)
    known = np.flatnonzero(count)
    empty = (count == 0).astype(np.uint8).reshape(size, size)
    _, nearest = cv2.distanceTransformWithLabels(
        empty, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    # OpenCV numbers the known cells from 1 in an unspecified order. Look the numbers up at the cells.
    level = np.zeros(len(known) + 1)
    level[nearest.ravel()[known]] = total[known] / count[known]
    return np.asarray(points[:, 2] - level[nearest.ravel()[cell]], np.float32)


# --- checks of returned values -----------------------------------------------------------------


def _check_array(name: str, value: Any, what: str, shape: tuple[int, ...], kinds: str) -> NDArray[Any]:
    """Return the value as a finite array of that shape (-1: any length) and kind of dtype."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as error:  # e.g. a tensor on another device or a ragged list
        raise StageError(f"{name} returned no array for {what}: {error}") from None
    if array.size == 0 and shape[0] in (-1, 0):
        return np.zeros((0, *shape[1:]), array.dtype if array.dtype.kind in kinds else kinds[0])
    wanted = ", ".join("any" if n < 0 else str(n) for n in shape)
    if array.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, array.shape, strict=True)):
        raise StageError(f"{name} returned {what} of shape {array.shape}, not ({wanted})")
    if array.dtype.kind not in kinds:
        kind = {"b": "bool", "iu": "integers", "fiu": "numbers"}[kinds]
        raise StageError(f"{name} returned {what} of type {array.dtype}, not {kind}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise StageError(
            f"{name} returned {what} with {np.isnan(array).sum()} NaN and {np.isinf(array).sum()} inf"
        )
    return array


def _unpack_three(name: str, value: Any, what: str) -> tuple[Any, Any, Any]:
    """Unpack a tuple or list of three values."""
    if not isinstance(value, tuple | list) or len(value) != 3:
        count = f"{len(value)} values" if isinstance(value, tuple | list) else f"a {type(value).__name__}"
        raise StageError(f"{name} returned {count}, not {what}")
    return value[0], value[1], value[2]


def _check_corners(name: str, xyxy: F32) -> None:
    """Raise StageError if boxes are not left, top, right, bottom in pixels."""
    swapped = np.flatnonzero((xyxy[:, 2:] < xyxy[:, :2]).any(axis=1))
    if len(swapped):
        box = " ".join(f"{value:g}" for value in xyxy[swapped[0]])
        raise StageError(
            f"{name} returned {len(swapped)} of {len(xyxy)} boxes with swapped corners ({box}): a box is "
            "left, top, right, bottom, not a corner and a size"
        )
    if len(xyxy) and xyxy.max() <= 1:
        raise StageError(
            f"{name} returned boxes within one pixel: corners are pixels, not shares of the image"
        )


def _check_scores(name: str, count: int, score: Any, names: Any) -> tuple[F32, list[str]]:
    """Check scores and names of boxes."""
    scores = _check_array(name, score, "scores", (count,), "fiu").astype(np.float32)
    wrong = scores[(scores < -ROUNDING) | (scores > 1 + ROUNDING)]
    if len(wrong):
        raise StageError(f"{name} returned a score of {wrong[0]:g}: scores are from 0 to 1")
    try:
        listed = [str(text) for text in names]
    except TypeError:
        raise StageError(f"{name} returned a {type(names).__name__} for class names") from None
    if len(listed) != count:
        raise StageError(f"{name} returned {len(listed)} class names for {count} boxes")
    return scores, listed


def _renumber(labels: NDArray[np.int64]) -> I32:
    """Renumber the clusters in the order of their first points."""
    values, first, number = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(values), np.int32)
    rank[np.argsort(np.where(values < 0, -1, first), kind="stable")] = np.arange(len(values))
    noise = int(len(values) > 0 and values[0] < 0)
    return np.asarray(rank[number.ravel()] - noise, np.int32)
