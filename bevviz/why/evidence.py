"""What is known of one subject: its points, clusters and detections, and what became of them."""

from __future__ import annotations

from dataclasses import dataclass

from bevviz.model.frame import F32, I64, U8
from bevviz.model.results import (
    CameraResult,
    ClusterState,
    Decision,
    DetectionState,
    FrameResult,
    Fusion,
)

MOST = 0.5  # share from which something is called the cause, or a cluster is mostly of an object


@dataclass(frozen=True, slots=True)
class Part:
    """A cluster that has points at the place."""

    cluster: int
    points: int  # there
    count: int  # in all
    state: ClusterState

    @property
    def kept(self) -> bool:
        return self.state == ClusterState.KEPT


@dataclass(frozen=True, slots=True)
class Candidate:
    """A detection at the place, and what became of it."""

    camera: str
    row: int
    name: str
    score: float
    state: DetectionState
    overlap: float  # IoU with the projected subject; 1 for the subject itself
    decision: Decision
    cluster: int  # matched, or the best one that was refused, else -1

    @property
    def kept(self) -> bool:
        return self.state == DetectionState.KEPT


@dataclass(frozen=True, slots=True)
class Named:
    """The object that stands at the place.

    Attributes:
        row: of the frame's objects.
        cluster: that it is made of, -1: none.
        camera, detection: that named it; empty and -1 where no detection did.
        own: whether that detection is the subject's own.
        also: other clusters that the same detection named.
    """

    row: int
    name: str
    cluster: int
    camera: str
    detection: int
    own: bool
    also: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Evidence:
    """What is known of a subject.

    Attributes:
        points: rows of the raw points at the place.
        fate: (N,) Fate of every raw point.
        distance: horizontal metres from the origin of the points; NaN where unknown.
        voxels: after the voxel grid.
        ground: heights above the local ground of those that are ground.
        noise: voxels there that are in no cluster.
        neighbours: of the noise point that has most, within clustering.eps, itself included; 0: no noise.
        parts: clusters there, the one with most points first.
        main: the kept one that has most of it, -1: none has more than a few.
        aimed: returns in the subject's direction; ``in_front``: those that end before it.
        front: cluster that most of those in front belong to, else -1.
        candidates: its own detections, the most telling first.
        named: the object that stands there; None: none does.
        mates: rows of other objects of the truth, or of detections, in its main cluster ...
        others: ... with their names and points.
        gap: metres between its points and the nearest of these, or the rest of its cluster; else NaN.
        finer: largest eps that tells them apart, by clustering the points again; 0: none does.
        apart: metres between its two largest clusters, NaN without.
        in_view: whether a camera has it in its image.
    """

    points: I64
    fate: U8
    distance: float
    voxels: int
    ground: F32
    noise: int
    neighbours: int
    parts: tuple[Part, ...]
    main: int
    aimed: int
    in_front: int
    front: int
    candidates: tuple[Candidate, ...]
    named: Named | None
    mates: tuple[int, ...]
    others: tuple[tuple[str, int], ...]
    gap: float
    finer: float
    apart: float
    in_view: bool

    @property
    def raw(self) -> int:
        return len(self.points)

    @property
    def obstacles(self) -> int:
        """Voxels there that are not ground."""
        return self.voxels - len(self.ground)

    @property
    def best(self) -> Candidate | None:
        """The most telling of its detections."""
        return self.candidates[0] if self.candidates else None

    def part(self, cluster: int) -> Part | None:
        return next((part for part in self.parts if part.cluster == cluster), None)

    @property
    def purity(self) -> float:
        """Share of its main cluster that is its own; 1 without a cluster."""
        part = self.part(self.main)
        return 1.0 if part is None else part.points / max(part.count, 1)


def fusion_of(result: FrameResult, camera: str) -> tuple[CameraResult, Fusion | None]:
    found = next(c for c in result.cameras if c.camera.name == camera)
    return found, found.fusion
