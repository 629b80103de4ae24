"""Source of frames of the synthetic drive."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz.errors import UserError
from bevviz.extras.demo.faults import find_faults
from bevviz.extras.demo.mesh import Material
from bevviz.extras.demo.sensors import Caster, Lidar, PinholeCamera, RaycastView, Scan, optical
from bevviz.extras.demo.world import World, bounds
from bevviz.model import geometry
from bevviz.model.frame import (
    F64,
    I32,
    I64,
    Bool,
    Boxes3D,
    Camera,
    Cloud,
    Frame,
    Image,
    Intrinsics,
    LabelledBoxes3D,
    Scene,
)

LIDAR_TOPIC = "/rslidar_points"
IMAGE_TOPIC = "/zed2/zed/rgb/image_rect_color"
CAMERA_INFO_TOPIC = "/zed2/zed/rgb/camera_info"
ODOMETRY_TOPIC = "/odom"
TRUTH_TOPIC = "/ground_truth"
MAP, ODOM, BASE = "map", "odom", "base_link"
LIDAR_FRAME, CAMERA_FRAME = "rslidar", "zed2_left_camera_optical_frame"

START = 1_750_000_000_000_000_000  # stamp of the first scan
PERIOD = 100_000_000  # nanoseconds between scans
IMAGE_DELAY = 12_000_000  # nanoseconds from a scan to its image
LATENCY = 8_000_000  # nanoseconds from a stamp to its reception
TRUTH_RANGE = 80.0  # metres
GROUND = (Material.ROAD, Material.PAVEMENT, Material.KERB, Material.GRASS)
# SemanticKITTI's numbers (Behley et al. 2019), used in the field 'label' of the points.
SCENERY_LABELS = {Material.ROAD: 40, Material.PAVEMENT: 48, Material.KERB: 49, Material.GRASS: 72}
OBJECT_LABELS = {"car": 10, "person": 30, "cyclist": 31}
OTHER_STRUCTURE, OTHER_OBJECT = 52, 99


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A frame with ground truth of a simulator. Object numbers are those of the world's actors."""

    frame: Frame
    truth_object: I32  # (K,) number of the object of each box in Frame.truth
    truth_hits: I32  # (K,) LiDAR points on that object; few or none mean that it is hidden
    point_object: I32  # (N,) object of each point in Frame.points, 0: scenery
    point_ground: Bool  # (N,) road, kerb, pavement or grass
    pixel_object: I32  # (H, W) object of each pixel, 0: scenery, -1: sky


