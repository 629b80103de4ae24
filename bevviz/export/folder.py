"""Base class of exports of a drive into a data set folder."""

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
    """Observer that writes each frame into a folder. It counts frames that lack required data and skips them.

    Args:
        folder: folder to create. It must not exist or must be empty.
        camera: name of the only camera to write; empty: all cameras that the format supports.

    Attributes:
        frames: number of written frames.
        labels: number of written labels.
        skipped: number of skipped frames by reason.

    Raises:
        UserError: the folder is not empty.
    """

    def __init__(self, folder: Path, camera: str = "") -> None:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UserError(f"{folder}: is there already; give another folder")
        self._folder, self._camera = folder, camera
        self.frames = self.labels = 0
        self.skipped: dict[str, int] = {}

    def begin(self, items: Items[object]) -> None:
        """Create the folders.

        Raises:
            UserError: the camera does not exist, or the folders cannot be created.
        """
        cameras = items.scene.cameras
        if self._camera and self._camera not in cameras:
            raise UserError(f"--camera {self._camera}: there is none of that name but {', '.join(cameras)}")
        with self._saving("made"):
            for name in self._folders(cameras):
                (self._folder / name).mkdir(parents=True)

    @abstractmethod
    def _folders(self, cameras: Sequence[str]) -> Sequence[str]:
        """Return the folders to create for a drive with these cameras."""

    def _takes(self, camera: str) -> bool:
        """Return whether a camera is written."""
        return self._camera in ("", camera)

    def _skip(self, why: str) -> None:
        self.skipped[why] = self.skipped.get(why, 0) + 1

    @contextmanager
    def _saving(self, what: str = "written") -> Iterator[None]:
        """Turn an OSError into a UserError that names the folder."""
        try:
            yield
        except OSError as error:
            raise UserError(f"{self._folder}: cannot be {what}: {error.strerror}") from None


def rectify(bgr: U8, intrinsics: Intrinsics) -> U8:
    """Return the (H, W, 3) image as a camera with the same K and no distortion would take it."""
    if not intrinsics.distortion_model:
        return bgr
    if intrinsics.distortion_model == "equidistant":
        straight = cv2.fisheye.undistortImage(bgr, intrinsics.K, intrinsics.D[:4], Knew=intrinsics.K)
    else:
        straight = cv2.undistort(bgr, intrinsics.K, intrinsics.D[:8])
    return np.asarray(straight, np.uint8)
