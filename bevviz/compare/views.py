"""Views of two compared runs, for layouts. See also ``bevviz.recording.views``."""

from __future__ import annotations

import rerun.blueprint as rrb

from bevviz.evaluate.differences import DIFFERENT, Change
from bevviz.model.frame import Scene
from bevviz.recording import entities
from bevviz.recording.views import HIDDEN, LINKED, birds_eye, plot, space, text_log

_SIDES = {"": ("A", Change.ONLY_A), entities.B: ("B", Change.ONLY_B)}


def side_space(scene: Scene, root: str) -> rrb.Spatial3DView:
    """Return the 3D view of one run: obstacles, clusters, objects and their differences."""
    name, only_here = _SIDES[root]
    contents = [entities.TRUTH, *changes(only_here, Change.MOVED, Change.CLASS)]
    return space(scene, raw=False, names=False, name=f"3D {name}", root=root, beside=contents)


def side_camera(camera_name: str, root: str) -> rrb.Spatial2DView:
    """Return the image view with one run's detections and with those missing in the other run."""
    name, only_here = _SIDES[root]
    image, detections = entities.IMAGE.path(camera_name), entities.DETECTIONS.path(camera_name)
    differences = [
        entities.IMAGE_DIFFERENCE.path(camera_name, change) for change in (only_here, Change.CLASS)
    ]
    return rrb.Spatial2DView(
        name=f"{camera_name} {name}",
        origin=entities.SENSOR.path(camera_name),
        contents=[image, f"{root}{image}/**", *differences],
        overrides=dict.fromkeys(
            (root + entities.WEAK.path(camera_name), root + entities.NAMES.path(detections)), HIDDEN
        ),
    )


def side_pictures(scene: Scene, root: str) -> rrb.Tabs:
    """Return the camera views and the bird's-eye view of one run, in tabs."""
    name = _SIDES[root][0]
    cameras = [side_camera(camera_name, root) for camera_name in scene.cameras]
    return rrb.Tabs(*cameras, birds_eye(scene, root, f"Bird's-eye view {name}"))


def differences() -> rrb.TextDocumentView:
    """Return the view of the frame's differences as text."""
    return rrb.TextDocumentView(name="Differences", origin=entities.COMPARE, contents=["$origin"])


def changes(*which: Change) -> list[str]:
    """Return the entity paths of objects that differ, and of objects that one run alone gets right.

    Args:
        which: kinds of difference; none: all of them.
    """
    return [f"{entities.DIFFERENCE.path(change)}/**" for change in (*(which or DIFFERENT), "broken", "fixed")]


def compared() -> rrb.TextDocumentView:
    """Return the view of the names and configurations of both runs."""
    return rrb.TextDocumentView(name="A and B", origin=entities.COMPARE_ABOUT)


def difference_log() -> rrb.TextLogView:
    """Return the view of the differences as log lines."""
    return text_log("Log of differences", entities.COMPARE_LOG)


def numbers() -> rrb.Tabs:
    """Return the plots, in tabs. Side by side, their legends would hide the curves."""
    return rrb.Tabs(difference_counts(), side_counts(), name="Numbers")


def difference_counts() -> rrb.TimeSeriesView:
    """Return the plot of the number of objects that differ, by kind of difference."""
    contents = [entities.DIFFERENCE_COUNT.path(change) for change in DIFFERENT]
    return plot("Objects that differ", entities.COMPARE, contents, linked=True)


def side_counts() -> rrb.TimeSeriesView:
    """Return the plot of the number of objects and clusters on both sides."""
    contents = [
        entities.DIFFERENCE_COUNT.path(f"{what}_{side}") for what in ("objects", "clusters") for side in "ab"
    ]
    return plot("Objects and clusters", entities.COMPARE, contents, linked=True)


def difference_states() -> rrb.StateTimelineView:
    """Return the timeline of the worst change of each class."""
    return rrb.StateTimelineView(
        name="Worst of each class", origin=entities.DIFFERENCE_STATE.above, time_view=LINKED
    )
