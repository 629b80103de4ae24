"""Layout for one object and its chain through the stages: in words, in 3D and in the image."""

from __future__ import annotations

import rerun.blueprint as rrb

from bevviz.model.frame import Scene
from bevviz.recording import views


def blueprint(scene: Scene) -> rrb.Blueprint:
    """Return the layout."""
    side: list[rrb.Container | rrb.View] = [views.cameras(scene, why=True)] if scene.cameras else []
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                views.why(), rrb.Tabs(views.explain(), views.log(), views.config()), row_shares=[3, 2]
            ),
            views.space(scene, why=True),
            rrb.Vertical(*side, views.birds_eye(scene), row_shares=[*[3] * len(side), 2]),
            column_shares=[4, 4, 5],
        ),
        views.time_panel(),
        *views.panels(),
    )
