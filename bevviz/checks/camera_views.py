"""Sample of the images of a drive: what the checks of extrinsics need of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F32, F64, Camera, Intrinsics
from bevviz.model.results import CameraResult, FrameResult

POINTS = 8000  # most points of a frame that are kept
LEAST_HEIGHT = 16.0  # pixels of an image box; the size of a smaller one tells little
BORDER = 2.0  # pixels; a box that reaches the image's border may be a part of the object
INNER = 0.2  # share of a box that is left out at each side
NEAREST, FARTHEST = 0.65, 1.5  # factors of the distance that the size of a detection tells
REACH = 0.95  # share of the points that are nearer than the LiDAR's reach
FEW = 2  # points at that distance that a detection needs
MOST = 0.5  # share of the points in its box that are at that distance


@dataclass(frozen=True, slots=True)
class CameraView:
    """One image of a camera with the points of its time.

    Attributes:
        intrinsics: the camera model.
        camera_from_frame: (4, 4) stated transform from the frame of the points, which may be tilted.
        frame_from_points: (4, 4) transform from the points, which are upright.
        points: (N, 3) points, those that are not ground if the ground is known.
        inner: (D, 4) middle part of the image box of each detection whose distance is known by its size.
        depth: (D, 2) least and largest distance of each.
    """

    intrinsics: Intrinsics
    camera_from_frame: F64
    frame_from_points: F64
    points: F32
    inner: F32
    depth: F32

    def supported(self, camera_from_frame: F64) -> int:
        """Return how many detections have points at their distance with another transform."""
        uv, depth = geometry.project(
            geometry.apply(camera_from_frame @ self.frame_from_points, self.points), self.intrinsics
        )
        visible = np.isfinite(uv).all(axis=1) & (depth > 0)
        uv, depth = uv[visible], depth[visible]
        count = 0
        for (x0, y0, x1, y1), (near, far) in zip(self.inner, self.depth, strict=True):
            inside = (uv[:, 0] > x0) & (uv[:, 0] < x1) & (uv[:, 1] > y0) & (uv[:, 1] < y1)
            fitting = int(np.count_nonzero(inside & (depth > near) & (depth < far)))
            count += int(fitting >= max(FEW, MOST * np.count_nonzero(inside)))
        return count

    def in_image(self, camera_from_frame: F64) -> int:
        """Return how many points are in the image with another transform."""
        uv, depth = geometry.project(
            geometry.apply(camera_from_frame @ self.frame_from_points, self.points), self.intrinsics
        )
        size = np.array([self.intrinsics.width, self.intrinsics.height])
        with np.errstate(invalid="ignore"):
            return int(np.count_nonzero(np.all((uv >= 0) & (uv < size), axis=1) & (depth > 0)))


def view_of(result: FrameResult, row: int, sizes: Mapping[str, Sequence[float] | None]) -> CameraView | None:
    """Return the view of one camera of a result; None if the camera is not placed or has no image.

    Args:
        result: result of a frame. Stages need not have run.
        row: row of the camera.
        sizes: ``objects.sizes``.
    """
    camera_result = result.cameras[row]
    camera, frame = camera_result.camera, result.frame
    mounting = _mounting(camera)
    if mounting is None or camera.image is None or camera.intrinsics is None or not len(frame.points):
        return None
    points = frame.points if result.obstacles is None or frame.is_planar else result.obstacles
    if not len(points):
        return None
    upright = np.eye(4) if frame.upright is None else frame.upright
    reach = float(np.quantile(np.linalg.norm(frame.points[::7], axis=1), REACH))
    inset = 0.0 if frame.is_planar else INNER
    inner, depth = _distances(camera_result, camera.intrinsics, sizes, reach, inset)
    return CameraView(
        camera.intrinsics,
        mounting @ upright,
        geometry.inverse(upright),
        points[:: -(-len(points) // POINTS)].copy(),
        inner,
        depth,
    )


def _mounting(camera: Camera) -> F64 | None:
    """Return (4, 4) camera_from_points at standstill."""
    return camera.camera_from_points if camera.mounting is None else camera.mounting


def _distances(
    camera: CameraResult,
    intrinsics: Intrinsics,
    sizes: Mapping[str, Sequence[float] | None],
    reach: float,
    inset: float,
) -> tuple[F32, F32]:
    """Return the (D, 4) inner boxes and the (D, 2) distances of the kept detections of known size.

    Args:
        camera: the camera with its detections.
        intrinsics: the camera model.
        sizes: ``objects.sizes``.
        reach: metres that the LiDAR reaches. Farther detections are left out.
        inset: share of the height of a box that is left out above and below.
    """
    inner, depth = [], []
    detections = camera.detections
    for row in [] if detections is None else np.flatnonzero(detections.kept).tolist():
        assert detections is not None
        size = sizes.get(detections.names[row].lower())
        x0, y0, x1, y1 = detections.xyxy[row].tolist()
        cut = min(x0, y0) < BORDER or x1 > intrinsics.width - BORDER or y1 > intrinsics.height - BORDER
        if size is None or cut or y1 - y0 < LEAST_HEIGHT:
            continue
        heights, per_metre = size[2::6], float(intrinsics.K[1, 1]) / (y1 - y0)
        if per_metre * min(heights) > reach:
            continue
        width, height = INNER * (x1 - x0), inset * (y1 - y0)
        inner.append((x0 + width, y0 + height, x1 - width, y1 - height))
        depth.append((NEAREST * per_metre * min(heights), FARTHEST * per_metre * max(heights)))
    return np.array(inner, np.float32).reshape(-1, 4), np.array(depth, np.float32).reshape(-1, 2)
