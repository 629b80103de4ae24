"""Views of the layouts in ``blueprints/``, also for user layouts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun.blueprint as rrb

from bevviz.config.sections import Quantity
from bevviz.model.counts import OPINIONS
from bevviz.model.frame import Scene
from bevviz.recording import entities
from bevviz.recording.cloud import quantity_visualizer
from bevviz.recording.focus import ABOVE, FROM_ABOVE, IMAGE_HEIGHT, IMAGE_WIDTH, SPACE, frame_name
from bevviz.recording.health import COUNTS
from bevviz.recording.labels import EYE, LOOK_TARGET
from bevviz.recording.marks import MARK_COLORS

_DARK = (13, 14, 18)
_FROM_ABOVE = (0.0, 0.0, 40.0)  # eye over the origin of its view
HIDDEN = rrb.EntityBehavior(visible=False)
LINKED = rrb.archetypes.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)


def space(
    scene: Scene,
    *,
    raw: bool = True,
    frustums: bool = False,
    why: bool = False,
    names: bool = True,
    name: str = "3D",
    root: str = "",
    beside: Sequence[str] = (f"{entities.ROBOT.above}/**",),
    by: Quantity | None = None,
    follow: str | None = None,
    above: bool = False,
) -> rrb.Spatial3DView:
    """Return a 3D view of points, boxes, frustums and poses, seen from behind and above the robot.

    The origin is the LiDAR, so the robot stays in place and the world moves. Frustums, the occupancy grid
    and tracks without an object are hidden; the user can switch them on.

    Args:
        scene: names of the sensors.
        raw: show every raw point, coloured as ground or obstacle.
        frustums: show the frustum of each detection.
        why: show the explanation of ``bevviz why``.
        names: show the names of near objects.
        name: name of the view.
        root: entity that the run is logged under.
        beside: further contents of the view.
        by: quantity that colours the raw points; None: ground or obstacle.
        follow: entity that the eye goes to whenever it moves.
        above: look straight down, where the views of the scene go to a subject.
    """
    hidden = [entities.SET_ASIDE.path(scene.lidar)]
    # The coloured points of the clusters and the raw cloud already show the obstacles.
    hidden += [entities.GROUND.path(scene.lidar)] if scene.raw or why else []
    hidden += [entities.OBSTACLES.path(scene.lidar)] if raw and scene.raw else []
    clouds = [entities.POINTS.path(lidar) for lidar in scene.lidars or (scene.lidar,)]
    hidden += [] if raw else clouds
    hidden += [entities.GRID, entities.UNSEEN]
    hidden += [] if frustums else [entities.FRUSTUMS]
    # The explained points stand out by colours that differ in meaning from the colours of clusters.
    hidden += [entities.CLUSTERS.path(scene.lidar), entities.FRUSTUMS] if why else []
    hidden += [entities.CLUSTERS.path(scene.lidar), entities.FRUSTUMS] if by is not None else []
    name_entities = entities.NAMES.path(entities.FUSED), entities.NAMES.path(entities.FUSION)
    if why or not names:
        hidden += [
            *name_entities,
            *(entities.NAMES.path(entities.MARKED.path(state)) for state in MARK_COLORS),
        ]
    overrides: dict[Any, Any] = dict.fromkeys((root + path for path in hidden), HIDDEN)
    if by is not None:
        overrides |= {root + path: quantity_visualizer(by) for path in clouds}
    position, target = EYE, LOOK_TARGET
    # Without a target frame, contents outside of the origin's tree make the viewer use the fixed frame.
    target_frame = entities.space(root + entities.SENSOR.path(scene.lidar))
    away: list[str] = []
    if scene.moving:
        # The viewer draws no camera in a scaled frame.
        sensors = [
            entity.path(camera) for camera in scene.cameras for entity in (entities.SENSOR, entities.WHY_PART)
        ]
        away = [f"- {path}/**" for path in sensors]
        position, target = (_FROM_ABOVE if above else tuple(np.subtract(EYE, LOOK_TARGET))), (0.0, 0.0, 0.0)
        target_frame = frame_name(ABOVE if above else SPACE)
    elif why and scene.focus is not None:
        position, target = _eye_near(scene.focus), scene.focus
    return rrb.Spatial3DView(
        name=name if scene.raw else f"{name}, voxels (raw clouds now and then, or none)",
        origin=root + entities.SENSOR.path(scene.lidar),
        contents=[f"{root}{entities.WORLD}/**", *beside, *([f"{entities.WHY}/**"] if why else []), *away],
        background=_DARK,
        line_grid=False,
        spatial_information=rrb.SpatialInformation(target_frame=target_frame),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=position,
            look_target=target,
            eye_up=(1.0, 0.0, 0.0) if above else (0.0, 0.0, 1.0),
            tracking_entity=follow,
        ),
        overrides=overrides,
    )


def spaces(scene: Scene, **options: Any) -> rrb.Container | rrb.View:
    """Return the 3D view, with a further tab for each quantity that can colour the raw points."""
    first = space(scene, **options)
    if not scene.color_by:
        return first
    tabs = [
        space(scene, **options | {"raw": True, "name": by.capitalize(), "by": by}) for by in scene.color_by
    ]
    return rrb.Tabs(first, *tabs, name="3D")


def _eye_near(target: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return an eye position some metres from a target: on the robot's side, to the left and above.

    A large object, such as a truck, is seen whole from there.
    """
    x, y, z = target
    distance = max(math.hypot(x, y), 1e-6)
    offset = min(max(distance + 3.0, 12.0), 16.0)
    return (
        x - offset * x / distance - 4.0 * y / distance,
        y - offset * y / distance + 4.0 * x / distance,
        z + 7.0,
    )


