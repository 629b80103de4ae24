"""Answers as lines for a terminal and as a page of Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bevviz.errors import printable
from bevviz.evaluate import MIN_HITS, RANGE
from bevviz.model.reasons import ReasonKind
from bevviz.support.text import markdown
from bevviz.why.answer import Answer
from bevviz.why.subject import count

LISTED = 5  # other subjects at the place, at most


def plain_text(
    answers: Sequence[Answer], chains: int, beside: Sequence[Answer] = (), unseen: Sequence[Answer] = ()
) -> str:
    """Return the verdicts with steps for the first ``chains``, then the other subjects there.

    Args:
        answers: the answers.
        chains: number of answers with steps.
        beside: answers about other subjects at the place.
        unseen: answers about subjects that no sensor sees.
    """
    lines = [*_plain(answers, chains), *_listed("also there:", beside)]
    lines += _listed("out of the sensors' sight (--all explains them):", unseen)
    return "\n".join(map(printable, lines)).rstrip("\n")


def _plain(answers: Sequence[Answer], chains: int) -> Iterator[str]:
    """Yield the lines of the verdicts and steps."""
    for answer in answers[:chains]:
        yield answer.text
        yield ""
        for step in answer.steps:
            yield f"  {step.stage:<12} {step.text}"
        yield ""
    if len(answers) > chains:
        yield f"{len(answers) - chains} more, without their chains (--limit):"
        yield from (f"- {answer.text}" for answer in answers[chains:])


def _listed(heading: str, others: Sequence[Answer]) -> Iterator[str]:
    """Yield a heading and the verdicts of the first other subjects. Nothing without any."""
    if others:
        yield heading
        yield from (f"- {answer.text}" for answer in others[:LISTED])
    if len(others) > LISTED:
        yield f"- and {len(others) - LISTED} more"


def summary_line(answers: Sequence[Answer]) -> str:
    """Return one line about a frame. It needs the answers about all objects, reported ones included."""
    false = sum(answer.false for answer in answers)
    things = [answer for answer in answers if not answer.weak and not answer.false]
    reported = [answer for answer in things if answer.verdict.reported]
    flawed = [answer for answer in reported if answer.verdict.kind is not ReasonKind.REPORTED]
    hopeless = [answer for answer in things if answer.folded]
    missed = [answer for answer in things if not answer.verdict.reported and not answer.folded]
    near = [answer for answer in missed if answer.near]
    known = any(answer.subject.kind == "truth" for answer in answers)
    parts = [f"{len(reported)} reported" + (f" ({len(flawed)} with a flaw)" if flawed else "")]
    parts.append(f"{len(near)} missed within {RANGE:g} m with {MIN_HITS} points or more")
    if len(missed) > len(near):
        parts.append(f"{len(missed) - len(near)} missed farther off or with fewer points")
    if hopeless:
        parts.append(f"{len(hopeless)} hidden, out of view or without points")
    if false:
        parts.append(f"{false} {'false' if known else 'doubtful'}")
    weak = sum(answer.weak for answer in answers)
    if weak:
        parts.append(count(weak, "weak detection"))
    if any(answer.verdict.kind is ReasonKind.NOT_RUN for answer in missed):
        parts.append("the detector never ran")
    folded = " (folded: --all)" if any(answer.folded for answer in answers) else ""
    return f"{count(len(things), 'object')}: {', '.join(parts)}{folded}"


def markdown_page(answers: Sequence[Answer], chains: int) -> str:
    """Return the answers as Markdown, with steps for the first ``chains`` of them."""
    return "\n".join(_page(answers, chains))


def _page(answers: Sequence[Answer], chains: int) -> Iterator[str]:
    """Yield the lines of the page."""
    for answer in answers[:chains]:
        yield f"### {answer.verdict.kind.value}"
        yield ""
        yield f"**{markdown(answer.text)}**"
        yield ""
        yield from (f"- *{step.stage}*: {markdown(step.text)}" for step in answer.steps)
        yield ""
    if len(answers) > chains:
        yield "### more"
        yield ""
        yield from (f"- {markdown(answer.text)}" for answer in answers[chains:])
        yield ""
    yield (
        "Points: brown ground, red noise, orange set aside, yellow in a cluster without a name, "
        "light blue in an object, dark blue in front of it"
    )
