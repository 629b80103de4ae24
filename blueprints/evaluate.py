"""Layout for an evaluation: true, false and missed objects, their counts, and the worst frames."""

from __future__ import annotations

import rerun.blueprint as rrb

from bevviz.model.frame import Scene
from bevviz.recording import entities, views


def blueprint(scene: Scene) -> rrb.Blueprint:
    """Return the layout."""
    side: list[rrb.Container | rrb.View] = [views.cameras(scene)] if scene.cameras else []
    judged = (
        f"{entities.ROBOT.above}/**",
        entities.JUDGED.path("**"),
        f"- {entities.FUSED}/**",  # the same boxes, in other colours
    )
    words = rrb.Tabs(
        rrb.TextDocumentView(name="Frame", origin=entities.EVALUATE, contents=["$origin"]),
        rrb.TextDocumentView(name="Evaluation", origin=entities.EVALUATE_ABOUT),
        views.explain(),
    )
    counts = [entities.JUDGED_COUNT.path(outcome) for outcome in ("true", "missed", "false")]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                views.space(scene, raw=False, beside=judged),
                rrb.Vertical(*side, views.birds_eye(scene), row_shares=[*[2] * len(side), 3]),
                words,
                column_shares=[5, 4, 3],
            ),
            rrb.Horizontal(
                views.plot("True, missed, false", entities.EVALUATE, counts),
                views.text_log("Missed and false", entities.EVALUATE_LOG),
            ),
            row_shares=[3, 1],
        ),
        views.time_panel(),
        *views.panels(),
    )
