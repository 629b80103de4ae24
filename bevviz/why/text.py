"""Answers as lines for a terminal and as a page of Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bevviz.text import markdown, printable
from bevviz.why.answer import Answer


def plain(answers: Sequence[Answer], chains: int) -> str:
    """The verdicts, worst first; under the first ``chains`` of them the stages."""
    return "\n".join(map(printable, _plain(answers, chains)))


def _plain(answers: Sequence[Answer], chains: int) -> Iterator[str]:
    for answer in answers[:chains]:
        yield answer.verdict.text
        yield ""
        for step in answer.steps:
            yield f"  {step.stage:<12} {step.text}"
        yield ""
    if len(answers) > chains:
        yield f"{len(answers) - chains} more, without their chains (--limit):"
        yield from (f"- {answer.verdict.text}" for answer in answers[chains:])


def page(answers: Sequence[Answer], chains: int) -> str:
    return "\n".join(_page(answers, chains))


def _page(answers: Sequence[Answer], chains: int) -> Iterator[str]:
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
        "green in an object, blue in front of it"
    )
