"""Write the JSON schemas of the commands' outputs into docs/schemas."""

from __future__ import annotations

import json
from pathlib import Path

from bevviz.cli.json_forms import FORMS, schema

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "schemas"


def text_of(command: str) -> str:
    """Return the file of a command."""
    return json.dumps(schema(command), indent=1, sort_keys=False) + "\n"


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for command in FORMS:
        (FOLDER / f"{command}.json").write_text(text_of(command))


if __name__ == "__main__":
    main()
