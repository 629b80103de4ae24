"""Rerun's viewer in the cell of a notebook."""

from __future__ import annotations

from typing import Any

import rerun as rr
from rerun.blueprint import Blueprint

from bevviz.errors import UserError
from bevviz.frame import Scene
from bevviz.logging import blueprints
from bevviz.logging.sinks import APPLICATION


def in_notebook() -> bool:
    """Whether a cell could show a viewer: a plain IPython terminal cannot."""
    try:
        from IPython.core.getipython import get_ipython
    except ImportError:
        return False
    shell: Any = get_ipython()  # type: ignore[no-untyped-call, unused-ignore]
    return shell is not None and getattr(shell, "kernel", None) is not None


def notebook_viewer(scene: Scene, blueprint: str | Blueprint) -> tuple[Any, rr.RecordingStream]:
    """A viewer, shown in the current cell, and the recording that it shows.

    Raises:
        UserError: rerun-notebook is not installed, or there is no such blueprint.
    """
    layout = blueprints.load(blueprint, scene) if isinstance(blueprint, str) else blueprint
    recording = rr.RecordingStream(APPLICATION)
    recording.set_log_time_enabled(False)
    try:
        viewer = rr.notebook.Viewer(recording=recording, blueprint=layout, width="auto", height=720)
    except (ImportError, rr.error_utils.RerunMissingDependencyError):
        raise UserError(
            "a viewer in a notebook needs one more package: pip install 'bevviz[notebook]'"
        ) from None
    viewer.display()
    return viewer, recording
