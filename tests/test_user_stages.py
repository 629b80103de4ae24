"""Stages that are somebody else's function or the robot's topic: what they make, and what they do wrong."""

from __future__ import annotations

import logging
import re
import textwrap
import threading
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import Config, changes, config_yaml, load, parameters, plugins
from bevviz.config.project import named_code
from bevviz.config.trust import grant_trust
from bevviz.errors import StageError, UserError
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.messages.encode import (
    encode_boxes_2d,
    encode_boxes_3d,
    encode_camera_info,
    encode_cloud,
    encode_image,
    encode_transforms,
)
from bevviz.model.frame import Boxes3D, Camera, Frame, LabelledBoxes2D
from bevviz.model.geometry import inverse
from bevviz.model.results import ClusterState, DetectionState, FrameResult
from bevviz.pipeline.session import Session
from bevviz.stages import user_stages
from bevviz.stages.robot_results import detect
from bevviz.support import extensions
from tests.support import bags, kept_drives
from tests.support.modules import forget_modules
from tests.support.waiting import PATIENCE

MODULE = '''
"""Somebody's stages: nothing of bevviz is imported."""
import numpy as np
from pydantic import BaseModel, Field

__version__ = "1.2.3"
calls = []


class Params(BaseModel):
    height: float = Field(0.3, gt=0, description="metres above the lowest point")
    cell: float = Field(1.0, gt=0, description="metres: edge of a cell")
    score: float = 0.8


def ground(points, params):
    calls.append("ground")
    return points[:, 2] < np.median(points[:, 2]) + params.height


def cells(points, params):
    """A cluster is what is in one cell seen from above; cells with few points are noise."""
    calls.append("cells")
    cell = np.floor(points[:, :2] / params.cell).astype(np.int64)
    _, label, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    label = label.ravel()
    return np.where(count[label] < 5, -1, 100 + 7 * label)


def everything(points):
    points[:] = 0  # ours alone
    return np.zeros(len(points), np.int32)


class Detector:
    made = 0

    def __init__(self, params):
        Detector.made += 1
        self.score = params.score

    def __call__(self, bgr):
        height, width = bgr.shape[:2]
        box = [0.25 * width, 0.25 * height, 0.75 * width, 0.75 * height]
        return [[0, 0, 9, 9], box], [0.1, self.score], ["bird", "car"]


def pillars(points):
    assert points.shape[1] == 4
    return np.array([[10.0, 0, 0, 4, 2, 1.5, 0.3], [-500, 0, 0, 4, 2, 1.5, 0]]), [0.9, 0.4], ["car", "bus"]


def raising(points):
    return 1 // 0


def returns(value):
    return lambda points: value(points) if callable(value) else value


short = returns(lambda points: np.zeros(len(points) - 1, bool))
floats = returns(lambda points: np.zeros(len(points)))
below = returns(lambda points: np.full(len(points), -2))
nothing = returns(None)
half = returns(lambda points: ([[0, 0, 1, 1]], [0.5]))
ragged = returns(lambda points: ([[0, 0, 1]], [0.5], ["car"]))
nan = returns(lambda points: ([[0, 0, 1, np.nan]], [0.5], ["car"]))
names = returns(lambda points: ([[0, 0, 1, 1]], [0.5], ["car", "bus"]))
flat = returns(lambda points: ([[0, 0, 0, 1, 0, 1, 0]], [0.5], ["car"]))
swapped = returns(lambda image: ([[0, 0, 9, 9], [400, 300, 50, 40]], [0.5, 0.9], ["car", "car"]))
shares = returns(lambda image: ([[0.1, 0.2, 0.5, 0.6]], [0.5], ["car"]))
percent = returns(lambda array: ([[0, 0, 9, 9, 1, 1, 0][: 4 if array.ndim == 3 else 7]], [90], ["car"]))
number = 3
asked = []


def leaving(points):
    raise SystemExit(3)


def asking(points, params, stamp, number, sensor):
    asked.append((stamp, number, sensor))
    return cells(points, params)


class Asking(Detector):
    def __call__(self, bgr, *, sensor, stamp=None):
        asked.append((stamp, sensor))
        return super().__call__(bgr)
'''


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Run the test in a folder that contains a user's module."""
    package = tmp_path / "mine"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "stages.py").write_text(textwrap.dedent(MODULE))
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    forget_modules("mine", "broken")


@pytest.fixture(scope="module")
def frame() -> Frame:
    return kept_drives.frame()


