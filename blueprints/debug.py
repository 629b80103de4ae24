"""Layout with everything of a frame: 3D, cameras, bird's-eye view, decisions and times."""

from __future__ import annotations

import rerun.blueprint as rrb

from bevviz.model.frame import Scene
from bevviz.recording import views


def blueprint(scene: Scene) -> rrb.Blueprint:
    """Return the layout."""
    side: list[rrb.Container | rrb.View] = [views.cameras(scene)] if scene.cameras else []
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                views.spaces(scene),
                rrb.Vertical(*side, views.birds_eye(scene), row_shares=[*[2] * len(side), 3]),
                rrb.Tabs(views.explain(), views.log(), views.anomaly_log(), views.config(), name="Decisions"),
                column_shares=[5, 4, 3],
            ),
            rrb.Horizontal(views.health(), views.over_time()),
            row_shares=[3, 1],
        ),
        views.time_panel(),
        *views.panels(),
    )
