"""State of a drive from one frame to the next, and the configuration in force."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace

from bevviz.anomalies import AnomalyDetector
from bevviz.config import Config, ParameterChange, changes
from bevviz.model.frame import Frame
from bevviz.model.results import FrameResult
from bevviz.pipeline.perceive import add_explanations, perceive
from bevviz.pipeline.stage_loader import DetectFunction, StageLoader, Stages
from bevviz.pipeline.stage_log import Memo, StageLog
from bevviz.stages.fusion import clusters_in_view
from bevviz.stages.tracking import Tracker


class Session:
    """Processor of the frames of one drive, in order.

    ``perceive`` and ``finish`` may run in two threads, each in the order of the frames. ``configure`` may be
    called from any thread. One configuration makes all of a result, which refers to it.

    Args:
        config: the configuration.
        detect: function that replaces the detector's model.
        loader: loader shared by sessions that share networks.
        memo: results shared by sessions that run on the same frames. The maker of the frames clears it.

    Raises:
        UserError: the detector's model or a user-defined function cannot be used.
    """

    def __init__(
        self,
        config: Config,
        detect: DetectFunction | None = None,
        *,
        loader: StageLoader | None = None,
        memo: Memo | None = None,
    ) -> None:
        self.loader = loader or StageLoader()
        self._detect, self._memo = detect, memo
        self._in_force = config, self.loader.load(config, detect)  # Both are read and replaced together.
        self._tracker = Tracker()
        self._anomalies = AnomalyDetector()

    @property
    def config(self) -> Config:
        """Configuration in force."""
        return self._in_force[0]

    @property
    def stages(self) -> Stages:
        """Stages of the configuration in force."""
        return self._in_force[1]

    def configure(self, config: Config) -> dict[str, ParameterChange]:
        """Use another configuration from the next frame on. Return the changed parameters.

        Raises:
            UserError: the detector's model or a user-defined function cannot be used. Nothing is changed.
        """
        stages = self.loader.load(config, self._detect)
        previous = self.config
        self._in_force = config, stages
        return changes(previous, config)

    def run(self, frame: Frame) -> FrameResult:
        """Return the complete result of the next frame. The content of a frame never raises an error."""
        return self.finish(self.perceive(frame))

    def run_single(self, frame: Frame) -> FrameResult:
        """Return the result of any single frame, without tracks and anomalies, which need earlier frames."""
        config, stages = self._in_force
        return add_explanations(perceive(frame, config, stages, self._memo))

    def run_explained(self, frame: Frame) -> FrameResult:
        """Return the result of the next frame with explanations, without bird's-eye view and anomalies."""
        return add_explanations(self.perceive(frame), seen=False)

    def perceive(self, frame: Frame, network: Executor | None = None) -> FrameResult:
        """Run the stages on the next frame, and update the tracks."""
        config, stages = self._in_force
        return self.add_tracks(perceive(frame, config, stages, self._memo, network=network))

    def finish(self, result: FrameResult) -> FrameResult:
        """Add bird's-eye view, explanations and anomalies to a result of ``perceive``."""
        return self.add_anomalies(add_explanations(result))

    def add_anomalies(self, result: FrameResult) -> FrameResult:
        """Add the anomalies of the drive to the next result."""
        return replace(result, anomalies=self._anomalies.update(result, result.config.anomalies))

    def add_tracks(self, result: FrameResult) -> FrameResult:
        """Add the tracks of the drive to the next result."""
        clusters, config = result.clusters, result.config.tracking
        if clusters is None or config.method == "none":
            return result
        log = StageLog()
        is_in_view = clusters_in_view(result.cameras, len(clusters))
        tracks = log.run(
            "tracking", self._tracker.update, result.frame, clusters, is_in_view, result.objects, config
        )
        total = result.timings["total"] + log.timings["tracking"]
        return replace(
            result,
            tracks=tracks,
            timings={**result.timings, **log.timings, "total": total},
            failures=(*result.failures, *log.failures),
        )
