"""Answers as lines for a terminal and as a page of Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bevviz.evaluate import MIN_HITS, RANGE
from bevviz.support.text import markdown, printable
from bevviz.why.answer import Answer
from bevviz.why.subject import count
from bevviz.why.verdict import HOPELESS, Reason

LISTED = 5  # other subjects at the place, at most


def plain(answers: Sequence[Answer], chains: int, beside: Sequence[Answer] = ()) -> str:
    """Return the verdicts with steps for the first ``chains``, then the other subjects there."""
    return "\n".join(map(printable, [*_plain(answers, chains), *_listed(beside)])).rstrip("\n")


def _plain(answers: Sequence[Answer], chains: int) -> Iterator[str]:
    """Yield the lines of the verdicts and steps."""
    for answer in answers[:chains]:
        yield answer.verdict.text
        yield ""
        for step in answer.steps:
            yield f"  {step.stage:<12} {step.text}"
        yield ""
    if len(answers) > chains:
        yield f"{len(answers) - chains} more, without their chains (--limit):"
        yield from (f"- {answer.verdict.text}" for answer in answers[chains:])


def _listed(beside: Sequence[Answer]) -> Iterator[str]:
    """Yield the lines of the other subjects at the place."""
    if beside:
        yield "also there:"
        yield from (f"- {answer.verdict.text}" for answer in beside[:LISTED])
    if len(beside) > LISTED:
        yield f"- and {len(beside) - LISTED} more"


def summary(answers: Sequence[Answer]) -> str:
    """Return one line about a frame. It needs the answers about all objects, reported ones included."""
    things = [a for a in answers if not a.weak]
    reported = [a for a in things if a.verdict.reported]
    flawed = [a for a in reported if a.verdict.reason is not Reason.REPORTED]
    hopeless = [a for a in things if a.verdict.reason in HOPELESS]
    missed = [a for a in things if not a.verdict.reported and a.verdict.reason not in HOPELESS]
    near = [a for a in missed if a.near]
    said = [f"{len(reported)} reported" + (f" ({len(flawed)} with a flaw)" if flawed else "")]
    said.append(f"{len(near)} missed within {RANGE:g} m with {MIN_HITS} points or more")
    if len(missed) > len(near):
        said.append(f"{len(missed) - len(near)} missed farther off or with fewer points")
    if hopeless:
        said.append(f"{len(hopeless)} hidden, out of view or without points")
    weak = len(answers) - len(things)
    if weak:
        said.append(count(weak, "weak detection"))
    if any(a.verdict.reason is Reason.NOT_RUN for a in missed):
        said.append("the detector never ran")
    folded = " (folded: --all)" if any(a.folded for a in answers) else ""
    return f"{count(len(things), 'object')}: {', '.join(said)}{folded}"


def page(answers: Sequence[Answer], chains: int) -> str:
    """Return the answers as Markdown, with steps for the first ``chains`` of them."""
    return "\n".join(_page(answers, chains))


def _page(answers: Sequence[Answer], chains: int) -> Iterator[str]:
    """Yield the lines of the page."""
    for answer in answers[:chains]:
        yield f"### {answer.verdict.reason.value}"
        yield ""
        yield f"**{markdown(answer.verdict.text)}**"
        yield ""
        yield from (f"- *{step.stage}*: {markdown(step.text)}" for step in answer.steps)
        yield ""
    if len(answers) > chains:
        yield "### more"
        yield ""
        yield from (f"- {markdown(answer.verdict.text)}" for answer in answers[chains:])
        yield ""
    yield (
        "Points: brown ground, red noise, orange set aside, yellow in a cluster without a name, "
        "light blue in an object, dark blue in front of it"
    )
