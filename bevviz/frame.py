"""What flows through bevviz: small frozen dataclasses of arrays, free of ROS and Rerun.

Conventions, everywhere in the project:

- a rigid transform is a (4, 4) float64 matrix named ``a_from_b``: ``p_a = a_from_b @ p_b``;
- body frames are FLU (x forward, y left, z up), optical frames RDF (x right, y down, z forward);
- stamps are int nanoseconds, durations float seconds, lengths metres, angles radians, pixels float;
- pixel (0, 0) is the centre of the top left pixel; image boxes are x0, y0, x1, y1;
- images are (H, W, 3) uint8 BGR; points are (N, 3) float32.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from bevviz.errors import UserError

if TYPE_CHECKING:
    from pandas import DataFrame

    from bevviz.config import ClusteringConfig, Config

Bool = NDArray[np.bool_]
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

Codec = Literal["h264", "h265", "av1", "vp8", "vp9"]  # of video that Rerun shows as it is


def data_frame(columns: Mapping[str, Any] | Sequence[Mapping[str, Any]]) -> DataFrame:
    """A table, where pandas is installed.

    Raises:
        UserError: it is not.
    """
    try:
        from pandas import DataFrame
    except ImportError:
        raise UserError("a table needs pandas: pip install 'bevviz[notebook]'") from None
    return DataFrame(columns)


# --- input -------------------------------------------------------------------------------------


RING_FIELDS = ("ring", "line", "channel")
Quantity = Literal["height", "intensity", "ring", "time", "distance"]  # of a point


@dataclass(frozen=True, slots=True)
class Cloud:
    """One LiDAR scan as received: returns with finite coordinates; ``dropped`` counts the others."""

    stamp: int
    frame_id: str
    xyz: F32  # (N, 3), C-contiguous, in frame_id
    fields: Mapping[str, NDArray[Any]] = field(default_factory=dict)  # extra (N,) fields by name
    topic: str = ""
    received: int = 0
    dropped: int = 0  # points of the message that were NaN, infinite or (0, 0, 0)
    name: str = ""  # entity name of the LiDAR


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Pinhole or fisheye camera model (ROS CameraInfo conventions)."""

    width: int
    height: int
    K: F64  # (3, 3)
    distortion_model: str = ""  # "", plumb_bob, rational_polynomial or equidistant
    D: F64 = field(default_factory=lambda: np.zeros(0))  # coefficients in ROS order
    baseline: tuple[float, float] = (0.0, 0.0)  # metres right of and below the first camera of a stereo pair
    assumed: bool = False  # True: no CameraInfo was seen, these are the configured defaults


@dataclass(frozen=True, slots=True)
class Clip:
    """Packets of a video up to a picture: from the key frame that it needs, and the group before that."""

    codec: Codec
    places: tuple[tuple[int, int], ...]  # of each in its topic: time of receipt and stamp
    packets: tuple[bytes, ...]
    key: int  # row of the key frame


@dataclass(frozen=True, slots=True)
class Image:
    """One camera image. ``encoded`` is the untouched JPEG or PNG, where the source had one.

    Of video, ``clip`` is what it was decoded from, where Rerun shows that: no picture needs later ones.
    """

    stamp: int
    frame_id: str
    bgr: U8  # (H, W, 3)
    encoded: bytes | None = None
    media_type: str = ""
    topic: str = ""
    received: int = 0
    clip: Clip | None = None


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera as one frame sees it. Whatever is missing is None and named in ``problems``."""

    name: str
    image: Image | None
    intrinsics: Intrinsics | None
    camera_from_points: F64 | None  # (4, 4), from Frame.points at its stamp to the camera at the image's
    world_from_camera: F64 | None  # (4, 4)
    sync_error: float = float("nan")  # seconds, image stamp - cloud stamp
    tf_age: float = float("nan")  # seconds between the asked stamp and the nearest TF sample used
    motion_compensated: bool = False
    mounting: F64 | None = None  # camera_from_points without the motion that is compensated
    problems: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Boxes3D:
    """K upright boxes: turned by ``yaw`` about z (zero for axis-aligned ones)."""

    center: F32  # (K, 3)
    size: F32  # (K, 3) full lengths along the box's own x, y, z
    yaw: F32  # (K,)

    def __len__(self) -> int:
        return len(self.center)

    @staticmethod
    def empty() -> Boxes3D:
        return Boxes3D(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.float32))

    @staticmethod
    def joined(parts: Sequence[Boxes3D]) -> Boxes3D:
        """One after the other."""
        if not parts:
            return Boxes3D.empty()
        return Boxes3D(
            *(np.concatenate([getattr(p, name) for p in parts]) for name in ("center", "size", "yaw"))
        )

    def chosen(self, rows: Sequence[int] | NDArray[Any]) -> Boxes3D:
        """Some of them."""
        chosen = np.asarray(rows, np.int64) if len(rows) == 0 else rows
        return Boxes3D(self.center[chosen], self.size[chosen], self.yaw[chosen])

    @property
    def columns(self) -> dict[str, F32]:
        """For a table: centre, size and heading."""
        x, y, z = self.center.T
        length, width, height = self.size.T
        return {"x": x, "y": y, "z": z, "length": length, "width": width, "height": height, "yaw": self.yaw}


@dataclass(frozen=True, slots=True)
class LabelledBoxes3D:
    """Boxes somebody else states: the robot's own results, or ground truth. In ``frame_id``."""

    topic: str
    stamp: int
    frame_id: str
    boxes: Boxes3D
    labels: tuple[str, ...]
    scores: F32  # (K,), 1 where not given
    world_from_boxes: F64 | None = None
    received: int = 0
    ids: tuple[str, ...] = ()  # of each, the same from frame to frame; (): none are stated
    image: ImageLabels | None = None  # of a labelled data set


