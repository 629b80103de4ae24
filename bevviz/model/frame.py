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
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from bevviz.config.sections import Quantity
from bevviz.errors import UserError

if TYPE_CHECKING:
    from pandas import DataFrame


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


@dataclass(frozen=True, slots=True)
class Cloud:
    """One LiDAR scan as received: returns with finite coordinates; ``dropped`` counts the others."""

    stamp: int
    frame_id: str
    xyz: F32  # (N, 3), C-contiguous, in frame_id
    fields: Mapping[str, NDArray[Any]] = field(default_factory=dict)  # extra (N,) fields by name
    topic: str = ""
    received: int = 0
    dropped: int = 0  # points of the message that were NaN, infinite, beyond any sensor or (0, 0, 0)
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

    center: F32 | F64  # (K, 3); float64 in a map, whose origin may be far away
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
    # Until they are placed:
    turns: F64 | None = None  # (K, 4) quaternions xyzw, where some lean: ``yaw`` does not say enough then
    frames: tuple[str, ...] = ()  # of each; (): all are in frame_id
    unusable: tuple[str, ...] = ()  # a sentence for each box that was stated and left out


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
    unusable: tuple[str, ...] = ()  # a sentence for each box that was stated and left out


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
