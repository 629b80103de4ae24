"""The sentence of a verdict, made from the clause of its reason."""

from __future__ import annotations

from collections.abc import Sequence

from bevviz.model.reasons import Reason, ReasonKind
from bevviz.why.ideal import StageSet
from bevviz.why.reason_text import ONLY
from bevviz.why.subject import Subject
from bevviz.why.verdict import Verdict


def make_verdict(
    subject: Subject,
    reason: Reason,
    reported: bool,
    restored_by: tuple[StageSet, ...] = (),
    blamed: str = "",
    likely: Sequence[ReasonKind] = (),
) -> Verdict:
    """Return the verdict with its reason in one sentence.

    Args:
        subject: the object or place in question.
        reason: the stage or rule that decided.
        reported: whether it is an object of a right class.
        restored_by: sets of stages whose ideal results bring it back.
        blamed: stage that the reason blames; empty: none.
        likely: two reasons between which nothing decides; empty: the reason is plain.
    """
    because = reason.text
    head = subject.name[0].upper() + subject.name[1:]
    if reason.kind is ReasonKind.REPORTED:
        text = f"{head} was reported: {because}{_elsewhere_text(restored_by)}."
    elif reason.kind is ReasonKind.SECOND_NAME:
        text = f"{head} is probably a second name of {because}."
    elif because.startswith(ONLY):
        content, _, rest = because.partition(": ")
        text = f"There is {content} {subject.name.removeprefix('what is ')}: {rest}."
    elif likely:
        text = f"{head} was not reported; {' and '.join(likely)} each lost much of it: {because}."
    else:
        joint = "was reported, but" if reported else "was not reported because"
        text = f"{head} {joint} {because}{_restored_text(restored_by, blamed)}."
    return Verdict(reason, reported, text, restored_by)


_IDEAL = {  # ideal result of each stage
    "ground": "the right ground",
    "clustering": "a cluster of its own",
    "detector": "a right detection",
    "fusion": "the right match",
}


def _restored_text(sets: Sequence[StageSet], blamed: str) -> str:
    """Return a clause with the ideal results that bring an object back.

    It is empty if only that of the blamed stage does, or if none is known.
    """
    if not sets or sets == ((blamed,),):
        return ""
    ideals = [" and ".join(_IDEAL[stage] for stage in stages) for stages in sets]
    if len(sets[0]) > 1:
        return f"; only {' together, or '.join(ideals)} together bring it back"
    if (blamed,) in sets:
        others = " or ".join(_IDEAL[stage] for (stage,) in sets if stage != blamed)
        return f"; {others} alone brings it back, too"
    return f"; {' or '.join(ideals)} alone brings it back"


def _elsewhere_text(sets: Sequence[StageSet]) -> str:
    """Return a clause with the ideal results that report an object at another place; empty: it is right."""
    if not sets:
        return ""
    ideals = " or ".join(" and ".join(_IDEAL[stage] for stage in stages) for stages in sets)
    return f"; its image box fits an object at another place better, which {ideals} would report"


# --- no change was tried -----------------------------------------------------------------------

_UNTRIED = {  # the reason why no parameter can be tried
    ReasonKind.FAILED: "a stage has failed, which has to be mended first",
    ReasonKind.OUT_OF_VIEW: "no camera has it in view",
    ReasonKind.HIDDEN: "something hides it from the LiDAR",
    ReasonKind.NO_POINTS: "the LiDAR has no points on it",
    ReasonKind.MERGED: "no smaller clustering.eps parts its points from the others",
    ReasonKind.NOT_RUN: "the detector needs a model and an image",
    ReasonKind.NOT_DETECTED: "the detector has no candidate for it, only another model may have one",
    ReasonKind.BELOW_THRESHOLD: "a threshold below its score lets noise pass, only another model may help",
    ReasonKind.SUPPRESSED: "its score is too low as well",
    ReasonKind.SECOND_NAME: "the thing is reported already",
    ReasonKind.NOT_FUSED: "the camera needs a pose and intrinsics",
    ReasonKind.DETECTOR_ERROR: "the detector is as sure of it as of right objects, another model may not be",
}


def untried_text(subject: Subject, verdict: Verdict) -> str:
    """Return a clause with the reason why no change was tried; empty: there is nothing to mend."""
    if verdict.kind is ReasonKind.REPORTED or subject.is_place:
        return ""
    by = verdict.reason.by
    decided = f"{by} decides this, and bevviz cannot run it with other values" if by else ""
    return f"nothing was tried: {decided or _UNTRIED.get(verdict.kind, 'no parameter decides this')}"
