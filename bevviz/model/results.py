"""Results of the stages for one frame: small frozen dataclasses of arrays, free of ROS and Rerun.

The conventions are those of `bevviz.model.frame`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from bevviz.model.frame import F32, F64, I32, I64, U8, Bool, Boxes3D, Camera, Frame
from bevviz.model.tables import Columns, Tabular

if TYPE_CHECKING:
    from bevviz.config import AnomalyKind, ClusteringConfig, Config
    from bevviz.model.reasons import Reason


@dataclass(frozen=True, slots=True)
class Voxels:
    """Points after the voxel grid. ``inverse[i]`` is the row in ``points`` of the voxel of raw point i."""

    points: F32  # (M, 3)
    inverse: I32  # (N,)


@dataclass(frozen=True, slots=True)
class Ground:
    """Ground mask of the voxels."""

    mask: Bool  # (M,) True: ground
    height: F32  # (M,) metres above the local ground
    plane: F64 | None = None  # (4,) a, b, c, d of the single plane, if the method fits one


class ClusterState(IntEnum):
    """State of a cluster after the size limits."""

    KEPT = 0
    TOO_SMALL = 1  # fewer points than clustering.min_cluster_points
    TOO_LARGE = 2  # more points than clustering.max_cluster_points


@dataclass(frozen=True, slots=True, repr=False)
class Clusters(Tabular):
    """DBSCAN clusters of the obstacle points. Row k of each array is the cluster with label k."""

    labels: I32  # (P,) label of each obstacle point, -1 for noise
    state: I32  # (K,) ClusterState
    count: I32  # (K,) points
    centroid: F32  # (K, 3)
    aabb: Boxes3D  # axis-aligned
    obb: Boxes3D  # oriented about z

    def __len__(self) -> int:
        return len(self.count)

    def __repr__(self) -> str:
        return f"<Clusters: {len(self)}, {int(self.kept.sum())} of them kept>"

    @property
    def kept(self) -> Bool:
        """(K,) mask of the clusters that go on to the fusion."""
        return np.equal(self.state, ClusterState.KEPT)

    def boxes(self, config: ClusteringConfig) -> Boxes3D:
        """Return the boxes that ``clustering.boxes`` selects."""
        return self.obb if config.boxes == "oriented" else self.aabb

    def _columns(self) -> Columns:
        """Return a row for each cluster and its oriented box."""
        states = [ClusterState(state).name.lower() for state in self.state]
        return {"state": states, "points": self.count, **self.obb.columns}


class DetectionState(IntEnum):
    """State of a detection after threshold and NMS."""

    KEPT = 0
    BELOW_THRESHOLD = 1
    SUPPRESSED = 2  # by NMS


@dataclass(frozen=True, slots=True)
class Masks:
    """Pixels that each detection's object covers within its box, in the grid of the network's input."""

    packed: U8  # bits of np.packbits: the cells of each detection row by row, one detection after the other
    place: I32  # (D, 4) first column, first row, number of columns and rows of cells; 0 columns: no mask
    grid: F32  # (4,) columns and rows per pixel of the image, column and row of its upper left corner

    def has(self, d: int) -> bool:
        """Return whether detection ``d`` has a mask."""
        return bool(self.place[d, 2])

    def start(self, d: int) -> int:
        """Return the index of the first bit of a detection."""
        return int((self.place[:d, 2].astype(np.int64) * self.place[:d, 3]).sum())

    def cells(self, d: int) -> Bool:
        """Return the (rows, columns) cells of a detection."""
        start, size = self.start(d), int(self.place[d, 2]) * int(self.place[d, 3])
        bits = np.unpackbits(self.packed[start // 8 : -(-(start + size) // 8)])[start % 8 :][:size]
        cells: Bool = bits.reshape(self.place[d, 3], self.place[d, 2]).astype(bool)
        return cells


@dataclass(frozen=True, slots=True, repr=False)
class Detections(Tabular):
    """2D detections in pixels of the camera's image, best score first, including weak ones.

    Only the ``kept`` ones go on to the fusion. The others exist only to be explained.
    """

    xyxy: F32  # (D, 4)
    score: F32  # (D,)
    class_id: I32  # (D,)
    names: tuple[str, ...]  # (D,) class names
    state: I32  # (D,) DetectionState
    suppressed_by: I32  # (D,) row of the detection that suppressed it, else -1
    overlap: F32  # (D,) IoU with that detection, else 0
    masks: Masks | None = None  # masks of the kept detections, if the network gives any

    def __len__(self) -> int:
        return len(self.score)

    def __repr__(self) -> str:
        names = Counter(name for name, kept in zip(self.names, self.kept, strict=True) if kept)
        return f"<Detections: {_listed(names)}; {int((~self.kept).sum())} weak ones>"

    @property
    def kept(self) -> Bool:
        """(D,) mask of the detections that go on to the fusion."""
        return np.equal(self.state, DetectionState.KEPT)

    def labels(self) -> Iterator[tuple[F32, str]]:
        """Yield the box of each kept detection, and its name and score as text."""
        for row in np.flatnonzero(self.kept):
            yield self.xyxy[row], f"{self.names[row]} {self.score[row]:.2f}"

    def _columns(self) -> Columns:
        """Return a row for each detection, including weak ones."""
        x0, y0, x1, y1 = self.xyxy.T
        states = [DetectionState(state).name.lower() for state in self.state]
        box = {"x0": x0, "y0": y0, "x1": x1, "y1": y1}
        return {"name": self.names, "score": self.score, "state": states, **box}

    @staticmethod
    def of_boxes(xyxy: F32, score: F32, names: Sequence[str]) -> Detections:
        """Return detections that are all kept."""
        zero = np.zeros(len(names), np.int32)
        kept = zero + np.int32(DetectionState.KEPT)
        return Detections(xyxy, score, zero, tuple(names), kept, zero - 1, np.zeros(len(names), np.float32))

    @staticmethod
    def joined(several: Sequence[Detections]) -> Detections:
        """Return the detections of several, in order, without masks."""
        arrays = ("xyxy", "score", "class_id", "state", "suppressed_by", "overlap")
        values: dict[str, Any] = {
            name: np.concatenate([getattr(one, name) for one in several]) for name in arrays
        }
        return Detections(names=tuple(name for one in several for name in one.names), **values)

    @staticmethod
    def empty() -> Detections:
        """Return zero detections."""
        return Detections.of_boxes(np.zeros((0, 4), np.float32), np.zeros(0, np.float32), ())


class Decision(IntEnum):
    """Decision of the fusion about a detection or a cluster."""

    MATCHED = 0
    NO_CLUSTER = 1  # detection: no cluster has points in its frustum (reference: or a centre near its own)
    TOO_FEW_POINTS = 2  # a cluster has points in the frustum, but too few
    LOW_OVERLAP = 3  # projected cluster and 2D box overlap too little
    TAKEN = 4  # another detection has the cluster / another cluster has the detection
    OUT_OF_VIEW = 5  # cluster: outside the image, or behind the camera
    NO_DETECTION = 6  # cluster: in view, but under no detection
    NOT_KEPT = 7  # detection below threshold or suppressed; cluster outside the size limits
    MISFIT = 9  # no part of the cluster has the size and outline of the detected class
    TOO_FAR = 8  # reference: nearest 2D box centre is beyond match_radius; default: beyond fusion.max_depth


@dataclass(frozen=True, slots=True)
class Pairs:
    """Evidence of the fusion: one row for each (detection, cluster) pair that it compared."""

    detection: I32  # (Q,)
    cluster: I32  # (Q,)
    points: I32  # (Q,) points of the cluster inside the frustum (reference: 0)
    depth: F32  # (Q,) metres along the optical axis to those points (median), reference: centroid
    iou: F32  # (Q,) IoU of the 2D box and the box around the projected cluster
    distance: F32  # (Q,) pixels between the centres
    cost: F32  # (Q,) cost that the assignment minimises; inf where a rule forbids the pair


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
    """Obstacle points that one camera's detections take. Row d belongs to detection d."""

    cluster: I32  # (D,) row in the clusters, -1: the detection takes no points
    fit: F32  # (D,) 0 to 1: how well the best candidate points suit the detection's box and class
    boxes: Boxes3D  # (D,) boxes of the whole object, hidden parts included; NaN where no points are taken
    seen: Bool  # (D, 4) mask of the SIDES of that box that face the camera

    @staticmethod
    def none(count: int) -> Claims:
        """Return claims of ``count`` detections that take no points, to be filled in."""
        nan = np.full((count, 3), np.nan, np.float32)
        return Claims(
            np.full(count, -1, np.int32),
            np.zeros(count, np.float32),
            Boxes3D(nan, nan.copy(), nan[:, 0].copy()),
            np.zeros((count, 4), np.bool_),
        )


