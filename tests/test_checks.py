"""Checks of the input: every command shows one list."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import bevviz
from bevviz.checks import InputChecks
from bevviz.checks.extrinsics import candidates
from bevviz.cli import main
from bevviz.config import load
from bevviz.datasets.kitti_labels import named_rows
from bevviz.model import geometry
from bevviz.model.box_points import inside_each
from bevviz.model.frame import F32, F64, Boxes3D
from bevviz.model.input_findings import InputFinding, Remedy
from bevviz.model.results import Detections, FrameResult
from tests.support.small_bags import frozen_after


def test_a_run_names_the_sensor_and_its_fault(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """``bag``, ``info`` and Python say the same sentence."""
    path = frozen_after(2.0, tmp_path / "drive")
    sentence = "camera camera: frozen image since 2.0 s"
    assert main(["bag", str(path), "--save", str(tmp_path / "drive.rrd")]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert f"bevviz: warning: {sentence}" in lines
    assert "bevviz: anomalies: 1 sensor (camera camera: frozen image at 2.0 s)" in lines
    with bevviz.open(path) as drive:
        assert sentence not in drive.warnings
        list(drive)
        assert drive.warnings.count(sentence) == 1
        (finding,) = [finding for finding in drive.checks.findings if str(finding) == sentence]
    assert (finding.kind, finding.subject) == ("sensor", "camera camera: frozen image")


@pytest.mark.long
@pytest.mark.parametrize(
    "command",
    [
        "compare --set-b clustering.eps=0.7 --save OUT/compared.rrd",
        "sweep --set clustering.eps=0.5,0.7",
        "export --output OUT/exported",
    ],
)
def test_tables_name_the_fault_of_a_sensor_once(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = frozen_after(2.0, tmp_path / "drive")
    name, *words = command.replace("OUT", str(tmp_path)).split()
    main([name, str(path), *words])
    printed = capsys.readouterr().err
    assert printed.count("bevviz: warning: camera camera: frozen image since 2.0 s") == 1, printed


def test_a_finding_reads_as_one_sentence() -> None:
    assert str(InputFinding("clock", "/scan", "/scan is 0.5 s late")) == "/scan is 0.5 s late"
    remedy = Remedy("sync.offsets={/scan: -0.5}", tried="pairs 50 of 50 frames")
    assert str(InputFinding("clock", "/scan", "/scan is 0.5 s late", remedy)) == (
        "/scan is 0.5 s late: sync.offsets={/scan: -0.5} (pairs 50 of 50 frames)"
    )


# --- extrinsics --------------------------------------------------------------------------------

OPTICAL = geometry.transform([0, 0, 0], [-0.5, 0.5, -0.5, 0.5])  # body from optical axes


@pytest.fixture(scope="module")
def results() -> list[FrameResult]:
    with bevviz.simulate(60) as drive:
        return [drive[number] for number in range(0, 60, 12)]


def turned(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> F64:
    """Return the (4, 4) rotation by degrees about x, then y, then z."""
    matrix = np.eye(4)
    for axis, angle in enumerate((x, y, z)):
        matrix[:3, :3] = geometry.rotations(axis, np.radians([angle]))[0] @ matrix[:3, :3]
    return matrix


def scaled(pose: F64, factor: float) -> F64:
    pose = pose.copy()
    pose[:3, 3] *= factor
    return pose


def read_in_order(pose: F64) -> F64:
    """Return a pose whose quaternion x, y, z, w is read as w, x, y, z."""
    return geometry.transform_wxyz(pose[:3, 3], geometry.quaternion(pose))


def placed(result: FrameResult, camera_from_points: F64) -> FrameResult:
    """Return the result with another stated pose of its camera."""
    (camera,) = result.cameras
    stated = replace(camera.camera, camera_from_points=camera_from_points, mounting=camera_from_points)
    return replace(result, cameras=(replace(camera, camera=stated),))


def judged(results: list[FrameResult], pose: F64, *, detector: bool = True) -> list[InputFinding]:
    """Return the findings about a camera that is stated at this (4, 4) points_from_camera."""
    with bevviz.simulate(1) as drive:
        checks = InputChecks(drive.frames, drive.config)
    for result in results:
        wrong = placed(result, geometry.inverse(pose))
        if detector:
            checks.observe(wrong)
        else:
            frame = replace(wrong.frame, cameras=tuple(camera.camera for camera in wrong.cameras))
            checks.observe_frame(frame, follows=False)
    return [finding for finding in checks.findings if finding.kind == "calibration"]


def proposed(finding: InputFinding) -> F64:
    """Return the (4, 4) pose that a remedy states."""
    assert finding.remedy is not None
    (setting,) = finding.remedy.settings
    values = [float(value) for value in setting.partition("[")[2].rstrip("]}").split(",")]
    return geometry.transform(values[:3], values[3:])


MISTAKES: dict[str, Callable[[F64], F64]] = {
    "the inverse of the stated pose": geometry.inverse,
    "optical axes (z ahead) instead": lambda right: right @ geometry.inverse(OPTICAL),
    "turned by 180 degrees about the optical axis": lambda right: right @ turned(z=180),
    "divided by 100": lambda right: scaled(right, 100),
    "the inverse, and the translation divided by 100": lambda right: scaled(geometry.inverse(right), 100),
    "the LiDAR's axes turned by": lambda right: turned(z=90) @ right,
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_wrong_extrinsic_is_named_with_the_pose_that_would_do(
    results: list[FrameResult], name: str
) -> None:
    camera = results[0].cameras[0].camera
    assert camera.camera_from_points is not None
    right = geometry.inverse(camera.camera_from_points if camera.mounting is None else camera.mounting)
    stated = MISTAKES[name](right)
    (finding,) = judged(results, stated)
    assert finding.subject == camera.name and finding.remedy is not None
    assert name in finding.remedy.text and finding.remedy.tried
    difference = geometry.inverse(proposed(finding)) @ right
    assert np.linalg.norm(difference[:3, 3]) < 0.25
    assert np.trace(difference[:3, :3]) > 1 + 2 * np.cos(np.radians(3))


def test_a_quaternion_in_another_order_is_tried() -> None:
    """Both orders, of the pose and of its inverse."""
    right = turned(10, 40, 70) @ geometry.transform([0.1, 0.2, 0.3], [0, 0, 0, 1])
    x, y, z, w = geometry.quaternion(right)
    for pose in (geometry.transform(right[:3, 3], (w, x, y, z)), read_in_order(right)):
        assert any(np.allclose(other, right, atol=1e-6) for _, other in candidates(pose, {}))
        inverse = geometry.inverse(right)
        assert any(
            np.allclose(other, inverse, atol=1e-6) for _, other in candidates(geometry.inverse(pose), {})
        )


def test_a_right_extrinsic_is_not_doubted(results: list[FrameResult]) -> None:
    camera = results[0].cameras[0].camera
    assert camera.camera_from_points is not None
    right = geometry.inverse(camera.camera_from_points)
    for pose in (right, right @ turned(x=3), right @ turned(z=4)):
        assert not judged(results, pose)
        assert not judged(results, pose, detector=False)


def test_the_vertical_tells_of_a_wrong_extrinsic(results: list[FrameResult]) -> None:
    camera = results[0].cameras[0].camera
    assert camera.camera_from_points is not None
    right = geometry.inverse(camera.camera_from_points)
    (inverse,) = judged(results, geometry.inverse(right), detector=False)
    assert "down axis of its image points" in inverse.text
    assert np.allclose(proposed(inverse), right, atol=1e-3)
    (body,) = judged(results, right @ geometry.inverse(OPTICAL), detector=False)
    assert "optical axes" in str(body) and np.allclose(proposed(body)[:3, :3], right[:3, :3], atol=0.05)


@pytest.fixture
def folder(shared: Path, tmp_path: Path) -> Path:
    """Write a plain folder of KITTI's drive whose calibration is stated as its inverse."""
    rows = named_rows(shared / "kitti_drive" / "calib.txt")
    rect, velo, shift = np.eye(4), np.eye(4), np.eye(4)
    rect[:3, :3], velo[:3] = np.reshape(rows["R0_rect"], (3, 3)), np.reshape(rows["Tr_velo_to_cam"], (3, 4))
    projection = np.reshape(rows["P2"], (3, 4))
    shift[:3, 3] = np.linalg.inv(projection[:, :3]) @ projection[:, 3]
    pose = shift @ rect @ velo  # camera from LiDAR
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "lidar").symlink_to(shared / "kitti_drive" / "velodyne")
    (tmp_path / "drive" / "camera").symlink_to(shared / "kitti_drive" / "image_2")
    stated = [*pose[:3, 3].tolist(), *geometry.quaternion(pose).tolist()]
    camera = {"pose": stated, "K": projection[:, :3].ravel().tolist()}
    lidar = {"pose": [0, 0, 0, 0, 0, 0, 1]}
    text = json.dumps({"lidars": {"lidar": lidar}, "cameras": {"camera": camera}})
    (tmp_path / "drive" / "calibration.yaml").write_text(text)
    return tmp_path / "drive"


