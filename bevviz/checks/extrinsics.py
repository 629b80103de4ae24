"""Checks of extrinsics: a camera that looks elsewhere than its transform says, and the pose that would do.

The usual mistakes are few: the inverse, body axes instead of optical ones, another order of the quaternion,
degrees as radians, millimetres, an image upside down, the pose of another camera. Each is tried. Small errors
are none of these; ``bevviz calib`` measures them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import product

import cv2
import numpy as np

from bevviz.checks.camera_views import CameraView
from bevviz.checks.read_input import CameraSample, ReadInput
from bevviz.model import geometry
from bevviz.model.frame import F64
from bevviz.model.input_findings import InputFinding, Remedy
from bevviz.sync.gravity import SMALL_UNITS

LEVEL = math.radians(60.0)  # largest tilt of an image's down axis from the vertical without a doubt
UPRIGHT = math.radians(35.0)  # the same of a pose that is proposed
ALIKE = math.radians(20.0)  # the same between two poses that are one
FEW, MANY = 3, 10  # detections that tell whether a pose does, and that tell without one that does
POOR, GOOD, CLEAR = (
    0.5,
    0.6,
    0.8,
)  # shares with points: of a wrong pose, a better and a right one
FAR = 10.0  # metres from the LiDAR, from which on a camera is not on the same robot
UNITS = {**SMALL_UNITS, 10: "decimetres"}  # divisors that make metres of a unit
NEAR = 3.0  # metres; a camera is mostly nearer to the LiDAR
USUAL = 0.3  # metres between a camera and a LiDAR

# Optical axes (RDF) from body axes (FLU).
OPTICAL = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def wrong_extrinsics(read: ReadInput) -> Iterator[InputFinding]:
    """Yield each camera whose stated pose cannot be right, with the pose that would do."""
    for name, camera in read.cameras.items():
        if not camera.judged:
            others = {
                other: sample.views[-1].camera_from_frame
                for other, sample in read.cameras.items()
                if other != name
            }
            camera.finding, camera.judged = _judge(name, camera, others), True
        if camera.finding is not None:
            yield camera.finding


def _judge(name: str, camera: CameraSample, others: dict[str, F64]) -> InputFinding | None:
    """Return the finding about one camera, or None."""
    views, stated = camera.views, camera.views[-1].camera_from_frame
    total = sum(len(view.inner) for view in views)
    supported = sum(view.supported(view.camera_from_frame) for view in views)
    can_tell = total >= FEW
    is_tilted = _tilt(stated, views[-1]) > LEVEL and (not can_tell or supported < CLEAR * total)
    is_empty = not any(view.in_image(view.camera_from_frame) for view in views)
    distance = float(np.linalg.norm(geometry.inverse(stated)[:3, 3]))
    is_far = distance > FAR and (not can_tell or supported < CLEAR * total)
    if not (is_tilted or is_empty or is_far or (can_tell and supported <= POOR * total)):
        return None
    needed = max(supported + (1 if is_tilted else FEW), GOOD * total) if can_tell else 0.0
    best = _best(views, candidates(stated, others), stated, needed, can_tell=can_tell)
    if best is None and not (is_tilted or is_empty or is_far or (total >= MANY and supported == 0)):
        return None
    doubts = []
    if is_tilted:
        doubts.append(f"the down axis of its image points {_direction(stated, views[-1])}")
    if is_empty:
        doubts.append("no LiDAR point is in its image")
    if is_far:
        doubts.append(f"it is {distance:.0f} m from the LiDAR")
    if can_tell and not is_empty:
        have = "has" if supported < 2 else "have"
        doubts.append(
            f"{supported or 'none'} of its {total} detections {have} LiDAR points at the distance that the "
            "size tells"
        )
    text = f"camera '{name}': its stated pose looks wrong: {', and '.join(doubts)}"
    if best is None:
        remedy = Remedy("check the transform between it and the LiDAR, and its frame_id")
        return InputFinding("calibration", name, text, remedy)
    what, pose, count = best
    place = geometry.inverse(pose)
    values = np.round([*place[:3, 3], *geometry.quaternion(place)], 6) + 0.0
    numbers = ", ".join(f"{value:.6g}" for value in values)
    setting = f"source.extrinsics={{{camera.points_frame} {camera.image_frame}: [{numbers}]}}"
    if can_tell:
        tried, would = f"tried: {count} of {total} detections have points then", "would do"
    else:
        tried, would = "tried: its image is upright then, with LiDAR points in it", "may be meant"
    return InputFinding(
        "calibration", name, text, Remedy(f"{what} {would}: --set '{setting}'", (setting,), tried)
    )


def _best(
    views: Sequence[CameraView],
    poses: Iterator[tuple[str, F64]],
    stated: F64,
    needed: float,
    *,
    can_tell: bool,
) -> tuple[str, F64, int] | None:
    """Return the name of the likeliest mistake, the pose without it, and its detections with points.

    Args:
        views: the images.
        poses: the mistakes, the likeliest first.
        stated: the stated pose.
        needed: least number of detections with points.
        can_tell: whether there are enough detections. Else the first upright pose with points is returned.
    """
    best: tuple[str, F64, int] | None = None
    for what, pose in poses:
        if _tilt(pose, views[-1]) > UPRIGHT or np.linalg.norm(pose[:3, 3]) > FAR or _alike(pose, stated):
            continue
        if not can_tell:
            if any(view.in_image(pose) for view in views):
                return what, pose, 0
            continue
        count = sum(view.supported(pose) for view in views)
        if count >= needed and (best is None or count > 1.1 * best[2]):
            best = what, pose, count
    return best


def candidates(stated: F64, others: dict[str, F64]) -> Iterator[tuple[str, F64]]:
    """Yield what the stated pose may be instead, the likeliest mistakes first.

    Args:
        stated: (4, 4) camera_from_lidar.
        others: the same of other cameras, by name.
    """
    inverse = geometry.inverse(stated)
    optical = OPTICAL @ stated
    turned = np.eye(4)
    turned[:2, :2] *= -1
    yield "the inverse of the stated pose", inverse
    yield from _other_angles(stated)
    yield "optical axes (z ahead) instead of the stated body axes (x ahead)", optical
    yield "optical axes and the inverse of the stated pose", OPTICAL @ inverse
    yield "the pose without its optical axes, which are applied twice", geometry.inverse(OPTICAL) @ stated
    yield "the pose turned by 180 degrees about the optical axis", turned @ stated
    yield from _other_quaternions(stated)
    for other, pose in others.items():
        yield f"the pose of camera '{other}'", pose
    for what, pose in (("", stated), ("the inverse, and ", inverse), ("optical axes, and ", optical)):
        distance = float(np.linalg.norm(pose[:3, 3]))
        for divisor in sorted(UNITS, key=lambda unit: abs(math.log(max(distance, 1e-6) / unit / USUAL))):
            scaled = pose.copy()
            scaled[:3, 3] /= divisor
            unit = UNITS[divisor]
            if divisor == 1000 and distance < 100 * NEAR:
                unit += ", or by 100 if it is in centimetres"
            yield f"{what}the translation divided by {divisor} ({unit})", scaled
    for degrees in (90, -90, 180):
        about_up = np.eye(4)
        about_up[:3, :3] = geometry.rotations(2, np.radians([degrees]))[0]
        yield f"the LiDAR's axes turned by {degrees} degrees about z", stated @ about_up
    for matrix in _axes():
        yield "other axes of the camera", matrix @ stated


def _other_angles(stated: F64) -> Iterator[tuple[str, F64]]:
    """Yield poses whose angles were read in the wrong unit, in either direction."""
    for pose, is_inverse in ((geometry.inverse(stated), True), (stated, False)):
        angles = _angles(pose)
        for unit, read_as, other in (
            ("radians", "degrees", np.degrees(angles)),
            ("degrees", "radians", _right_angles(angles)),
        ):
            if other is not None:
                changed = pose.copy()
                changed[:3, :3] = _rotation(other)
                yield (
                    f"angles in {unit}, which were read as {read_as},",
                    geometry.inverse(changed) if is_inverse else changed,
                )


def _other_quaternions(stated: F64) -> Iterator[tuple[str, F64]]:
    """Yield poses whose quaternion was read in the wrong order, in either direction."""
    for pose, is_inverse in ((geometry.inverse(stated), True), (stated, False)):
        x, y, z, w = geometry.quaternion(pose).tolist()
        for order, quaternion in (("x, y, z, w", (w, x, y, z)), ("w, x, y, z", (y, z, w, x))):
            changed = geometry.transform(pose[:3, 3], quaternion)
            in_camera = geometry.inverse(changed) if is_inverse else changed
            yield f"the quaternion in the order {order}", in_camera
            yield f"the quaternion in the order {order} and optical axes", OPTICAL @ in_camera


def _axes() -> Iterator[F64]:
    """Yield the 24 rotations that permute axes, but the identity."""
    for order in ((0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (1, 0, 2), (2, 1, 0)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.eye(4)
            matrix[:3, :3] = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(matrix[:3, :3]) > 0 and not np.allclose(matrix, np.eye(4)):
                yield matrix


def _angles(pose: F64) -> F64:
    """Return roll, pitch and yaw of a pose in radians."""
    R = pose[:3, :3]
    return np.array(
        [
            math.atan2(R[2, 1], R[2, 2]),
            math.atan2(-R[2, 0], math.hypot(R[2, 1], R[2, 2])),
            math.atan2(R[1, 0], R[0, 0]),
        ]
    )


def _right_angles(angles: F64) -> F64 | None:
    """Return multiples of 90 degrees, in radians, that give these angles if degrees are read as radians."""
    right = np.array([-180.0, -90.0, 0.0, 90.0, 180.0])
    error = np.abs((angles[:, None] - right + math.pi) % math.tau - math.pi)
    best = error.argmin(axis=1)
    return None if (error.min(axis=1) > 0.01).any() else np.radians(right[best])


def _rotation(angles: F64) -> F64:
    """Return the (3, 3) rotation by roll, pitch and yaw in radians."""
    roll, pitch, yaw = (geometry.rotations(axis, angles[axis : axis + 1])[0] for axis in range(3))
    return np.asarray(yaw @ pitch @ roll)


def _tilt(camera_from_frame: F64, view: CameraView) -> float:
    """Return the angle between the down axis of the image and the vertical."""
    down = (camera_from_frame @ view.frame_from_points)[:3, :3] @ np.array([0.0, 0.0, -1.0])
    return math.acos(float(np.clip(down[1], -1, 1)))


def _alike(a: F64, b: F64) -> bool:
    """Return whether two poses look in one direction from one place."""
    turn = cv2.Rodrigues(a[:3, :3] @ b[:3, :3].T)[0]
    apart = np.linalg.norm(geometry.inverse(a)[:3, 3] - geometry.inverse(b)[:3, 3])
    return bool(np.linalg.norm(turn) < ALIKE and apart < 1.0)


def _direction(camera_from_frame: F64, view: CameraView) -> str:
    """Return where the down axis of the image points, in words."""
    axis = np.linalg.inv((camera_from_frame @ view.frame_from_points)[:3, :3])[:, 1]
    words = (("ahead", "back"), ("to the left", "to the right"), ("up", "down"))
    largest = int(np.abs(axis).argmax())
    return words[largest][int(axis[largest] < 0)]
