"""Write docs/reference.md: all reasons, parameters, metrics and entities, from the tables of the code."""

from __future__ import annotations

import json
from pathlib import Path

from bevviz.config import Config, load, parameters, values
from bevviz.evaluate.metrics import METRICS
from bevviz.model.reasons import FACTS
from bevviz.recording import entities

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reference.md"
HEAD = """# Reasons, parameters, metrics and entities

`python -m tools.make_reference` writes this page. `bevviz config KEY` explains one parameter and says where
its value is stated; [the project file](project.md#which-value-wins) states values.
"""


def text() -> str:
    """Return the page."""
    lines = [HEAD, "## Reasons", "", "| reason | meaning | parameter that decides |", "| --- | --- | --- |"]
    for kind, facts in FACTS.items():
        decides = f"`{facts.decides}`" if facts.decides else ""
        lines.append(f"| {kind} | {facts.meaning} | {decides} |")
    lines += ["", "## Parameters", "", "`reference` stands where that preset has another value.", ""]
    default, reference = values(load()), values(load(preset="reference"))
    for section in Config.model_fields:
        inside = [one for key, one in parameters().items() if key.startswith(f"{section}.")]
        if inside:
            lines += [
                f"### {section}",
                "",
                "| key | value | unit, range | meaning |",
                "| --- | --- | --- | --- |",
            ]
        for one in inside:
            value = _value(default[one.key])
            if reference[one.key] != default[one.key]:
                value += f"; reference {_value(reference[one.key])}"
            limits = ", ".join(filter(None, [one.unit, one.allowed]))
            lines.append(f"| `{one.key}` | {value} | {_cell(limits)} | {_cell(one.text)} |")
        if inside:
            lines.append("")
    lines += ["## Metrics", "", "[Evaluate](evaluate.md#metrics) says what each needs.", ""]
    lines += ["| metric | meaning |", "| --- | --- |"]
    lines += [f"| `{name}` | {_cell(meaning)} |" for name, meaning in METRICS.items()]
    lines += ["", "## Entities", "", "What [a recording](recordings.md) holds, by path."]
    for entity in entities.table().values():
        if entity in entities.SECTIONS:
            title = entities.SECTIONS[entity]
            lines += ["", f"### {title}", "", "| entity | Rerun type | content |", "| --- | --- | --- |"]
        lines.append(entity.row)
    return "\n".join(lines).rstrip() + "\n"


def _value(value: object) -> str:
    """Return a value as code; a long table is named by its size."""
    if value in (None, "", (), [], {}):
        return "empty"
    written = json.dumps(value, default=lambda item: dict(item) if hasattr(item, "items") else str(item))
    return f"`{_cell(written)}`" if len(written) <= 60 else f"{len(value)} entries"  # type: ignore[arg-type]


def _cell(words: str) -> str:
    """Return text for a cell of a table."""
    return words.replace("|", "\\|").replace("<", "&lt;")


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
