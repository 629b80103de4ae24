"""Write the types of the page's messages and elements: bevviz/workbench/page/types.d.ts."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from bevviz.workbench.page_types import FROM_PAGE, AnyToPage

PAGE = Path(__file__).resolve().parents[1] / "bevviz" / "workbench" / "page"
FILE = PAGE / "types.d.ts"
HEAD = "// Types of the page's messages and elements, by 'python -m tools.make_page_types'.\n"


def page_types() -> str:
    """Return the types of the page's messages and elements in TypeScript, for the page's comments."""
    to_page = TypeAdapter[Any](AnyToPage).json_schema(mode="serialization")
    from_page = FROM_PAGE.json_schema(mode="validation")
    forms = from_page["$defs"] | to_page["$defs"]
    unions = [
        f"export type {name} = {' | '.join(map(_type, tree['oneOf']))};\n"
        for name, tree in (("ToPage", to_page), ("FromPage", from_page))
    ]
    interfaces = (_interface(name, forms[name]) for name in sorted(forms))
    return "\n".join([HEAD, *interfaces, *unions, page_elements()])


class _Elements(HTMLParser):
    """Parser of a page. It keeps the tag of each element with an id."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: dict[str, str] = {}

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep the id of an element."""
        if name := dict(attrs).get("id"):
            self.tags[name] = tag


def page_elements() -> str:
    """Return the types of the page's elements by their ids, in TypeScript."""
    parser = _Elements()
    parser.feed((PAGE / "index.html").read_text())
    keys = "".join(f'  "{name}": HTMLElementTagNameMap["{tag}"];\n' for name, tag in parser.tags.items())
    return f"/** Elements of index.html by their ids. */\nexport interface Elements {{\n{keys}}}\n"


def _interface(name: str, form: dict[str, Any]) -> str:
    """Return one object type."""
    keys = "".join(_key(form, key, value) for key, value in form["properties"].items())
    more = "  [key: string]: unknown;\n" if form.get("additionalProperties") else ""
    return f"{_comment(form)}export interface {name} {{\n{keys}{more}}}\n"


def _key(form: dict[str, Any], key: str, value: dict[str, Any]) -> str:
    mark = "" if key in form.get("required", ()) else "?"
    return f"  {key}{mark}: {_type(value)};\n"


def _comment(form: dict[str, Any]) -> str:
    return f"/** {' '.join(form['description'].split())} */\n" if "description" in form else ""


def _type(form: dict[str, Any]) -> str:
    """Return the type of a value."""
    if "$ref" in form:
        return str(form["$ref"].rpartition("/")[2])
    if "const" in form or "enum" in form:
        return " | ".join(json.dumps(value) for value in form.get("enum", [form.get("const")]))
    if "anyOf" in form:
        return " | ".join(map(_type, form["anyOf"]))
    kind = form.get("type", "any")
    if kind == "array":
        item = _type(form["items"])
        return f"({item})[]" if " " in item else f"{item}[]"
    if kind == "object":
        return f"Record<string, {_type(form['additionalProperties'])}>"
    return {"integer": "number", "any": "any"}.get(kind, str(kind))


def main() -> None:
    FILE.write_text(page_types())


if __name__ == "__main__":
    main()
