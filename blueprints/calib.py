"""Layout for calibration: points over the image as stated and as corrected, and the score of each axis."""

from __future__ import annotations

import rerun.blueprint as rrb

from bevviz.extras.calib.log import alignment, calibration, score_curves
from bevviz.model.frame import Scene
from bevviz.recording import views


def blueprint(scene: Scene) -> rrb.Blueprint:
    """Return the layout."""
    pages: list[rrb.Container | rrb.View] = [
        rrb.Horizontal(
            alignment(name),
            rrb.Vertical(calibration(name), score_curves(name), row_shares=[2, 3]),
            column_shares=[5, 4],
            name=name,
        )
        for name in scene.cameras
    ]
    return rrb.Blueprint(
        rrb.Tabs(*pages) if len(pages) != 1 else pages[0],
        views.time_panel(play=rrb.components.PlayState.Paused),
        *views.panels(),
    )