def configured(*settings: str) -> Config:
    return load(settings=settings)


# --- what they make ----------------------------------------------------------------------------


def test_ground_and_clusters_of_the_user_are_used(here: Path, frame: Frame) -> None:
    config = configured("ground.method=mine.stages:ground", "clustering.method=mine.stages:cells")
    result = Session(config).run(frame)
    assert result.failures == ()
    assert result.voxels is not None and result.ground is not None and result.clusters is not None
    z = result.voxels.points[:, 2]
    np.testing.assert_array_equal(result.ground.mask, z < np.median(z) + 0.3)
    clusters, obstacles = result.clusters, result.obstacles
    assert obstacles is not None
    cell = np.floor(obstacles[:, :2])
    for k in range(0, len(clusters), 20):  # each is one cell, whole
        own = cell[clusters.labels == k]
        assert (own == own[0]).all()
        assert len(own) == clusters.count[k] == (cell == own[0]).all(axis=1).sum()
    assert clusters.labels.max() == len(clusters) - 1
    assert list(dict.fromkeys(clusters.labels[clusters.labels >= 0].tolist())) == list(range(len(clusters)))
    small = clusters.count < config.clustering.min_cluster_points
    assert (small == (clusters.state == ClusterState.TOO_SMALL)).all() and small.any() and not small.all()


def test_heights_are_measured_above_nearby_ground(frame: Frame) -> None:
    """On the drive's own ground, known exactly, they are close to what our own stage tells."""
    ours = Session(load()).run(frame)
    assert ours.voxels is not None and ours.ground is not None
    derived = user_stages.heights_above_ground(ours.voxels.points, ours.ground.mask)
    near = np.hypot(*ours.voxels.points[:, :2].T) < 30
    away = np.abs(derived - ours.ground.height)[near]
    assert np.median(away) < 0.05
    assert np.percentile(away, 95) < 0.25


@given(
    hnp.arrays(np.float32, st.tuples(st.integers(1, 50), st.just(3)), elements=st.floats(-300, 300, width=32))
)
def test_heights_are_finite_for_any_points(points: Any) -> None:
    everywhere = user_stages.heights_above_ground(points, np.ones(len(points), bool))
    assert np.isfinite(everywhere).all()
    lowest = user_stages.heights_above_ground(points, points[:, 2] == points[:, 2].min())
    assert (lowest >= -1e-3).all()
    assert np.isnan(user_stages.heights_above_ground(points, np.zeros(len(points), bool))).all()


def test_stages_cannot_change_the_points_of_a_frame(here: Path, frame: Frame) -> None:
    before = frame.points.copy()
    result = Session(configured("clustering.method=mine.stages:everything")).run(frame)
    assert result.clusters is not None and len(result.clusters) == 1
    assert result.obstacles is not None and np.abs(result.obstacles).max() > 1
    np.testing.assert_array_equal(frame.points, before)


def test_a_user_detector_is_built_once_and_fused(here: Path, frame: Frame) -> None:
    config = configured("detector.model=mine.stages:Detector", "detector.params.score=0.7")
    session = Session(config)
    for _ in range(2):
        result = session.run(frame)
    import mine.stages  # type: ignore[import-not-found]

    assert mine.stages.Detector.made == 1
    assert result.failures == ()
    (camera,) = result.cameras
    found = camera.detections
    assert found is not None and camera.fusion is not None
    assert found.names == ("car", "bird")
    np.testing.assert_allclose(found.score, [0.7, 0.1])
    assert found.state.tolist() == [DetectionState.KEPT, DetectionState.BELOW_THRESHOLD]
    assert [e.state for e in result.explanations if e.subject == "detection"][1] == "below_threshold"


def test_user_objects_have_the_clusters_in_their_boxes(here: Path, frame: Frame) -> None:
    result = Session(configured("objects.method=mine.stages:pillars")).run(frame)
    objects, clusters = result.objects, result.clusters
    assert result.failures == () and objects is not None and clusters is not None
    assert objects.names == ("car", "bus")
    np.testing.assert_allclose(objects.boxes.size[0], [4, 2, 1.5])
    assert objects.cluster[1] == -1
    if objects.cluster[0] >= 0:
        assert clusters.state[objects.cluster[0]] == ClusterState.KEPT
    car = clusters.centroid[int(np.flatnonzero(clusters.state == ClusterState.KEPT)[0])]
    box = Boxes3D(car[None], np.array([[5, 5, 5]], np.float32), np.zeros(1, np.float32))
    placed = user_stages.make_objects(box, ("car",), np.ones(1, np.float32), result.obstacles, clusters)
    inside = clusters.labels[(np.abs(result.obstacles - car) <= 2.5).all(axis=1)]
    kept = inside[(inside >= 0) & (clusters.state[inside] == ClusterState.KEPT)]
    assert placed.cluster[0] == np.bincount(kept).argmax()


