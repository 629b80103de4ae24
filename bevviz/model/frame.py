"""Input of the stages: small frozen dataclasses of arrays, free of ROS and Rerun.

Conventions, everywhere in the project:

- a rigid transform is a (4, 4) float64 matrix named ``a_from_b``: ``p_a = a_from_b @ p_b``;
- body frames are FLU (x forward, y left, z up), optical frames RDF (x right, y down, z forward);
- stamps are int nanoseconds, durations float seconds, lengths metres, angles radians, pixels float;
- pixel (0, 0) is the centre of the top left pixel; image boxes are x0, y0, x1, y1;
- images are (H, W, 3) uint8 BGR; points are (N, 3) float32.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from bevviz.config.sections import Quantity

Bool = NDArray[np.bool_]
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]

Codec = Literal["h264", "h265", "av1", "vp8", "vp9"]  # video codecs that Rerun shows without decoding


# --- input -------------------------------------------------------------------------------------


RING_FIELDS = ("ring", "line", "channel")


@dataclass(frozen=True, slots=True)
class Cloud:
    """One LiDAR scan as received, without invalid points. ``dropped`` counts these."""

    stamp: int
    frame_id: str
    xyz: F32  # (N, 3), C-contiguous, in frame_id
    fields: Mapping[str, NDArray[Any]] = field(default_factory=dict)  # extra (N,) fields by name
    topic: str = ""
    received: int = 0
    dropped: int = 0  # points of the message that are NaN, infinite, beyond any sensor's range or (0, 0, 0)
    name: str = ""  # entity name of the LiDAR
    number: int | None = None  # number in the recording, if it makes a frame; None: not known
    doubt: str = ""  # what of the message does not fit together, as a sentence without the topic


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Pinhole or fisheye camera model (ROS CameraInfo conventions)."""

    width: int
    height: int
    K: F64  # (3, 3)
    distortion_model: str = ""  # "", plumb_bob, rational_polynomial or equidistant
    D: F64 = field(default_factory=lambda: np.zeros(0))  # coefficients in ROS order
    baseline: tuple[float, float] = (0.0, 0.0)  # metres right of and below the first camera of a stereo pair
    assumed: bool = False  # True: there is no CameraInfo, and these are the configured defaults
    cropped: bool = False  # True: the images show a part of the sensor, so that the centre may be anywhere
    doubt: str = ""  # what of the message does not fit together, as a sentence without the topic
    raw: Intrinsics | None = None  # model of the images before they were rectified, if that is stated


@dataclass(frozen=True, slots=True)
class VideoClip:
    """Packets of a video up to a picture: the group with its key frame, and the group before that."""

    codec: Codec
    places: tuple[tuple[int, int], ...]  # time of receipt and stamp of each packet in its topic
    packets: tuple[bytes, ...]
    key: int  # row of the key frame


@dataclass(frozen=True, slots=True)
class Image:
    """One camera image. ``encoded`` is the untouched JPEG or PNG, if the source had one.

    For video that Rerun can show, ``clip`` holds the packets it was decoded from. No picture needs later
    packets.
    """

    stamp: int
    frame_id: str
    bgr: U8  # (H, W, 3)
    encoded: bytes | None = None
    media_type: str = ""
    topic: str = ""
    received: int = 0
    clip: VideoClip | None = None


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera as one frame sees it. A missing value is None and named in ``problems``."""

    name: str
    image: Image | None
    intrinsics: Intrinsics | None
    camera_from_points: F64 | None  # (4, 4) from Frame.points at its stamp to the camera at the image stamp
    world_from_camera: F64 | None  # (4, 4)
    sync_error: float = float("nan")  # seconds, image stamp - cloud stamp
    tf_age: float = float("nan")  # seconds between the requested stamp and the nearest TF sample used
    motion_compensated: bool = False
    mounting: F64 | None = None  # camera_from_points without motion compensation
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
        """Return zero boxes."""
        return Boxes3D(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0, np.float32))

    @staticmethod
    def joined(parts: Sequence[Boxes3D]) -> Boxes3D:
        """Concatenate boxes."""
        if not parts:
            return Boxes3D.empty()
        return Boxes3D(
            *(np.concatenate([getattr(p, name) for p in parts]) for name in ("center", "size", "yaw"))
        )

    def chosen(self, rows: Sequence[int] | NDArray[Any]) -> Boxes3D:
        """Return the boxes of some rows."""
        indices = np.asarray(rows, np.int64) if len(rows) == 0 else rows
        return Boxes3D(self.center[indices], self.size[indices], self.yaw[indices])

    @property
    def distance(self) -> F64:
        """(K,) metres on the ground plane from the origin, which is the sensor's place, to each centre."""
        return np.hypot(self.center[:, 0], self.center[:, 1], dtype=np.float64)

    @property
    def columns(self) -> dict[str, F32]:
        """Columns of a table: centre, size and heading."""
        x, y, z = self.center.T
        length, width, height = self.size.T
        return {"x": x, "y": y, "z": z, "length": length, "width": width, "height": height, "yaw": self.yaw}


