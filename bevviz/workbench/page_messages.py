"""JSON of the messages to the page: other answers, hints, notes and parameter controls."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from bevviz.config import Config, Parameter, parameters, values
from bevviz.errors import UserError
from bevviz.model.frame import Boxes3D
from bevviz.support.json_form import json_tree
from bevviz.why import Answer
from bevviz.why.answer_results import AnswerResult
from bevviz.why.kept_labels import box_of
from bevviz.workbench.page_types import (
    Chip,
    Control,
    LabelBox,
    OtherObject,
    RowRemark,
)

UNSEEN = ("source.", "live.", "logging.", "sync.", "detector.model")  # no effect on a single frame
BESIDE = 6  # further answers that are listed

# --- answers and notes -------------------------------------------------------------------------


def other_answers(answers: Sequence[Answer]) -> Iterator[OtherObject]:
    """Yield the first other answers in brief, in the order of the explainer."""
    for answer in answers[:BESIDE]:
        if (selection := answer.selection) is not None:
            yield {
                "pick": str(selection),
                "name": answer.subject.name,
                "reported": answer.verdict.reported,
                "reason": answer.verdict.kind.value,
            }


def answer_tree(answer: Answer) -> dict[str, Any]:
    """Return an answer as ``bevviz why --json`` writes it."""
    return json_tree(AnswerResult.of(answer))


def row_remark(answer: Answer) -> RowRemark:
    """Return the remark on a row: its sentence about hints, the same in two words, and the reason."""
    chips: dict[Chip, object] = {
        "hint": answer.hints,
        "cannot tell": answer.likely,
        "tried in vain": answer.tried,
    }
    chip: Chip = next((chip for chip, known in chips.items() if known), "")
    return {"remark": answer.remark, "chip": chip, "text": answer.verdict.kind.value}


def label_box(label: str, box: Boxes3D) -> LabelBox:
    """Return a label for the page."""
    center, size = ([round(value, 2) for value in row[0].tolist()] for row in (box.center, box.size))
    return {"label": label, "center": center, "size": size, "yaw": round(math.degrees(box.yaw[0]), 1)}


def label_of_page(box: LabelBox) -> tuple[str, Boxes3D]:
    """Return class and box of a label that the user has drawn.

    Raises:
        UserError: a number is missing or no size.
    """
    values, label = [*box["center"], *box["size"], math.radians(box["yaw"])], box["label"].strip()
    if not label or len(values) != 7 or not all(map(math.isfinite, values)) or min(box["size"]) <= 0:
        raise UserError("a label has a class, a centre of 3 numbers, a size of 3 above 0, and a yaw")
    return label, box_of(values)


def opened_values(config: Config) -> str:
    """Return a short text that is the same for the same values on every machine, wherever the model lies."""
    content = config.model_dump(mode="json")
    content["detector"]["model"] = Path(content["detector"]["model"] or "").name
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:8]


# --- parameter controls ------------------------------------------------------------------------


def controls(config: Config, opened: Config | None = None) -> list[Control]:
    """Return one control, with unit, range, value and description, for each parameter of the stages.

    Args:
        config: configuration whose stages have the parameters.
        opened: configuration with the initial values. A stage that it does not name has its defaults. None:
            the values of ``config``.
    """
    at_first = values(config if opened is None else opened)
    current = values(config)
    return [
        _control(declared, at_first.get(key, current[key] if declared.required else declared.default))
        for key, declared in parameters(config).items()
        if "." in key and not key.startswith(UNSEEN)
    ]


def _control(declared: Parameter, value: Any) -> Control:
    """Return the control of one parameter as JSON for the page."""
    return {
        "key": declared.key,
        "value": value,
        "unit": declared.unit,
        "about": declared.text,
        "kind": declared.kind,
        "low": declared.low,
        "high": declared.high,
        "choices": list(declared.choices) if declared.kind in ("choice", "list") else [],
    }