def camera(scene: Scene, name: str, *, why: bool = False, weak: bool = False) -> rrb.Spatial2DView:
    """Return a view of a camera's image with its detections, projected points, and the robot's detections.

    Args:
        scene: names of the sensors.
        name: name of the camera.
        why: show the explanation of ``bevviz why`` instead of points and names.
        weak: show weak detections too.
    """
    contents = ["$origin/**", *([f"{entities.ROBOT.above}/**"] if scene.robot else [])]
    points_and_names = [entities.PROJECTED.path(name), entities.NAMES.path(entities.DETECTIONS.path(name))]
    names_of_marks = [entities.NAMES.path(entities.IMAGE_MARK.path(name, state)) for state in MARK_COLORS]
    hidden = [
        *([*points_and_names, *names_of_marks] if why else []),
        *([] if weak else [entities.WEAK.path(name)]),
    ]
    options: dict[str, Any] = {}
    if scene.moving:
        options["spatial_information"] = rrb.SpatialInformation(target_frame=frame_name(name))
        x_range, y_range = (0.0, IMAGE_WIDTH), (0.0, IMAGE_HEIGHT)
        options["visual_bounds"] = rrb.VisualBounds2D(x_range=x_range, y_range=y_range)
    return rrb.Spatial2DView(
        name=name,
        origin=entities.SENSOR.path(name),
        contents=[*contents, *([f"{entities.WHY_PART.path(name)}/**"] if why else [])],
        overrides=dict.fromkeys(hidden, HIDDEN),
        **options,
    )


def cameras(scene: Scene, *, why: bool = False, weak: bool = False) -> rrb.Container | rrb.View:
    """Return the views of all cameras, in tabs if there are more than two."""
    views = [camera(scene, name, why=why, weak=weak) for name in scene.cameras]
    if len(views) == 1:
        return views[0]
    return rrb.Tabs(*views, name="Cameras") if len(views) > 2 else rrb.Vertical(*views, name="Cameras")


def from_above(scene: Scene, beside: Sequence[str]) -> rrb.Container | rrb.View:
    """Return a view of the scene from above that goes to the subject, with the bird's-eye image in a tab."""
    robot = f"{entities.FOCUS.above}/**"
    view = space(scene, raw=False, names=False, name=FROM_ABOVE, beside=[*beside, robot], above=True)
    return rrb.Tabs(view, birds_eye(scene, name="Its image"))


def birds_eye(scene: Scene, root: str = "", name: str = "Bird's-eye view") -> rrb.Spatial2DView:
    """Return a view of the bird's-eye image with the outlines of ground truth and of the robot's boxes."""
    bev = root + entities.BEV
    channels = [
        f"- {root}{entities.CHANNEL.path(name)}/**"
        for name in ("density", "height", "intensity", "occupancy")
    ]
    bounds = None
    if scene.above is not None:
        left, top, right, bottom = scene.above
        bounds = rrb.VisualBounds2D(x_range=(left, right), y_range=(top, bottom))
    contents = ["$origin/**", *channels]
    return rrb.Spatial2DView(name=name, origin=bev, contents=contents, background=_DARK, visual_bounds=bounds)


def robots_birds_eye() -> rrb.Spatial2DView:
    """Return a view of the bird's-eye image that the robot publishes."""
    origin = entities.ROBOT.path("/visualization/bev_image")
    return rrb.Spatial2DView(name="The robot's", origin=origin, background=_DARK)


def explain(root: str = "", name: str = "Explain") -> rrb.TextDocumentView:
    """Return a view of the frame's decisions in words."""
    return rrb.TextDocumentView(name=name, origin=root + entities.EXPLAIN, contents=["$origin"])


def why() -> rrb.TextDocumentView:
    """Return a view of the answer of ``bevviz why``."""
    return rrb.TextDocumentView(name="Why", origin=entities.WHY, contents=["$origin"])


def report() -> rrb.TextDocumentView:
    """Return a view of the text of a bug report."""
    return rrb.TextDocumentView(name="Report", origin=entities.REPORT, contents=["$origin"])


