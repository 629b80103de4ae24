"""Thumbnails of a drive: small camera images that the page shows above its timeline."""

from __future__ import annotations

from bevviz.model.frame import Frame
from bevviz.report.pictures import jpeg, shrink

MOST = 512  # thumbnails of a drive, about 4 kB each
WIDTH, QUALITY = 224, 70  # pixels, and percent


class Thumbnails:
    """Thumbnails of the first camera, one in each of at most 512 equal parts of a drive.

    Any thread may add and read.

    Args:
        total: number of frames of the drive.
    """

    def __init__(self, total: int) -> None:
        self._total = max(total, MOST)
        self._pictures: dict[int, bytes] = {}  # by part of the drive

    def add(self, frame: Frame) -> None:
        """Keep the thumbnail of a frame, unless its part of the drive has one."""
        image = next((camera.image for camera in frame.cameras if camera.image is not None), None)
        if image is not None and self._part(frame.index) not in self._pictures:
            self._pictures[self._part(frame.index)] = jpeg(shrink(image.bgr, WIDTH)[0], QUALITY)

    def near(self, number: int) -> bytes | None:
        """Return the thumbnail of the part of the drive that a frame is in. None: there is none yet."""
        return self._pictures.get(self._part(number))

    def _part(self, number: int) -> int:
        return number * MOST // self._total