@dataclass(frozen=True, slots=True)
class Splits:
    """Clusters that a camera divided or joined: a row for each detection and cluster it took points from."""

    camera: tuple[str, ...]
    detection: I32  # (S,) row in that camera's detections
    cluster: I32  # (S,) row in the clusters of the points it took
    rest: I32  # (S,) row of the rest of the cluster it took them from; -1: no rest, or the points were noise
    is_noise: Bool  # (S,) the points belonged to no cluster
    points: I32  # (S,) number of points it took
    of: I32  # (S,) number of points the cluster had

    def __len__(self) -> int:
        return len(self.camera)

    @staticmethod
    def none() -> Splits:
        """Return zero splits."""
        i = np.zeros(0, np.int32)
        return Splits((), i, i, i, np.zeros(0, np.bool_), i, i)


@dataclass(frozen=True, slots=True)
class Fusion:
    """Result of the fusion for one camera. Row d belongs to detection d, row k to cluster k."""

    detection_decision: I32  # (D,) Decision
    detection_cluster: I32  # (D,) matched cluster, or the best candidate that was rejected, else -1
    detection_points: I32  # (D,) obstacle points inside the frustum, of any cluster
    cluster_decision: I32  # (K,) Decision
    cluster_detection: I32  # (K,) matched detection, or the best candidate that was rejected, else -1
    pairs: Pairs
    cluster_uv: F32  # (K, 4) x0, y0, x1, y1 around the projected cluster, NaN if not in view
    claims: Claims | None = None  # None: clusters are matched whole
    detection_covered: I32 | None = None  # (D,) number of detection_points in the mask, -1: mask not used

    def matched_cluster(self, detection: int) -> int:
        """Return the cluster that a detection was matched with, -1: none."""
        is_matched = self.detection_decision[detection] == Decision.MATCHED
        return int(self.detection_cluster[detection]) if is_matched else -1

    def pair(self, detection: int, cluster: int) -> Pair | None:
        """Return the evidence of a detection and a cluster, or None if the fusion did not compare them."""
        if detection < 0 or cluster < 0:  # no detection or no cluster at all
            return None
        pairs = self.pairs
        rows = np.flatnonzero((pairs.detection == detection) & (pairs.cluster == cluster))
        if len(rows) == 0:
            return None
        row = int(rows[0])
        points, depth = int(pairs.points[row]), float(pairs.depth[row])
        return Pair(points, depth, float(pairs.iou[row]), float(pairs.distance[row]), float(pairs.cost[row]))


