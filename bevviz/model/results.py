"""What stages make of a frame and decide about it: small frozen dataclasses of arrays, free of ROS and Rerun.

The conventions are those of `bevviz.model.frame`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from bevviz.model.frame import (
    F32,
    F64,
    I32,
    I64,
    U8,
    Bool,
    Boxes3D,
    Camera,
    Frame,
    data_frame,
)

if TYPE_CHECKING:
    from pandas import DataFrame

    from bevviz.config import AnomalyKind, ClusteringConfig, Config


@dataclass(frozen=True, slots=True)
class Voxels:
    """Points after the voxel grid. ``inverse[i]`` is the row of ``points`` that raw point i went to."""

    points: F32  # (M, 3)
    inverse: I32  # (N,)


@dataclass(frozen=True, slots=True)
class Ground:
    mask: Bool  # (M,) True: ground
    height: F32  # (M,) metres above the local ground
    plane: F64 | None = None  # (4,) a, b, c, d of the single plane, for the methods that fit one


class ClusterState(IntEnum):
    KEPT = 0
    TOO_SMALL = 1  # fewer points than clustering.min_cluster_points
    TOO_LARGE = 2  # more points than clustering.max_cluster_points


@dataclass(frozen=True, slots=True)
class Clusters:
    """DBSCAN clusters of the obstacle points. Row k of each array is the cluster with label k."""

    labels: I32  # (P,) over the obstacle points, -1 noise
    state: I32  # (K,) ClusterState
    count: I32  # (K,) points
    centroid: F32  # (K, 3)
    aabb: Boxes3D  # axis-aligned
    obb: Boxes3D  # oriented about z

    def __len__(self) -> int:
        return len(self.count)

    @property
    def kept(self) -> Bool:
        """(K,) those that go on to the fusion."""
        return np.equal(self.state, ClusterState.KEPT)

    def boxes(self, config: ClusteringConfig) -> Boxes3D:
        """Those that ``clustering.boxes`` asks for."""
        return self.obb if config.boxes == "oriented" else self.aabb

    def to_pandas(self) -> DataFrame:
        """A row for each cluster, with its oriented box."""
        states = [ClusterState(state).name.lower() for state in self.state]
        return data_frame({"state": states, "points": self.count, **self.obb.columns})


class DetectionState(IntEnum):
    KEPT = 0
    BELOW_THRESHOLD = 1
    SUPPRESSED = 2  # by NMS


@dataclass(frozen=True, slots=True)
class Masks:
    """Which pixels each detection's object covers, in the grid of the network's input, within its box."""

    packed: U8  # bits, as of np.packbits: row by row of one detection's cells after the other's
    place: I32  # (D, 4) first column, first row, columns, rows of each one's cells; 0 columns: it has none
    grid: F32  # (4,) columns and rows for each pixel of the image, column and row of its upper left corner

    def has(self, d: int) -> bool:
        return bool(self.place[d, 2])

    def start(self, d: int) -> int:
        """The bit that a detection's cells begin with."""
        return int((self.place[:d, 2].astype(np.int64) * self.place[:d, 3]).sum())

    def cells(self, d: int) -> Bool:
        """(rows, columns) those of a detection."""
        start, size = self.start(d), int(self.place[d, 2]) * int(self.place[d, 3])
        bits = np.unpackbits(self.packed[start // 8 : -(-(start + size) // 8)])[start % 8 :][:size]
        cells: Bool = bits.reshape(self.place[d, 3], self.place[d, 2]).astype(bool)
        return cells


@dataclass(frozen=True, slots=True)
class Detections:
    """2D detections in pixels of the camera's image, best score first, however weak.

    Only the ``kept`` ones go on to the fusion; the others are there to be explained.
    """

    xyxy: F32  # (D, 4)
    score: F32  # (D,)
    class_id: I32  # (D,)
    names: tuple[str, ...]  # (D,) class names
    state: I32  # (D,) DetectionState
    suppressed_by: I32  # (D,) row of the detection that suppressed it, else -1
    overlap: F32  # (D,) IoU with that one, else 0
    masks: Masks | None = None  # of those that are kept, where the network gives some

    def __len__(self) -> int:
        return len(self.score)

    @property
    def kept(self) -> Bool:
        """(D,) those that go on to the fusion."""
        return np.equal(self.state, DetectionState.KEPT)

    def to_pandas(self) -> DataFrame:
        """A row for each detection, however weak."""
        x0, y0, x1, y1 = self.xyxy.T
        states = [DetectionState(state).name.lower() for state in self.state]
        box = {"x0": x0, "y0": y0, "x1": x1, "y1": y1}
        return data_frame({"name": self.names, "score": self.score, "state": states, **box})

    @staticmethod
    def empty() -> Detections:
        f, i = np.zeros(0, np.float32), np.zeros(0, np.int32)
        return Detections(np.zeros((0, 4), np.float32), f, i, (), i, i, f)


class Decision(IntEnum):
    """What became of a detection or a cluster in the fusion."""

    MATCHED = 0
    NO_CLUSTER = 1  # detection: no cluster has points in its frustum (or, reference: near its centre)
    TOO_FEW_POINTS = 2  # there is a cluster in the frustum, but with too few points in it
    LOW_OVERLAP = 3  # projected cluster and 2D box overlap too little
    TAKEN = 4  # another detection has the cluster / another cluster has the detection
    OUT_OF_VIEW = 5  # cluster: outside the image, or behind the camera
    NO_DETECTION = 6  # cluster: in view, but under no detection
    NOT_KEPT = 7  # detection below threshold or suppressed; cluster outside the size limits
    MISFIT = 9  # nothing of the cluster has the size and outline of what was detected
    TOO_FAR = 8  # reference: nearest 2D box centre is beyond match_radius; default: beyond fusion.max_depth


@dataclass(frozen=True, slots=True)
class Pairs:
    """The evidence: one row for each (detection, cluster) pair that was looked at."""

    detection: I32  # (Q,)
    cluster: I32  # (Q,)
    points: I32  # (Q,) points of the cluster inside the frustum (reference: 0)
    depth: F32  # (Q,) metres along the optical axis to those points (median), reference: centroid
    iou: F32  # (Q,) IoU of the 2D box and the box around the projected cluster
    distance: F32  # (Q,) pixels between the centres
    cost: F32  # (Q,) what the assignment minimises; inf where a rule forbids the pair


@dataclass(frozen=True, slots=True)
class Pair:
    """One row of ``Pairs``."""

    points: int
    depth: float
    iou: float
    distance: float
    cost: float


@dataclass(frozen=True, slots=True)
class Claims:
    """What one camera's detections take of the obstacle points. Row d belongs to detection d."""

    cluster: I32  # (D,) row in the clusters, -1: it takes nothing
    fit: F32  # (D,) 0 to 1: how well the best that it could take suits its box and its class
    boxes: Boxes3D  # (D,) of the whole object, what was not seen completed; NaN where nothing is taken
    seen: Bool  # (D, 4) SIDES of that box that face the camera

    @staticmethod
    def none(count: int) -> Claims:
        """To be filled in."""
        nan = np.full((count, 3), np.nan, np.float32)
        return Claims(
            np.full(count, -1, np.int32),
            np.zeros(count, np.float32),
            Boxes3D(nan, nan.copy(), nan[:, 0].copy()),
            np.zeros((count, 4), np.bool_),
        )


@dataclass(frozen=True, slots=True)
class Splits:
    """Clusters that a camera divided or joined: a row for a detection and a cluster it took points of."""

    camera: tuple[str, ...]
    detection: I32  # (S,) row in that camera's detections
    cluster: I32  # (S,) row in the clusters, of what it took
    rest: I32  # (S,) row of what is left of the cluster it took them of; -1: nothing is, or they were noise
    is_noise: Bool  # (S,) they were of no cluster
    points: I32  # (S,) that it took
    of: I32  # (S,) that the cluster had

    def __len__(self) -> int:
        return len(self.camera)

    @staticmethod
    def none() -> Splits:
        i = np.zeros(0, np.int32)
        return Splits((), i, i, i, np.zeros(0, np.bool_), i, i)


@dataclass(frozen=True, slots=True)
class Fusion:
    """Result for one camera. Row d belongs to detection d, row k to cluster k."""

    detection_decision: I32  # (D,) Decision
    detection_cluster: I32  # (D,) matched cluster, or the best candidate that was refused, else -1
    detection_points: I32  # (D,) obstacle points inside the frustum, whatever their cluster
    cluster_decision: I32  # (K,) Decision
    cluster_detection: I32  # (K,) matched detection, or the best candidate that was refused, else -1
    pairs: Pairs
    cluster_uv: F32  # (K, 4) x0, y0, x1, y1 around the projected cluster, NaN where not in view
    claims: Claims | None = None  # None: clusters are matched as they are
    detection_covered: I32 | None = None  # (D,) of detection_points those in the mask, -1: not by a mask

    def pair(self, detection: int, cluster: int) -> Pair | None:
        """The evidence of a detection and a cluster; None: the fusion did not look at them together."""
        pairs = self.pairs
        rows = np.flatnonzero((pairs.detection == detection) & (pairs.cluster == cluster))
        if len(rows) == 0:
            return None
        row = int(rows[0])
        points, depth = int(pairs.points[row]), float(pairs.depth[row])
        return Pair(points, depth, float(pairs.iou[row]), float(pairs.distance[row]), float(pairs.cost[row]))


@dataclass(frozen=True, slots=True)
class CameraResult:
    camera: Camera
    detections: Detections | None  # None: not run or failed
    fusion: Fusion | None
    uv: F32 | None = None  # (P, 2) obstacle points in pixels, NaN where not in the image
    depth: F32 | None = None  # (P,) metres along the optical axis


SIDES = ("front", "back", "left", "right")  # of a box: +x, -x, +y, -y


@dataclass(frozen=True, slots=True)
class Objects:
    """Fused boxes: one row for each named object, in Frame.points_frame."""

    boxes: Boxes3D  # of the whole object, where sizes of its class are known; else of what was seen
    names: tuple[str, ...]
    score: F32  # (J,)
    cluster: I32  # (J,)
    camera: tuple[str, ...]
    detection: I32  # (J,) row in that camera's detections
    measured: Boxes3D | None = None  # (J,) around what was seen of each; None: ``boxes`` are that
    seen: Bool | None = None  # (J, 4) SIDES that were seen; None: not known

    def __len__(self) -> int:
        return len(self.names)

    @staticmethod
    def empty() -> Objects:
        f, i = np.zeros(0, np.float32), np.zeros(0, np.int32)
        return Objects(Boxes3D.empty(), (), f, i, (), i)

    def to_pandas(self) -> DataFrame:
        """A row for each object."""
        origin = {"camera": self.camera, "detection": self.detection, "cluster": self.cluster}
        return data_frame({"name": self.names, "score": self.score, **self.boxes.columns, **origin})


class Opinion(IntEnum):
    """What cameras say of an object that somebody else's method has. Up to CONTRADICTED they have seen it."""

    CONFIRMED = 0
    NAMED_OTHERWISE = 1  # what is there has another class
    CONTRADICTED = 2  # it is to be seen, and the detector has kept nothing there
    NO_CLASS = 3  # the detector knows no class that it could be called
    TOO_SMALL = 4  # fewer pixels high than a detector has to find
    HIDDEN = 5
    OUT_OF_VIEW = 6
    NOT_ASKED = 7  # no camera has detections

    @property
    def is_unseen(self) -> bool:
        """Whether nothing is said for it or against it."""
        return self > Opinion.CONTRADICTED

    @property
    def word(self) -> str:
        return "unseen" if self.is_unseen else self.name.lower().replace("_", " ")


@dataclass(frozen=True, slots=True)
class Opinions:
    """Objects of somebody else's method and those of our fusion, each held against the other.

    Row k belongs to object k of the method's, row j to object j of our fusion's.
    """

    fused: Objects  # what our fusion of cameras and clusters would have made
    opinion: I32  # (K,) Opinion
    camera: tuple[str, ...]  # (K,) whose image it is of, empty where it is of none
    detection: I32  # (K,) row in that camera's detections: which looks at it, or is nearest to it; -1: none
    iou: F32  # (K,) of that detection and the object in the image
    held: F32  # (K,) share of the points of the cluster which that detection named that are in it, NaN: none
    shown: F32  # (K,) share of it that is in that camera's image
    visible: F32  # (K,) share of it that nothing nearer hides from the LiDAR
    height: F32  # (K,) pixels
    partner: I32  # (J,) object of the method's that it is, -1: the method has missed it

    @property
    def missed(self) -> Bool:
        """(J,) objects of our fusion's that the method has not."""
        return np.less(self.partner, 0)


@dataclass(frozen=True, slots=True)
class Tracks:
    """Objects over time: one row for each track that lives, also those that have no name yet.

    In ``frame_id``: the fixed frame, or (not ``absolute``) that of the points, where speeds are relative
    to the robot.
    """

    frame_id: str
    absolute: bool
    id: I64  # (T,) never given twice
    boxes: Boxes3D  # smoothed
    velocity: F32  # (T, 3) m/s
    age: F32  # (T,) seconds since it was first seen
    coasting: F32  # (T,) seconds since it was last seen, 0: it is now
    innovation: F32  # (T,) metres on the ground from where it was expected; NaN: not seen now, or new
    hits: I32  # (T,) frames that it was seen in
    names: tuple[str, ...]  # (T,) class, "" where none was ever given
    confirmed: Bool  # (T,) named in ``tracking.min_hits`` frames or more, and lately
    cluster: I32  # (T,) row in this frame's clusters, -1: not seen
    object: I32  # (T,) row in this frame's objects, -1: not named now
    trail: F32  # (T, L, 3) where it was in the last frames, this one included; NaN before it was born

    def __len__(self) -> int:
        return len(self.id)

    @property
    def speed(self) -> F32:
        """(T,) m/s on the ground."""
        return np.hypot(self.velocity[:, 0], self.velocity[:, 1])

    def to_pandas(self) -> DataFrame:
        """A row for each track that lives."""
        state = {"confirmed": self.confirmed, "age": self.age, "coasting": self.coasting}
        rows = {"cluster": self.cluster, "object": self.object}
        head = {"id": self.id, "name": self.names, "speed": self.speed}
        return data_frame({**head, **self.boxes.columns, **state, **rows})


@dataclass(frozen=True, slots=True)
class Bev:
    """Bird's-eye view. Channels are (rows, columns); row 0 is range_x ahead, column 0 range_y to the left."""

    resolution: float
    range_x: float
    range_y: float
    image: U8  # (rows, columns, 3) BGR with boxes and labels on top
    channels: Mapping[str, NDArray[Any]] = field(default_factory=dict)  # by name, see BevConfig.channels


@dataclass(frozen=True, slots=True)
class Failure:
    stage: str
    reason: str  # one clear sentence
    traceback: str = ""  # of an error that nobody foresaw


@dataclass(frozen=True, slots=True)
class FrameResult:
    """Everything that was seen, made and decided for one frame. None: not run, see ``failures``."""

    frame: Frame
    config: Config  # that it was made with, all of it
    voxels: Voxels | None
    ground: Ground | None
    obstacles: F32 | None  # (P, 3) the voxels that are not ground
    clusters: Clusters | None
    cameras: tuple[CameraResult, ...]
    objects: Objects | None
    bev: Bev | None
    explanations: tuple[Explanation, ...] = ()
    timings: Mapping[str, float] = field(default_factory=dict)  # stage -> seconds
    failures: tuple[Failure, ...] = ()
    tracks: Tracks | None = None
    anomalies: tuple[Anomaly, ...] = ()
    splits: Splits | None = None  # None: clusters are as the LiDAR alone has them
    opinions: Opinions | None = None  # None: the objects are our fusion's own, or there are none
    ranges: F32 | None = None  # of ``visibility.range_image``, where it was made before it was asked for

    @staticmethod
    def unprocessed(
        frame: Frame, config: Config, cameras: tuple[CameraResult, ...] | None = None
    ) -> FrameResult:
        """The frame as it came, no stage run on it."""
        if cameras is None:
            cameras = tuple(CameraResult(camera, None, None) for camera in frame.cameras)
        return FrameResult(frame, config, None, None, None, None, cameras, None, None)


@dataclass(frozen=True, slots=True)
class Explanation:
    """One decision in words. ``state`` is the lower-case name of the Decision or DetectionState."""

    subject: str  # "detection", "cluster", "split", "object", "fused" or "camera"
    camera: str  # "" where no camera is involved
    row: int
    state: str
    text: str


@dataclass(frozen=True, slots=True)
class Anomaly:
    """Something that is worth a look, in words and numbers."""

    kind: AnomalyKind
    subject: str  # "person #12", the name of a sensor or of a stage
    text: str
    severity: Literal["WARN", "ERROR"] = "WARN"
    since: int = 0  # stamp of the frame that it began in
    rank: float = 0.0  # 0 to 1: how bad it is; the worst come first
