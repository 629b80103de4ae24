"""Camera models of ROS messages."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from bevviz.messages.decoders import MessageError, either
from bevviz.model.frame import F64, Intrinsics
from bevviz.support.text import short_repr

_DISTORTION = {
    "plumb_bob": "plumb_bob",
    "": "plumb_bob",  # coefficients without a name
    "rational_polynomial": "rational_polynomial",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "kannala_brandt": "equidistant",  # name in Foxglove's messages
    "kannala_brandt4": "equidistant",  # name in librealsense
}

OPENCV_COUNTS = (
    4,
    5,
    8,
    12,
    14,
)  # numbers of coefficients that OpenCV takes; of an equidistant lens the first
MOST_OFF = 0.2  # farthest principal point from the image centre without a warning, as share of the image size
MAX_NUMBER = 1e6  # Largest coefficient, and largest focal length or centre in pixels, of any real camera.


def decode_camera_info(msg: Any, rectified: bool, topic: str = "camera_info") -> Intrinsics:
    """Return the camera model of a sensor_msgs/CameraInfo, for images as they are published.

    K of a message is for the full sensor. The region of interest and the binning are applied as
    image_geometry does: first the offset, then the scale.

    Args:
        msg: message of ROS 1 (upper-case K, D, P) or ROS 2.
        rectified: whether the images are rectified. Then the left 3 x 3 of P is used without distortion; K if
            there is no P.
        topic: topic of the message, for errors.

    Raises:
        MessageError: the camera is not calibrated, its distortion model is not supported, or a number is
            absurd.
    """
    K, D, P = (np.asarray(either(msg, n, n.lower()), np.float64) for n in "KDP")
    matrix, baseline = K.reshape(3, 3), (0.0, 0.0)
    if rectified and P[0]:
        matrix = P.reshape(3, 4)[:, :3]
        baseline = -float(P[3] / P[0]), -float(P[7] / P[5] if P[5] else 0.0)
    if not np.isfinite(matrix).all() or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise MessageError(f"{topic}: the camera is uncalibrated (K is zero or not finite); calibrate it")
    if max(np.abs(matrix).max(), *map(abs, baseline)) > MAX_NUMBER or not np.isfinite(baseline).all():
        raise MessageError(f"{topic}: {matrix.tolist()} is no camera matrix in pixels; calibrate the camera")
    model, coefficients = "", np.zeros(0)
    if not rectified and (np.any(D) or (len(D) and _is_fisheye(msg.distortion_model))):
        model, coefficients = _distortion(msg.distortion_model, D, topic)
    sensor, offset = (int(msg.width), int(msg.height)), np.array([msg.roi.x_offset, msg.roi.y_offset])
    region = np.array([msg.roi.width or msg.width, msg.roi.height or msg.height], int)
    binning = np.array([max(int(msg.binning_x), 1), max(int(msg.binning_y), 1)])
    width, height = (region // binning).tolist()
    size, doubt = (width, height), ""
    cropped = bool(offset.any()) or (0 < msg.roi.width < msg.width)
    outside = bool((offset + region > sensor).any()) and all(sensor)
    if (outside or off_centre(matrix, sensor) > MOST_OFF) and 2 * off_centre(matrix, size) < MOST_OFF:
        why = f"binning {binning[0]} x {binning[1]}" if binning.max() > 1 else "its region of interest"
        doubt = (
            f"by {why} its K is for the full sensor, but its centre ({matrix[0, 2]:.0f}, {matrix[1, 2]:.0f}) "
            f"is that of the images of {width} x {height} pixels: K is taken as theirs"
        )
    else:
        matrix = matrix.copy()
        matrix[:2, 2] -= offset
        matrix /= np.array([[binning[0]], [binning[1]], [1]])
    raw = None
    if rectified and np.any(D):
        with suppress(MessageError):
            raw = decode_camera_info(msg, rectified=False, topic=topic)
    return Intrinsics(*size, matrix, model, coefficients, baseline, cropped=cropped, doubt=doubt, raw=raw)


def off_centre(matrix: F64, size: tuple[int, int]) -> float:
    """Return how far the principal point is from the middle of the image, as share of its size."""
    if not size[0] or not size[1]:
        return 0.0
    return float(np.abs(matrix[:2, 2] / size - 0.5).max())


def _is_fisheye(name: str) -> bool:
    """Return whether a model is a fisheye lens (r = f theta), also with all coefficients at zero."""
    return _DISTORTION.get(name.lower()) == "equidistant"


def _distortion(name: str, D: F64, topic: str) -> tuple[str, F64]:
    """Return the model and as many coefficients as OpenCV takes.

    Coefficients that are not stated are zero. That is the same lens: each is the factor of one term of a sum
    (k of a power of the radius or of the angle, p1 and p2 of the tangential terms, s of the thin prism) or
    an angle of the tilted sensor, and all tools state them in this order: k1, k2, p1, p2, k3, k4, k5, k6,
    s1 to s4, two angles, or k1 to k4 of an equidistant lens.

    Raises:
        MessageError: the model is not supported, or these are no coefficients of it.
    """
    model = _DISTORTION.get(name.lower())
    if model is None:
        raise MessageError(
            f"{topic}: distortion model '{name}' is not supported; supported are "
            f"{', '.join(sorted(set(_DISTORTION.values())))}"
        )
    if not (np.abs(D) <= MAX_NUMBER).all():  # not true of NaN, too
        raise MessageError(
            f"{topic}: {short_repr(D.tolist())} are no coefficients of the distortion model '{name}'"
        )
    counts = OPENCV_COUNTS[:1] if model == "equidistant" else OPENCV_COUNTS
    if np.any(D[counts[-1] :]):
        raise MessageError(
            f"{topic}: more than {counts[-1]} coefficients of the distortion model '{model}' are stated, and "
            f"OpenCV has {counts[-1]}"
        )
    coefficients = np.zeros(next((count for count in counts if len(D) <= count), counts[-1]))
    coefficients[: len(D)] = D[: len(coefficients)]
    return model, coefficients
