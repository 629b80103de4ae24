"""Find the object that a report is about, and say what became of it, where, why, and what was tried."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bevviz.evaluate.differences import BeforeAfter
from bevviz.model.reasons import ReasonKind
from bevviz.model.results import FrameResult
from bevviz.report.facts import Cause, TriedText
from bevviz.why import Answer, FrameExplainer, Selection
from bevviz.why.answer import Hint
from bevviz.why.log import focus_point

LISTED = 5  # further objects of the frame that are listed


@dataclass(frozen=True, slots=True)
class TriedValues:
    """Values that the user tried before the report.

    Attributes:
        settings: settings that differ from those of the drive.
        answer: answer about the subject with them. None: it is not found then, or was not asked about.
        effects: their effects on the other objects of the frame.
        drive: their effects on the whole drive. Empty: the drive was not run with them.
    """

    settings: Sequence[str]
    answer: Answer | None
    effects: BeforeAfter
    drive: str = ""


def explain_subject(
    explainer: FrameExplainer, selection: Selection, answers: Sequence[Answer] = ()
) -> list[Answer]:
    """Return the answers that a report opens on. The first one is about its subject and has hints.

    Args:
        explainer: explainer of the frame.
        selection: the subject. An empty selection means the worst of the frame.
        answers: answers that the user has already. Empty: ask.

    Raises:
        UserError: as ``FrameExplainer.ask``.
    """
    if not answers:
        return explainer.explain(selection, hints=1)
    first, *others = answers
    searched = first.hints or first.tried or first.remark or first.verdict.kind is ReasonKind.REPORTED
    return [first if searched else explainer.with_hints(first), *others]


def cause_of(result: FrameResult, seconds: float, answer: Answer, tried: TriedValues | None = None) -> Cause:
    """Return what became of the subject of an answer, in words.

    Args:
        result: result of its frame.
        seconds: time of the frame since the start of the recording.
        answer: the answer, with hints.
        tried: values that the user tried.
    """
    kind = "Reported" if answer.verdict.reported else "Missed"
    if answer.false:
        kind = "False" if result.frame.truth is not None else "Doubtful"
    elif answer.verdict.reported and answer.verdict.kind is not ReasonKind.REPORTED:
        kind = "Reported with a flaw"
    return Cause(
        what=f"{kind}: {answer.subject.name}",
        where=f"{_place(result, answer)}in frame {result.frame.index} of the drive, at {seconds:.3f} s.",
        why=answer.verdict.cause,
        chain=answer.steps,
        tried=list(_tried(answer, tried)),
        remark="" if answer.hints or answer.tried or tried is not None else answer.remark,
    )


def _place(result: FrameResult, answer: Answer) -> str:
    """Return where the subject is, seen from the sensor, with a comma at the end."""
    focus = focus_point(result.frame, answer)
    if focus is None:
        camera = answer.subject.camera
        return f"In the image of {camera}, " if camera else ""
    x, y = focus[:2].tolist()
    ahead, side = "ahead" if x >= 0 else "behind", "to the left" if y >= 0 else "to the right"
    return f"{abs(x):.1f} m {ahead} of {result.frame.lidar or 'the sensor'} and {abs(y):.1f} m {side}, "


def _tried(answer: Answer, tried: TriedValues | None) -> Iterator[TriedText]:
    """Yield the values that were tried: those of the user, those that help, then those in vain."""
    if tried is not None:
        text = "" if tried.answer is None else tried.answer.verdict.text
        result = f"{text} {tried.drive}".strip()
        yield TriedText(", ".join(tried.settings), result, *_good_and_bad(tried.effects))
    known = set() if tried is None else {tuple(tried.settings)}
    yield from (_hint_text(hint) for hint in answer.hints if hint.settings not in known)
    for change in answer.tried:
        yield TriedText(", ".join(change.settings), change.text)


def _hint_text(hint: Hint) -> TriedText:
    """Return a hint as a row of the table."""
    return TriedText(", ".join(hint.settings), hint.text, *_good_and_bad(hint.effects))


def _good_and_bad(effects: BeforeAfter) -> tuple[str, str]:
    """Return the objects of a frame that get better, and those that get worse."""
    names = effects.names
    worse = [f"new false {name}" for name in names.false]
    worse += [f"broken {name}" for name in (names.lost if effects.truth is None else names.right)]
    worse += [f"{effects.doubtful} doubtful"] if effects.doubtful > 0 else []
    gone = [f"false gone {name}" for name in names.false_gone]
    return ", ".join([*names.fixed, *gone]) or "nothing", ", ".join(worse) or "nothing"
