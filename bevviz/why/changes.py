"""Parameter changes that may help against a reason. ``hints`` tests them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import ValidationError

from bevviz.config import Config, parameters, plugin_of, preset_differences, values
from bevviz.config.value_types import CLUSTERING, GROUND
from bevviz.errors import UserError
from bevviz.model.reasons import ReasonKind, facts_of
from bevviz.model.results import DetectionState, FrameResult
from bevviz.why.evidence import Candidate, Evidence
from bevviz.why.frame_index import FrameIndex
from bevviz.why.subject import NOISE

Change = Mapping[str, Any]  # dotted key -> value

LOWEST = 2  # percent of the points of a scan that may be lower than the floor
STEPS = (0.5, 2.0)  # factors of a number
FAR_STEPS = (0.25, 4.0)
_GRID: Mapping[str, tuple[str, ...]] = {  # numbers of each stage that are stepped, the most telling first
    "ground": ("ground.distance_threshold", "ground.max_step"),
    "clustering": (
        "clustering.min_points",
        "clustering.eps",
        "clustering.min_cluster_points",
        "clustering.max_cluster_points",
        "voxel.size",
    ),
    "detector": ("detector.conf_threshold", "detector.iou_threshold"),
    "fusion": (
        "fusion.min_iou",
        "fusion.min_points",
        "fusion.min_rating",
        "fusion.max_gap",
        "fusion.max_depth",
        "fusion.match_radius",
    ),
}
_STAGE_OF = {"voxel": "clustering", "objects": "fusion"}  # section -> stage, where their names differ
_METHODS: Mapping[str, tuple[Change, ...]] = {  # other methods of each stage
    "ground": ({"ground.method": "polar", "ground.distance_threshold": 0.2}, {"ground.method": "plane"}),
    "fusion": ({"fusion.method": "frustum"}, {"fusion.split": True}, {"fusion.split": False}),
}

# Parameters that bevviz applies to the output of user functions, too.
_SHARED_PARAMETERS = {"min_cluster_points", "max_cluster_points", "conf_threshold"}
_NEAR = {  # stage that lost a subject -> sections whose values may be the cause, the nearest first
    "ground": ("ground", "clustering"),
    "clustering": ("clustering", "ground", "fusion"),
    "detector": ("detector", "fusion"),
    "fusion": ("fusion", "clustering", "detector"),
    "objects": ("fusion", "clustering", "detector"),
}
_OTHER_OWNER = {  # another subject has the detection or the cluster
    ReasonKind.SHARED_BOX,
    ReasonKind.BORROWED,
    ReasonKind.TAKEN,
    ReasonKind.OTHER_CLUSTER,
    ReasonKind.MISNAMED,
}

_TUNED = {key for keys in _GRID.values() for key in keys} | {  # parameters that decide, unlike names of files
    key for changes in _METHODS.values() for change in changes for key in change
}


def with_changes(config: Config, change: Change) -> Config:
    """Return the configuration with other values."""
    tree = config.model_dump()
    for key, value in change.items():
        *path, name = key.split(".")
        section = tree
        for part in path:
            section = section[part]
        section[name] = value
    return config.restated(tree)


def stages_of(settings: Iterable[str]) -> tuple[str, ...]:
    """Return the stages that settings ``key=value`` change, in their order."""
    sections = {setting.partition(".")[0] for setting in settings}
    changed = {_STAGE_OF.get(section, section) for section in sections}
    return tuple(stage for stage in _GRID if stage in changed)


def restored_values(config: Config) -> Iterator[Change]:
    """Yield the preset's values of all parameters that have another value, together."""
    restored = {key: value for key, value in preset_differences(config).items() if key in _TUNED}
    if restored:
        yield restored


