"""Layout next to the workbench's panel: 3D, images and bird's-eye view, for selection by click."""

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
    above = views.from_above(scene, beside) if scene.moving else views.birds_eye(scene)
    return rrb.Blueprint(
        rrb.Horizontal(
            views.spaces(scene, beside=beside, names=False),
            rrb.Vertical(*side, above, row_shares=[*[3] * len(side), 2]),
            column_shares=[4, 4],
        ),
        views.time_panel(play=rrb.components.PlayState.Paused),
        *views.panels(),
    )
