"""Layout for a reader who was not there: the cause first, then the object in 3D, image and from above."""

from __future__ import annotations

import rerun.blueprint as rrb

from bevviz.model.frame import Scene
from bevviz.recording import views


def blueprint(scene: Scene) -> rrb.Blueprint:
    """Return the layout. Without a subject, the decisions of the frame come first."""
    why = scene.focus is not None
    side: list[rrb.Container | rrb.View] = [views.cameras(scene, why=why)] if scene.cameras else []
    words = [views.report(), views.explain(), views.config()]
    over_time = rrb.Tabs(views.states(), views.anomalies(), views.tracks(), views.speeds())
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Tabs(*words, active_tab=0 if why else 1),
                views.spaces(scene, why=why),
                rrb.Vertical(*side, views.birds_eye(scene), row_shares=[*[2] * len(side), 3]),
                column_shares=[3, 5, 4],
            ),
            # Wide, as the lines of a log are not wrapped.
            rrb.Horizontal(rrb.Tabs(views.log(), views.anomaly_log()), over_time),
            row_shares=[3, 1],
        ),
        views.time_panel(),
        *views.panels(),
    )
