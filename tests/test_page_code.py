"""The page's scripts, beside what 'make page-check' tests."""

from __future__ import annotations

import pytest


def test_the_viewers_script_has_the_widget_that_is_exported() -> None:
    """Without it the page shows the drive, but keeps no layout and changes no tab."""
    pytest.importorskip("starlette", reason="needs pip install 'bevviz[workbench]'")
    from bevviz.workbench.routes import WIDGET
    from bevviz.workbench.server import viewer_folder

    assert WIDGET in (viewer_folder() / "widget.js").read_text()
