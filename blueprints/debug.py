"""Everything of a frame at once: 3D, each camera, the bird's-eye view, what was decided, and how long it took."""

from __future__ import annotations

import rerun.blueprint as rrb

from bevviz.sources import Scene


def blueprint(scene: Scene) -> rrb.Blueprint:
    return rrb.Blueprint(
        rrb.Spatial3DView(origin="/world", contents=["/world/**", "/robot/**"]),
    )