@dataclass(frozen=True, slots=True)
class CameraResult:
    """Results of the stages for one camera."""

    camera: Camera
    detections: Detections | None  # None: the detector did not run, or failed
    fusion: Fusion | None
    uv: F32 | None = None  # (P, 2) obstacle points in pixels, NaN where not in the image
    depth: F32 | None = None  # (P,) metres along the optical axis


BOX_SIDES = ("front", "back", "left", "right")  # sides of a box: +x, -x, +y, -y


@dataclass(frozen=True, slots=True, repr=False)
class Objects(Tabular):
    """Fused boxes: one row for each named object, in Frame.points_frame."""

    boxes: Boxes3D  # boxes of the whole object if sizes of its class are known, else around its points
    names: tuple[str, ...]
    score: F32  # (J,)
    cluster: I32  # (J,)
    camera: tuple[str, ...]
    detection: I32  # (J,) row in that camera's detections
    measured: Boxes3D | None = None  # (J,) boxes around the points of each object; None: ``boxes`` are these
    seen: Bool | None = None  # (J, 4) mask of the visible SIDES; None: not known

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        return f"<Objects: {_listed(Counter(self.names))}>"

    @staticmethod
    def empty() -> Objects:
        """Return zero objects."""
        f, i = np.zeros(0, np.float32), np.zeros(0, np.int32)
        return Objects(Boxes3D.empty(), (), f, i, (), i)

    def labels(self) -> list[tuple[str, str, str, str]]:
        """Return name, score, distance and camera of each object as text, the nearest first."""
        distance = self.boxes.distance
        return [
            (self.names[row], f"{self.score[row]:.2f}", f"{distance[row]:.1f} m", self.camera[row])
            for row in np.argsort(distance).tolist()
        ]

    def _columns(self) -> Columns:
        """Return a row for each object."""
        origin = {"camera": self.camera, "detection": self.detection, "cluster": self.cluster}
        return {"name": self.names, "score": self.score, **self.boxes.columns, **origin}


