"""The page's scripts: their types."""

from __future__ import annotations

from tools.make_page_types import FILE, page_types


def test_the_kept_types_of_the_page_are_those_of_the_code() -> None:
    assert FILE.read_text() == page_types(), "run: python -m tools.make_page_types"
