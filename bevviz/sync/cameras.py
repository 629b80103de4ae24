"""Buffers of images and calibrations, and the camera of each frame that is made from them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

import numpy as np

from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.messages.camera_info import MOST_OFF, off_centre
from bevviz.messages.roles import Roles
from bevviz.messages.topics import CameraRole
from bevviz.model import geometry
from bevviz.model.frame import F64, Camera, Image, Intrinsics
from bevviz.sync.buffers import TopicBuffer, describe_distance
from bevviz.sync.pose_lookup import PoseLookup, ReferenceFrames
from bevviz.sync.report import SyncReport
from bevviz.sync.transform_tree import TransformError

TUTORIAL_K = np.array([[267.0, 0.0, 320.0], [0.0, 267.0, 180.0], [0.0, 0.0, 1.0]])
WIDEST, NARROWEST = 150.0, 3.0  # degrees; fields of view of lenses that are no fisheyes
SQUARE = 1.5  # largest ratio of the two focal lengths
FOLDED = 0.05  # share of the image beside a border, beyond which coefficients fold
DECENTRED = 0.04  # largest tangential distortion in a corner, as share of the image's diagonal; 0.01 is usual


@dataclass(frozen=True, slots=True)
class UndecodedImage:
    """Image that is not decoded yet.

    Attributes:
        frame_id: frame of the header.
        load: decodes the image.
    """

    frame_id: str
    load: Callable[[], Image]


class Cameras:
    """Buffer of the images and calibrations of all cameras.

    Args:
        roles: roles of the topics.
        config: tolerances.
        report: counts missing images.
        placing: finds the poses of cameras.
        horizon: nanoseconds of images and calibrations that are kept.

    Attributes:
        images: images by topic.
        frames: optical frame by image topic.
        intrinsics: newest calibration by CameraInfo topic.
    """

    def __init__(
        self, roles: Roles, config: Config, report: SyncReport, placing: PoseLookup, horizon: int
    ) -> None:
        self._roles, self._config, self._report, self._placing = roles, config, report, placing
        self._driver, self._horizon = roles.driver, horizon
        self._tolerance = round(config.sync.tolerance * 1e9)
        self._tf = report.tf
        self.images: dict[str, TopicBuffer[UndecodedImage]] = {
            c.topic: TopicBuffer(horizon) for c in roles.cameras
        }
        self.frames: dict[str, str] = {}
        self.intrinsics: dict[str, Intrinsics] = {}
        self._infos: dict[str, TopicBuffer[Intrinsics]] = {}  # by topic
        self._info_topics = {camera.topic: camera.info_topic for camera in roles.cameras}
        self._info_frames: dict[str, str] = {}  # by CameraInfo topic
        self._refused: dict[str, str] = {}  # why the calibrations of a topic cannot be used
        self._info_counts: Counter[str] = Counter()
        self._image_counts: Counter[str] = Counter()

    def take_over(self, former: Cameras) -> None:
        """Continue with the calibrations of ``former``."""
        self._report, self._tf = former._report, former._tf
        self.intrinsics, self._infos, self._refused = former.intrinsics, former._infos, former._refused
        self._info_frames = former._info_frames

    def add_image(self, topic: str, stamp: int, frame_id: str, load: Callable[[], Image]) -> bool:
        """Add an image. Return whether it replaces an image with the same stamp."""
        self.frames[topic] = frame_id = self._optical_frame(topic, frame_id)
        self._image_counts[topic] += 1
        return self.images[topic].add(stamp, UndecodedImage(frame_id, load))

    def _optical_frame(self, topic: str, frame_id: str) -> str:
        """Return the frame of an image: the stated one, or that of its CameraInfo if that fits better."""
        if topic in self._config.source.frames:
            return self._config.source.frames[topic]
        info_topic = self._info_topics[topic]
        other = self._info_frames.get(info_topic, "")
        if not other or other.lstrip("/") == frame_id.lstrip("/"):
            return frame_id
        known = self._tf.frames()
        if not frame_id:
            chosen, why = other, "its images state no frame"
        elif other.lstrip("/") not in known:
            return frame_id
        elif frame_id.lstrip("/") not in known:
            chosen, why = other, f"its images state the frame '{frame_id}', which no transform has"
        else:
            chosen = other if "optical" in other and "optical" not in frame_id else frame_id
            why = f"its images state the frame '{frame_id}', and {info_topic} states '{other}'"
        unused = frame_id if chosen == other else other
        helps = (
            f"; --set source.frames='{{{topic}: {unused}}}' takes the other one" if unused in known else ""
        )
        used = f"'{other}' of {info_topic}" if chosen == other else f"'{frame_id}'"
        self._report.oddities.setdefault(f"{topic} frame", f"{topic}: {why}: {used} is used{helps}")
        return chosen

    def add_info(self, topic: str, stamp: int, intrinsics: Intrinsics, frame_id: str = "") -> None:
        """Add a calibration. An image uses the calibration with the nearest stamp."""
        self._info_frames[topic] = frame_id
        self.intrinsics[topic] = intrinsics
        self._info_counts[topic] += 1
        self._infos.setdefault(topic, TopicBuffer(self._horizon)).add(stamp, intrinsics)

    def refuse_info(self, topic: str, reason: str) -> None:
        """Note why the calibrations of a topic cannot be used."""
        self._refused[topic] = reason

    def info_reaches(self, role: CameraRole, stamp: int, absent: Collection[str]) -> bool:
        """Return whether the calibration of the image at a stamp has come, if each image has its own."""
        buffer, image = self._infos.get(role.info_topic), self.images[role.topic].nearest(stamp)
        if buffer is None or buffer.newest is None or image is None or role.info_topic in absent:
            return True
        one_each = self._info_counts[role.info_topic] * 2 > self._image_counts[role.topic] > 1
        return not one_each or buffer.newest >= image[0]

    def at(self, role: CameraRole, reference: ReferenceFrames) -> Camera:
        """Return the camera of a frame: image, calibration and pose, with a sentence for each problem."""
        problems: list[str] = []
        image, stamp = self._image(role, reference.stamp, problems)
        intrinsics = self._camera_intrinsics(role, image, stamp, problems)
        camera = Camera(role.name, image, intrinsics, None, None, problems=tuple(problems))
        if image is not None:
            camera = replace(camera, sync_error=(stamp - reference.stamp) * 1e-9)
            if offset := self._report.clocks.wrong(role.topic, self._driver):
                self._report.complain(
                    problems,
                    f"the clocks of camera '{role.name}' and the LiDAR are {abs(offset):.2f} s apart: "
                    f"its image is of another time",
                )
                camera = replace(camera, problems=tuple(problems))
        frame = self.frames.get(role.topic)
        if frame is None:
            return camera
        try:
            lookup, compensated = self._placing.moved(reference, stamp, frame)
        except TransformError as error:
            if not frame or not reference.points_frame:
                helps = "; source.frames can state it"
            else:
                lacking = not self._tf.knows(reference.points_frame, frame)
                helps = "; source.extrinsics can state it" if lacking else ""
            self._report.complain(problems, f"{error}{helps}")
            return replace(camera, problems=tuple(problems))
        if image is not None and not compensated and self._placing.compensates(reference):
            self._report.complain(
                problems, f"no motion compensation: '{reference.inertial_frame}' is out of reach"
            )
        world = np.eye(4) if reference.world_from_points is None else reference.world_from_points
        first_from_camera = self._second_of_stereo(role, intrinsics, frame)
        points_from_camera = lookup.matrix @ first_from_camera
        mounting = self._placing.mounting(reference, frame) if compensated else None
        return replace(
            camera,
            camera_from_points=geometry.inverse(points_from_camera),
            world_from_camera=world @ points_from_camera,
            tf_age=lookup.age,
            motion_compensated=compensated,
            mounting=None if mounting is None else geometry.inverse(first_from_camera) @ mounting,
            problems=tuple(problems),
        )

    def _second_of_stereo(self, role: CameraRole, intrinsics: Intrinsics | None, frame: str) -> F64:
        """Return (4, 4) frame of the image from its camera.

        The second camera of a stereo pair is in the frame of the first. See P in sensor_msgs/CameraInfo. Many
        drivers give the second camera its own frame and nevertheless write P. Then the transforms count.
        """
        pose = np.eye(4)
        if intrinsics is None or intrinsics.baseline == (0.0, 0.0):
            return pose
        if any(other_frame == frame for topic, other_frame in self.frames.items() if topic != role.topic):
            pose[:2, 3] = intrinsics.baseline
        else:
            self._report.oddities.setdefault(
                role.info_topic,
                f"{role.info_topic}: its P tells of a camera {math.hypot(*intrinsics.baseline):.3f} m beside "
                f"another one's frame; '{frame}' is taken as its own, as no other camera is in it",
            )
        return pose

    def _image(self, role: CameraRole, stamp: int, problems: list[str]) -> tuple[Image | None, int]:
        """Return the decoded image nearest to ``stamp`` and its stamp; without one, None and ``stamp``."""
        nearest = self.images[role.topic].nearest(stamp)
        if nearest is None or abs(nearest[0] - stamp) > self._tolerance:
            self._report.without_image[role.name] += 1
            problems.append(
                f"no image of camera '{role.name}' {describe_distance(nearest, stamp, self._tolerance)}"
            )
            return None, stamp
        try:
            image = replace(nearest[1].load(), stamp=nearest[0], frame_id=nearest[1].frame_id)
            self._report.images += 1
            return image, nearest[0]
        except UserError as error:
            self._report.undecodable.add(role.name, str(error))
            problems.append(str(error))
            return None, stamp

    def _camera_intrinsics(
        self, role: CameraRole, image: Image | None, stamp: int, problems: list[str]
    ) -> Intrinsics | None:
        infos = self._infos.get(role.info_topic)
        nearest = None if infos is None else infos.nearest(stamp)
        intrinsics = None if nearest is None else nearest[1]
        if intrinsics is not None and image is not None:
            fitted = self._fitted(role, intrinsics, image, problems)
            if fitted is not None:
                self._check_intrinsics(role, fitted)
            return fitted
        if intrinsics is not None:
            return intrinsics
        missing = f"no CameraInfo on {role.info_topic}" if role.info_topic else "no CameraInfo topic"
        if self._config.preset == "reference":
            self._report.complain(
                problems, f"{missing} yet: using fx = fy = 267, cx 320, cy 180 of the reference"
            )
            height, width = image.bgr.shape[:2] if image is not None else (360, 640)
            return Intrinsics(width, height, TUTORIAL_K, assumed=True)
        if role.info_topic in self._refused:
            self._report.complain(problems, self._refused[role.info_topic])
            return None
        others = [topic for topic in self._roles.camera_infos if topic != role.info_topic]
        setting = f"source.camera_info_topics='{{{role.topic}: {others[0]}}}'" if others else ""
        helps = f"name the topic with --set {setting}" if setting else "record one"
        self._report.complain(
            problems, f"{missing} for camera '{role.name}': nothing can be projected into it; {helps}"
        )
        return None

    def _check_intrinsics(self, role: CameraRole, intrinsics: Intrinsics) -> None:
        """Note doubts about a camera matrix for images of its size."""
        size = intrinsics.width, intrinsics.height
        fx, fy = intrinsics.K[0, 0], intrinsics.K[1, 1]
        view = math.degrees(2 * math.atan(size[0] / (2 * fx)))
        images = f"images of {size[0]} x {size[1]} pixels"
        doubt = ""
        if intrinsics.doubt:
            doubt = intrinsics.doubt
        elif not intrinsics.cropped and off_centre(intrinsics.K, size) > MOST_OFF:
            cx, cy = intrinsics.K[:2, 2]
            doubt = f"the principal point ({cx:.0f}, {cy:.0f}) is far from the middle of {images}"
        elif max(fx / fy, fy / fx) > SQUARE:
            doubt = f"the focal lengths {fx:.0f} and {fy:.0f} are of no square pixels"
        elif intrinsics.distortion_model not in geometry.FISHEYE and not NARROWEST < view < WIDEST:
            doubt = f"the focal length {fx:.0f} gives {images} a field of view of {view:.0f} degrees"
        helps = "" if intrinsics.doubt else ": is its K for other images?"
        if not doubt and (what := _no_lens(intrinsics)):
            doubt = f"its coefficients of {intrinsics.distortion_model} {what} {images}"
            helps = ": are they those of a fisheye lens? Then distortion_model must be equidistant"
        if doubt:
            self._report.oddities.setdefault(f"{role.topic} K", f"{role.info_topic}: {doubt}{helps}")

    def _fitted(
        self, role: CameraRole, intrinsics: Intrinsics, image: Image, problems: list[str]
    ) -> Intrinsics | None:
        """Return the intrinsics scaled to the size of the image; None if they do not fit."""
        height, width = image.bgr.shape[:2]
        if (width, height) == (intrinsics.width, intrinsics.height):
            return intrinsics
        if not intrinsics.width or not intrinsics.height:  # many drivers send 0
            return replace(intrinsics, width=width, height=height)
        sx, sy = width / intrinsics.width, height / intrinsics.height
        if abs(sx / sy - 1) > 0.01:
            self._report.complain(
                problems,
                f"CameraInfo on {role.info_topic} is for {intrinsics.width} x {intrinsics.height} pixels, "
                f"the image has {width} x {height}: nothing can be projected into it",
            )
            return None
        # Pixel (0, 0) is the centre of the corner pixel, so the corner itself is at -0.5.
        scale = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
        raw = intrinsics.raw and replace(
            intrinsics.raw, width=width, height=height, K=scale @ intrinsics.raw.K
        )
        return replace(intrinsics, width=width, height=height, K=scale @ intrinsics.K, raw=raw)


def _no_lens(intrinsics: Intrinsics) -> str:
    """Return what distortion coefficients do that those of no lens do, but of a fisheye; empty: nothing."""
    if intrinsics.distortion_model in geometry.FISHEYE or not geometry.has_distortion(intrinsics):
        return ""
    size = np.array([intrinsics.width, intrinsics.height])
    corner = (size / 2 / intrinsics.K[[0, 1], [0, 1]]) ** 2
    p1, p2 = np.abs(geometry.coefficients(intrinsics)[2:4])
    tangential = (p1 + p2) * 3 * float(corner.sum()) * float(intrinsics.K[0, 0]) / np.linalg.norm(size)
    if tangential > DECENTRED:
        return f"are of a lens {100 * tangential:.0f} % off the middle of"
    tangents = np.tan(np.radians(np.arange(-85, 85.5, 0.5)))[:, None]
    for axis, name in ((0, "columns"), (1, "rows")):
        rays = np.eye(3)[axis] * tangents + np.eye(3)[2]
        reached = geometry.project(rays, intrinsics)[0][:, axis]
        low, high = float(np.nanmin(reached)), float(np.nanmax(reached))
        if low > FOLDED * size[axis] or high < (1 - FOLDED) * size[axis]:
            return f"fold: they reach the {name} {max(low, 0):.0f} to {min(high, size[axis]):.0f} only of"
    return ""
