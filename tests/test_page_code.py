"""The page's scripts: their types."""

from __future__ import annotations

import pytest

from tools.make_page_types import FILE, page_types


def test_the_kept_types_of_the_page_are_those_of_the_code() -> None:
    assert FILE.read_text() == page_types(), "run: python -m tools.make_page_types"


def test_the_viewers_script_has_the_widget_that_is_exported() -> None:
    """Without it the page shows the drive, but keeps no layout and changes no tab."""
    pytest.importorskip("starlette", reason="needs pip install 'bevviz[workbench]'")
    from bevviz.workbench.routes import WIDGET
    from bevviz.workbench.server import viewer_folder

    assert WIDGET in (viewer_folder() / "widget.js").read_text()