def test_a_registered_name_is_a_stage(here: Path, frame: Frame, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a package's entry point in the group ``bevviz.stages`` does."""
    metadata = here / "mine-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[bevviz.stages]\ngrid = mine.stages:cells\n")
    (metadata / "top_level.txt").write_text("mine\n")
    monkeypatch.syspath_prepend(str(here))
    extensions.registered.cache_clear()
    try:
        config = configured("clustering.method=grid", "clustering.cell=2.0")
        assert config.clustering.method == "grid"
        assert config.clustering.params["cell"] == 2.0
        result = Session(config).run(frame)
        assert result.clusters is not None and len(result.clusters) > 3
        assert plugins.load_plugin("mine.stages:cells").version == "mine 1.0"
        with pytest.raises(UserError, match=r"polar, plane, grid \(registered\), module:function"):
            configured("ground.method=gird")
    finally:
        extensions.registered.cache_clear()


# --- parameters --------------------------------------------------------------------------------


def test_parameters_become_part_of_the_section(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    method = "clustering.method=mine.stages:cells"
    config = configured(method, "clustering.params.cell=2", "clustering.height=0.5")
    assert config.clustering.params == {"height": 0.5, "cell": 2.0, "score": 0.8}
    text = config_yaml(config)
    assert "  params:\n    height: 0.5  # metres above the lowest point\n" in text
    Path("c.yaml").write_text(text)
    monkeypatch.setenv("XDG_DATA_HOME", str(here / "data"))
    grant_trust(named_code(Path("c.yaml")))
    assert load("c.yaml") == config
    assert "clustering.params.cell" in parameters(config)
    assert {k: str(c) for k, c in changes(configured(method), config).items()} == {
        "clustering.params.height": "0.3 -> 0.5",
        "clustering.params.cell": "1.0 -> 2.0",
    }
    # Of another function, they mean nothing.
    assert load("c.yaml", ["clustering.method=dbscan"]).clustering.params == {}
    assert load("c.yaml", ["clustering.method=mine.stages:everything"]).clustering.params["cell"] == 1.0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            ["clustering.cell=-1"],
            "clustering.params.cell must be greater than 0 (given: -1); it is: metres: edge",
        ),
        (["clustering.cell=wide"], "clustering.params.cell must be a valid number"),
        (["clustering.cel=1"], "unknown key 'clustering.cel'; did you mean 'clustering.params.cell'?"),
        (["clustering.method=mine.stages:cell"], "module 'mine.stages' has no 'cell'; it has ground, cells"),
        (["clustering.method=mine.stagse:cells"], "there is no module 'mine.stagse' here"),
        (["clustering.method=mine.stages:number"], "'mine.stages:number' is a int, not a function"),
        (["clustering.method=mine stages:cells"], "'mine stages:cells' is no module:function"),
        (
            ["clustering.method=broken:cells"],
            "'broken' cannot be imported: ZeroDivisionError: division by zero (broken.py, line 2)",
        ),
        (["detector.model=none.onnx"], "detector.model none.onnx: no such file"),
    ],
)
def test_an_unusable_stage_is_one_line(here: Path, settings: list[str], message: str) -> None:
    (here / "broken.py").write_text("import sys\n1 / 0\n")
    with pytest.raises(UserError) as caught:
        Session(configured("clustering.method=mine.stages:cells", *settings))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


# --- what is wrong with what they return -------------------------------------------------------