def stage_changes(stage: str, config: Config, factors: Sequence[float] = STEPS) -> Iterator[Change]:
    """Yield changes of one of our stages: the preset's values, other methods, and factors of its numbers."""
    present, differing = values(config), preset_differences(config)
    prefixes = ("clustering.", "voxel.") if stage == "clustering" else (f"{stage}.",)
    restored = {key: value for key, value in differing.items() if key in _TUNED and key.startswith(prefixes)}
    if restored:
        yield restored
    yield from ({key: value} for key, value in restored.items() if len(restored) > 1)
    for change in _METHODS.get(stage, ()):
        if any(present[key] != value for key, value in change.items()):
            yield change
    yield from stepped_numbers(stage, config, factors)


def other_methods(stages: Iterable[str], config: Config) -> tuple[str, ...]:
    """Return the other built-in methods of some stages, as settings ``key=value``."""
    fusion = parameters()["fusion.method"].choices
    built_in = {"ground": GROUND.ours, "clustering": CLUSTERING.ours, "fusion": fusion}
    present = values(config)
    return tuple(
        f"{stage}.method={method}"
        for stage in dict.fromkeys(stages)
        for method in built_in.get(stage, ())
        if method != present[f"{stage}.method"]
    )


def stepped_numbers(stage: str, config: Config, factors: Sequence[float]) -> Iterator[Change]:
    """Yield the numbers of a stage times some factors, within their bounds."""
    present = values(config)
    keys = [key for key in _GRID[stage] if present[key] is not None]
    for factor in factors:
        for key in keys:
            value, declared = present[key] * factor, parameters()[key]
            value = max(1, round(value)) if isinstance(present[key], int) else float(f"{value:.3g}")
            high = math.inf if declared.high is None else declared.high
            if value != present[key] and (declared.low or 0) <= value <= high:
                yield {key: value}


def changes_for(
    evidence: Evidence, kind: ReasonKind, traces: FrameIndex, *, is_false: bool = False
) -> Iterator[Change]:
    """Yield changes that may help: parameters of our stages, or of the user's function.

    Args:
        evidence: evidence about the subject.
        kind: kind of the reason why it was lost, or is false.
        traces: index of the frame.
        is_false: whether it is a false object.
    """
    result = traces.result
    stage = facts_of(kind).stage
    section = "objects" if stage == "fusion" else stage
    if stage in _NEAR and not traces.origin(section).ours:
        yield from _function_changes(result, section)
    if not traces.origin("objects").ours:
        return
    for change in (
        *_our_changes(evidence, kind, result, is_false=is_false),
        *_stated_height(kind, result),
    ):
        if all(_has_effect(key, traces) for key in change):
            yield change


def _has_effect(key: str, traces: FrameIndex) -> bool:
    """Return whether a parameter has an effect. Ours have none on a stage that is not ours."""
    section, _, name = key.partition(".")
    if section not in ("ground", "clustering", "detector"):
        return True
    owner = traces.origin(section)
    return owner.ours or (bool(owner.function) and name in _SHARED_PARAMETERS)


def _function_changes(result: FrameResult, section: str) -> Iterator[Change]:
    """Yield halves and doubles of the numeric parameters of a user's function, within their bounds."""
    try:
        plugin = plugin_of(result.config, section)
    except UserError:
        return
    if plugin is None or plugin.params is None:
        return
    params = dict(getattr(result.config, section).params)
    for factor in (0.5, 2.0):
        for name, value in params.items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not value:
                continue
            other = type(value)(round(value * factor)) if isinstance(value, int) else round(value * factor, 6)
            try:
                plugin.params.model_validate({**params, name: other})
            except ValidationError:
                continue
            if other != value:
                yield {f"{section}.params.{name}": other}