@pytest.mark.long
def test_the_remedy_for_a_wrong_extrinsic_works(
    folder: Path, shared: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every command says it, and the setting gives the objects of the right pose."""
    model = str(shared / "models" / "yolox_nano.onnx")
    with bevviz.open(folder, model=model, every=6) as drive:
        assert sum(len(result.objects.names) for result in drive if result.objects is not None) < 5
        (finding,) = [finding for finding in drive.checks.findings if finding.kind == "calibration"]
    assert finding.remedy is not None
    assert "the inverse of the stated pose would do" in finding.remedy.text
    with bevviz.open(folder, model=model, every=6, set=list(finding.remedy.settings)) as drive:
        count = sum(len(result.objects.names) for result in drive if result.objects is not None)
        assert count >= 27
        assert not [finding for finding in drive.checks.findings if finding.kind == "calibration"]
    for command in (
        ["info", str(folder), "--model", model],
        ["why", str(folder), "--at-frame", "3", "--limit", "1", "--model", model],
        ["calib", str(folder), "--frames", "0:2", "--every", "1"],
    ):
        main(command)
        output = capsys.readouterr()
        assert "the inverse of the stated pose" in " ".join((output.out + output.err).split()), command


# --- the detector ------------------------------------------------------------------------------


def test_a_detector_without_any_candidate_is_named(results: list[FrameResult]) -> None:
    config = load(settings=["detector.model=forklift.onnx"])
    with bevviz.simulate(1) as drive:
        checks = InputChecks(drive.frames, config)
        empty = [
            replace(
                result, config=config, cameras=(replace(result.cameras[0], detections=Detections.empty()),)
            )
            for result in results
        ]
        for result in empty[:4]:
            checks.observe(result)
        assert not checks.findings, "four images tell little"
        checks.observe(empty[4])
        (finding,) = checks.findings
        assert (finding.kind, finding.subject) == ("detector", "forklift.onnx")
        assert "no candidate with a score of 0.01 or more in 5 of 5 images" in str(finding)
        checks.observe(replace(results[0], config=config))
        assert not [finding for finding in checks.findings if finding.kind == "detector"]


def of_boxes(detections: Detections, boxes: F32, name: str = "") -> Detections:
    names = (name,) * len(detections) if name else detections.names
    return replace(detections, xyxy=boxes.astype(np.float32), names=names)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda d: of_boxes(d, d.xyxy / 640), "are smaller than two pixels: publish pixels"),
        (lambda d: of_boxes(d, d.xyxy * 3), "reach far out of the image: publish pixels of the image"),
        (lambda d: of_boxes(d, d.xyxy, "2"), "have a number for a class"),
    ],
)
def test_boxes_that_do_not_fit_the_images_are_named(
    results: list[FrameResult], change: Callable[[Detections], Detections], text: str
) -> None:
    with bevviz.simulate(1) as drive:
        checks = InputChecks(drive.frames, load(settings=["detector.model=topic:/detections"]))
        for result in results:
            camera = result.cameras[0]
            assert camera.detections is not None
            checks.observe(replace(result, cameras=(replace(camera, detections=change(camera.detections)),)))
    assert any(text in str(finding) for finding in checks.findings if finding.kind == "detector")


TOPICS = ("ground truth", "/results/net")


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            lambda b: replace(b, center=b.center + np.array([0, 0, 3], np.float32)),
            "boxes within 20 m hold no point of the LiDAR: check their frame",
        ),
        (
            lambda b: replace(b, center=b.center - b.size * np.array([0, 0, 0.5], np.float32)),
            "boxes have the upper half of their object above them: their z is the bottom",
        ),
        (
            lambda b: replace(b, size=b.size[:, [1, 0, 2]]),
            "long boxes hold more points if they are turned by 90 degrees: swap",
        ),
    ],
)
def test_boxes_of_another_convention_are_named(
    results: list[FrameResult], change: Callable[[Boxes3D], Boxes3D], text: str
) -> None:
    """Ground truth, and the same boxes in a result file. Three labels of a frame tell, three results not."""
    assert results[0].frame.truth is not None
    boxes = results[0].frame.truth.boxes
    held = np.array([len(rows) for _, rows in inside_each(results[0].frame.points, boxes)])
    is_judged = (boxes.size[:, 0] > 1.5 * boxes.size[:, 1]) & (boxes.distance < 17)
    few = boxes.chosen(np.argsort(-np.where(is_judged, held, 0))[:3])
    every = [result.frame.truth.boxes for result in results if result.frame.truth is not None]
    one = few.chosen([0])
    for chosen, topics in (
        (every, TOPICS),
        ([few], TOPICS[:1]),
        ([few.chosen([0, 1])], ()),
        ([one, one, one], ()),
    ):
        with bevviz.simulate(1) as drive:
            checks = InputChecks(drive.frames, drive.config)
        for result, boxes in zip(results, chosen, strict=False):
            assert result.frame.truth is not None
            truth = replace(result.frame.truth, boxes=change(boxes))
            results_file = replace(truth, topic=TOPICS[1])
            frame = replace(result.frame, truth=truth, robot_boxes=(results_file,))
            checks.observe(replace(result, frame=frame))
        said = [str(finding) for finding in checks.findings if finding.kind == "truth"]
        assert [text in sentence for sentence in said] == [True] * len(topics)
        assert tuple(sentence.partition(": ")[0] for sentence in said) == topics


@pytest.mark.long
@pytest.mark.parametrize("name", ["kitti", "kitti_more", "sus"])
def test_real_labels_are_left_alone(shared: Path, name: str) -> None:
    with bevviz.open(shared / name) as drive:
        checks = InputChecks(drive.frames, drive.config)
        for frame in checks.watched(drive.frames):
            assert frame.truth is not None
    assert not [finding for finding in checks.findings if finding.kind == "truth"]


def test_a_right_drive_has_no_finding(results: list[FrameResult]) -> None:
    with bevviz.simulate(1) as drive:
        checks = InputChecks(drive.frames, drive.config)
        for result in results:
            checks.observe(result)
    assert not checks.findings
