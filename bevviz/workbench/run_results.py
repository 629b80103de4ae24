"""Results of the run over a drive: what later questions and trials need of each frame, on disk."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace

import numpy as np

from bevviz.model.results import CameraResult, FrameResult, Objects, Tracks
from bevviz.support.contexts import Closable
from bevviz.workbench.buffers import RecordingBuffer


@dataclass(frozen=True, slots=True)
class RunResult:
    """Results of the run for one frame, without its points and images.

    Attributes:
        objects: its objects.
        tracks: its tracks, without their trails.
        cameras: its cameras with their detections, by which objects are judged. Empty without ground truth.
    """

    objects: Objects | None
    tracks: Tracks | None
    cameras: tuple[CameraResult, ...]

    @classmethod
    def of(cls, result: FrameResult) -> RunResult:
        """Return what is kept of a result."""
        cameras = () if result.frame.truth is None else result.cameras
        return cls(result.objects, without_trails(result.tracks), tuple(map(_without_image, cameras)))


def without_trails(tracks: Tracks | None) -> Tracks | None:
    """Return tracks without their trails. These are much larger than the tracks, and are made of them."""
    return tracks and replace(tracks, trail=np.zeros((len(tracks), 0, 3), np.float32))


def _without_image(result: CameraResult) -> CameraResult:
    """Return the detections of a camera, without its image, masks and fusion."""
    detections = result.detections and replace(result.detections, masks=None)
    return CameraResult(replace(result.camera, image=None), detections, fusion=None)


class RunResults(Closable):
    """Results of the run by frame number, in a temporary file: in memory they would grow with the drive.

    One thread may add, any thread may read.
    """

    def __init__(self) -> None:
        self._pieces = RecordingBuffer()
        self._rows: dict[int, int] = {}  # by frame number

    def close(self) -> None:
        """Delete the file."""
        self._rows.clear()
        self._pieces.close()

    def __contains__(self, number: int) -> bool:
        return number in self._rows

    def add(self, result: FrameResult) -> None:
        """Keep the result of a frame.

        Raises:
            UserError: the disk of the temporary folder is full.
        """
        self._pieces.add(pickle.dumps(RunResult.of(result), pickle.HIGHEST_PROTOCOL))
        self._rows[result.frame.index] = len(self._pieces) - 1

    def get(self, number: int) -> RunResult | None:
        """Return the results for a frame. None: the run has not reached it."""
        row = self._rows.get(number)
        return None if row is None else pickle.loads(self._pieces[row])
