"""Layout for tuning: one frame with the newest version of the configuration, and its differences."""

from __future__ import annotations

import rerun.blueprint as rrb

from bevviz.compare import views as compare
from bevviz.model.frame import Scene
from bevviz.recording import entities, views


def blueprint(scene: Scene) -> rrb.Blueprint:
    """Return the layout."""
    side: list[rrb.Container | rrb.View] = [views.cameras(scene)] if scene.cameras else []
    words = rrb.Tabs(
        compare.differences(), views.explain(), compare.difference_log(), views.log(), views.config()
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                views.space(scene, beside=[f"{entities.ROBOT.above}/**", *compare.changes()]),
                rrb.Vertical(*side, views.birds_eye(scene), row_shares=[*[2] * len(side), 3]),
                rrb.Vertical(compare.version(), words, row_shares=[1, 2]),
                column_shares=[5, 4, 3],
            ),
            rrb.Horizontal(
                rrb.Tabs(compare.difference_counts(), compare.side_counts()),
                rrb.Tabs(views.stage_times(), views.counts()),
            ),
            row_shares=[3, 1],
        ),
        views.time_panel(play=rrb.components.PlayState.Following, timeline=entities.VERSION),
        *views.panels(),
    )
