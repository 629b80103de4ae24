"""Answers about one subject: the verdict, the steps through the stages, and changes that help."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from bevviz.evaluate.differences import BeforeAfter
from bevviz.model.frame import U8
from bevviz.model.reasons import ReasonKind
from bevviz.why.changes import stages_of
from bevviz.why.evidence import Evidence
from bevviz.why.ideal import StageSet
from bevviz.why.selection import Selection
from bevviz.why.steps import Step
from bevviz.why.subject import Subject
from bevviz.why.verdict import FALSE, HOPELESS, Verdict, stage_of

KERB = 0.3  # metres above the ground's level up to which ground at a place is nothing else
NAMED = 3  # tried changes of the same result that a sentence names


@dataclass(frozen=True, slots=True)
class Hint:
    """Settings that change the verdict, and their effects, found by running the stages again.

    Attributes:
        settings: settings as ``--set`` takes them.
        text: the result for the subject.
        effects: objects of the frame that change.
        balance: number of objects that it fixes, the subject included, minus those that it breaks.
        beside: the same for the frames before and after, None: they are not known.
    """

    settings: tuple[str, ...]
    text: str
    effects: BeforeAfter
    balance: int = 1
    beside: int | None = None

    @property
    def is_good(self) -> bool:
        """Return whether it fixes more than it breaks here, and no less in the frames before and after."""
        return self.balance > 0 and (self.beside or 0) >= 0

    @property
    def objection(self) -> str:
        """The result, and what speaks against it."""
        if self.balance > 0:
            return f"{self.text}, but it breaks more than it fixes in the frames before and after"
        return f"{self.text}, but it breaks as much as it fixes: {self.effects.text}"


@dataclass(frozen=True, slots=True)
class TriedChange:
    """Change of parameters that was run and does not help."""

    settings: tuple[str, ...]
    """key=value each"""
    text: str
    """its result"""


@dataclass(frozen=True, slots=True)
class Answer:
    """Everything about one subject.

    Attributes:
        subject: the object or place in question.
        verdict: the reason and its sentence.
        steps: the result of each stage.
        hints: changes of the configuration that change the verdict. Each was run.
        fate: (N,) ``Fate`` of each raw point.
        distance: metres on the ground from the sensor to its centre, see ``Evidence``.
        points: number of raw points on the subject.
        evidence: the points, clusters and detections of the subject.
        tried: changes that were run and did not help.
        remark: one sentence about the search for hints: the best one, or what was tried, or why nothing could
            be. Empty: none was searched, or there is nothing to mend.
        likely: two reasons that each lost much of it where nothing tells which one mattered; else empty.
        near: whether the pipeline had to report it, see ``FrameIndex.must``.
        label: row of the label of the user that the answer is about. -1: none.
    """

    subject: Subject
    verdict: Verdict
    steps: tuple[Step, ...]
    hints: tuple[Hint, ...]
    fate: U8
    distance: float
    points: int
    evidence: Evidence = field(repr=False)
    tried: tuple[TriedChange, ...] = ()
    remark: str = ""
    likely: tuple[ReasonKind, ...] = ()
    near: bool = False
    label: int = -1

    @property
    def restored_by(self) -> tuple[StageSet, ...]:
        """Smallest sets of stages that bring it back: by their ideal results, else by the best change."""
        if self.verdict.restored_by or not self.hints or self.verdict.reported:
            return self.verdict.restored_by
        return (stages_of(self.hints[0].settings),)

    @property
    def lost_in(self) -> tuple[str, ...]:
        """Stages that may have lost it: that of the reason, then those whose ideal result brings it back."""
        if self.verdict.reported:
            return ()
        alone = (stages[0] for stages in self.restored_by if len(stages) == 1)
        return tuple(dict.fromkeys([stage_of(self.verdict.kind, self.evidence), *alone]))

    @property
    def text(self) -> str:
        """The sentence."""
        return self.verdict.text

    @property
    def center(self) -> tuple[float, float, float] | None:
        """Centre of its 3D box, or of the box of its cluster, in Frame.points_frame. None: it has neither."""
        return self.evidence.center

    @property
    def weak(self) -> bool:
        """Whether the subject is a weak detection without an object of the ground truth."""
        best = self.evidence.best
        return self.subject.kind == "detection" and best is not None and not best.kept

    @property
    def false(self) -> bool:
        """Whether the subject is an object that no ground truth explains, or that looks doubtful."""
        return self.subject.kind == "object" and self.verdict.kind in FALSE

    @property
    def empty(self) -> bool:
        """Whether a place has nothing that concerns detections: no points, or ground as low as a kerb."""
        kind, (_, highest) = self.verdict.kind, self.evidence.ground_span
        low = kind is ReasonKind.GROUND and not highest > KERB
        return self.subject.is_place and (low or kind is ReasonKind.NO_POINTS)

    @property
    def folded(self) -> bool:
        """Whether no setting could help: it is hidden, out of view, without points, or a weak detection."""
        return (self.verdict.kind in HOPELESS and not self.near) or self.weak

    def tried_text(self, named: int = NAMED) -> str:
        """Return a clause with the results of the tried changes; empty: one helps, or none was tried.

        Args:
            named: number of changes that are named for each result.
        """
        if self.hints or not self.tried:
            return ""
        by_result: dict[str, list[str]] = {}
        for change in self.tried:
            by_result.setdefault(change.text, []).append(" and ".join(change.settings))
        results = ", ".join(f"with {_some(settings, named)} {text}" for text, settings in by_result.items())
        head = "no tried change helps" if self.tried[1:] else "the one tried change does not help"
        return f"{head}: {results}"

    @property
    def selection(self) -> Selection | None:
        """The selection of the subject; None: it is a place or a track."""
        subject = self.subject
        if subject.kind not in ("truth", "object", "cluster", "detection"):
            return None
        return Selection.of(subject.kind, subject.row, subject.camera)

    @property
    def surroundings(self) -> Selection | None:
        """Everything around the subject, since a click may mean another one there; None: unknown place."""
        subject = self.subject
        if subject.kind == "detection" and subject.xyxy is not None:
            u0, v0, u1, v1 = (float(v) for v in subject.xyxy)
            return Selection(box=((u0 + u1) / 2, (v0 + v1) / 2), camera=subject.camera)
        if subject.box is not None:
            x, y, z = (float(v) for v in subject.box.center[0])
            return Selection(point=(x, y, z), radius=max(0.5, float(subject.box.size[0].min()) / 2))
        return None


def _some(settings: Sequence[str], named: int) -> str:
    """Name the first settings and the number of the others."""
    more = f" or {len(settings) - named} more" if len(settings) > named else ""
    return " or ".join(settings[:named]) + more