class SyntheticSource:
    """Source of frames with exact ground truth: a vehicle drives down a street, with 10 Hz.

    A scan is taken at one instant, without motion distortion. The image is taken ``IMAGE_DELAY`` later, so
    that projection needs motion compensation. The same arguments give the same frames. A frame depends
    neither on the frames requested before nor on the length of the drive.

    Args:
        frames: number of frames of the drive.
        seed: seed of street, traffic, light and sensor noise.
        plant: names of faults to plant, see ``bevviz.extras.demo.faults``.
        weave: whether the vehicle swerves, brakes and speeds up, as for the calibration of its sensors.
        camera_error: (4, 4) true_camera_from_stated_camera, the error of the stated camera mounting.
        image_late: seconds by which the stamps of the images are late.
        lidar: the LiDAR; None: a HDL-64E.
        camera: the camera; None: a ZED 2.

    Raises:
        UserError: ``frames`` is below 1, ``seed`` below 0, a fault is unknown, or the drive is too short for
        it.
    """

    def __init__(
        self,
        frames: int = 100,
        seed: int = 0,
        *,
        plant: Sequence[str] = (),
        weave: bool = False,
        camera_error: F64 | None = None,
        image_late: float = 0.0,
        lidar: Lidar | None = None,
        camera: PinholeCamera | None = None,
    ) -> None:
        if frames < 1:
            raise UserError(f"a synthetic drive needs at least 1 frame, not {frames}")
        if seed < 0:
            raise UserError(f"seed {seed}: a seed is 0 or above")
        self.total = frames
        self.seed = seed
        self.faults, sensor_faults = find_faults(plant, (frames - 1) * PERIOD * 1e-9)
        self.scene = Scene(
            f"synthetic drive, seed {seed}" + "".join(f", {name}" for name in plant),
            lidar=LIDAR_FRAME,
            lidars=(LIDAR_FRAME,),
            cameras=("zed",),
            truth=True,
        )
        self.warnings: tuple[str, ...] = ()
        self.base_from_lidar = geometry.transform(np.array([0.2, 0.0, 1.9]), np.array([0, 0, 0, 1.0]))
        self._base_from_true_camera = optical((0.7, 0.06, 1.55), np.radians(3.0))
        self.base_from_camera = self._base_from_true_camera  # the stated mounting
        if camera_error is not None:
            self.base_from_camera = self.base_from_camera @ camera_error
        for fault in sensor_faults:
            error = np.array(fault.camera_error)
            self.base_from_camera = self.base_from_camera @ geometry.transform(error[:3], error[3:])
            image_late += fault.image_late
        self._image_late = round(image_late * 1e9)
        self._weave = weave
        self._lidar, self._camera = lidar or Lidar(), camera or PinholeCamera()

    @cached_property
    def world(self) -> World:
        """The world of this seed."""
        scenes = [(fault.time, fault.scene) for fault in self.faults]
        return World(self.seed, self.total * PERIOD * 1e-9, scenes, weave=self._weave)

    @cached_property
    def _static(self) -> Callable[[int], Caster]:
        """Caster of the scenery around a section. Two are cached: scan and image may be in two sections."""
        return lru_cache(maxsize=2)(lambda section: Caster(self.world.static(section)))

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics of the camera."""
        return self._camera.intrinsics

    @cached_property
    def map_from_odom(self) -> F64:
        """Pose of the odometry's origin: the vehicle's pose at the start."""
        return self.world.ego(0.0)

    def map_from_base(self, stamp: int) -> F64:
        """Return the (4, 4) pose of the vehicle at a stamp."""
        return self.world.ego((stamp - START) * 1e-9)

    def __iter__(self) -> Iterator[Frame]:
        for index in range(self.total):
            yield self.snapshot(index).frame

    @property
    def scans(self) -> I64:
        """(N,) time of receipt of each scan, in nanoseconds."""
        return START + LATENCY + PERIOD * np.arange(self.total, dtype=np.int64)

    def number_at(self, time: str | float) -> int:
        """Return the number of the scan nearest to a time in seconds from the start.

        Raises:
            UserError: the time is no number or outside the drive.
        """
        try:
            number = round(float(time) * 1e9 / PERIOD)
        except ValueError:
            raise UserError(f"'{time}' is no time in seconds from the start") from None
        if not 0 <= number < self.total:
            raise UserError(
                f"{time} is outside the drive, which has {(self.total - 1) * PERIOD * 1e-9:.1f} s"
            )
        return number

    def frame(self, number: int) -> Frame:
        """Return one frame, in any order.

        Raises:
            UserError: no frame has this number.
        """
        if not 0 <= number < self.total:
            raise UserError(f"frame {number}: the drive has {self.total} scans, counted from 0")
        return self.snapshot(number).frame

    def close(self) -> None:
        """Do nothing: no file is open."""

    def snapshot(self, index: int) -> Snapshot:
        """Render frame ``index`` with its ground truth."""
        rng = np.random.default_rng((self.seed, index))
        stamp = START + index * PERIOD
        image_stamp = stamp + IMAGE_DELAY
        map_from_lidar = self.map_from_base(stamp) @ self.base_from_lidar
        map_from_camera = self.map_from_base(image_stamp) @ self.base_from_camera
        exposure = image_stamp - self._image_late
        map_from_lens = self.map_from_base(exposure) @ self._base_from_true_camera
        at_scan, at_image = ((t - START) * 1e-9 for t in (stamp, exposure))

        moving = self.world.moving(at_scan, map_from_lidar[:3, 3], self._lidar.reach)
        scan = self._lidar.scan(
            RaycastView(self._static(self.world.section(at_scan)), moving), map_from_lidar, rng
        )
        ahead = (
            map_from_lens[:3, 3] + 50.0 * map_from_lens[:3, 2]
        )  # objects far behind cast no shadow into the image
        scenery = self._static(self.world.section(at_image))
        seen = RaycastView(scenery, self.world.moving(at_image, ahead, 70.0))
        picture = self._camera.picture(seen, map_from_lens, self.world.light, rng)

        fields: dict[str, NDArray[Any]] = {"intensity": scan.intensity, "ring": scan.ring, "time": scan.time}
        fields["label"] = self._labels(scan)
        cloud = Cloud(stamp, LIDAR_FRAME, scan.xyz, fields, LIDAR_TOPIC, stamp + LATENCY, name=LIDAR_FRAME)
        image = Image(
            image_stamp, CAMERA_FRAME, picture.bgr, topic=IMAGE_TOPIC, received=image_stamp + LATENCY
        )
        camera = Camera(
            name="zed",
            image=image,
            intrinsics=self.intrinsics,
            camera_from_points=geometry.inverse(map_from_camera) @ map_from_lidar,
            world_from_camera=map_from_camera,
            sync_error=(image_stamp - stamp) * 1e-9,
            tf_age=0.0,
            motion_compensated=True,
            mounting=geometry.inverse(self.base_from_camera) @ self.base_from_lidar,
        )
        truth, numbers = self._truth(stamp, at_scan, map_from_lidar)
        frame = Frame(
            index=index,
            stamp=stamp,
            received=cloud.received,
            lidar=LIDAR_FRAME,
            points=scan.xyz,
            points_frame=LIDAR_FRAME,
            fields=fields,
            world_frame=MAP,
            world_from_points=map_from_lidar,
            clouds=(cloud,),
            points_from_clouds=(np.eye(4),),
            cameras=(camera,),
            truth=truth,
            tf_age=0.0,
        )
        hits = np.bincount(scan.object, minlength=max(numbers, default=0) + 1)[numbers]
        ground = np.isin(scan.material, GROUND)
        return Snapshot(frame, numbers, hits.astype(np.int32), scan.object, ground, picture.object)

    def _labels(self, scan: Scan) -> NDArray[np.uint16]:
        """Return the (N,) semantic label of each point."""
        scenery = np.full(len(Material), OTHER_STRUCTURE, np.uint16)
        for material, number in SCENERY_LABELS.items():
            scenery[material] = number
        actors = self.world.actors
        of_object = np.zeros(1 + max((actor.number for actor in actors), default=0), np.uint16)
        for actor in actors:
            of_object[actor.number] = OBJECT_LABELS.get(actor.label, OTHER_OBJECT)
        return np.where(scan.object > 0, of_object[scan.object], scenery[scan.material])

    def _truth(self, stamp: int, time: float, map_from_lidar: F64) -> tuple[LabelledBoxes3D, I32]:
        """Return tight boxes around every actor in range, hidden or not, and the (K,) actor numbers.

        The boxes are upright in the LiDAR's frame.
        """
        lidar_from_map = geometry.inverse(map_from_lidar)
        objects = self.world.objects(time, map_from_lidar[:3, 3], TRUTH_RANGE)
        yaw = np.array([heading for _, _, heading in objects]) - geometry.yaw(map_from_lidar)
        extent = np.array(
            [bounds(mesh, lidar_from_map, y) for (_, mesh, _), y in zip(objects, yaw, strict=True)]
        )
        extent = extent.reshape(-1, 2, 3).astype(np.float32)
        turned = np.arctan2(np.sin(yaw), np.cos(yaw)).astype(np.float32)
        boxes = Boxes3D(extent[:, 0], extent[:, 1], turned)
        labels = tuple(actor.label for actor, _, _ in objects)
        truth = LabelledBoxes3D(
            TRUTH_TOPIC,
            stamp,
            LIDAR_FRAME,
            boxes,
            labels,
            np.ones(len(objects), np.float32),
            map_from_lidar,
            stamp + LATENCY,
            ids=tuple(str(actor.number) for actor, _, _ in objects),
        )
        return truth, np.array([actor.number for actor, _, _ in objects], np.int32)