def text_log(name: str, origin: str) -> rrb.TextLogView:
    """Return a view of a log with frame, time and text of each line."""
    columns = rrb.TextLogColumns(timeline_columns=[entities.FRAME, entities.STAMP], text_log_columns=["body"])
    return rrb.TextLogView(name=name, origin=origin, columns=columns)


def log() -> rrb.TextLogView:
    """Return a view of failures, problems and rejected detections of all frames."""
    return text_log("Log", entities.EXPLAIN_LOG)


def states() -> rrb.StateTimelineView:
    """Return a view of the states of the pipeline, the cameras and the best detection of each class."""
    return rrb.StateTimelineView(name="States", origin=entities.STATE.above)


def diagnostics() -> rrb.StateTimelineView:
    """Return a view of the levels in the robot's diagnostics over time."""
    return rrb.StateTimelineView(name="Diagnostics", origin=entities.DIAGNOSTIC.above)


def anomalies() -> rrb.StateTimelineView:
    """Return a view of anomalies by kind over time, with the state of the pipeline, which every run has."""
    contents = [entities.STATE.path("pipeline"), "$origin/**"]
    return rrb.StateTimelineView(name="Anomalies", origin=entities.ANOMALY_STATE.above, contents=contents)


def anomaly_log() -> rrb.TextLogView:
    """Return a view of a log with each anomaly's begin and numbers."""
    return text_log("Anomaly log", entities.ANOMALY_LOG)


def tracks() -> rrb.StateTimelineView:
    """Return a view of the tracks over time."""
    return rrb.StateTimelineView(name="Tracks", origin=entities.TRACK_STATE.above)


def speeds() -> rrb.TimeSeriesView:
    """Return a view of the tracks' speeds, in the same lanes as the tracks."""
    return rrb.TimeSeriesView(
        name="Speeds, m/s", origin=entities.TRACK_SPEEDS, plot_legend=rrb.PlotLegend(visible=False)
    )


def over_time() -> rrb.Tabs:
    """Return tabs with anomalies, decisions, tracks and speeds over time."""
    return rrb.Tabs(anomalies(), states(), tracks(), speeds(), name="Over time")


def plot(
    name: str, origin: str, contents: Sequence[str] = ("$origin/**",), *, linked: bool = False
) -> rrb.TimeSeriesView:
    """Return a plot over time with the legend inside. ``linked`` plots share their visible time range."""
    return rrb.TimeSeriesView(
        name=name,
        origin=origin,
        contents=contents,
        plot_legend=rrb.Corner2D.LeftTop,
        axis_x=LINKED if linked else None,
    )


def stage_times() -> rrb.TimeSeriesView:
    """Return a plot of the stage times."""
    return plot("Stage times, ms", entities.STAGE_TIME.path(""))


def clocks() -> rrb.TimeSeriesView:
    """Return a plot of the time between image and cloud, and of the age of transforms."""
    contents = [entities.SYNC_ERROR.path("**"), entities.TF_AGE.path("**")]
    return plot("Sync error and TF age, ms", entities.HEALTH, contents)


def counts() -> rrb.TimeSeriesView:
    """Return a plot of clusters, detections, matches and opinions, which are numbers of similar size."""
    return plot("Counts", entities.HEALTH, [entities.COUNT.path(name) for name in (*COUNTS, *OPINIONS)])


def rates() -> rrb.TimeSeriesView:
    """Return a plot of the rates."""
    return plot("Rates, Hz", entities.RATE.path(""))


def latencies() -> rrb.TimeSeriesView:
    """Return a plot of the latency from a cloud's arrival to the log call, and of the viewers' lag."""
    contents = [entities.LATENCY.path("**"), entities.VIEWER_LAG.path("**")]
    return plot("Latency and lag of viewers, ms", entities.HEALTH, contents)


def motion(scene: Scene) -> list[rrb.View]:
    """Return plots of IMU data; empty: there is no IMU."""
    if not scene.imu:
        return []
    return [
        plot("Rotation, rad/s", entities.ROTATION.above),
        plot("Acceleration, m/s²", entities.ACCELERATION.above),
    ]


def health() -> rrb.Tabs:
    """Return tabs of health plots. Side by side, their legends would hide the curves."""
    return rrb.Tabs(stage_times(), clocks(), counts(), rates(), name="Health")


def config() -> rrb.TextDocumentView:
    """Return a view of how the recording was made."""
    return rrb.TextDocumentView(name="Configuration", origin=entities.CONFIG)


def time_panel(
    *, play: rrb.components.PlayState | None = None, timeline: str = entities.STAMP
) -> rrb.TimePanel:
    """Return a collapsed time panel on sensor time."""
    return rrb.TimePanel(state="collapsed", timeline=timeline, play_state=play)


def panels() -> tuple[rrb.BlueprintPanel, rrb.SelectionPanel]:
    """Return collapsed blueprint and selection panels."""
    return rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed")
