"""The views of two runs that are compared, for layouts; see ``bevviz.recording.views``."""

from __future__ import annotations

import rerun.blueprint as rrb

from bevviz.compare.differences import DIFFERENT, Change
from bevviz.model.frame import Scene
from bevviz.recording import entities
from bevviz.recording.views import HIDDEN, LINKED, birds_eye, plot, space, text_log

_SIDES = {"": ("A", Change.ONLY_A), entities.B: ("B", Change.ONLY_B)}


def side_space(scene: Scene, root: str) -> rrb.Spatial3DView:
    """What one run has found, with the differences that concern it: obstacles, clusters, objects."""
    name, only = _SIDES[root]
    beside = [entities.TRUTH, *changes(only, Change.MOVED, Change.CLASS)]
    return space(scene, raw=False, names=False, name=f"3D {name}", root=root, beside=beside)


def side_camera(camera_name: str, root: str) -> rrb.Spatial2DView:
    """The one image, with the detections of one run and those that the other one has not."""
    name, only = _SIDES[root]
    image, own = entities.image(camera_name), entities.detections(camera_name)
    different = [entities.image_difference(camera_name, change) for change in (only, Change.CLASS)]
    return rrb.Spatial2DView(
        name=f"{camera_name} {name}",
        origin=entities.sensor(camera_name),
        contents=[image, f"{root}{image}/**", *different],
        overrides=dict.fromkeys((root + entities.weak(camera_name), root + entities.names(own)), HIDDEN),
    )


def side_pictures(scene: Scene, root: str) -> rrb.Tabs:
    """The cameras and the bird's-eye view of one run."""
    name = _SIDES[root][0]
    cameras = [side_camera(camera_name, root) for camera_name in scene.cameras]
    return rrb.Tabs(*cameras, birds_eye(scene, root, f"Bird's-eye view {name}"))


def differences() -> rrb.TextDocumentView:
    """How the runs differ in the frame, in words."""
    return rrb.TextDocumentView(name="Differences", origin=entities.COMPARE, contents=["$origin"])


def changes(*which: Change) -> list[str]:
    """Contents: objects that differ, in these ways or in any, and that one run alone is right about."""
    return [f"{entities.difference(change)}/**" for change in (*(which or DIFFERENT), "broken", "fixed")]


def compared() -> rrb.TextDocumentView:
    """What the two runs are."""
    return rrb.TextDocumentView(name="A and B", origin=entities.COMPARE_ABOUT)


def difference_log() -> rrb.TextLogView:
    return text_log("Log of differences", entities.COMPARE_LOG)


def numbers() -> rrb.Tabs:
    """In tabs: side by side, their legends would hide the curves."""
    return rrb.Tabs(difference_counts(), side_counts(), name="Numbers")


def difference_counts() -> rrb.TimeSeriesView:
    """Objects that differ, by how."""
    contents = [entities.difference_count(change) for change in DIFFERENT]
    return plot("Objects that differ", entities.COMPARE, contents, linked=True)


def side_counts() -> rrb.TimeSeriesView:
    """Objects and clusters of both."""
    contents = [
        entities.difference_count(f"{what}_{side}") for what in ("objects", "clusters") for side in "ab"
    ]
    return plot("Objects and clusters", entities.COMPARE, contents, linked=True)


def difference_states() -> rrb.StateTimelineView:
    """For each class the worst that has become of it, over time."""
    return rrb.StateTimelineView(name="Worst of each class", origin=entities.COMPARE_STATES, time_view=LINKED)


def version() -> rrb.TextDocumentView:
    """What was changed in the configuration, in ``bevviz tune``."""
    return rrb.TextDocumentView(name="Version", origin=entities.TUNE)
