"""Calibration: planted errors are found, good ones are left alone, and what cannot be told is not told."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.calib import Drive
from bevviz import geometry
from bevviz.bags.source import BagSource
from bevviz.calib import AXES, Calibration, Finding, calibrate, gather
from bevviz.calib.axes import SCALES, TIME, error_pose
from bevviz.calib.edges import cloud_edges
from bevviz.calib.score import Scorer
from bevviz.cli import main
from bevviz.config import Config, load
from bevviz.errors import UserError
from bevviz.frame import F64, Cloud, Frame
from bevviz.synthetic import SyntheticSource, write_bag
from bevviz.synthetic.drive import PERIOD, START
from tests import bags
from tests.recordings import Recording, verify

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def drive() -> Drive:
    """Ten frames, nearly a second apart, of a drive that swerves."""
    return Drive(80, 0, weave=True, every=8)


def offsets(**given: float) -> F64:
    """In units of the axes."""
    values: F64 = np.array([given.get(axis.name, 0.0) for axis in AXES]) / SCALES
    return values


def found(result: Calibration) -> dict[str, float]:
    return {axis.axis.name: axis.offset for axis in result.axes}


def findings(result: Calibration) -> dict[str, str]:
    return {axis.axis.name: str(axis.finding) for axis in result.axes}


# --- planted errors ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "planted", [{}, {"rx": 1.0, "dt": 40.0}, {"rz": -1.0, "tx": 5.0, "tz": 8.0}], ids=str
)
def test_what_was_planted_is_found(drive: Drive, planted: dict[str, float]) -> None:
    result = drive.calibrate(offsets(**planted))
    for axis in result.axes:
        near = {"deg": 0.2, "cm": 2.0, "ms": 10.0}[axis.axis.unit]
        assert axis.offset == pytest.approx(planted.get(axis.axis.name, 0.0), abs=near)
    assert {axis.axis.name for axis in result.by(Finding.OFF)} == set(planted)
    assert result.score_corrected >= result.score_stated


def test_the_correction_undoes_the_error(drive: Drive) -> None:
    result = drive.calibrate(offsets(ry=1.0))
    true = geometry.inverse(drive.source.base_from_lidar) @ drive.source.base_from_camera
    left = geometry.inverse(true) @ result.corrected
    assert np.degrees(np.arccos((np.trace(left[:3, :3]) - 1) / 2)) < 0.1
    assert np.allclose(result.corrected[:3, 3], true[:3, 3], atol=0.01)
    (pose,) = load(
        None, [f"source.extrinsics={{{result.config.splitlines()[2]}}}"]
    ).source.extrinsics.values()
    assert np.allclose(
        geometry.transform(np.array(pose[:3]), np.array(pose[3:])), result.corrected, atol=1e-5
    )


def test_the_gradient_is_that_of_the_score(drive: Drive) -> None:
    shots = []
    for shot in gather(drive.planted(offsets(ry=0.1)), ["zed"], drive.pose)["zed"].shots[:2]:
        uv, _ = geometry.project(
            geometry.apply(shot.camera_from_points(0.0), shot.xyz), drive.source.intrinsics
        )
        inner = (np.abs(uv - (320, 180)) < (300, 160)).all(axis=1)  # at the rim, edges come and go
        parts = (array[inner] for array in (shot.xyz, shot.across, shot.group))
        shots.append(replace(shot, **dict(zip(("xyz", "across", "group"), parts, strict=True))))
    scorer = Scorer(shots, 4.0)
    step = np.array([1e-5] * 3 + [1e-4] * 3 + [1e-4])
    slope = [
        (scorer(row).score.sum() - scorer(-row).score.sum()) / (2 * size)
        for row, size in zip(np.diag(step), step, strict=True)
    ]
    gradient = scorer(np.zeros(7)).gradient.sum(0)
    assert np.allclose(gradient, slope, rtol=0.05, atol=0.03 * np.abs(slope).max())


# --- the drive carries what is planted ---------------------------------------------------------


def test_stated_mounting_and_stamps_are_wrong_in_frames_and_bag(tmp_path: Path) -> None:
    error = error_pose(offsets(ry=1.0))
    right = SyntheticSource(2, 3, weave=True)
    wrong = SyntheticSource(2, 3, weave=True, plant=["turned_camera"])
    late = SyntheticSource(2, 3, weave=True, plant=["late_image"])
    frames = [next(iter(source)) for source in (right, wrong, late)]
    pictures = [frame.cameras[0].image for frame in frames]
    assert pictures[0] is not None and pictures[1] is not None and pictures[2] is not None
    assert np.array_equal(pictures[0].bgr, pictures[1].bgr)
    assert pictures[2].stamp == pictures[0].stamp
    assert not np.array_equal(pictures[0].bgr, pictures[2].bgr)
    write_bag(wrong, tmp_path / "wrong.mcap", [frames[1]])
    with BagSource([tmp_path / "wrong.mcap"], Config()) as source:
        (read,) = source
    for frame in (frames[1], read):
        true, stated = frames[0].cameras[0].camera_from_points, frame.cameras[0].camera_from_points
        assert true is not None and stated is not None
        assert np.allclose(true, error @ stated, atol=1e-3)


def test_the_default_drive_does_not_weave() -> None:
    plain, weaving = SyntheticSource(2, 0), SyntheticSource(2, 0, weave=True)
    assert not np.allclose(plain.map_from_base(START + PERIOD), weaving.map_from_base(START + PERIOD))


# --- KITTI -------------------------------------------------------------------------------------


def test_kitti_is_near_zero(shared: Path, tmp_path: Path) -> None:
    """Two frames, no motion: the turns are sure, and what is not sure is said to be so."""
    path = bags.write(tmp_path / "kitti", bags.kitti_items(shared))
    with BagSource([path], Config()) as source:
        result = calibrate(gather(source, source.scene.cameras, source.pose)["camera"])
    assert not result.by(Finding.OFF)
    assert max(abs(found(result)[name]) for name in ("rx", "ry", "rz")) < 0.2
    assert max(abs(found(result)[name]) for name in ("tx", "ty")) < 3.0
    for axis in result.axes[:3]:
        assert abs(axis.abscissa[axis.score.argmax()]) <= 0.2
    assert findings(result)["dt"] == "cannot tell"
    assert "motion of the robot is not known" in result.axes[TIME].reason
    assert np.allclose(result.corrected, result.stated)


# --- what cannot be told -----------------------------------------------------------------------


def changed(drive: Drive, change: object) -> Iterator[Frame]:
    for number, frame in enumerate(drive.frames):
        camera = frame.cameras[0]
        assert camera.image is not None and callable(change)
        bgr = change(number, camera.image.bgr)
        yield replace(frame, cameras=(replace(camera, image=replace(camera.image, bgr=bgr)),))


def test_images_without_edges_tell_nothing(drive: Drive) -> None:
    grey = changed(drive, lambda number, bgr: np.full_like(bgr, 90))
    result = calibrate(gather(grey, ["zed"], drive.pose)["zed"])
    assert set(findings(result).values()) == {"cannot tell"}
    assert "cannot tell: the score is flat" in result.answer
    assert not result.correction.any()


def test_images_of_another_street_tell_nothing(drive: Drive) -> None:
    mirrored = changed(drive, lambda number, bgr: np.ascontiguousarray(bgr[:, ::-1]))
    result = calibrate(gather(mirrored, ["zed"], drive.pose)["zed"])
    assert not result.by(Finding.OFF)


def test_clouds_without_edges_tell_nothing(drive: Drive) -> None:
    few = [
        replace(frame, clouds=tuple(replace(c, xyz=c.xyz[:50], fields={}) for c in frame.clouds))
        for frame in drive.frames[:3]
    ]
    result = calibrate(gather(few, ["zed"], drive.pose)["zed"])
    assert set(findings(result).values()) == {"cannot tell"}
    assert "only 0 edges" in result.answer


def test_a_robot_at_rest_tells_no_time(drive: Drive) -> None:
    still = gather(drive.frames[:3], ["zed"], lambda frame, stamp: drive.pose(frame, frame.stamp))["zed"]
    time = calibrate(still).axes[TIME]
    assert time.finding is Finding.UNKNOWN
    assert "hardly moved" in time.reason


def test_no_frame_to_use(drive: Drive) -> None:
    blind = [
        replace(f, cameras=(replace(f.cameras[0], image=None, problems=("no image",)),)) for f in drive.frames
    ]
    with pytest.raises(UserError, match=r"camera 'zed': no frame to calibrate with: no image \(10 frames\)"):
        calibrate(gather(blind, ["zed"], drive.pose)["zed"])


def test_edges_of_a_wall_before_a_wall() -> None:
    """A near wall that ends at 10 degrees to the left: the border is there, at the near wall's range."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-30, 30, 0.2)), np.radians(np.arange(-8, 8, 0.4)))
    unit = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1
    )
    reach = np.where(azimuth > np.radians(10.0), 20.0, 8.0) / unit[..., 0]
    ring = np.broadcast_to(np.arange(len(azimuth))[:, None], azimuth.shape).reshape(-1)
    points = (unit * reach[..., None]).reshape(-1, 3).astype(np.float32)
    for fields in ({"ring": ring}, {}):
        edges = cloud_edges(Cloud(0, "lidar", points, fields))
        assert len(edges.xyz) == len(azimuth) if fields else len(edges.xyz) > 0.7 * len(azimuth)
        assert not edges.across.any()
        near = 0.11 if fields else 0.31  # beams of two rings are taken for one
        assert np.allclose(np.degrees(np.arctan2(edges.xyz[:, 1], edges.xyz[:, 0])), 10.0, atol=near)
        assert np.allclose(edges.xyz[:, 0], 8.0, atol=0.1)


