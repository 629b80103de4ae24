"""A folder that a drive is written into as a data set: what all of these have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from bevviz.errors import UserError
from bevviz.model.frame import U8, Intrinsics
from bevviz.model.protocols import Items, Observer
from bevviz.model.results import FrameResult


class FolderExport(Observer[FrameResult]):
    """Writes each frame; those that lack what the data set needs are counted and left out.

    Args:
        folder: to be made; it must not hold an export yet.
        camera: name of the only one whose images are written; empty: what the data set has room for.

    Attributes:
        frames: written.
        labels: written.
        skipped: frames that were left out, by the reason.

    Raises:
        UserError: the folder holds something.
    """

    def __init__(self, folder: Path, camera: str = "") -> None:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UserError(f"{folder}: is there already; give another folder")
        self._folder, self._camera = folder, camera
        self.frames = self.labels = 0
        self.skipped: dict[str, int] = {}

    def begin(self, items: Items[object]) -> None:
        cameras = items.scene.cameras
        if self._camera and self._camera not in cameras:
            raise UserError(f"--camera {self._camera}: there is none of that name but {', '.join(cameras)}")
        with self._saving("made"):
            for name in self._folders(cameras):
                (self._folder / name).mkdir(parents=True)

    @abstractmethod
    def _folders(self, cameras: Sequence[str]) -> Sequence[str]:
        """That are made first, of a drive with these cameras."""

    def _skip(self, why: str) -> None:
        self.skipped[why] = self.skipped.get(why, 0) + 1

    @contextmanager
    def _saving(self, what: str = "written") -> Iterator[None]:
        """An OSError in it is told in one line."""
        try:
            yield
        except OSError as error:
            raise UserError(f"{self._folder}: cannot be {what}: {error.strerror}") from None


def rectified(bgr: U8, intrinsics: Intrinsics) -> U8:
    """The (H, W, 3) image as a camera of the same K without distortion has it."""
    if not intrinsics.distortion_model:
        return bgr
    if intrinsics.distortion_model == "equidistant":
        straight = cv2.fisheye.undistortImage(bgr, intrinsics.K, intrinsics.D[:4], Knew=intrinsics.K)
    else:
        straight = cv2.undistort(bgr, intrinsics.K, intrinsics.D[:8])
    return np.asarray(straight, np.uint8)