def _our_changes(
    evidence: Evidence, kind: ReasonKind, result: FrameResult, *, is_false: bool
) -> Iterator[Change]:
    """Yield changes of our parameters that may help against a kind of reason."""
    config, best, named = result.config, evidence.best, evidence.named
    clustering, count = config.clustering, 0 if evidence.aside is None else evidence.aside.count
    yield from _restored_values(kind, config)
    if kind is ReasonKind.GROUND:
        yield from _ground_changes(config)
    elif kind is ReasonKind.NOISE:
        for points in _smaller_min_points(evidence.neighbours, clustering.min_points):
            yield {"clustering.min_points": points}
            if points < clustering.min_cluster_points:
                yield {"clustering.min_points": points, "clustering.min_cluster_points": points}
        yield from _scaled(config, "clustering.eps", 1.5, 2.0)
        yield from _ground_changes(config)
    elif kind is ReasonKind.TOO_SMALL:
        yield {"clustering.min_cluster_points": max(count, 1)}
        yield from _scaled(config, "clustering.eps", 1.5)
    elif kind is ReasonKind.TOO_LARGE:
        yield {"clustering.max_cluster_points": count}
    elif is_false and named is not None and result.objects is not None:
        yield from _changes_against_false(kind, float(result.objects.score[named.row]), config)
    elif kind is ReasonKind.MISPLACED:
        yield from _regrouped(config, 0.8, 1.5)
    elif kind is ReasonKind.MERGED:
        if evidence.joined_by is not None:
            yield from _scaled(config, "fusion.min_rating", 2.0)
            yield {"fusion.split": False}
        if config.fusion.method == "frustum" and not config.fusion.split:
            yield {"fusion.split": True}
        if evidence.finer:
            yield from ({"clustering.eps": round(evidence.finer * factor, 3)} for factor in (1.0, 0.85, 0.7))
        elif not evidence.mates:
            yield from _scaled(config, "clustering.eps", 0.8, 0.6, 0.4)
    elif kind is ReasonKind.SPLIT:
        # The distance is unknown if one of the parts is not a cluster.
        yield {"clustering.eps": round(max(np.nan_to_num(evidence.apart), clustering.eps) * 1.1, 3)}
        yield {"clustering.min_points": max(1, clustering.min_points // 2)}
        yield from _scaled(config, "clustering.eps", 1.5)
    elif best is not None:
        yield from _detection_changes(kind, best, config)


def _stated_height(kind: ReasonKind, result: FrameResult) -> Iterator[Change]:
    """Yield the height of the sensor above the lowest points, where the ground was estimated.

    It helps where a ceiling, a table or a roof was taken for the ground.
    """
    points = result.frame.points
    if kind is ReasonKind.GROUND and result.config.ground.sensor_height is None and len(points):
        height = -round(float(np.percentile(points[:, 2], LOWEST)), 2)
        if height > 0:
            yield {"ground.sensor_height": height}


def _restored_values(kind: ReasonKind, config: Config) -> Iterator[Change]:
    """Yield the preset's value of each number that was changed in a stage that may have lost the subject."""
    differing = preset_differences(config)
    for section in _NEAR.get(facts_of(kind).stage, ()):
        for key, value in differing.items():
            if key.startswith(f"{section}.") and isinstance(value, int | float):
                yield {key: value}


def _changes_against_false(kind: ReasonKind, score: float, config: Config) -> Iterator[Change]:
    """Yield changes that may remove a false object: those for its cause, then stricter limits."""
    method = config.fusion.method
    if kind is ReasonKind.DUPLICATE:
        yield from _scaled(config, "detector.iou_threshold", 0.8, 0.6)
    if kind in (ReasonKind.DUPLICATE, ReasonKind.SPLIT):
        yield from _regrouped(config, 1.5)
    elif kind is not ReasonKind.DETECTOR_ERROR:
        yield from _regrouped(config, 0.8, 1.5)
    if method == "frustum":
        yield from _scaled(config, "fusion.min_rating", 2.0, 4.0)
        yield from _scaled(config, "fusion.min_iou", 2.0, 3.0)
    elif kind in (ReasonKind.WALL, ReasonKind.WRONG_DEPTH, ReasonKind.DUPLICATE):
        yield {"fusion.method": "frustum"}
    if score < 0.6:  # A higher threshold would lose too many right objects.
        yield {"detector.conf_threshold": math.floor(100 * score + 1) / 100}


def _regrouped(config: Config, *factors: float) -> Iterator[Change]:
    """Yield changes that group the points in another way: by the detections, or by another eps."""
    if config.fusion.method == "frustum":
        yield {"fusion.split": not config.fusion.split}
    yield from _scaled(config, "clustering.eps", *factors)


def _scaled(config: Config, key: str, *factors: float) -> Iterator[Change]:
    """Yield a number times some factors. A rating is small, and keeps four decimals."""
    present, decimals = values(config)[key], 4 if key == "fusion.min_rating" else 3
    yield from ({key: round(present * factor, decimals)} for factor in factors)


def _detection_changes(kind: ReasonKind, best: Candidate, config: Config) -> Iterator[Change]:
    """Yield changes that may help a subject that has a detection."""
    if kind is ReasonKind.BELOW_THRESHOLD:
        # A threshold that lets noise pass is no advice.
        if best.score >= NOISE:
            passes = {"detector.conf_threshold": math.floor(100 * best.score) / 100}
            yield passes
            if best.state == DetectionState.SUPPRESSED:
                yield from ({**passes, "detector.iou_threshold": value} for value in (0.6, 0.7, 0.8, 0.9))
            if config.fusion.method == "frustum" and config.fusion.split:
                # The rating of a match is proportional to the score.
                weak = config.fusion.min_rating * best.score / config.detector.conf_threshold
                yield from ({**passes, "fusion.min_rating": round(weak * factor, 4)} for factor in (1.0, 0.5))
    elif kind is ReasonKind.SUPPRESSED:
        yield from ({"detector.iou_threshold": value} for value in (0.6, 0.7, 0.8, 0.9))
    elif kind is ReasonKind.LOW_OVERLAP:
        yield from _scaled(config, "fusion.min_iou", 0.5, 0.2, 0.0)
        yield from _scaled(config, "clustering.eps", 0.6)
    elif kind is ReasonKind.MISFIT:
        yield from _scaled(config, "fusion.min_rating", 0.5, 0.2)
        yield {"fusion.split": False}
    elif kind is ReasonKind.TOO_FEW_POINTS:
        yield from ({"fusion.min_points": value} for value in range(config.fusion.min_points - 1, 0, -1))
    elif kind in _OTHER_OWNER:
        if config.fusion.method == "centroid":
            yield {"fusion.method": "frustum"}
        elif kind in (ReasonKind.TAKEN, ReasonKind.OTHER_CLUSTER):
            yield from _regrouped(config, 0.8, 0.6)
    elif kind is ReasonKind.TOO_FAR and config.fusion.method == "centroid":
        # The subject has no cluster of its own: the fusion compared the nearest other one.
        yield from _ground_changes(config)
        yield {"fusion.method": "frustum"}
    elif kind is ReasonKind.TOO_FAR:
        yield {"fusion.max_depth": 200.0}


def _ground_changes(config: Config) -> Iterator[Change]:
    """Yield thinner ground layers, and for a plane also a ground that follows the road."""
    ground, points = config.ground, max(1, config.clustering.min_points // 3)
    for threshold in (0.3, 0.2, 0.1):
        if threshold < ground.distance_threshold:
            yield {"ground.distance_threshold": threshold}
    if ground.method == "plane":
        yield {"ground.method": "polar", "ground.distance_threshold": 0.2}
        yield {"ground.method": "polar", "ground.distance_threshold": 0.2, "clustering.min_points": points}


def _smaller_min_points(neighbours: int, limit: int) -> list[int]:
    """Return values of min_points to try: the number that the best point reaches, and less."""
    tries = [neighbours, round(neighbours * 0.75), neighbours // 2]
    return [n for n in dict.fromkeys(tries) if 2 <= n < limit]
