"""Layout for a reader who was not there: decisions and problems first, then the scene."""

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
                rrb.Tabs(views.explain(), views.config()),
                views.spaces(scene),
                rrb.Vertical(*side, views.birds_eye(scene), row_shares=[*[2] * len(side), 3]),
                column_shares=[3, 5, 4],
            ),
            # Wide, as the lines of a log are not wrapped.
            rrb.Horizontal(rrb.Tabs(views.log(), views.anomaly_log()), views.over_time()),
            row_shares=[3, 1],
        ),
        views.time_panel(),
        *views.panels(),
    )
