"""Runs of one frame with other parameters, or with ideal stages. Each is run once."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.evaluate import judge
from bevviz.model.frame import Camera
from bevviz.model.results import Detections, DetectionState, FrameResult
from bevviz.pipeline.perceive import perceive
from bevviz.pipeline.stage_loader import DetectFunction, StageLoader
from bevviz.pipeline.stage_log import Memo
from bevviz.why.assumed_truth import assumed_truth
from bevviz.why.changes import Change, with_changes
from bevviz.why.frame_index import FrameIndex
from bevviz.why.ideal import STAGES, IdealStages, StageSet, ideal_config, takes_from_ground
from bevviz.why.subject import Subject

RUNS = 12  # whole results in the cache, for other subjects of the frame
STAGE_RESULTS = 60  # results of single stages in the cache; one of a large cloud takes some megabytes


class _Wanted(NamedTuple):
    """A missed object, in the ground truth of the frame or in an assumed one."""

    traces: FrameIndex  # with this ground truth
    row: int
    missed: tuple[int, ...]  # rows of all missed objects


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
        self._assumed: dict[tuple[object, ...], FrameIndex | None] = {}  # by subject

    def with_change(self, change: Change) -> FrameIndex | None:
        """Run the frame with a change. None: the configuration cannot be run."""
        key = tuple(sorted(change.items()))
        if key not in self._runs:
            result = self._run(change)
            self._runs[key] = None if result is None else self._traces.for_result(result)
            while len(self._runs) > RUNS:
                del self._runs[next(iter(self._runs))]
        return self._runs[key]

    def _run(
        self, change: Change, ideal: StageSet = (), edits: IdealStages | None = None
    ) -> FrameResult | None:
        """Run the frame with a change, and with the ideal results of stages. None: it cannot be run."""
        try:
            config = with_changes(self._result.config, change) if change else self._result.config
            stages = self._loader.load(config, self._known_detections(config, change))
        except (UserError, ValidationError):  # the model file has gone, or the value is out of bounds
            return None
        return perceive(self._result.frame, ideal_config(config, ideal), stages, self._memo, edits=edits)

    def is_found(self, subject: Subject, change: Change, ideal: StageSet) -> bool:
        """Return whether a missed object is found with a change, if other stages have their ideal results."""
        wanted = self.wanted(subject)
        if wanted is None:
            return False
        key = (id(wanted.traces), *sorted(change.items()), *ideal)
        if key not in self._found:
            self._found[key] = self._find(wanted, change, ideal)
        return wanted.row in self._found[key]

    def _find(self, wanted: _Wanted, change: Change, ideal: StageSet) -> frozenset[int]:
        """Return the missed objects that are found with a change and the ideal results of other stages."""
        truth = wanted.traces.labels_in_evaluate
        assert truth is not None
        edits = IdealStages(wanted.traces, wanted.missed, ideal, self._memo)
        after = self._run(change, ideal, edits)
        if after is None or after.objects is None:
            return frozenset()
        return frozenset(wanted.missed) - {*np.flatnonzero(judge(after.objects, truth).missed).tolist()}

    def restored_by(self, subject: Subject, blamed: str = "") -> tuple[StageSet, ...]:
        """Return the smallest sets of stages whose ideal results bring a missed object back.

        It is empty where no set does, and for objects that need not be found. Pairs are tried if no single
        stage brings the object back, and all stages together if no pair does. Without ground truth, the
        object is the one that the image box of the subject seems to show.

        Args:
            subject: the subject in question.
            blamed: stage whose sets are tried first. The first one that does is enough. Empty: return all.
        """
        wanted = self.wanted(subject)
        if wanted is None:
            return ()
        tried = STAGES if takes_from_ground(wanted.traces, wanted.row) else STAGES[1:]
        for size in (1, 2, len(tried)):
            if size == 2 and not self.is_found(subject, {}, tried):
                return ()
            sets = []
            for chosen in sorted(combinations(tried, size), key=lambda stages: blamed not in stages):
                if self.is_found(subject, {}, chosen):
                    sets.append(chosen)
                    if blamed in chosen:
                        return (chosen,)
            if sets:
                return tuple(sets)
        return ()

    def wanted(self, subject: Subject) -> _Wanted | None:
        """Return the missed object of a subject. None: there is none, or nothing tells where it is."""
        traces = self._traces
        if not traces.origin("objects").ours:
            return None
        if traces.labels_in_evaluate is None:
            key = (*subject.key, *(() if subject.asked is None else subject.asked.tolist()))
            if key not in self._assumed:
                truth = assumed_truth(subject, traces)
                self._assumed[key] = None if truth is None else traces.with_truth(truth)
            if (assumed := self._assumed[key]) is None:
                return None
            traces, row = assumed, 0
        elif subject.kind == "truth":
            row = subject.row
        else:
            return None
        if traces.matches is None:
            return None
        missed = tuple(np.flatnonzero(traces.matches.missed).tolist())
        return _Wanted(traces, row, missed) if row in missed else None

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
