"""For somebody who was not there: first what was decided and what went wrong, then the scene."""

from __future__ import annotations

import rerun.blueprint as rrb

from bevviz.frame import Scene
from bevviz.logging import views


def blueprint(scene: Scene) -> rrb.Blueprint:
    side: list[rrb.Container | rrb.View] = [views.cameras(scene)] if scene.cameras else []
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                views.explain(), rrb.Tabs(views.log(), views.anomaly_log(), views.config()), row_shares=[3, 1]
            ),
            rrb.Vertical(views.spaces(scene), views.over_time(), row_shares=[3, 1]),
            rrb.Vertical(*side, views.birds_eye(scene), row_shares=[*[2] * len(side), 3]),
            column_shares=[3, 5, 4],
        ),
        views.time_panel(),
        *views.panels(),
    )
