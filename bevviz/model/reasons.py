"""Reasons of decisions: one vocabulary for stages, explanations, state lanes and the answers of ``why``.

A reason holds the parameter that decided, and the values that were compared in a clause.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from functools import cache, lru_cache
from typing import Any, NamedTuple

from bevviz.config import METHOD_KEYS, Config, method_label, parameters
from bevviz.config.plugins import TOPIC
from bevviz.errors import UserError


class ReasonKind(StrEnum):
    """The stage or rule that decided. The order is that of the stages."""

    REPORTED = "reported"
    SHARED_BOX = "shared box"  # reported, but its box also names other clusters
    BORROWED = "borrowed name"  # named by a detection that is not its own
    SPLIT = "split"
    MERGED = "merged"
    MISNAMED = "misnamed"
    MISPLACED = "misplaced"  # its object is farther off than evaluate allows
    DUPLICATE = "duplicate"  # false: a second object of something that another object is already
    WRONG_DEPTH = "wrong depth"  # false: the detection is right, and the points are of something else
    WALL = "wall in the frustum"  # false: its points are a part of something larger
    DETECTOR_ERROR = "detector's own error"  # false: nothing is where the detector sees it
    FAILED = "failed"
    OUT_OF_VIEW = "out of view"
    HIDDEN = "hidden"
    NO_POINTS = "no points"
    GROUND = "ground"
    NOISE = "noise"
    NO_CLUSTER = "no cluster"  # of a user's function or the robot; or none in a detection's frustum
    TOO_SMALL = "too small"
    TOO_LARGE = "too large"
    NOT_RUN = "detector not run"
    NOT_DETECTED = "not detected"
    BELOW_THRESHOLD = "below threshold"
    SUPPRESSED = "suppressed"
    SECOND_NAME = "second name"  # not a miss: the thing is reported by another detection
    NOT_FUSED = "not fused"
    LOW_OVERLAP = "low overlap"
    TOO_FEW_POINTS = "too few points"
    TOO_FAR = "too far"
    TAKEN = "taken"
    MISFIT = "misfit"
    OTHER_CLUSTER = "other cluster"
    CONTRADICTED = "contradicted"  # reported by a stage that is not ours, and a camera sees nothing there
    NOT_AMONG = "not among the objects"  # of a 3D detector, or of a robot whose stages are unknown
    LOST_IN_FUSION = "lost in the fusion"  # in the robot's fusion, although it had a cluster and a detection
    # The rest are reasons of single decisions, which no subject of ``why`` has.
    KEPT = "kept"
    NOT_KEPT = "not kept"
    MATCHED = "matched"
    NO_DETECTION = "no detection"
    CONFIRMED = "confirmed"
    NAMED_OTHERWISE = "named otherwise"
    UNSEEN = "unseen"
    MISSED = "missed"
    IN_BOTH = "found"
    PROBLEM = "problem"


class ReasonFacts(NamedTuple):
    """Facts about a kind of reason that an answer can have.

    Attributes:
        meaning: its meaning, for the docs and the page.
        stage: stage that lost the object, or made the false one; empty: none.
        decides: parameter that decides; empty: none.
        searched: parameters that ``fix`` searches, because they change how often it comes to this reason.
    """

    meaning: str
    stage: str = ""
    decides: str = ""
    searched: tuple[str, ...] = ()


_GROUND = ("ground.distance_threshold", "ground.method", "clustering.min_points", "voxel.size")
_GROUPS = ("clustering.eps", "clustering.min_points", "clustering.min_cluster_points", "voxel.size")
_MATCH = ("fusion.min_rating", "fusion.min_iou", "fusion.min_points", "fusion.split", "fusion.method")
FACTS: Mapping[str, ReasonFacts] = {
    ReasonKind.SHARED_BOX: ReasonFacts(
        "the image box that names it names other clusters, too",
        "fusion",
        searched=("fusion.method", "fusion.split"),
    ),
    ReasonKind.BORROWED: ReasonFacts(
        "the image box of another object names it",
        "fusion",
        searched=("fusion.method", "clustering.eps", "fusion.split"),
    ),
    ReasonKind.SPLIT: ReasonFacts(
        "it is spread over several clusters; of a false object: it is a part of a labelled one",
        "clustering",
        searched=("clustering.eps", "clustering.min_points", "fusion.split", "voxel.size"),
    ),
    ReasonKind.MERGED: ReasonFacts(
        "its cluster holds another object; the answer names the gap and the eps for it",
        "clustering",
        decides="clustering.eps",
        searched=("clustering.eps", "fusion.split", "fusion.min_rating", "fusion.method", "voxel.size"),
    ),
    ReasonKind.MISNAMED: ReasonFacts(
        "a detection of another class names it",
        "fusion",
        searched=("fusion.method", "detector.iou_threshold", "detector.conf_threshold"),
    ),
    ReasonKind.MISPLACED: ReasonFacts(
        "its object is farther off than evaluate allows",
        "fusion",
        searched=("clustering.eps", "fusion.split", "fusion.method", "voxel.size"),
    ),
    ReasonKind.DUPLICATE: ReasonFacts(
        "false: another object is the same thing already",
        "fusion",
        searched=(
            "detector.iou_threshold",
            "clustering.eps",
            "fusion.split",
            "fusion.min_rating",
            "fusion.min_iou",
        ),
    ),
    ReasonKind.WRONG_DEPTH: ReasonFacts(
        "false: its image box is right, and its points are before or behind the thing",
        "fusion",
        searched=(*_MATCH, "clustering.eps"),
    ),
    ReasonKind.WALL: ReasonFacts(
        "false: its points are a part of something larger", "fusion", searched=(*_MATCH, "clustering.eps")
    ),
    ReasonKind.DETECTOR_ERROR: ReasonFacts(
        "false: no label is in reach; it is unlabelled, or the detector's own error",
        "detector",
        searched=("detector.conf_threshold", "fusion.min_rating", "fusion.min_iou"),
    ),
    ReasonKind.FAILED: ReasonFacts("a stage failed"),
    ReasonKind.OUT_OF_VIEW: ReasonFacts("no camera sees it", "sensors"),
    ReasonKind.HIDDEN: ReasonFacts(
        "fewer than three points; most returns in its direction end before it", "sensors"
    ),
    ReasonKind.NO_POINTS: ReasonFacts(
        "the LiDAR has fewer than three points there", "sensors", searched=("voxel.size",)
    ),
    ReasonKind.GROUND: ReasonFacts(
        "most of it was removed as ground",
        "ground",
        decides="ground.distance_threshold",
        searched=(*_GROUND, "clustering.min_cluster_points"),
    ),
    ReasonKind.NOISE: ReasonFacts(
        "no point has clustering.min_points neighbours within clustering.eps",
        "clustering",
        decides="clustering.min_points",
        searched=(*_GROUPS, "ground.distance_threshold"),
    ),
    ReasonKind.NO_CLUSTER: ReasonFacts(
        "your function or the robot lost it",
        "clustering",
        searched=(*_GROUPS, "ground.distance_threshold", "fusion.max_depth"),
    ),
    ReasonKind.TOO_SMALL: ReasonFacts(
        "its cluster has too few points",
        "clustering",
        decides="clustering.min_cluster_points",
        searched=("clustering.min_cluster_points", "clustering.eps", "clustering.min_points", "voxel.size"),
    ),
    ReasonKind.TOO_LARGE: ReasonFacts(
        "its cluster has too many points",
        "clustering",
        decides="clustering.max_cluster_points",
        searched=("clustering.max_cluster_points", "clustering.eps"),
    ),
    ReasonKind.NOT_RUN: ReasonFacts("no model, no image or no camera", "detector"),
    ReasonKind.NOT_DETECTED: ReasonFacts(
        "the detector has no candidate there",
        "detector",
        decides="detector.explain_threshold",
        searched=("detector.conf_threshold",),
    ),
    ReasonKind.BELOW_THRESHOLD: ReasonFacts(
        "the detector's score is too low",
        "detector",
        decides="detector.conf_threshold",
        searched=("detector.conf_threshold", "fusion.min_rating"),
    ),
    ReasonKind.SUPPRESSED: ReasonFacts(
        "a better detection overlaps it; the answer names it and the IoU",
        "detector",
        decides="detector.iou_threshold",
        searched=("detector.iou_threshold",),
    ),
    ReasonKind.SECOND_NAME: ReasonFacts(
        "probably a second box of a reported thing: nothing was missed", "detector"
    ),
    ReasonKind.NOT_FUSED: ReasonFacts("its camera lacks a calibration or a pose", "fusion"),
    ReasonKind.LOW_OVERLAP: ReasonFacts(
        "its points cover too little of the image box",
        "fusion",
        decides="fusion.min_iou",
        searched=("fusion.min_iou", "clustering.eps", "fusion.method", "fusion.split"),
    ),
    ReasonKind.TOO_FEW_POINTS: ReasonFacts(
        "too few of its points are in the image box",
        "fusion",
        decides="fusion.min_points",
        searched=("fusion.min_points", "clustering.min_points", "voxel.size", "ground.distance_threshold"),
    ),
    ReasonKind.TOO_FAR: ReasonFacts(
        "it is too far away, for `reference` too many pixels from the image box",
        "fusion",
        decides="fusion.max_depth",
        searched=("fusion.max_depth", "fusion.method", "ground.distance_threshold"),
    ),
    ReasonKind.TAKEN: ReasonFacts(
        "a better detection has its cluster",
        "fusion",
        searched=("fusion.method", "clustering.eps", "detector.iou_threshold", "fusion.min_iou"),
    ),
    ReasonKind.MISFIT: ReasonFacts(
        "no candidate in the frustum is rated high enough",
        "fusion",
        decides="fusion.min_rating",
        searched=("fusion.min_rating", "fusion.split", "clustering.eps"),
    ),
    ReasonKind.OTHER_CLUSTER: ReasonFacts(
        "its detection has another cluster",
        "fusion",
        searched=("fusion.method", "clustering.eps", "fusion.split"),
    ),
    ReasonKind.CONTRADICTED: ReasonFacts(
        "your function or the robot has it, and a camera that sees the place does not", "objects"
    ),
    ReasonKind.NOT_AMONG: ReasonFacts(
        "it is not among the objects of your function or of the robot", "objects"
    ),
    ReasonKind.LOST_IN_FUSION: ReasonFacts(
        "the robot has its cluster and its detection, and no object of them", "fusion"
    ),
}

_NO_FACTS = ReasonFacts("")


def facts_of(kind: str) -> ReasonFacts:
    """Return the facts of a kind of reason. Kinds that no answer has have no facts."""
    return FACTS.get(kind, _NO_FACTS)


@lru_cache(typed=True)  # members of two enumerations are equal numbers
def kind_of(state: IntEnum) -> ReasonKind:
    """Return the kind that a state of a detection, a cluster or a pair has as a reason."""
    return ReasonKind(state.name.lower().replace("_", " "))


@dataclass(frozen=True, slots=True)
class Limit:
    """A parameter and its value."""

    key: str
    value: float | int | str
    unit: str = ""

    @property
    def number(self) -> str:
        """The value with its unit."""
        text = f"{self.value:g}" if isinstance(self.value, float) else str(self.value)
        return f"{text} {self.unit}".rstrip()

    @property
    def short(self) -> str:
        """The key and the value, for texts in brackets."""
        return f"{self.key} {self.number}"

    def __str__(self) -> str:
        """Return the sentence about the parameter."""
        return f"{self.key} is {self.number}"


def limit(config: Config, key: str) -> Limit:
    """Return a parameter of the configuration."""
    section, name = key.split(".")
    return Limit(key, getattr(getattr(config, section), name), _unit(key))


@cache
def _unit(key: str) -> str:
    """Return the symbol of a parameter's unit."""
    return next(iter(parameters()[key].spellings), "")


