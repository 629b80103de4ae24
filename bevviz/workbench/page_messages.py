"""JSON of the messages to the page: other answers, hints, notes and parameter controls."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from pydantic.fields import FieldInfo
from pydantic_core import to_jsonable_python

from bevviz.config import Config, unit, values
from bevviz.config.keys import field_of, limits_of
from bevviz.pipeline.notes import HandledFinding, Note
from bevviz.why import Answer
from bevviz.why.robot_messages import FollowedObject, RobotQuestions, step_line
from bevviz.workbench.source import Message

UNSEEN = ("source.", "live.", "logging.", "sync.", "detector.model")  # no effect on a single frame
BESIDE = 6  # further answers that are listed

# --- answers and notes -------------------------------------------------------------------------


def other_answers(answers: Sequence[Answer]) -> Iterator[dict[str, Any]]:
    """Yield the first other answers in brief, in the order of the explainer."""
    for answer in answers[:BESIDE]:
        if (selection := answer.selection) is not None:
            yield {
                "pick": str(selection),
                "name": answer.subject.name,
                "reported": answer.verdict.reported,
                "reason": answer.verdict.kind.value,
            }


def hints_dict(answer: Answer) -> dict[str, Any]:
    """Return the hints of an answer with hints, and the sentence about them."""
    return {"hints": answer.as_dict()["hints"], "remark": answer.remark}


def robot_dict(questions: RobotQuestions, followed: FollowedObject) -> dict[str, Any]:
    """Return each step of the robot's own chain, with what it did with an object."""
    outcomes = {outcome.topic: outcome for outcome in followed.outcomes}
    chain, change = questions.chain, followed.change
    return {
        "text": followed.text,
        "steps": [
            {
                "about": step_line(step.topic, chain).removeprefix(f"{step.topic}: "),
                "text": outcomes[step.topic].text if step.topic in outcomes else "",
                "changed": change is not None and step.topic == change.topic,
            }
            for step in chain.steps
        ],
        "notes": questions.notes,
    }


def note_dict(note: Note) -> dict[str, Any]:
    """Return a note. Its times are text, as JavaScript numbers cannot hold them."""
    return {**asdict(note), "stamp": str(note.stamp), "received": str(note.received)}


def handled_dict(finding: HandledFinding) -> dict[str, Any]:
    """Return a finding that the user has dealt with. Its time is text."""
    return {**asdict(finding), "stamp": str(finding.stamp)}


def handled_finding(message: Message) -> HandledFinding:
    """Return the finding that a message of the page says is done or ignored."""
    what, name, pick, state, text = (str(message[key]) for key in ("what", "name", "pick", "state", "text"))
    distance = None if message["distance"] is None else float(message["distance"])
    return HandledFinding(int(message["stamp"]), what, name, pick, distance, state, text.strip())


def opened_values(config: Config) -> str:
    """Return a short text that is the same for the same values on every machine, wherever the model lies."""
    content = config.model_dump(mode="json")
    content["detector"]["model"] = Path(content["detector"]["model"] or "").name
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:8]


# --- parameter controls ------------------------------------------------------------------------


def controls(config: Config, opened: Config | None = None) -> list[dict[str, Any]]:
    """Return one control, with unit, range, value and description, for each parameter of the stages.

    Args:
        config: configuration whose stages have the parameters.
        opened: configuration with the initial values. A stage that it does not name has its defaults. None:
            the values of ``config``.
    """
    at_first = values(config if opened is None else opened)
    return [
        _control(key, at_first.get(key, _default(value, info)), info)
        for key, value in values(config).items()
        if "." in key and not key.startswith(UNSEEN) and (info := field_of(key, config)) is not None
    ]


def _default(value: Any, info: FieldInfo) -> Any:
    """Return the default of a parameter, or ``value`` if it has none."""
    return value if info.is_required() else to_jsonable_python(info.get_default(call_default_factory=True))


def _control(key: str, value: Any, info: FieldInfo) -> dict[str, Any]:
    """Return the control of one parameter as JSON for the page."""
    control: dict[str, Any] = {
        "key": key,
        "value": value,
        "unit": unit(key),
        "about": info.description or "",
        "kind": _kind(info.annotation),
    }
    limits = zip(("low", "high"), limits_of(info), strict=True)
    control |= {name: limit for name, limit in limits if limit is not None}
    (choice, *_) = [*get_args(info.annotation), None] if control["kind"] == "list" else [info.annotation]
    if get_origin(choice) is Literal:
        control["choices"] = list(get_args(choice))
    return control


def _kind(annotation: Any) -> str:
    """Return the kind of input for a type annotation: choice, list, switch, whole, number or text."""
    if get_origin(annotation) is Literal:
        return "choice"
    if get_origin(annotation) in (list, tuple):
        return "list"
    united = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else ()
    inner = {annotation, *united}
    return "switch" if bool in inner else "whole" if int in inner else "number" if float in inner else "text"