class Opinion(IntEnum):
    """Opinion of the cameras on an object of a 3D detector or of the robot.

    Values up to CONTRADICTED mean that a camera has seen the place of the object.
    """

    CONFIRMED = 0
    NAMED_OTHERWISE = 1  # the detection there has another class
    CONTRADICTED = 2  # the object should be visible, and the detector has kept no detection there
    NO_CLASS = 3  # the detector knows no class that suits the object
    TOO_SMALL = 4  # fewer pixels high than a detector must find
    HIDDEN = 5
    OUT_OF_VIEW = 6
    NOT_ASKED = 7  # no camera has detections

    @property
    def is_unseen(self) -> bool:
        """Whether no camera can confirm or contradict the object."""
        return self > Opinion.CONTRADICTED

    @property
    def word(self) -> str:
        """The opinion in lower-case words."""
        return "unseen" if self.is_unseen else self.name.lower().replace("_", " ")


@dataclass(frozen=True, slots=True)
class Opinions:
    """Comparison of the objects of a 3D detector or of the robot with those of our fusion.

    Row k belongs to object k of that method, row j to object j of our fusion.
    """

    fused: Objects  # objects that our fusion of cameras and clusters would have made
    opinion: I32  # (K,) Opinion
    camera: tuple[str, ...]  # (K,) camera of the opinion, empty if there is none
    detection: I32  # (K,) row of that camera's detection that is of the object or nearest to it; -1: none
    iou: F32  # (K,) IoU of that detection and the object in the image
    held: F32  # (K,) share of the points of that detection's cluster that are in the object; NaN: no cluster
    shown: F32  # (K,) share of the object that is in that camera's image
    visible: F32  # (K,) share of the object that no nearer point hides from the LiDAR
    height: F32  # (K,) height of the object in the image in pixels
    partner: I32  # (J,) the same object of the other method, -1: that method has missed it

    @property
    def missed(self) -> Bool:
        """(J,) mask of the objects of our fusion that the other method lacks."""
        return np.less(self.partner, 0)


@dataclass(frozen=True, slots=True, repr=False)
class Tracks(Tabular):
    """Objects over time: one row for each living track, including tracks without a name.

    Coordinates are in ``frame_id``. This is the fixed frame, or (not ``absolute``) the frame of the points,
    in which speeds are relative to the robot.
    """

    frame_id: str
    absolute: bool
    id: I64  # (T,) never used twice
    boxes: Boxes3D  # smoothed
    velocity: F32  # (T, 3) m/s
    age: F32  # (T,) seconds since it was first seen
    coasting: F32  # (T,) seconds since it was last seen, 0: seen in this frame
    innovation: F32  # (T,) metres on the ground from the expected position; NaN: not seen, or new
    hits: I32  # (T,) number of frames in which it was seen
    names: tuple[str, ...]  # (T,) class, "" if it never had a name
    confirmed: Bool  # (T,) named in at least ``tracking.min_hits`` frames, and recently
    cluster: I32  # (T,) row in this frame's clusters, -1: not seen
    object: I32  # (T,) row in this frame's objects, -1: not named in this frame
    trail: F32  # (T, L, 3) positions in the last frames and this one; NaN before its first frame

    def __len__(self) -> int:
        return len(self.id)

    def __repr__(self) -> str:
        names = (name for name, confirmed in zip(self.names, self.confirmed, strict=True) if confirmed)
        return f"<Tracks: {len(self)}, confirmed: {_listed(Counter(names))}>"

    @property
    def speed(self) -> F32:
        """(T,) m/s on the ground."""
        return np.hypot(self.velocity[:, 0], self.velocity[:, 1])

    def _columns(self) -> Columns:
        """Return a row for each living track."""
        state = {"confirmed": self.confirmed, "age": self.age, "coasting": self.coasting}
        rows = {"cluster": self.cluster, "object": self.object}
        head = {"id": self.id, "name": self.names, "speed": self.speed}
        return {**head, **self.boxes.columns, **state, **rows}


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
    """A stage that failed, and the reason."""

    stage: str
    reason: str  # one clear sentence
    traceback: str = ""  # traceback of an unexpected error