@pytest.mark.parametrize(
    ("setting", "stage", "reason"),
    [
        (
            "clustering.method=mine.stages:raising",
            "clustering",
            "mine.stages:raising raised ZeroDivisionError: integer division or modulo by zero "
            "(stages.py, line 54)",
        ),
        ("clustering.method=mine.stages:leaving", "clustering", "leaving raised SystemExit: 3 (stages.py"),
        ("detector.model=mine.stages:swapped", "detector", "returned 1 of 2 boxes with swapped corners (400"),
        ("detector.model=mine.stages:shares", "detector", "corners are pixels, not shares of the image"),
        ("detector.model=mine.stages:percent", "detector", "a score of 90: scores are from 0 to 1"),
        ("objects.method=mine.stages:percent", "objects", "a score of 90: scores are from 0 to 1"),
        ("clustering.method=mine.stages:short", "clustering", "returned labels of shape ("),
        (
            "clustering.method=mine.stages:floats",
            "clustering",
            "returned labels of type float64, not integers",
        ),
        ("clustering.method=mine.stages:below", "clustering", "returned label -2: -1 is noise"),
        ("clustering.method=mine.stages:nothing", "clustering", "returned labels of shape ()"),
        ("ground.method=mine.stages:short", "ground", "mine.stages:short returned a mask of shape ("),
        ("ground.method=mine.stages:floats", "ground", "returned a mask of type float64, not bool"),
        ("detector.model=mine.stages:half", "detector", "returned 2 values, not xyxy, score and class names"),
        ("detector.model=mine.stages:nothing", "detector", "returned a NoneType, not xyxy"),
        (
            "detector.model=mine.stages:ragged",
            "detector",
            "returned boxes xyxy of shape (1, 3), not (any, 4)",
        ),
        ("detector.model=mine.stages:nan", "detector", "returned boxes xyxy with 1 NaN and 0 inf"),
        ("detector.model=mine.stages:names", "detector", "returned 2 class names for 1 boxes"),
        ("objects.method=mine.stages:flat", "objects", "returned a box without a volume"),
        ("objects.method=mine.stages:raising", "objects", "ZeroDivisionError"),
    ],
)
def test_a_wrong_stage_result_is_a_reason_and_the_frame_goes_on(
    here: Path, frame: Frame, setting: str, stage: str, reason: str
) -> None:
    result = Session(configured(setting)).run(frame)
    (failure,) = result.failures
    assert failure.stage == stage
    assert reason in failure.reason
    assert "\n" not in failure.reason
    assert result.bev is not None
    assert ("Traceback" in failure.traceback) == ("raised" in reason or "ZeroDivision" in reason)


def test_stages_get_the_facts_that_they_ask_for(here: Path, frame: Frame) -> None:
    session = Session(configured("clustering.method=mine.stages:asking", "detector.model=mine.stages:Asking"))
    assert session.run(frame).failures == ()
    import mine.stages

    assert set(mine.stages.asked) == {(frame.stamp, frame.index, "rslidar"), (frame.stamp, "zed")}


def test_the_traceback_goes_to_logging(here: Path, frame: Frame, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "bevviz"):
        Session(configured("clustering.method=mine.stages:raising")).run(frame)
    (record,) = caplog.records
    assert "stage clustering failed" in record.getMessage()
    assert record.exc_info is not None and record.exc_info[0] is ZeroDivisionError
    assert "return 1 // 0" in caplog.text


# --- one configuration for a frame -------------------------------------------------------------


def test_a_change_from_another_thread_meets_the_next_frame(here: Path, frame: Frame) -> None:
    """While a frame is in a stage another configuration comes: the frame keeps that which it began with."""
    (here / "mine" / "slow.py").write_text(
        "import numpy as np, threading\n"
        "inside, go = threading.Event(), threading.Event()\n"
        "def cluster(points):\n    inside.set()\n    assert go.wait(180)\n"
        "    return np.zeros(len(points), int)\n"
    )
    first = load(settings=["clustering.method=mine.slow:cluster", "detector.model=demo"])
    second = load(settings=["detector.model=demo"], preset="reference")
    session = Session(first)
    import mine.slow  # type: ignore[import-not-found]

    results: list[FrameResult] = []
    thread = threading.Thread(target=lambda: results.append(session.run(frame)))
    thread.start()
    assert mine.slow.inside.wait(PATIENCE)
    assert "clustering.method" in session.configure(second)
    mine.slow.go.set()
    thread.join()
    (result,) = results
    assert result.config is first
    alone = Session(first).run(frame)
    assert result.explanations == alone.explanations
    assert result.bev is not None and alone.bev is not None
    np.testing.assert_array_equal(result.bev.image, alone.bev.image)
    assert result.tracks is not None
    assert session.run(frame).config is second


# --- the robot's own stages --------------------------------------------------------------------


