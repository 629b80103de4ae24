"""Several configurations on the same frames. Stages that they have in common run once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace

from bevviz.config import Config, changes
from bevviz.errors import UserError
from bevviz.model import geometry
from bevviz.model.frame import Camera, Frame
from bevviz.model.results import FrameResult
from bevviz.pipeline.perceive import perceive
from bevviz.pipeline.session import Session
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.pipeline.stage_log import Memo

MOTION = "sync.motion_compensation"  # the only parameter of frames in which variants may differ


class Variants:
    """Configurations that share frames, networks, and results of stages on the same arrays.

    Args:
        loader: loader with loaded networks.
    """

    def __init__(self, loader: StageLoader | None = None) -> None:
        self._memo, self._loader = Memo(), loader or StageLoader()
        self._frame: Frame | None = None
        self._still: Frame | None = None

    def session(self, config: Config) -> Session:
        """Return a new session with its own tracks and anomalies.

        Raises:
            UserError: the detector's model or a user-defined function cannot be used.
        """
        return Session(config, loader=self._loader, memo=self._memo)

    def check(self, config: Config) -> None:
        """Check that the stages of a configuration can be loaded.

        Raises:
            UserError: the detector's model or a user-defined function cannot be used.
        """
        self._loader.load(config)

    def frame(self, frame: Frame, config: Config) -> Frame:
        """Return the frame as a configuration wants it made. A new frame clears the shared results."""
        if frame is not self._frame:
            self._memo.clear()
            self._frame, self._still = frame, None
        if config.sync.motion_compensation:
            return frame
        self._still = self._still or without_motion_compensation(frame)
        return self._still

    def perceive(self, frame: Frame, config: Config, network: Executor | None = None) -> FrameResult:
        """Run the stages that need no other frame on one frame.

        A reused result keeps the time that it once took.

        Raises:
            UserError: the detector's model or a user-defined function cannot be used.
        """
        stages = self._loader.load(config)
        return perceive(self.frame(frame, config), config, stages, self._memo, network=network)


class SessionGroup:
    """Several sessions on the same frames as one processor. A result is a tuple of theirs."""

    def __init__(self, configs: Sequence[Config]) -> None:
        self._variants = Variants()
        self.sessions = [self._variants.session(config) for config in configs]

    def perceive(self, frame: Frame, network: Executor | None = None) -> tuple[FrameResult, ...]:
        """Run ``perceive`` of each session on the frame."""
        return tuple(
            session.perceive(self._variants.frame(frame, session.config), network)
            for session in self.sessions
        )

    def finish(self, results: tuple[FrameResult, ...]) -> tuple[FrameResult, ...]:
        """Run ``finish`` of each session on its result."""
        return tuple(session.finish(result) for session, result in zip(self.sessions, results, strict=True))


def check_same_frames(configs: Mapping[str, Config]) -> None:
    """Check that variants can share decoded frames.

    Raises:
        UserError: they differ in a parameter of the frames.
    """
    first, *others = configs.items()
    for name, config in others:
        for key, change in changes(first[1], config).items():
            if key.startswith(("source.", "sync.")) and key != MOTION:
                raise UserError(
                    f"{first[0]} and {name} differ in {key} ({change}), but are to run on the same frames; "
                    f"give both the same with --set {key}=..."
                )


def common_frames(configs: Iterable[Config]) -> Config:
    """Return the configuration that makes the frames of all: with motion compensation if any needs it."""
    configs = list(configs)
    return next((config for config in configs if config.sync.motion_compensation), configs[0])


def without_motion_compensation(frame: Frame) -> Frame:
    """Return the frame as with ``sync.motion_compensation`` off: the cameras have their mounting pose."""

    def still(camera: Camera) -> Camera:
        """Return a camera at its mounting pose."""
        if camera.mounting is None:
            return camera
        return replace(
            camera,
            camera_from_points=camera.mounting,
            world_from_camera=frame.pose @ geometry.inverse(camera.mounting),
            motion_compensated=False,
        )

    return replace(frame, cameras=tuple(map(still, frame.cameras)))
