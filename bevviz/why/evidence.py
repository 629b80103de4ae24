"""Evidence about one subject: its points, clusters and detections, stage by stage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bevviz.model.frame import F32, I64, U8
from bevviz.model.reasons import Scored
from bevviz.model.results import ClusterState, Decision, DetectionState
from bevviz.why.subject import Subject

MOST = 0.5  # least share of the main cause, and of a cluster that belongs mostly to one object


@dataclass(frozen=True, slots=True)
class ClusterPart:
    """A cluster that holds points of the subject."""

    cluster: int
    points: int  # of the subject
    count: int  # of the whole cluster
    state: ClusterState

    @property
    def kept(self) -> bool:
        """Whether the cluster is within the size limits."""
        return self.state == ClusterState.KEPT


@dataclass(frozen=True, slots=True)
class Candidate:
    """A detection of the subject, and the decisions about it."""

    camera: str
    row: int
    name: str
    score: float
    state: DetectionState
    overlap: float  # how well it fits the subject, 0 to 1; 1 for the subject itself
    decision: Decision
    cluster: int  # the matched cluster, or the best one that was refused, else -1
    own: bool  # whether it is a detection of the subject, and not of another object that it fits, too
    owner: int  # row of the ground truth object that it is the box of, -1: none

    @property
    def label(self) -> Scored:
        """Its class and score."""
        return Scored(self.name, self.score)

    @property
    def kept(self) -> bool:
        """Whether the detector stage kept it."""
        return self.state == DetectionState.KEPT


@dataclass(frozen=True, slots=True)
class ReportedObject:
    """The reported object of the subject.

    Attributes:
        row: row in the frame's objects.
        name: class of the object.
        cluster: cluster of the object, -1: none.
        camera: camera of the detection that named it; empty: none.
        detection: row of that detection, -1: none.
        own: whether that detection belongs to the subject.
        also: other clusters that the same detection named.
        right: whether it counts for the subject; for ground truth, by the rule of ``evaluate``.
        away: metres on the ground between its box and that of the subject; NaN where unknown.
        counts_for: row of the ground truth object that ``evaluate`` counts it for, -1: none.
    """

    row: int
    name: str
    cluster: int
    camera: str
    detection: int
    own: bool
    also: tuple[int, ...]
    right: bool
    away: float
    counts_for: int


@dataclass(frozen=True, slots=True)
class Evidence:
    """Everything that the stages know about a subject.

    Attributes:
        points: rows of the raw points of the subject.
        fate: (N,) Fate of every raw point.
        center: centre of its 3D box or of that of its cluster, in Frame.points_frame; None: it has neither.
        distance: metres on the ground from the sensor, which is the origin of the points, to that centre.
            Without a centre it is the median of its points; NaN: unknown.
        voxels: number of voxels of the subject.
        ground: heights in metres above the local ground of its voxels that are ground.
        noise: number of its voxels that the clustering itself put in no cluster.
        neighbours: most neighbours within clustering.eps that one of its noise voxels has, itself included;
            0: no noise.
        parts: its clusters, the one with most points first.
        main: kept cluster that holds most of it, -1: none holds more than a few points.
        aimed: number of returns in the direction of the subject.
        in_front: number of these returns that end before the subject.
        front: cluster of most of the returns in front, -1: none.
        candidates: its detections, the most significant first.
        named: its reported object; None: none.
        mates: other objects of the ground truth, or other detections, in its main cluster, with their points.
        gap: metres between its points and the nearest mate, or the rest of its cluster; NaN: no mate.
        finer: largest eps that separates them when the points are clustered again; 0: none does.
        joined_by: detection for which the fusion joined them; None: the clustering itself did.
        apart: metres between its two largest clusters, NaN without two.
        in_view: whether a camera has it in its image.
    """

    points: I64
    fate: U8
    center: tuple[float, float, float] | None
    distance: float
    voxels: int
    ground: F32
    noise: int
    neighbours: int
    parts: tuple[ClusterPart, ...]
    main: int
    aimed: int
    in_front: int
    front: int
    candidates: tuple[Candidate, ...]
    named: ReportedObject | None
    mates: tuple[tuple[Subject, int], ...]
    gap: float
    finer: float
    joined_by: Scored | None
    apart: float
    in_view: bool

    @property
    def ground_span(self) -> tuple[float, float]:
        """Lowest and highest known height of its ground voxels; NaN: none is known."""
        known = self.ground[np.isfinite(self.ground)]
        return (float(known.min()), float(known.max())) if len(known) else (np.nan, np.nan)

    @property
    def raw(self) -> int:
        """Number of its raw points."""
        return len(self.points)

    @property
    def obstacles(self) -> int:
        """Number of its voxels that are not ground."""
        return self.voxels - len(self.ground)

    @property
    def own_candidates(self) -> tuple[Candidate, ...]:
        """Its detections without those of other objects that fit it, too."""
        return tuple(candidate for candidate in self.candidates if candidate.own)

    @property
    def best(self) -> Candidate | None:
        """Its most significant detection, which is not that of another object."""
        return self.candidates[0] if self.candidates and self.candidates[0].own else None

    def shared(self, subject: Subject) -> Candidate | None:
        """Return the best detection of its class that fits it, but is the box of another object."""
        others = (
            candidate
            for candidate in self.candidates
            if not candidate.own and candidate.owner >= 0 and subject.accepts(candidate.name)
        )
        return max(others, key=lambda candidate: (candidate.kept, candidate.overlap), default=None)

    def part(self, cluster: int) -> ClusterPart | None:
        """Return its part in a cluster, None if it has no points there."""
        return next((part for part in self.parts if part.cluster == cluster), None)

    @property
    def aside(self) -> ClusterPart | None:
        """Its largest part in a cluster outside the size limits."""
        return next((part for part in self.parts if not part.kept), None)

    @property
    def aside_points(self) -> int:
        """Number of its voxels in clusters outside the size limits."""
        return sum(part.points for part in self.parts if not part.kept)

    @property
    def purity(self) -> float:
        """Share of its main cluster that belongs to it; 1 without a cluster."""
        part = self.part(self.main)
        if part is None:
            return 1.0 if self.main < 0 else 0.0
        return part.points / max(part.count, 1)
