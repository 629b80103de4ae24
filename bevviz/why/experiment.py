"""Experiments: configurations run on frames, and the state of each object. One table serves all views.

A comparison, a sweep, the search of a fix and a hint are a choice of frames and configurations, and a view.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from bevviz.config import Config
from bevviz.evaluate import Matches, Truth, judge
from bevviz.evaluate.ground_truth import TruthLookup
from bevviz.model.frame import Boxes3D, Frame
from bevviz.model.reasons import Reason, facts_of
from bevviz.model.results import FrameResult, Objects
from bevviz.pipeline.session import Variants
from bevviz.why.answer import FrameExplainer
from bevviz.why.false_objects import false_reasons
from bevviz.why.frame_index import FrameIndex
from bevviz.why.selection import Selection

if TYPE_CHECKING:
    import pyarrow as pa

State: TypeAlias = Literal["found", "missed", "false", "reported", "doubtful"]


@dataclass(frozen=True, slots=True)
class ObjectRow:
    """State of one object under one configuration.

    Attributes:
        frame: number of the scan.
        object: text of the selection that asks about it: a row of the ground truth, or of the result.
        label: class, in lower case.
        configuration: name of the configuration.
        state: found, missed or false. Without ground truth: reported or doubtful.
        stage: stage that lost it or made it. Empty: none, or reasons were not asked for.
        reason: kind of the reason. Empty: there is none, or reasons were not asked for.
        x: metres in the frame of the points, as y and z.
        y: metres.
        z: metres.
        distance: metres on the ground from the sensor.
    """

    frame: int
    object: str
    label: str
    configuration: str
    state: State
    stage: str
    reason: str
    x: float
    y: float
    z: float
    distance: float


@dataclass(frozen=True)
class Outcome:
    """Result of one configuration on one frame. It is judged and explained only if that is asked for.

    Attributes:
        configuration: name of the configuration.
        result: result of the frame: of our stages, or of the robot.
        truth: ground truth of the frame. None: it is unknown.
    """

    configuration: str
    result: FrameResult
    truth: Truth | None = None

    @property
    def objects(self) -> Objects:
        """The objects. A stage that failed has none."""
        return self.result.objects or Objects.empty()

    @cached_property
    def matches(self) -> Matches | None:
        """The objects matched with the ground truth. None: it is unknown."""
        return None if self.truth is None else judge(self.objects, self.truth, self.result.cameras)

    @property
    def traces(self) -> FrameIndex:
        """Index of the result."""
        return self._explainer.traces

    def rows(self, *, reasons: bool = False) -> Iterator[ObjectRow]:
        """Yield a row for each object that had to be found, and for each false one.

        Without ground truth, yield a row for each reported object.

        Args:
            reasons: whether the missed, false and doubtful objects get their stage and reason.
        """
        if self.truth is None or self.matches is None:
            doubts = false_reasons(self.traces)
            for row in range(len(self.objects)):
                yield self._object_row(row, "doubtful" if row in doubts else "reported", doubts)
            return
        for row in np.flatnonzero(self.truth.must).tolist():
            is_missed = bool(self.matches.missed[row])
            reason = self._reason(row) if reasons and is_missed else None
            state: State = "missed" if is_missed else "found"
            label, boxes = self.truth.labels[row], self.truth.boxes
            yield self._row(Selection(truth=row), label, state, boxes, row, reason)
        causes = false_reasons(self.traces) if reasons else {}
        for row in np.flatnonzero(self.matches.false).tolist():
            yield self._object_row(row, "false", causes)

    def _object_row(self, row: int, state: State, reasons: Mapping[int, Reason]) -> ObjectRow:
        objects = self.objects
        return self._row(
            Selection(object=row), objects.names[row], state, objects.boxes, row, reasons.get(row)
        )

    def _row(
        self, selection: Selection, label: str, state: State, boxes: Boxes3D, row: int, reason: Reason | None
    ) -> ObjectRow:
        """Return the row of an object.

        Args:
            selection: selection that asks about it.
            label: its class.
            state: its state.
            boxes: boxes that its own is among.
            row: row of its box.
            reason: reason of the state. None: there is none, or it was not asked for.
        """
        x, y, z = boxes.center[row].tolist()
        return ObjectRow(
            frame=self.result.frame.index,
            object=str(selection),
            label=label.lower(),
            configuration=self.configuration,
            state=state,
            stage="" if reason is None else facts_of(reason.kind).stage,
            reason="" if reason is None else reason.kind.value,
            x=x,
            y=y,
            z=z,
            distance=float(boxes.distance[row]),
        )

    def _reason(self, row: int) -> Reason:
        """Return why an object of the ground truth is missed."""
        return self._explainer.about(Selection(truth=row)).verdict.reason

    @cached_property
    def _explainer(self) -> FrameExplainer:
        return FrameExplainer(self.result, truth=self.truth)


class Experiment:
    """Experiment that runs configurations on the same frames. Stages with equal parameters run once a frame.

    Args:
        truth: returns the ground truth of a frame. None: it is not known.
        variants: runs the stages. Experiments that share it share networks.
        kept: number of results of the current frame that are kept, so that each is made once.
    """

    def __init__(
        self, truth: TruthLookup | None = None, variants: Variants | None = None, kept: int = 0
    ) -> None:
        self.variants = variants or Variants()
        self._truth_of, self._size = truth, kept
        self._frame: Frame | None = None
        self._truth: Truth | None = None
        self._kept: OrderedDict[str, FrameResult] = OrderedDict()  # by configuration

    def outcome(
        self, frame: Frame, config: Config, name: str = "", network: Executor | None = None
    ) -> Outcome:
        """Return the outcome of one configuration on a frame.

        Args:
            frame: the frame.
            config: the configuration.
            name: name of the configuration.
            network: executor of the detector, see ``perceive``.

        Raises:
            UserError: the detector's model or a user-defined function cannot be used.
        """
        if frame is not self._frame:
            self._frame, self._truth = frame, None if self._truth_of is None else self._truth_of(frame)
            self._kept.clear()
        key = config.model_dump_json() if self._size else ""
        result = self._kept.pop(key, None) or self.variants.perceive(frame, config, network)
        if self._size:
            self._kept[key] = result
            while len(self._kept) > self._size:
                self._kept.popitem(last=False)
        return Outcome(name, result, self._truth)

    def table(
        self, frames: Iterable[Frame], configurations: Mapping[str, Config], *, reasons: bool = False
    ) -> pa.Table:
        """Return the objects of every frame and configuration as a table of Arrow, see ``ObjectRow``.

        Raises:
            UserError: as ``outcome``.
        """
        return table_of(
            row
            for frame in frames
            for name, config in configurations.items()
            for row in self.outcome(frame, config, name).rows(reasons=reasons)
        )


def table_of(rows: Iterable[ObjectRow]) -> pa.Table:
    """Return rows as a table of Arrow."""
    import pyarrow as pa

    words = pa.dictionary(pa.int32(), pa.string())
    names = ("object", "label", "configuration", "state", "stage", "reason")
    types = {"frame": pa.int32()} | dict.fromkeys(names, words)
    types |= dict.fromkeys(("x", "y", "z", "distance"), pa.float32())
    listed = list(rows)
    return pa.table(
        {name: pa.array([getattr(row, name) for row in listed], of) for name, of in types.items()}
    )
