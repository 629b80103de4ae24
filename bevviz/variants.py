"""Several configurations on the same frames: what they have in common runs once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from bevviz import geometry
from bevviz.config import Config, DetectorConfig
from bevviz.errors import UserError
from bevviz.frame import Camera, Detections, Frame, FrameResult
from bevviz.live.settings import differences
from bevviz.pipeline import Memo, Pipeline
from bevviz.stages.detector import Detector

MOTION = "sync.motion_compensation"  # the one thing in how frames are made that variants may differ in


class Variants:
    """Runs any configuration on a frame, and no stage twice that gets the same input and parameters."""

    def __init__(self) -> None:
        self._memo = Memo()
        self._frame: Frame | None = None
        self._networks: dict[tuple[str, str, str, int], Detector] = {}
        self._detectors: dict[DetectorConfig, _Thresholds] = {}
        self._still: Frame | None = None

    def prepare(self, config: Config) -> None:
        """Load the network that the configuration wants.

        Raises:
            UserError: the detector's model cannot be used.
        """
        self._detector(config.detector)

    def run(self, frame: Frame, config: Config, *, draw: bool = True) -> FrameResult:
        """Everything that the configuration makes of the frame. A spared stage tells the time it took.

        ``draw``: with the bird's-eye view and the explanations.

        Raises:
            UserError: the detector's model cannot be used.
        """
        if frame is not self._frame:
            self._memo.clear()
            self._frame, self._still = frame, None
        if not config.sync.motion_compensation:
            frame = self._still = self._still or without_motion(frame)
        detect = self._detector(config.detector)
        with Pipeline(config, detect=detect, memo=self._memo, draw=draw) as pipeline:
            return pipeline.run(frame)

    def _detector(self, config: DetectorConfig) -> _Thresholds | None:
        if not config.model:
            return None
        if config not in self._detectors:
            network = (config.model, config.names, config.provider, config.threads)
            if network not in self._networks:
                self._networks[network] = Detector(config)
            self._detectors[config] = _Thresholds(self._networks[network], config, self._memo)
        return self._detectors[config]


class _Thresholds:
    """A detector whose network runs once on an image, whatever is made of its output."""

    def __init__(self, network: Detector, config: DetectorConfig, memo: Memo) -> None:
        self._network, self._memo = network, memo
        self._detector = network.restated(config)

    def __call__(self, camera: Camera) -> Detections | None:
        if camera.image is None:
            return None
        if not camera.image.bgr.size:
            return Detections.empty()
        return self._detector.interpret(self._memo.call(self._network.infer, camera.image.bgr))


def check_same_frames(configs: dict[str, Config]) -> None:
    """Variants run on frames that are decoded once.

    Raises:
        UserError: they differ in what frames are made of.
    """
    first, *others = configs.items()
    for name, config in others:
        for key, change in differences(first[1], config).items():
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
