"""Layout next to the workbench's panel for a running robot, at the newest frame."""

from __future__ import annotations

import rerun.blueprint as rrb

from bevviz.model.frame import Scene
from bevviz.recording import entities, views


def blueprint(scene: Scene) -> rrb.Blueprint:
    """Return the layout."""
    side: list[rrb.Container | rrb.View] = (
        [views.cameras(scene, why=True, weak=True)] if scene.cameras else []
    )
    beside = (f"{entities.ROBOT.above}/**", f"{entities.WHY}/**")
    return rrb.Blueprint(
        rrb.Horizontal(
            views.spaces(scene, beside=beside, follow=entities.WHY_PART.path("place")),
            rrb.Vertical(*side, views.birds_eye(scene), row_shares=[*[3] * len(side), 2]),
            column_shares=[4, 4],
        ),
        views.time_panel(play=rrb.components.PlayState.Following),
        *views.panels(),
    )