# --- the command -------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


@pytest.fixture(scope="module")
def turned(drive: Drive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of that drive whose camera is stated 1 degree too far right."""
    path = tmp_path_factory.mktemp("calib") / "turned.mcap"
    source = SyntheticSource(80, 0, weave=True, plant=["turned_camera"])
    write_bag(source, path, drive.frames)
    return path


def test_command(turned: Path, capsys: Capture) -> None:
    arguments = ["calib", str(turned), "--save", "calib.rrd", "--write", "fixed.yaml"]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert said.startswith("Camera 'zed' is off: it looks too far right, by ")
    assert "off: looks too far right" in said
    verify(Path("calib.rrd"))
    recording = Recording(Path("calib.rrd"))
    assert recording.blueprints == 1
    for what in ("stated", "corrected"):
        for part in ("image", "points", "edges"):
            assert len(recording.rows[f"/calib/zed/{what}/{part}"]) == 10
    for axis in AXES:
        assert "BarChart:values" in recording.static[f"/calib/zed/score/{axis.name}"]
    assert "too far right" in recording.static["/calib/zed/result"]["TextDocument:text"][0]

    assert main(["calib", str(turned), "--config", "fixed.yaml", "--json", "--frames", ":8"]) == 0
    (again,) = json.loads(capsys.readouterr().out)
    assert not [name for name, axis in again["axes"].items() if axis["finding"] == "off"]


def test_wrong_input(turned: Path, capsys: Capture) -> None:
    messages = bags.Messages()
    no_image = [i for i in bags.small_items(messages, scans=3) if i.topic != bags.IMAGE]
    bags.write(Path("blind"), no_image, messages)
    no_tf = [i for i in bags.small_items(messages, scans=3) if "tf" not in i.topic]
    bags.write(Path("loose"), no_tf, messages)
    for arguments, message in (
        (["blind"], "no camera to calibrate"),
        (["loose"], "no frame to calibrate with: no transform from"),
        ([turned, "--camera", "left"], "there is no such camera; there are zed"),
        ([turned, "--write", "fixed.txt"], "ends in .yaml"),
        ([turned, "--write", "nowhere/fixed.yaml", "--frames", ":1"], "nowhere/fixed.yaml: No such file"),
        (["nothing.mcap"], "nothing.mcap"),
    ):
        assert main(["calib", *map(str, arguments)]) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.strip().splitlines()[-1].startswith("bevviz: error: ")