@dataclass(frozen=True, slots=True, repr=False)
class FrameResult:
    """All results and decisions of one frame. None: the stage did not run, see ``failures``."""

    frame: Frame
    config: Config  # complete configuration that made the result
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
    splits: Splits | None = None  # None: clusters are those of the LiDAR alone
    opinions: Opinions | None = None  # None: our fusion made the objects, or there are none
    first_labels: I32 | None = None  # (P,) cluster of each obstacle before detections divided clusters
    ranges: F32 | None = None  # result of ``visibility.range_image``, if a stage has computed it already

    def __repr__(self) -> str:
        words = [f"{len(self.frame.points):,} points", f"{len(self.cameras)} images"]
        if self.clusters is not None:
            words.append(f"{int(self.clusters.kept.sum())} clusters")
        if any(camera.detections is not None for camera in self.cameras):
            kept = (camera.detections.kept.sum() for camera in self.cameras if camera.detections is not None)
            words.append(f"{int(sum(kept))} detections")
        if self.objects is not None:
            words.append(f"objects: {_listed(Counter(self.objects.names))}")
        failed = f"; failed: {', '.join(failure.stage for failure in self.failures)}" if self.failures else ""
        return f"<FrameResult {self.frame.index}: {', '.join(words)}{failed}>"

    def _repr_html_(self) -> str:
        """Return the images, the view from above and the objects, for a notebook."""
        from bevviz.model.preview import MAX_CAMERAS, draw_boxes, preview

        pictures = [
            draw_boxes(camera.camera.image.bgr, camera.detections.labels() if camera.detections else ())
            for camera in self.cameras
            if camera.camera.image is not None
        ][:MAX_CAMERAS]
        if self.bev is not None:
            pictures.append(self.bev.image)
        objects = [] if self.objects is None else self.objects.labels()
        failures = [f"{failure.stage} failed: {failure.reason}" for failure in self.failures]
        return preview(repr(self)[1:-1], pictures, objects, failures)

    def camera(self, name: str) -> CameraResult | None:
        """Return the result of a camera. None: there is no camera of that name."""
        return next((camera for camera in self.cameras if camera.camera.name == name), None)

    def fusion(self, camera: str) -> Fusion | None:
        """Return the result of the fusion for a camera. None: it did not run."""
        result = self.camera(camera)
        return None if result is None else result.fusion

    @staticmethod
    def unprocessed(
        frame: Frame, config: Config, cameras: tuple[CameraResult, ...] | None = None
    ) -> FrameResult:
        """Return a result without any stage run on the frame."""
        if cameras is None:
            cameras = tuple(CameraResult(camera, None, None) for camera in frame.cameras)
        return FrameResult(frame, config, None, None, None, None, cameras, None, None)


@dataclass(frozen=True, slots=True)
class Explanation:
    """One decision: its reason, and the same in words."""

    subject: str  # "detection", "cluster", "split", "object", "fused" or "camera"
    camera: str  # "" where no camera is involved
    row: int
    reason: Reason
    text: str

    @property
    def state(self) -> str:
        """The kind of the reason as one word; the opinion of a camera in its own words."""
        word = self.reason.kind.value
        return word if self.subject == "object" else word.replace(" ", "_")


def explanations_of(
    explanations: Iterable[Explanation], subject: str, camera: str | None = None
) -> list[Explanation]:
    """Return the explanations of a subject. ``camera``: of one camera; None: of all."""
    return [
        explanation
        for explanation in explanations
        if explanation.subject == subject and camera in (None, explanation.camera)
    ]


def texts_by_row(
    explanations: Iterable[Explanation], subject: str, camera: str | None = None
) -> dict[int, str]:
    """Return row -> text of the explanations of a subject, see ``explanations_of``."""
    return {
        explanation.row: explanation.text for explanation in explanations_of(explanations, subject, camera)
    }


@dataclass(frozen=True, slots=True)
class Anomaly:
    """An unusual event that deserves a look, in words and numbers."""

    kind: AnomalyKind
    subject: str  # "person #12", the name of a sensor or of a stage
    text: str
    severity: Literal["WARN", "ERROR"] = "WARN"
    since: int = 0  # stamp of the frame in which it began
    rank: float = 0.0  # 0 to 1: severity; the highest come first


def _listed(names: Counter[str]) -> str:
    """Return ``2 car, 1 person``."""
    return ", ".join(f"{count} {name}" for name, count in sorted(names.items())) or "none"