def robot_drive(folder: Path, scans: int = 3) -> Path:
    """Write a drive whose robot publishes the results of our own stages. Its clusters use the LiDAR alone."""
    drive = SyntheticSource(frames=scans, seed=3)
    config = load(settings=["detector.model=demo", "fusion.split=false"])
    session = Session(config)
    items = []
    for frame in drive:
        result = session.run(frame)
        assert result.clusters is not None and result.objects is not None and result.obstacles is not None
        clusters, objects = result.clusters, result.objects
        kept = np.flatnonzero(clusters.state == ClusterState.KEPT)
        cloud, camera = frame.clouds[0], frame.cameras[0]
        image, detections = camera.image, result.cameras[0].detections
        assert image is not None and camera.intrinsics is not None and detections is not None
        assert camera.mounting is not None
        sure = np.flatnonzero(detections.state == DetectionState.KEPT)
        boxes = Boxes3D(clusters.obb.center[kept], clusters.obb.size[kept], clusters.obb.yaw[kept])
        name, stamp, late = frame.points_frame, frame.stamp, frame.received + 5_000_000
        box3, box2 = "vision_msgs/msg/Detection3DArray", "vision_msgs/msg/Detection2DArray"
        points, info = "sensor_msgs/msg/PointCloud2", encode_camera_info(image, camera.intrinsics)
        numbered = [[(f"cluster_{k}", 1.0)] for k in kept]
        found = [[(detections.names[d], float(detections.score[d]))] for d in sure]
        named = [[(n, float(s))] for n, s in zip(objects.names, objects.score, strict=True)]
        obstacles = replace(cloud, xyz=result.obstacles, fields={})
        mounting = encode_transforms(stamp, [(name, image.frame_id, inverse(camera.mounting))])
        messages = [
            ("/points", points, encode_cloud(cloud)),
            ("/camera/image_raw", "sensor_msgs/msg/Image", encode_image(image)),
            ("/camera/camera_info", "sensor_msgs/msg/CameraInfo", info),
            ("/robot/clusters", box3, encode_boxes_3d(stamp, name, boxes, numbered)),
            ("/robot/detections", box2, encode_boxes_2d(stamp, image.frame_id, detections.xyxy[sure], found)),
            ("/robot/objects", box3, encode_boxes_3d(stamp, name, objects.boxes, named)),
            ("/robot/obstacles", points, encode_cloud(obstacles)),
            ("/tf_static", "tf2_msgs/msg/TFMessage", mounting),
        ]
        items += [bags.Item(topic, kind, late, message) for topic, kind, message in messages]
    return bags.write(folder / "robot", items)


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return robot_drive(tmp_path_factory.mktemp("robot"))


def results_of(bag: Path, *settings: str) -> list[FrameResult]:
    config = load(settings=settings)
    with BagSource([bag], config) as source:
        session = Session(config)
        return [session.run(frame) for frame in source]


@pytest.mark.long
def test_topics_of_the_robot_replace_stages(robot: Path) -> None:
    ours = results_of(robot, "detector.model=demo", "fusion.split=false")
    taken = results_of(
        robot,
        "ground.method=topic:/robot/obstacles",
        "clustering.method=topic:/robot/clusters",
        "detector.model=topic:/robot/detections",
    )
    assert len(taken) == len(ours) == 3
    for mine, theirs in zip(ours, taken, strict=True):
        assert theirs.failures == ()
        assert mine.ground is not None and theirs.ground is not None
        same = mine.ground.mask == theirs.ground.mask
        assert same.mean() > 0.93, "ground within a voxel's reach of an obstacle is taken for one"
        assert mine.clusters is not None and theirs.clusters is not None
        kept = np.flatnonzero(mine.clusters.state == ClusterState.KEPT)
        np.testing.assert_allclose(theirs.clusters.obb.center, mine.clusters.obb.center[kept], atol=1e-4)
        share = theirs.clusters.count / mine.clusters.count[kept]
        assert np.median(share) > 0.9, "points that their boxes share go to one of them"
        a, b = mine.cameras[0].detections, theirs.cameras[0].detections
        assert a is not None and b is not None
        np.testing.assert_allclose(b.xyxy, a.xyxy[a.state == DetectionState.KEPT], atol=1e-3)
        assert mine.objects is not None and theirs.objects is not None
        both = Counter(theirs.objects.names) & Counter(mine.objects.names)
        assert both.total() >= 0.85 * max(len(theirs.objects), len(mine.objects))


