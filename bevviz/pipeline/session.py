"""What a drive remembers from one frame to the next, and the configuration that is in force."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace

from bevviz.anomalies import AnomalyDetector
from bevviz.config import Config, ParameterChange, changes
from bevviz.model.frame import Frame
from bevviz.model.results import FrameResult
from bevviz.pipeline.perceive import describe, perceive
from bevviz.pipeline.stage_loader import Detect, StageLoader, Stages
from bevviz.pipeline.stage_log import Memo, StageLog
from bevviz.stages.fusion import in_view
from bevviz.stages.tracking import Tracker


class Session:
    """Makes results of the frames of one drive, in order.

    ``perceive`` and ``finish`` may run in two threads, each in the order of the frames; ``configure`` may be
    called from any. A frame is made with one configuration from beginning to end, which its result names.

    Args:
        config: the configuration.
        detect: what finds the objects in a camera's image instead of the detector's model.
        loader: shared by sessions that are to share networks.
        memo: shared by sessions that run on the same frames; whoever makes the frames clears it.

    Raises:
        UserError: the detector's model or somebody's function cannot be used.
    """

    def __init__(
        self,
        config: Config,
        detect: Detect | None = None,
        *,
        loader: StageLoader | None = None,
        memo: Memo | None = None,
    ) -> None:
        self.loader = loader or StageLoader()
        self._detect, self._memo = detect, memo
        self._in_force = config, self.loader.load(config, detect)  # read and replaced as one
        self._tracker = Tracker()
        self._anomalies = AnomalyDetector()

    @property
    def config(self) -> Config:
        return self._in_force[0]

    @property
    def stages(self) -> Stages:
        return self._in_force[1]

    def configure(self, config: Config) -> dict[str, ParameterChange]:
        """From the next frame on. Returns what changes.

        Raises:
            UserError: the detector's model or somebody's function cannot be used; nothing is changed.
        """
        stages = self.loader.load(config, self._detect)
        before = self.config
        self._in_force = config, stages
        return changes(before, config)

    def run(self, frame: Frame) -> FrameResult:
        """Everything that can be made of the next frame. Never raises for what the frame holds."""
        return self.finish(self.perceive(frame))

    def alone(self, frame: Frame) -> FrameResult:
        """What can be made of any one frame, without what needs those before it: tracks and anomalies."""
        config, stages = self._in_force
        return describe(perceive(frame, config, stages, self._memo))

    def explained(self, frame: Frame) -> FrameResult:
        """What is asked about the next frame needs: everything but its bird's-eye view and its anomalies."""
        return describe(self.perceive(frame), seen=False)

    def perceive(self, frame: Frame, network: Executor | None = None) -> FrameResult:
        """What the stages make of the next frame, with its tracks."""
        config, stages = self._in_force
        return self.track(perceive(frame, config, stages, self._memo, network=network))

    def finish(self, result: FrameResult) -> FrameResult:
        """The result of ``perceive`` with its bird's-eye view, explanations and anomalies."""
        return self.watch(describe(result))

    def watch(self, result: FrameResult) -> FrameResult:
        """The result with the anomalies of the drive so far."""
        return replace(result, anomalies=self._anomalies.update(result, result.config.anomalies))

    def track(self, result: FrameResult) -> FrameResult:
        """The result with the tracks of the drive so far."""
        clusters, config = result.clusters, result.config.tracking
        if clusters is None or config.method == "none":
            return result
        log = StageLog()
        seen = in_view(result.cameras, len(clusters))
        tracks = log.run(
            "tracking", self._tracker.update, result.frame, clusters, seen, result.objects, config
        )
        total = result.timings["total"] + log.timings["tracking"]
        return replace(
            result,
            tracks=tracks,
            timings={**result.timings, **log.timings, "total": total},
            failures=(*result.failures, *log.failures),
        )
