"""Layout for a running robot: the newest frame, without raw clouds and texts, to stay fast."""

from __future__ import annotations

import rerun.blueprint as rrb

from bevviz.compare import views as compare
from bevviz.model.frame import Scene
from bevviz.recording import views


def blueprint(scene: Scene) -> rrb.Blueprint:
    """Return the layout."""
    side: list[rrb.Container | rrb.View] = [views.cameras(scene)] if scene.cameras else []
    return rrb.Blueprint(
        rrb.Horizontal(
            views.spaces(scene, raw=False),
            rrb.Vertical(
                *side,
                rrb.Tabs(views.birds_eye(scene), views.robots_birds_eye())
                if scene.robot
                else views.birds_eye(scene),
                rrb.Tabs(
                    views.rates(),
                    views.stage_times(),
                    views.latencies(),
                    views.clocks(),
                    views.anomalies(),
                    views.states(),
                    views.tracks(),
                    views.diagnostics(),
                    *([compare.difference_counts(), compare.difference_states()] if scene.robot else []),
                    *views.motion(scene),
                    views.log(),
                ),
                row_shares=[*[2] * len(side), 3, 2],
            ),
            column_shares=[3, 2],
        ),
        views.time_panel(play=rrb.components.PlayState.Following),
        *views.panels(),
    )