@dataclass(frozen=True, slots=True)
class LabelledBoxes3D:
    """Boxes in ``frame_id`` that bevviz did not compute: the robot's own results, or ground truth."""

    topic: str
    stamp: int
    frame_id: str
    boxes: Boxes3D
    labels: tuple[str, ...]
    scores: F32  # (K,), 1 where the message has none
    world_from_boxes: F64 | None = None
    received: int = 0
    ids: tuple[str, ...] = ()  # (K,) ids, the same from frame to frame; (): the message has none
    image: ImageLabels | None = None  # labels of the image in a data set
    # These hold values only until the boxes are transformed into the frame of the points:
    turns: F64 | None = None  # (K, 4) quaternions xyzw, if some boxes lean, so that ``yaw`` is not enough
    frames: tuple[str, ...] = ()  # (K,) frame of each box; (): all are in frame_id
    unusable: tuple[str, ...] = ()  # one sentence for each box that was left out


@dataclass(frozen=True, slots=True)
class ImageLabels:
    """Labels of a data set's image beside the boxes in 3D. KITTI's terms."""

    xyxy: F32  # (K, 4) box of each object in the image
    truncated: F32  # (K,) share outside of the image, 0 to 1
    occluded: I32  # (K,) 0 fully visible, 1 partly occluded, 2 largely occluded, 3 not known
    dont_care: F32  # (R, 4) regions without labels


@dataclass(frozen=True, slots=True)
class LabelledBoxes2D:
    """Image boxes that the robot itself published."""

    topic: str
    stamp: int
    frame_id: str
    xyxy: F32  # (K, 4)
    labels: tuple[str, ...]
    scores: F32  # (K,)
    camera: str = ""  # name of the camera whose image they are in, if known
    received: int = 0
    unusable: tuple[str, ...] = ()  # one sentence for each box that was left out


# --- surroundings ------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ComponentStatus:
    """State of one component of the robot, from its diagnostics."""

    name: str
    level: Literal["ok", "warning", "error", "stale"]
    text: str


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """An occupancy grid: cells from 0 (free) to 100 (occupied), -1 for unknown."""

    cells: NDArray[np.int8]  # (rows, columns)
    resolution: float  # metres
    pose: F64  # (4, 4) frame of the map from the corner of the first cell, rows along y, columns along x


@dataclass(frozen=True, slots=True)
class SolidShapes:
    """Boxes, or the ellipsoids inscribed in them."""

    center: F32  # (N, 3)
    half: F32  # (N, 3) metres
    quaternion: F32  # (N, 4) x, y, z, w
    round: bool = False


@dataclass(frozen=True, slots=True)
class HeightMap:
    """A map of heights, or of other values on a plane: triangles between the centres of its known cells."""

    vertices: F32  # (V, 3)
    triangles: NDArray[np.uint32]  # (T, 3) rows of the vertices
    values: F32  # (V,) values to colour


@dataclass(frozen=True, slots=True)
class MeshFile:
    """A file with a mesh, and the pose of the mesh in its frame."""

    path: Path
    pose: F64  # (4, 4)
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class ImuSamples:
    """Samples of an IMU since the previous frame, in its own frame. NaN if it measures none."""

    topic: str
    stamp: I64  # (N,)
    received: I64  # (N,)
    rotation: F64  # (N, 3) rad/s
    acceleration: F64  # (N, 3) m/s^2, or in g, as drivers differ


@dataclass(frozen=True, slots=True)
class PlacedShape:
    """Geometry in the coordinates of ``frame_id``."""

    topic: str  # also the namespace and id of a marker
    frame_id: str
    stamp: int
    points: F32 | None = None  # (N, 3)
    strips: tuple[F32, ...] = ()  # (N, 3) each
    solids: SolidShapes | None = None
    axes: F64 | None = None  # (4, 4) frame_id from a pose
    grid: OccupancyGrid | None = None
    surface: HeightMap | None = None
    meshes: tuple[MeshFile, ...] = ()
    fix: tuple[float, float] | None = None  # latitude and longitude in degrees
    picture: U8 | None = None  # (H, W, 3) BGR
    color: U8 | None = None  # red, green, blue, alpha
    text: str = ""
    world_from_shape: F64 | None = None  # (4, 4); None: TF does not connect it with the points


