"""Runs of one frame with other parameters, or with ideal stages. Each is run once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from pydantic import ValidationError

from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.evaluate import judge
from bevviz.model.frame import Camera
from bevviz.model.results import Detections, DetectionState
from bevviz.pipeline.perceive import perceive
from bevviz.pipeline.stage_loader import DetectFunction, StageLoader
from bevviz.pipeline.stage_log import Memo
from bevviz.why.changes import Change, with_changes
from bevviz.why.frame_index import FrameIndex
from bevviz.why.ideal import IdealStages, StageSet, ideal_config, restoring_stages

RUNS = 12  # whole results in the cache, for other subjects of the frame
STAGE_RESULTS = 60  # results of single stages in the cache; one of a large cloud takes some megabytes


class FrameRuns:
    """Further runs of one frame.

    Args:
        traces: index of the frame's result.
        loader: stage loader with the networks already loaded.
    """

    def __init__(self, traces: FrameIndex, loader: StageLoader) -> None:
        self._traces, self._result = traces, traces.result
        self._loader, self._memo = loader, Memo(STAGE_RESULTS)
        self._runs: dict[tuple[tuple[str, Any], ...], FrameIndex | None] = {}
        self._found: dict[tuple[object, ...], frozenset[int]] = {}

    def with_change(self, change: Change) -> FrameIndex | None:
        """Run the frame with a change. None: the configuration cannot be run."""
        key = tuple(sorted(change.items()))
        if key not in self._runs:
            try:
                config = with_changes(self._result.config, change)
                stages = self._loader.load(config, self._known_detections(config, change))
            except (UserError, ValidationError):  # the model file has gone, or the value is out of bounds
                self._runs[key] = None
            else:
                result = perceive(self._result.frame, config, stages, self._memo)
                self._runs[key] = self._traces.for_result(result)
            while len(self._runs) > RUNS:
                del self._runs[next(iter(self._runs))]
        return self._runs[key]

    def is_found(self, row: int, change: Change, ideal: StageSet) -> bool:
        """Return whether a missed object is found with a change, if other stages have their ideal results."""
        key = (*sorted(change.items()), *ideal)
        if key not in self._found:
            self._found[key] = self._find(change, ideal)
        return row in self._found[key]

    def _find(self, change: Change, ideal: StageSet) -> frozenset[int]:
        """Return the missed objects that are found with a change and the ideal results of other stages."""
        truth = self._traces.labels_in_evaluate
        assert truth is not None
        try:
            config = with_changes(self._result.config, change)
            stages = self._loader.load(config, self._known_detections(config, change))
        except (UserError, ValidationError):
            return frozenset()
        edits = IdealStages(self._traces, self._missed, ideal, self._memo)
        after = perceive(self._result.frame, ideal_config(config, ideal), stages, self._memo, edits=edits)
        if after.objects is None:
            return frozenset()
        return frozenset(self._missed) - {*np.flatnonzero(judge(after.objects, truth).missed).tolist()}

    @cached_property
    def _missed(self) -> tuple[int, ...]:
        """Rows of the missed objects of the ground truth."""
        matches = self._traces.matches
        return () if matches is None else tuple(np.flatnonzero(matches.missed).tolist())

    def restored_by(self, row: int) -> tuple[StageSet, ...]:
        """Return the smallest sets of stages whose ideal results bring a missed ground truth object back.

        It is empty where no set does, and for objects that need not be found.
        """
        return self._restored.get(row, ())

    @cached_property
    def _restored(self) -> Mapping[int, tuple[StageSet, ...]]:
        matches = self._traces.matches
        if matches is None or not self._traces.origin("objects").ours:
            return {}
        config = self._result.config
        stages = self._loader.load(config, self._detections)
        return restoring_stages(self._traces, self._missed, stages, self._memo)

    def _detections(self, camera: Camera) -> Detections | None:
        """Return the detections of a camera in the frame's result."""
        return next(c.detections for c in self._result.cameras if c.camera.name == camera.name)

    def _known_detections(self, config: Config, change: Change) -> DetectFunction | None:
        """Return a detector that applies another threshold to the known detections. None: run the network.

        The candidates kept for explanations do not tell the result of another NMS, nor that of other
        parameters of a user's detector. Detections of the robot never change.
        """
        touched = {key for key in change if key.startswith("detector.")} - {"detector.conf_threshold"}
        if touched or self._traces.origin("detector").topic:
            return None

        def detect(camera: Camera) -> Detections | None:
            """Return the detections of a camera with the states of the new threshold."""
            detections = self._detections(camera)
            if detections is None:
                return None
            kept = detections.score >= config.detector.conf_threshold
            state = np.where(kept, DetectionState.KEPT, DetectionState.BELOW_THRESHOLD).astype(np.int32)
            state[detections.state == DetectionState.SUPPRESSED] = DetectionState.SUPPRESSED
            return replace(detections, state=state)

        return detect
