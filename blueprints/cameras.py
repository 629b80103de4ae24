"""Layout for recordings without a LiDAR: cameras only."""

from __future__ import annotations

import rerun.blueprint as rrb

from bevviz.model.frame import Scene
from bevviz.recording import views


def blueprint(scene: Scene) -> rrb.Blueprint:
    """Return the layout."""
    images = [views.camera(scene, name, weak=True) for name in scene.cameras]
    texts = [views.explain(), views.why(), views.log(), views.anomaly_log(), views.config()]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(rrb.Grid(*images), rrb.Tabs(*texts, name="Decisions"), column_shares=[3, 1]),
            rrb.Horizontal(views.stage_times(), views.counts(), rrb.Tabs(views.anomalies(), views.states())),
            row_shares=[3, 1],
        ),
        views.time_panel(),
        *views.panels(),
    )
