"""Amount of data that a recording keeps: everything, enough for an inspection, or enough for a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from bevviz.config import Config, LoggingConfig
from bevviz.model.frame import F32, I64, Frame
from bevviz.recording import entities
from bevviz.recording.components import Components
from bevviz.recording.writer import Writer

CLUSTER_STEPS = 4  # rounding steps per voxel for points of clusters, if not everything is kept
OTHER_STEPS = 2  # the same for the ground and for points without a cluster
PIXEL_STEPS = 2  # rounding steps per pixel for obstacle points in an image
BEV_QUALITY = 60  # JPEG quality of the bird's-eye view, which shows points only
LOSSY = ("image/jpeg", "image/webp")


def keeps_everything(config: Config) -> bool:
    """Return whether the recording keeps everything."""
    return config.logging.keep == "everything"


def omitted_data(config: LoggingConfig) -> tuple[str, ...]:
    """Return one sentence for each kind of data that a recording omits."""
    if config.keep == "everything":
        return ()
    clouds = (
        f"raw clouds: there is that of each {config.raw_every}th frame, and those within "
        f"{config.raw_around:g} s of where an anomaly begins, a person's mark, or where the state of the "
        "pipeline, of a camera or the configuration changes; where anomalies and states come thick, of "
        f"{100 * config.raw_share:g} % of all frames"
        if config.keep == "inspect"
        else "raw clouds, the voxels of the ground and of what is in no cluster, the obstacle points over "
        "the images and the grid on the ground"
    )
    return (
        clouds,
        "voxels are rounded, to half a voxel at most in clusters and to a whole one elsewhere, and are there "
        "once: those of clusters with the clusters, not among the obstacles",
        "images that came raw or without loss: they are H.264, and the bird's-eye view is JPEG of quality "
        f"{BEV_QUALITY}",
        "what is missing is in the bag: 'bevviz open' and 'bevviz why' with this recording read it there",
    )


# --- order -------------------------------------------------------------------------------------


def rounding_scale(voxel_size: float, parts: int) -> float:
    """Return rounding steps per metre, as a power of two. 0: no rounding.

    A voxel has at most ``parts`` steps, and more than half as many.
    """
    return 0.0 if voxel_size == 0 else float(2.0 ** np.floor(np.log2(parts / voxel_size)))


def sorted_rows(points: F32, scale: float, first: I64 | None = None) -> I64:
    """Sort (N, 2) or (N, 3) points by their last coordinate, then by the one before it. Return their rows.

    LZ4, the compression of recordings, has no entropy coding. It profits from repeated values only.

    Args:
        points: points to sort.
        scale: steps per unit to which they are rounded.
        first: (N,) integers that are compared before the coordinates.
    """
    cells = np.clip(np.rint(points * np.float32(scale or 32.0)), -(1 << 14), (1 << 14) - 1).astype(np.int64)
    key = np.zeros(len(points), np.int64) if first is None else first.astype(np.int64)
    for axis in reversed(range(points.shape[1])):
        key = (key << 15) + cells[:, axis] + (1 << 14)
    return np.argsort(key)


# --- raw clouds --------------------------------------------------------------------------------


RawCloud: TypeAlias = tuple[str, F32, NDArray[np.uint16]]  # entity, points, class id of each point


@dataclass(frozen=True, slots=True)
class RawCloudFrame:
    """Raw clouds of a frame that may still be selected."""

    clock: tuple[int, int, int]  # index, stamp and received
    clouds: Sequence[RawCloud]


class RawCloudSelector:
    """Selector of frames whose raw clouds are kept. It buffers the frames of the last ``raw_around`` seconds.

    Anomalies and state changes keep the clouds around them only while the clouds kept for this reason are
    fewer than ``raw_share`` of all frames. The first event always keeps its clouds.

    Attributes:
        left_out: number of anomalies and state changes without raw clouds.
    """

    LONGEST = 100  # frames; limit of the buffer at any frame rate

    def __init__(self) -> None:
        self.left_out = 0
        self._buffer: list[RawCloudFrame] = []
        self._until = -1
        self._count = self._kept_for_events = 0

    @property
    def buffered(self) -> int:
        """Number of buffered frames."""
        return len(self._buffer)

    def select(
        self, frame: RawCloudFrame, config: LoggingConfig, *, is_event: bool, is_requested: bool = False
    ) -> Sequence[RawCloudFrame]:
        """Return the frames whose clouds are logged now, oldest first.

        Args:
            frame: next frame.
            config: limits.
            is_event: whether an anomaly begins or a state changes in this frame.
            is_requested: whether a user caused an event in this frame: a mark or a new configuration.
        """
        stamp, reach = frame.clock[1], round(config.raw_around * 1e9)
        if self._buffer and stamp < self._buffer[-1].clock[1]:
            self._buffer, self._until = [], -1
        self._buffer = [
            buffered for buffered in self._buffer[-self.LONGEST :] if stamp - buffered.clock[1] <= reach
        ]
        is_nth = self._count % config.raw_every == 0
        self._count += 1
        if is_event and not is_requested:
            is_event = not self._kept_for_events or self._kept_for_events < config.raw_share * self._count
            self.left_out += not is_event
        if is_event or is_requested:
            self._until = stamp + reach
            selected, self._buffer = [*self._buffer, frame], []
            self._kept_for_events += len(selected) - is_nth
            return selected
        if is_nth or stamp <= self._until:
            self._kept_for_events += not is_nth
            return [frame]
        self._buffer.append(frame)
        return []


class RawCloudLog:
    """Logger of raw clouds for recordings that keep those of selected frames only."""

    def __init__(self) -> None:
        self._selector = RawCloudSelector()
        self._shown: set[str] = set()  # entities with the raw clouds of the previous frame
        self._known: set[str] = set()
        self._states: Mapping[str, str] = {}

    @property
    def left_out(self) -> int:
        """Number of events without raw clouds around them, because the limit of raw clouds was reached."""
        return self._selector.left_out

    def refresh(self) -> None:
        """Clear all raw clouds that the next frame lacks."""
        self._shown = set(self._known)

    def log(
        self,
        to: Writer,
        frame: Frame,
        clouds: Sequence[RawCloud],
        config: LoggingConfig,
        states: Mapping[str, str],
        *,
        is_event: bool,
        is_requested: bool,
    ) -> None:
        """Log the raw clouds of a frame and of buffered earlier frames, if they are wanted.

        Args:
            to: writer of the recording.
            frame: the frame.
            clouds: its raw clouds.
            config: limits.
            states: states of the pipeline and the cameras, by lane. A change selects the clouds.
            is_event: whether an anomaly begins in this frame.
            is_requested: see ``RawCloudSelector.select``.
        """
        is_event |= any(self._states.get(lane, state) != state for lane, state in states.items())
        self._states = states
        clock, left_out = (frame.index, frame.stamp, frame.received), self.left_out
        selected = self._selector.select(
            RawCloudFrame(clock, clouds), config, is_event=is_event, is_requested=is_requested
        )
        if self.left_out > left_out:
            text = f"logging.raw_share is reached; {self.left_out} times so far"
            to.lines(entities.EXPLAIN_LOG, [("INFO", f"no raw clouds around what begins here: {text}")])
        for frame_clouds in selected:
            to.set_time(*frame_clouds.clock)
            for path, points, class_ids in frame_clouds.clouds:
                fields = {"positions": points, "class_ids": class_ids}
                to.write(path, Components(rr.Points3D, fields))
        to.set_time(*clock)
        shown = {path for path, _, _ in clouds} if selected else set()
        for path in sorted(self._shown - shown):
            to.write(path, rr.Clear(recursive=False))
        self._shown = shown
        self._known |= shown
