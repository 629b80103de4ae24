"""Several configurations on the same frames: what they have in common runs once."""

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

MOTION = "sync.motion_compensation"  # the one thing in how frames are made that variants may differ in


class Variants:
    """Configurations that share frames, networks, and what stages make of the same arrays.

    Args:
        loader: that has networks already.
    """

    def __init__(self, loader: StageLoader | None = None) -> None:
        self._memo, self._loader = Memo(), loader or StageLoader()
        self._frame: Frame | None = None
        self._still: Frame | None = None

    def session(self, config: Config) -> Session:
        """A drive of its own, with its own tracks and anomalies.

        Raises:
            UserError: the detector's model or somebody's function cannot be used.
        """
        return Session(config, loader=self._loader, memo=self._memo)

    def check(self, config: Config) -> None:
        """Raises UserError where the configuration's model or somebody's function cannot be used."""
        self._loader.load(config)

    def frame(self, frame: Frame, config: Config) -> Frame:
        """The frame as the configuration wants it made; a new frame ends what is shared of the last."""
        if frame is not self._frame:
            self._memo.clear()
            self._frame, self._still = frame, None
        if config.sync.motion_compensation:
            return frame
        self._still = self._still or without_motion(frame)
        return self._still

    def perceive(self, frame: Frame, config: Config, network: Executor | None = None) -> FrameResult:
        """What the stages make of one frame, without what needs other frames. A stage that need not be run
        again tells the time that it took.

        Raises:
            UserError: the detector's model or somebody's function cannot be used.
        """
        stages = self._loader.load(config)
        return perceive(self.frame(frame, config), config, stages, self._memo, network=network)


class Sessions:
    """Several sessions on the same frames, as one: a result is a tuple of theirs."""

    def __init__(self, configs: Sequence[Config]) -> None:
        self._variants = Variants()
        self.sessions = [self._variants.session(config) for config in configs]

    def perceive(self, frame: Frame, network: Executor | None = None) -> tuple[FrameResult, ...]:
        return tuple(
            session.perceive(self._variants.frame(frame, session.config), network)
            for session in self.sessions
        )

    def finish(self, results: tuple[FrameResult, ...]) -> tuple[FrameResult, ...]:
        return tuple(session.finish(result) for session, result in zip(self.sessions, results, strict=True))


def check_same_frames(configs: Mapping[str, Config]) -> None:
    """Variants run on frames that are decoded once.

    Raises:
        UserError: they differ in what frames are made of.
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
    """How frames are to be made for all of them: with motion compensated, if any wants that."""
    configs = list(configs)
    return next((config for config in configs if config.sync.motion_compensation), configs[0])


def without_motion(frame: Frame) -> Frame:
    """The frame as it is with ``sync.motion_compensation`` off: its cameras where they are mounted."""

    def still(camera: Camera) -> Camera:
        if camera.mounting is None:
            return camera
        return replace(
            camera,
            camera_from_points=camera.mounting,
            world_from_camera=frame.pose @ geometry.inverse(camera.mounting),
            motion_compensated=False,
        )

    return replace(frame, cameras=tuple(map(still, frame.cameras)))
