"""Layout for two runs on the same frames: A and B side by side, and their differences."""

from __future__ import annotations

import rerun.blueprint as rrb

from bevviz.compare import views as compare
from bevviz.model.frame import Scene
from bevviz.recording import entities, views


def blueprint(scene: Scene) -> rrb.Blueprint:
    """Return the layout."""
    sides = [
        rrb.Vertical(compare.side_space(scene, root), compare.side_pictures(scene, root), row_shares=[3, 2])
        for root in ("", entities.B)
    ]
    words = rrb.Tabs(
        compare.differences(),
        compare.compared(),
        views.explain(name="Explain A"),
        views.explain(entities.B, "Explain B"),
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(*sides, words, column_shares=[4, 4, 3]),
            rrb.Horizontal(
                compare.numbers(),
                compare.difference_states(),
                compare.difference_log(),
            ),
            row_shares=[3, 1],
        ),
        views.time_panel(),
        *views.panels(),
    )