@dataclass(frozen=True, slots=True)
class RobotContext:
    """Other topics of the robot beside perception, at the time of a frame."""

    marks: tuple[str, ...] = ()  # marks that people set at this frame
    statuses: tuple[ComponentStatus, ...] = ()
    shapes: tuple[PlacedShape, ...] = ()
    motions: tuple[ImuSamples, ...] = ()


@dataclass(frozen=True, slots=True)
class UserMark:
    """A note that a person took, and its frame."""

    text: str
    index: int
    stamp: int


@dataclass(frozen=True, slots=True)
class LateBoxes:
    """Boxes of the robot that came after their frame was processed. Only live runs have them."""

    boxes: LabelledBoxes2D | LabelledBoxes3D
    frame_stamp: int  # stamp of the nearest frame
    pose: F64  # (4, 4) world_from_points of that frame
    index: int = 0  # index of that frame


@dataclass(frozen=True, slots=True, repr=False)
class Frame:
    """One LiDAR scan with all data of its time. Without a LiDAR, one image of the first camera.

    ``points`` are the points of every LiDAR in ``points_frame``. This is the LiDAR's own frame if there is
    one LiDAR, and the base frame if several are merged. If the frame is not upright, ``upright`` turns the
    points about its origin, so that z points up.
    """

    index: int
    stamp: int
    received: int
    lidar: str  # entity name: that of the LiDAR, "lidars" for merged ones, empty without a LiDAR
    points: F32  # (N, 3)
    points_frame: str
    fields: Mapping[str, NDArray[Any]] = field(default_factory=dict)  # extra fields common to all clouds
    upright: F64 | None = None  # (4, 4) points from points_frame; None: z of points_frame points up
    world_frame: str = ""  # name of the fixed frame; equal to points_frame if there is none
    world_from_points: F64 | None = None  # None: no TF to the fixed frame (the identity is assumed)
    clouds: tuple[Cloud, ...] = ()
    points_from_clouds: tuple[F64, ...] = ()
    cameras: tuple[Camera, ...] = ()
    robot_boxes: tuple[LabelledBoxes3D, ...] = ()
    robot_detections: tuple[LabelledBoxes2D, ...] = ()
    robot_clouds: tuple[Cloud, ...] = ()  # obstacle points, in the frame of the points
    truth: LabelledBoxes3D | None = None
    label_names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # source.labels
    tf_age: float = float("nan")
    problems: tuple[str, ...] = ()  # one clear sentence each
    around: RobotContext | None = None

    def __repr__(self) -> str:
        images = ", ".join(camera.name for camera in self.cameras if camera.image is not None) or "none"
        points = f"{len(self.points):,} points of {self.lidar or 'no LiDAR'}"
        return f"<Frame {self.index}: {points}, images: {images}>"

    @property
    def is_planar(self) -> bool:
        """Whether the clouds are scans of one plane through the sensor, which no floor is in."""
        heights = [cloud.xyz[:, 2] for cloud in self.clouds]
        return bool(heights) and not any(z[:1].any() or z.any() for z in heights)  # mostly the first tells

    @property
    def pose(self) -> F64:
        """(4, 4) ``world_from_points``, or the identity if there is no TF to the fixed frame."""
        return np.eye(4) if self.world_from_points is None else self.world_from_points


# --- sources -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Scene:
    """Description of a source: the names that entities and blueprints are made from."""

    name: str  # name of the bag or drive, for the recording's title
    lidar: str  # entity name of Frame.points; empty: there is no LiDAR
    lidars: tuple[str, ...] = ()  # entity name of each LiDAR; equal to lidar if there is one
    cameras: tuple[str, ...] = ()
    robot: bool = False  # the source has the robot's own results
    truth: bool = False  # the source has ground truth
    imu: bool = False  # the source has rotation and acceleration
    bag: tuple[Path, ...] = ()  # files and folders that the frames are read from; () if there are none
    topics: tuple[str, ...] = ()  # key=value settings that give the same topics the same roles
    focus: tuple[float, float, float] | None = None  # the point in question, in metres of Frame.points_frame
    above: tuple[float, float, float, float] | None = None  # u, v, u, v: start of a look from above
    moving: bool = False  # the views go to what a user asks about
    raw: bool = True  # every raw cloud is logged
    color_by: tuple[Quantity, ...] = ()  # quantities that can colour the raw cloud
