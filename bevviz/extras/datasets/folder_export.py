"""Base class of exports of a drive into a data set folder."""

from __future__ import annotations

import os
import sys
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from bevviz.errors import UserError
from bevviz.model import geometry
from bevviz.model.frame import U8, Intrinsics
from bevviz.model.protocols import Items, Observer
from bevviz.model.results import FrameResult
from bevviz.support.unfinished_folder import UnfinishedFolder


class FolderExport(Observer[FrameResult]):
    """Observer that writes each frame into a folder. It counts frames that lack required data and skips them.

    The folder gets its name when it is complete, see ``UnfinishedFolder``. A run that fails leaves none, and
    so does one without a frame.

    Args:
        folder: folder to create. It must not exist or must be empty.
        camera: name of the only camera to write; empty: all cameras that the format supports.

    Attributes:
        frames: number of written frames.
        labels: number of written labels.
        skipped: number of skipped frames by reason.

    Raises:
        UserError: the folder is not empty, or it cannot be replaced.
    """

    def __init__(self, folder: Path, camera: str = "") -> None:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UserError(f"{folder}: is there already; give another folder")
        if folder.exists() and (folder.is_mount() or folder.samefile(os.curdir)):
            raise UserError(f"{folder}: cannot be replaced; give a folder inside of it, which is then made")
        self._target, self._camera = folder, camera
        self._unfinished: UnfinishedFolder | None = None
        self.frames = self.labels = 0
        self.skipped: dict[str, int] = {}

    def begin(self, items: Items[object]) -> None:
        """Create the folders under a temporary name.

        Raises:
            UserError: the camera does not exist, the folders cannot be created, or another process writes
                the same folder.
        """
        cameras = items.scene.cameras
        if self._camera and self._camera not in cameras:
            raise UserError(f"--camera {self._camera}: there is none of that name but {', '.join(cameras)}")
        with self._saving("made"):
            self._target.parent.mkdir(parents=True, exist_ok=True)
            self._unfinished = UnfinishedFolder(self._target)
            try:
                for name in self._folders(cameras):
                    (self._unfinished.path / name).mkdir(parents=True)
                self._prepare(items)
            except BaseException:
                self._unfinished.discard()
                raise

    def end(self) -> None:
        """Complete the folder and give it its name. Delete it if the run failed or wrote no frame."""
        assert self._unfinished is not None
        try:
            if self.frames and sys.exc_info()[0] is None:
                with self._saving():
                    self._finish()
                    self._unfinished.finish()
        finally:
            self._unfinished.discard()

    def _prepare(self, items: Items[object]) -> None:
        """Write what precedes the first frame."""

    def _finish(self) -> None:
        """Write what follows the last frame."""

    def _write_file(self, name: str, data: bytes) -> None:
        """Write a file of the folder.

        Raises:
            OSError: the file cannot be written as a whole.
        """
        assert self._unfinished is not None
        (self._unfinished.path / name).write_bytes(data)

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
            raise UserError(f"{self._target}: cannot be {what}: {error.strerror}") from None


def encode_image(bgr: U8, suffix: str, options: Sequence[int] = ()) -> bytes:
    """Encode an image in memory: OpenCV does not notice a full disk.

    Raises:
        OSError: the image cannot be encoded.
    """
    done, encoded = cv2.imencode(suffix, bgr, options)
    if not done:
        raise OSError(0, "the image cannot be encoded")
    return encoded.tobytes()


def rectify(bgr: U8, intrinsics: Intrinsics) -> U8:
    """Return the (H, W, 3) image as a camera with the same K and no distortion would take it."""
    if not intrinsics.distortion_model:
        return bgr
    if intrinsics.distortion_model == "equidistant":
        straight = cv2.fisheye.undistortImage(bgr, intrinsics.K, intrinsics.D[:4], Knew=intrinsics.K)
    else:
        straight = cv2.undistort(bgr, intrinsics.K, geometry.coefficients(intrinsics))
    return np.asarray(straight, np.uint8)