@dataclass(frozen=True, slots=True)
class ImageLabels:
    """What was labelled in the image, beside boxes in 3D. KITTI's terms."""

    xyxy: F32  # (K, 4) of each box
    truncated: F32  # (K,) share outside of the image, 0 to 1
    occluded: I32  # (K,) 0 seen whole, 1 partly, 2 largely hidden, 3 not known
    dont_care: F32  # (R, 4) regions in which nothing was labelled


@dataclass(frozen=True, slots=True)
class LabelledBoxes2D:
    """Image boxes that the robot itself published."""

    topic: str
    stamp: int
    frame_id: str
    xyxy: F32  # (K, 4)
    labels: tuple[str, ...]
    scores: F32  # (K,)
    camera: str = ""  # name of the camera they belong to, where known
    received: int = 0


# --- around perception -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Status:
    """What the robot's diagnostics say of one of its parts."""

    name: str
    level: Literal["ok", "warning", "error", "stale"]
    text: str


@dataclass(frozen=True, slots=True)
class Grid:
    """A map: cells from 0 (free) to 100 (occupied), -1 where nothing is known."""

    cells: NDArray[np.int8]  # (rows, columns)
    resolution: float  # metres
    pose: F64  # (4, 4) frame of the map from its first cell's corner, rows along y, columns along x


@dataclass(frozen=True, slots=True)
class Solids:
    """Boxes, or ellipsoids in them."""

    center: F32  # (N, 3)
    half: F32  # (N, 3) metres
    quaternion: F32  # (N, 4) x, y, z, w
    round: bool = False


@dataclass(frozen=True, slots=True)
class Surface:
    """A map of heights, or of other values on a plane: triangles between the centres of its known cells."""

    vertices: F32  # (V, 3)
    triangles: NDArray[np.uint32]  # (T, 3) rows of the vertices
    values: F32  # (V,) that the colours are of


@dataclass(frozen=True, slots=True)
class MeshFile:
    """A file with a mesh, and where it is in its frame."""

    path: Path
    pose: F64  # (4, 4)
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Motion:
    """What an Imu has measured since the frame before, in its own frame; NaN where it measures none."""

    topic: str
    stamp: I64  # (N,)
    received: I64  # (N,)
    rotation: F64  # (N, 3) rad/s
    acceleration: F64  # (N, 3) m/s^2, or in g: drivers differ


@dataclass(frozen=True, slots=True)
class Shape:
    """What has a place in the world, in the coordinates of ``frame_id``."""

    topic: str  # with a marker's namespace and id
    frame_id: str
    stamp: int
    points: F32 | None = None  # (N, 3)
    strips: tuple[F32, ...] = ()  # (N, 3) each
    solids: Solids | None = None
    axes: F64 | None = None  # (4, 4) frame_id from a pose
    grid: Grid | None = None
    surface: Surface | None = None
    meshes: tuple[MeshFile, ...] = ()
    fix: tuple[float, float] | None = None  # degrees of latitude and longitude
    picture: U8 | None = None  # (H, W, 3) BGR
    color: U8 | None = None  # red, green, blue, alpha
    text: str = ""
    world_from_shape: F64 | None = None  # (4, 4); None: not connected with the points


@dataclass(frozen=True, slots=True)
class Around:
    """What the robot says around its perception, at the time of a frame."""

    marks: tuple[str, ...] = ()  # set by people, at this frame
    statuses: tuple[Status, ...] = ()
    shapes: tuple[Shape, ...] = ()
    motions: tuple[Motion, ...] = ()


