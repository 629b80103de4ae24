"""Parameters that the ONNX file of a 3D detector does not state, for ``objects.method=FILE.onnx``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PositiveFloat,
    ValidationInfo,
    field_validator,
)
from pydantic_core import PydanticCustomError

from bevviz.config.value_types import COMPLETE_SENTENCE

MAX_POINTS = 1000  # Most points of a pillar. Known networks have up to 100.

Feature = Literal[
    "x",
    "y",
    "z",
    "intensity",
    "time",
    "mean_x",
    "mean_y",
    "mean_z",
    "center_x",
    "center_y",
    "center_z",
    "distance",
]
Share = Annotated[float, Field(ge=0, le=1)]
Size3D = tuple[PositiveFloat, PositiveFloat, PositiveFloat]
PointRange = tuple[float, float, float, float, float, float]


def _complete_error(sentence: str) -> PydanticCustomError:
    """Return an error for pydantic with a complete sentence."""
    return PydanticCustomError(COMPLETE_SENTENCE, "{sentence}", {"sentence": sentence})


def _empty_is_none(value: Any) -> Any:
    """Return None for an empty text."""
    return value or None


def _as_list(value: Any) -> Any:
    """Return a single string as a list."""
    return [value] if isinstance(value, str) else value


class PillarParams(BaseModel):
    """Input encoding and output decoding of a network on pillars. Metres and radians."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)

    point_range: PointRange = Field(
        description="metres: lowest x, y, z, then highest x, y, z of the points that the network is shown"
    )
    voxel_size: Size3D = Field(
        description="metres: edges of a pillar; in z it reaches through the whole point_range"
    )
    features: tuple[Feature, ...] = Field(
        min_length=3,
        description="features of a point in the network's order: x, y, z, intensity, time (0: of this scan); "
        "mean_x, mean_y, mean_z from the mean of its pillar; center_x, center_y, center_z from its pillar's "
        "centre; distance from the origin",
    )
    classes: Annotated[tuple[str, ...], BeforeValidator(_as_list)] = Field(
        min_length=1, description="class names in the network's order"
    )
    encoder: Annotated[Path | None, BeforeValidator(_empty_is_none)] = Field(
        None, description="ONNX file of the pillars' encoder, where the network is two files"
    )
    max_points: int | None = Field(
        None,
        ge=1,
        le=MAX_POINTS,
        description="points of a pillar, later ones are left out; empty: as the file says",
    )
    max_pillars: int = Field(
        40_000, ge=1, le=1_000_000, description="pillars of a cloud, later ones are left out"
    )
    intensity_scale: float = Field(
        1.0, gt=0, description="factor from the cloud's intensity to that of the training data"
    )
    z_offset: float = Field(
        0.0,
        ge=-20,
        le=20,
        description="metres added to the cloud's z: height of this LiDAR less that of the one in training",
    )

    anchors: tuple[tuple[PositiveFloat, PositiveFloat, PositiveFloat, float], ...] = Field(
        (),
        description="metres: length, width, height, z of the lower face; empty: it is a network of centres",
    )
    rotations: tuple[float, ...] = Field(
        (0.0, 1.57), min_length=1, description="radians: each anchor is turned so"
    )
    anchor_places: Literal["cell_centers", "edge_to_edge"] | None = Field(
        None,
        description="cell_centers (mmdetection3d's aligned generator), or the first and last on the edges of "
        "anchor_range (OpenPCDet without align_center)",
    )
    anchor_range: tuple[float, float, float, float] | None = Field(
        None, description="metres: lowest x, y, highest x, y of the anchors; empty: that of point_range"
    )
    direction_offset: float | None = Field(
        None, ge=-7, le=7, description="radians: dir_offset, where the network tells front from back"
    )
    direction_limit_offset: float = Field(0.0, ge=-1, le=1, description="dir_limit_offset, in half turns")

    boxes: Literal["lwh", "wlh"] | None = Field(
        None,
        description="centres: lwh is length, width, height and yaw from x to the left (OpenPCDet, "
        "mmdetection3d from 1.0); wlh is width, length, height and -yaw - pi/2 (Autoware, older ones)",
    )
    rotation: Literal["sin_cos", "cos_sin"] | None = Field(
        None, description="centres: sin_cos (mmdetection3d, Autoware) or cos_sin (OpenPCDet)"
    )
    groups: tuple[tuple[str, ...], ...] = Field(
        (), description="centres: class names of each head, where the network has several"
    )
    min_rotation: Mapping[str, float] = Field(
        {}, description="centres: least norm of (sin, cos) by class, else 0; Autoware's yaw_norm_thresholds"
    )

    scores: Literal["logits", "probabilities"] = Field(
        "logits", description="form of the output; logits pass through a sigmoid"
    )
    score_threshold: Share = Field(0.3, description="lowest score of an object")
    score_thresholds: Mapping[str, Share] = Field({}, description="the same of single classes, by name")
    labels: Literal["best", "each"] = Field(
        "best",
        description="best: one class a place (OpenPCDet's anchors, Autoware); each: every class that scores "
        "enough (mmdetection3d, OpenPCDet's centres)",
    )
    nms: Literal["all", "group", "class"] = Field(
        "class", description="boxes that suppress one another: all, of one head, of one class"
    )
    nms_iou: Share = Field(0.1, description="IoU from above at which the weaker box is removed; 1: never")
    nms_distance: float = Field(
        0.0, ge=0, le=20, description="metres between centres at which the weaker box is removed; 0: never"
    )
    nms_candidates: int = Field(
        1000, ge=1, le=100_000, description="places that enter it, best first, of each head"
    )
    max_objects: int = Field(500, ge=1, le=10_000, description="objects of a cloud, best first")

    @field_validator("point_range")
    @classmethod
    def _upwards(cls, point_range: PointRange) -> PointRange:
        """Check that each low end is below its high end."""
        if any(low >= high for low, high in zip(point_range[:3], point_range[3:], strict=True)):
            raise _complete_error(
                "has a low end above its high one: it is lowest x, y, z, then highest x, y, z"
            )
        return point_range

    @field_validator("voxel_size")
    @classmethod
    def _whole(cls, voxel_size: Size3D, info: ValidationInfo) -> Size3D:
        """Check that pillars have the full height and divide the range evenly."""
        if (point_range := info.data.get("point_range")) is None:
            return voxel_size
        extent = [high - low for low, high in zip(point_range[:3], point_range[3:], strict=True)]
        if voxel_size[2] < extent[2] * 0.999:
            raise _complete_error(
                f"is {voxel_size[2]:g} m in z, less than the {extent[2]:g} m of point_range: these "
                "are voxels, and only networks on pillars can be run"
            )
        for axis, length, edge in zip("xy", extent, voxel_size, strict=False):
            if abs(length / edge - round(length / edge)) > 0.01:
                raise _complete_error(
                    f"makes {length / edge:.2f} pillars of the {length:g} m of point_range in {axis}"
                )
        return voxel_size

    @field_validator("classes")
    @classmethod
    def _different(cls, classes: tuple[str, ...]) -> tuple[str, ...]:
        """Check that no class is named twice."""
        if len(set(classes)) < len(classes):
            raise _complete_error("has a name twice")
        return classes

    @field_validator("score_thresholds", "min_rotation")
    @classmethod
    def _known(cls, by_class: Mapping[str, float], info: ValidationInfo) -> Mapping[str, float]:
        """Check that each name is a class."""
        classes = info.data.get("classes", ())
        for name in by_class:
            if name not in classes:
                raise _complete_error(f"names '{name}', which is none of classes: {', '.join(classes)}")
        return by_class

    @field_validator("groups")
    @classmethod
    def _all(cls, groups: Any, info: ValidationInfo) -> Any:
        """Check that the groups contain all classes in their order."""
        if groups and tuple(name for group in groups for name in group) != info.data.get("classes"):
            raise _complete_error("must hold the names of classes, each once and in their order")
        return groups

    @property
    def grid(self) -> tuple[int, int]:
        """Number of pillars along x and y."""
        low, high = self.point_range[:2], self.point_range[3:5]
        nx, ny = (round((b - a) / size) for a, b, size in zip(low, high, self.voxel_size, strict=False))
        return nx, ny


INPUT_PARAMS = (
    "point_range",
    "voxel_size",
    "features",
    "max_points",
    "max_pillars",
    "intensity_scale",
    "z_offset",
)
"""Parameters that decide the input of the network. With equal ones its output is the same."""