def test_image_boxes_of_an_unknown_camera_go_to_no_camera() -> None:
    boxes = np.array([[1, 2, 3, 4]], np.float32)
    found = LabelledBoxes2D("/boxes", 0, "yolo", boxes, ("car",), np.ones(1, np.float32))
    front, rear = (Camera(name, None, None, None, None) for name in ("front", "rear"))
    alone = Frame(
        0, 0, 0, "l", np.zeros((0, 3), np.float32), "l", cameras=(front,), robot_detections=(found,)
    )
    assert detect(alone, front, "/boxes").names == ("car",)
    for camera in (front, rear):
        with pytest.raises(StageError, match=r"/boxes does not say which camera .* the frame 'yolo'"):
            detect(replace(alone, cameras=(front, rear)), camera, "/boxes")


@pytest.mark.long
def test_a_topic_of_the_robot_replaces_objects(robot: Path) -> None:
    ours = results_of(robot, "detector.model=demo", "fusion.split=false")
    taken = results_of(robot, "objects.method=topic:/robot/objects")
    for mine, theirs in zip(ours, taken, strict=True):
        assert theirs.objects is not None and mine.objects is not None
        assert theirs.objects.names == mine.objects.names
        same = theirs.objects.cluster == mine.objects.cluster
        assert same.mean() > 0.9, "a box may hold more points of its neighbour than of its own cluster"
    with pytest.raises(
        UserError, match=r"clustering.method: there is no topic /robot/cluster; the nearest are"
    ):
        results_of(robot, "clustering.method=topic:/robot/cluster")
    with pytest.raises(
        UserError, match=r"/robot/objects is a .*Detection3DArray, but must be Detection2DArray"
    ):
        results_of(robot, "detector.model=topic:/robot/objects")


def test_a_scan_without_robot_results_is_a_reason(frame: Frame) -> None:
    result = Session(load(settings=["clustering.method=topic:/clusters"])).run(frame)
    (failure,) = result.failures
    assert failure.reason == "the robot published no boxes on /clusters at the time of this scan"
    with pytest.raises(StageError, match="no detections on /d"):
        from bevviz.stages import robot_results as published

        published.detect(frame, frame.cameras[0], "/d")


# --- as a user runs it -------------------------------------------------------------------------


@pytest.mark.long
def test_a_whole_run_uses_user_stages(here: Path, robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive, own = str(robot), ["--set", "clustering.method=mine.stages:cells"]
    assert main(["bag", drive, *own, "--save", "x.rrd"]) == 0
    assert main(["sweep", drive, *own, "--set", "clustering.cell=0.5:1.5:0.5"]) == 0
    table = capsys.readouterr().out
    assert [line.split()[0] for line in table.splitlines()[3:6]] == ["0.5", "1", "1.5"]
    counts = [float(line.split()[1]) for line in table.splitlines()[3:6]]
    assert len(set(counts)) > 1, "the parameter arrives"
    assert main(["compare", drive, *own, "--set-b", "clustering.cell=3", "--save", "c.rrd"]) == 0
    assert "clustering.params.cell  1.0 -> 3.0" in capsys.readouterr().out
    assert main(["why", drive, *own, "--at", "0.1", "--point=1,1,0"]) == 0
    assert main(["bag", drive, "--set", "clustering.method=mine.stages:raising", "--save", "y.rrd"]) == 0
    assert main(["report", drive, *own, "--at", "0.1", "-o", "bug.rrd"]) == 0
    trusted = ["--set", "clustering.method=mine.stages:cells"]
    capsys.readouterr()
    assert main(["report", "--check", "bug.rrd"]) == 2  # somebody else's report may name any code
    assert f"if you trust it, add {' '.join(trusted)}" in capsys.readouterr().err
    assert main(["report", "--check", "bug.rrd", *trusted]) == 0
    module = here / "mine" / "stages.py"
    source = module.read_text()
    module.write_text(source + "# another\n")
    capsys.readouterr()
    assert main(["report", "--check", "bug.rrd", *trusted]) == 0
    assert re.search(
        r"not as it was: clustering\.method was mine\.stages:cells \(SHA-256 \w{64}\), is",
        capsys.readouterr().out,
    )
    module.write_text(source)
    raising = ["--set", "clustering.method=mine.stages:raising"]
    assert main(["report", drive, *raising, "--at", "0.1", "-o", "failed.rrd"]) == 0
    text = (here / "failed.html").read_text()
    assert "Traceback of stage &#39;clustering&#39;" in text and "in raising" in text
    assert str(here) not in text, "no folder of the machine"
    assert main(["config", *own]) == 0
    assert "cell: 1.0  # metres: edge of a cell" in capsys.readouterr().out