@dataclass(frozen=True, slots=True)
class Mark:
    """A note of people's, and the frame that it belongs to."""

    text: str
    index: int
    stamp: int


@dataclass(frozen=True, slots=True)
class LateResult:
    """Boxes of the robot's own that came when the frame of their time had gone on: beside a robot alone."""

    boxes: LabelledBoxes2D | LabelledBoxes3D
    frame_stamp: int  # of the frame that is nearest
    pose: F64  # (4, 4) world from points, at that frame
    index: int = 0  # of that frame


@dataclass(frozen=True, slots=True)
class Frame:
    """One LiDAR scan with all that belongs to its time; without a LiDAR, one image of the first camera.

    ``points`` are the points of every LiDAR in ``points_frame``: the LiDAR's own frame where there is
    one LiDAR, the base frame where several are merged. Where that frame is not upright, they are turned
    about its origin by ``upright``, so that z points up.
    """

    index: int
    stamp: int
    received: int
    lidar: str  # entity name: that of the LiDAR, "lidars" for merged ones, empty where cameras are alone
    points: F32  # (N, 3)
    points_frame: str
    fields: Mapping[str, NDArray[Any]] = field(default_factory=dict)  # extra fields common to all clouds
    upright: F64 | None = None  # (4, 4) points from points_frame; None: z of points_frame points up
    world_frame: str = ""  # name of the fixed frame; equal to points_frame where there is none
    world_from_points: F64 | None = None  # None: no TF to the fixed frame (identity is assumed)
    clouds: tuple[Cloud, ...] = ()
    points_from_clouds: tuple[F64, ...] = ()
    cameras: tuple[Camera, ...] = ()
    robot_boxes: tuple[LabelledBoxes3D, ...] = ()
    robot_detections: tuple[LabelledBoxes2D, ...] = ()
    robot_clouds: tuple[Cloud, ...] = ()  # of obstacles, in the frame of the points
    truth: LabelledBoxes3D | None = None
    tf_age: float = float("nan")
    problems: tuple[str, ...] = ()  # one clear sentence each
    around: Around | None = None

    @property
    def pose(self) -> F64:
        """(4, 4) ``world_from_points``, the identity where there is no TF to the fixed frame."""
        return np.eye(4) if self.world_from_points is None else self.world_from_points


# --- sources -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Scene:
    """What a source will deliver: the names that entities and blueprints are made from."""

    name: str  # of the bag or drive, for the recording's title
    lidar: str  # entity name of Frame.points; empty: there is no LiDAR
    lidars: tuple[str, ...] = ()  # entity name of each LiDAR; the same as lidar where there is one
    cameras: tuple[str, ...] = ()
    robot: bool = False  # the robot's own results come along
    truth: bool = False  # ground truth comes along
    imu: bool = False  # rotation and acceleration come along
    bag: tuple[Path, ...] = ()  # files and folders that the frames are read from; (): none
    topics: tuple[str, ...] = ()  # key=value each, which give the same topics the same roles
    focus: tuple[float, float, float] | None = None  # what is asked about, in metres of Frame.points_frame
    above: tuple[float, float, float, float] | None = None  # u, v, u, v: where a look from above begins
    raw: bool = True  # every raw cloud is logged
    color_by: tuple[Quantity, ...] = ()  # that it can be coloured by


class Source(Protocol):
    """An iterable of frames, in order of stamp: a bag, the synthetic drive, or a running robot."""

    @property
    def scene(self) -> Scene: ...

    @property
    def total(self) -> int | None:
        """Frames to expect, for a progress bar; None where unknown."""
        ...

    @property
    def warnings(self) -> Sequence[str]:
        """What was lost or looked wrong so far, one sentence each."""
        ...

    def __iter__(self) -> Iterator[Frame]: ...


# --- results -----------------------------------------------------------------------------------


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

    def to_pandas(self) -> DataFrame:
        """A row for each object."""
        origin = {"camera": self.camera, "detection": self.detection, "cluster": self.cluster}
        return data_frame({"name": self.names, "score": self.score, **self.boxes.columns, **origin})


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

    subject: str  # "detection", "cluster", "split" or "camera"
    camera: str  # "" where no camera is involved
    row: int
    state: str
    text: str


AnomalyKind = Literal["flicker", "jump", "one_sensor", "sync", "tf", "stage"]


@dataclass(frozen=True, slots=True)
class Anomaly:
    """Something that is worth a look, in words and numbers."""

    kind: AnomalyKind
    subject: str  # "person #12", the name of a sensor or of a stage
    text: str
    severity: Literal["WARN", "ERROR"] = "WARN"
    since: int = 0  # stamp of the frame that it began in
    rank: float = 0.0  # 0 to 1: how bad it is; the worst come first
