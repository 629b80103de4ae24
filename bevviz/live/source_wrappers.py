"""Frames of a run: thinned on purpose, and artificial ones to warm up."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from bevviz.config import Config
from bevviz.live.encoder import Encoder, sample_rows
from bevviz.live.problems import CurrentProblems
from bevviz.live.raw_recorder import RawRecorder
from bevviz.model.frame import F64, Camera, Cloud, Frame, Image, Intrinsics, LateBoxes, Scene, UserMark
from bevviz.model.geometry import inverse
from bevviz.model.protocols import Items
from bevviz.model.results import Detections, DetectionState, FrameResult, Masks
from bevviz.pipeline.session import Session
from bevviz.pipeline.stage_loader import StageLoader

SCENE = Scene("warm", "lidar", ("lidar",), ("camera",))
PERIOD = 100_000_000  # nanoseconds
CAMERA_FROM_LIDAR: F64 = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


class RobotFrames(Items[Frame], Protocol):
    """Frames of a robot as they come, and what is known beside them."""

    problems: CurrentProblems  # what is wrong with the input, to which a run adds its own
    raw: RawRecorder | None  # recorder of the messages from which the frames are made

    @property
    def dropped(self) -> int:
        """Frames that the source itself has dropped."""

    @property
    def states(self) -> Mapping[str, str]:
        """State of each topic."""

    def overtaken(self) -> tuple[LateBoxes, ...]:
        """Return the robot's results that came too late for their frames, since the last call."""

    def marks(self, index: int) -> tuple[UserMark, ...]:
        """Return the users' marks up to the frame of this index, since the last call."""

    def mark(self, text: str) -> None:
        """Take in a user's mark."""

    def stop(self) -> None:
        """End the iteration. Any thread may call it."""


def thinned(
    frames: Iterable[Frame], config: Callable[[], Config], clock: Callable[[], float] = time.monotonic
) -> Iterator[Frame]:
    """Yield the frames and points that the configuration asks for.

    Args:
        frames: frames of the robot.
        config: returns the current configuration.
        clock: returns seconds, for tests.
    """
    earliest = 0.0
    for number, frame in enumerate(frames):
        live, now = config().live, clock()
        if number % live.every or now < earliest:
            continue
        if live.max_rate is not None:
            # A frame that comes a little early keeps its turn. A pause permits no burst afterwards.
            earliest = max(earliest + 1 / live.max_rate, now - 0.5 / live.max_rate)
        yield thin(frame, live.points)


def thin(frame: Frame, points: int | None) -> Frame:
    """Return the frame with at most ``points`` points, chosen at random as in ``sample_rows``.

    A fixed step would choose the same ring of the LiDAR again and again.
    """
    count = len(frame.points)
    if points is None or count <= points:
        return frame
    rows = sample_rows(count, points, frame.index)
    ends = np.cumsum([len(cloud.xyz) for cloud in frame.clouds])
    clouds = []
    for cloud, end in zip(frame.clouds, ends.tolist(), strict=True):
        kept = rows[(rows >= end - len(cloud.xyz)) & (rows < end)] - (end - len(cloud.xyz))
        fields = {name: values[kept] for name, values in cloud.fields.items()}
        clouds.append(replace(cloud, xyz=cloud.xyz[kept], fields=fields))
    return replace(
        frame,
        points=frame.points[rows],
        fields={name: values[rows] for name, values in frame.fields.items()},
        clouds=tuple(clouds),
    )


def warm_up(config: Config, loader: StageLoader) -> None:
    """Run the stages, the network and the logging on small artificial frames. The results are discarded.

    User-defined stages are left out, because they may not accept artificial frames.

    Args:
        config: configuration of the run.
        loader: loader that has the network.
    """
    config = _without_user_stages(config)
    network, seen = Session(config, loader=loader), Session(config, lambda camera: _one_car())
    network.run(_frame(0))
    results = [seen.run(_frame(index)) for index in range(2)]
    with closing(Encoder(config, SCENE, "live")) as encoder:
        for result in (*results, FrameResult.unprocessed(_frame(2), config)):
            encoder.encode(result, SCENE, {}, ())


def _without_user_stages(config: Config) -> Config:
    """Return the configuration without user-defined stages and without robot topics."""
    changes: dict[str, Any] = {
        name: getattr(Config(), name)
        for name in ("ground", "clustering", "objects")
        if ":" in getattr(config, name).method
    }
    if ":" in config.detector.model:
        changes["detector"] = config.detector.model_copy(update={"model": ""})
    return config.model_copy(update=changes)


def _frame(index: int) -> Frame:
    """Return a frame with level ground and a box of points before the camera."""
    ground = np.mgrid[-20:20:0.5, -20:20:0.5, -1.8:-1.7:1].reshape(3, -1).T
    car = np.mgrid[8:10:0.1, -1:1:0.1, -1.5:0:0.2].reshape(3, -1).T
    points = np.concatenate([ground, car]).astype(np.float32)
    fields = {"intensity": np.ones(len(points), np.float32)}
    stamp = PERIOD * (1 + index)
    image = Image(stamp, "camera", np.zeros((360, 640, 3), np.uint8))
    intrinsics = Intrinsics(640, 360, np.array([[300.0, 0, 320], [0, 300, 180], [0, 0, 1]]))
    return Frame(
        index,
        stamp,
        stamp,
        "lidar",
        points,
        "lidar",
        fields,
        world_frame="map",
        world_from_points=np.eye(4),
        clouds=(Cloud(stamp, "lidar", points, fields, name="lidar"),),
        points_from_clouds=(np.eye(4),),
        cameras=(Camera("camera", image, intrinsics, CAMERA_FROM_LIDAR, inverse(CAMERA_FROM_LIDAR)),),
    )


def _one_car() -> Detections:
    """Return the detection of one car, with a mask."""
    first = np.zeros(1, np.int32)
    box = np.array([[260, 170, 380, 240]], np.float32)
    score = np.ones(1, np.float32)
    cells = Masks(
        np.packbits(np.ones(120 * 70, np.uint8)),
        np.array([[260, 170, 120, 70]], np.int32),
        np.array([1, 1, 0, 0], np.float32),
    )
    return Detections(box, score, first, ("car",), first + DetectionState.KEPT, first - 1, 0 * score, cells)