def limit_of(kind: ReasonKind, config: Config) -> Limit | None:
    """Return the parameter that decides about a kind of reason, None if there is none."""
    key = facts_of(kind).decides
    if kind is ReasonKind.TOO_FAR and config.fusion.method == "centroid":
        key = "fusion.match_radius"
    return limit(config, key) if key else None


class Scored(NamedTuple):
    """A class name with its score."""

    name: str
    score: float

    def __str__(self) -> str:
        return f"{self.name} {self.score:.2f}"

    def beside(self, limit: float) -> str:
        """Return the score with as many digits as tell it from a limit, two at least."""
        texts = (f"{self.score:.{digits}f}" for digits in range(2, 8))
        return next((text for text in texts if float(text) != round(limit, 7)), f"{self.score:.2f}")


def scored(items: Any, row: int) -> Scored:
    """Return name and score of a row of detections or objects."""
    return Scored(items.names[row], float(items.score[row]))


@dataclass(frozen=True, slots=True)
class Reason:
    """The reason of one decision.

    Attributes:
        kind: the rule.
        limit: the parameter that decided, None if no parameter of ours did.
        text: clause with the values that were compared; empty: the explanation of the decision has them.
        by: user's function or topic of the robot that decided; empty: bevviz.
    """

    kind: ReasonKind
    limit: Limit | None = None
    text: str = ""
    by: str = ""


# --- owners of stages --------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class StageOwner:
    """The owner of one stage: bevviz, a user's function, or a topic of the robot.

    Attributes:
        section: section of the configuration.
        function: ``module:name`` of the user's function; empty: none.
        topic: topic of the robot; empty: none.
    """

    section: str
    function: str = ""
    topic: str = ""

    @property
    def ours(self) -> bool:
        """Whether the stage is part of bevviz."""
        return not self.function and not self.topic

    @property
    def name(self) -> str:
        """Name of the function or topic for sentences, empty for our stages."""
        return self.function or self.topic


def owner_of(config: Config, section: str) -> StageOwner:
    """Return the owner of the stage of a section."""
    method = str(getattr(getattr(config, section), METHOD_KEYS[section]))
    if method.startswith(TOPIC):
        return StageOwner(section, topic=method.removeprefix(TOPIC))
    try:
        return StageOwner(section, function=method_label(config, section))
    except UserError:  # The function could be loaded when the frame was run.
        return StageOwner(section, function=method)
