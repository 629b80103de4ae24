"""Calibration: planted errors are found, good ones are left alone, and what cannot be told is not told."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import Config, load
from bevviz.errors import UserError
from bevviz.extras.calib.result import (
    AXES,
    SCALES,
    TIME,
    AxisFinding,
    Calibration,
    correction_yaml,
    error_pose,
)
from bevviz.extras.calib.score import Scorer, Shots, gather
from bevviz.extras.calib.search import search
from bevviz.extras.calib.solve import FIT, calibrate
from bevviz.extras.demo.bag import write_bag
from bevviz.extras.demo.drive import PERIOD, START, SyntheticSource
from bevviz.model import geometry
from bevviz.model.frame import F64, I64, U8, Camera, Cloud, Frame, Image, Intrinsics
from bevviz.stages.edges import cloud_edges
from tests.support import bags, documented_json
from tests.support.miscalibrated_drives import Drive, Kitti, stated_wrongly
from tests.support.recordings import Recording, verify

pytestmark = pytest.mark.usefixtures("elsewhere")

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def drive() -> Drive:
    """Ten frames, nearly a second apart, of a drive that swerves."""
    return Drive(80, 0, weave=True, every=8)


@pytest.fixture(scope="module")
def faultless(drive: Drive) -> Calibration:
    """Calibrate that drive, whose image stamps are shifted by 0.1 s already."""
    shots = gather(drive.frames, ["zed"], drive.pose)["zed"]
    return calibrate(shots, stamps={"/zed2/zed/rgb/image_rect_color": 0.1})


@pytest.fixture(scope="module")
def late_and_rolled(drive: Drive) -> Calibration:
    """Calibrate that drive with a camera that is turned by 1 degree and late by 40 ms."""
    return drive.calibrate(offsets(rx=1.0, dt=40.0))


def offsets(**given: float) -> F64:
    """In units of the axes."""
    values: F64 = np.array([given.get(axis.name, 0.0) for axis in AXES]) / SCALES
    return values


def found(result: Calibration) -> dict[str, float]:
    return {axis.axis.name: axis.offset for axis in result.axes}


def findings(result: Calibration) -> dict[str, str]:
    return {axis.axis.name: str(axis.finding) for axis in result.axes}


# --- planted errors ----------------------------------------------------------------------------


def assert_found(result: Calibration, planted: dict[str, float]) -> None:
    """Compare the offsets and findings with the planted errors."""
    for axis in result.axes:
        near = {"deg": 0.2, "cm": 2.0, "ms": 10.0}[axis.axis.unit]
        assert axis.offset == pytest.approx(planted.get(axis.axis.name, 0.0), abs=near)
        assert abs(axis.offset - planted.get(axis.axis.name, 0.0)) < axis.interval
    assert {axis.axis.name for axis in result.by(AxisFinding.OFF)} == set(planted)
    assert result.score_corrected >= result.score_stated


@pytest.mark.long
def test_a_right_calibration_is_left_alone(faultless: Calibration) -> None:
    assert_found(faultless, {})
    assert set(findings(faultless).values()) == {"fine"}
    assert faultless.answer == "Camera 'zed': calibration and clock are fine."


@pytest.mark.long
def test_a_turn_and_a_late_clock_are_found(late_and_rolled: Calibration) -> None:
    assert_found(late_and_rolled, {"rx": 1.0, "dt": 40.0})


@pytest.mark.long
def test_turns_and_shifts_are_found_together(drive: Drive) -> None:
    planted = {"ry": -2.0, "rz": 2.0, "tx": 10.0, "ty": -20.0, "tz": 15.0}
    assert_found(drive.calibrate(offsets(**planted)), planted)


@pytest.mark.long
@pytest.mark.parametrize("turn", [2.0, -2.0])
def test_a_fence_is_not_taken_for_its_neighbour(turn: float) -> None:
    """Posts every 2 degrees: between what is stated and the truth lies a place that fits nearly as well."""
    wrong = stated_wrongly([fence(seed) for seed in range(4)], offsets(ry=turn))
    result = calibrate(gather(wrong, ["camera"], lambda frame, stamp: None)["camera"])
    assert covers(result, ry=turn)
    assert [axis.axis.name for axis in result.by(AxisFinding.OFF)] == ["ry"]
    assert found(result)["ry"] == pytest.approx(turn, abs=0.1)


def fence(seed: int) -> Frame:
    """Make a frame of slightly irregular posts at 5 to 25 m before a wall, with the camera at the LiDAR."""
    rng = np.random.default_rng(seed)
    place = np.radians(np.arange(-40.0, 40.0, 2.0) + rng.uniform(-0.3, 0.3, 40))
    top, reach = np.radians(rng.uniform(1, 6, 40)), np.append(rng.uniform(5, 25, 40), 60.0)

    def seen(azimuth: F64, elevation: F64) -> I64:
        on = (np.abs(azimuth[..., None] - place) < np.radians(1 / 3)) & (elevation[..., None] < top)
        nearest = np.where(on, reach[:-1], np.inf)
        return np.where(on.any(-1), nearest.argmin(-1), len(place))

    azimuth, elevation = np.meshgrid(np.radians(np.arange(-40, 40, 0.2)), np.radians(np.arange(-10, 10, 0.4)))
    flat = np.cos(elevation)
    unit = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1)
    xyz = (unit * reach[seen(azimuth, elevation)][..., None]).reshape(-1, 3).astype(np.float32)
    ring = np.repeat(np.arange(len(azimuth)), azimuth.shape[1])
    x, y = np.meshgrid((np.arange(640) - 319.5) / 400, (np.arange(360) - 179.5) / 400)
    grey = np.append(rng.integers(20, 100, 40), 180)[seen(np.arctan(-x), np.arctan(-y / np.hypot(1, x)))]
    bgr = np.repeat((grey + rng.normal(0, 2, grey.shape)).astype(np.uint8)[..., None], 3, 2)
    mounting = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    intrinsics = Intrinsics(640, 360, np.array([[400, 0, 319.5], [0, 400, 179.5], [0, 0, 1.0]]))
    return Frame(
        seed, 0, 0, "lidar", xyz, "lidar",
        clouds=(Cloud(0, "lidar", xyz, {"ring": ring}),),
        points_from_clouds=(np.eye(4),),
        cameras=(Camera("camera", Image(0, "camera", bgr), intrinsics, mounting, None),),
    )  # fmt: skip


@pytest.mark.long
def test_the_correction_undoes_the_error(drive: Drive, late_and_rolled: Calibration) -> None:
    result = late_and_rolled
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


@pytest.mark.long
def test_the_gradient_equals_differences_of_the_score(drive: Drive) -> None:
    shots = []
    for shot in gather(drive.planted(offsets(ry=0.1)), ["zed"], drive.pose)["zed"].shots[:2]:
        uv, _ = geometry.project(
            geometry.apply(shot.camera_from_points(0.0), shot.xyz), drive.source.intrinsics
        )
        inner = (np.abs(uv - (320, 180)) < (300, 160)).all(axis=1)  # at the rim, edges come and go
        parts = (array[inner] for array in (shot.xyz, shot.change, shot.cell))
        shots.append(replace(shot, **dict(zip(("xyz", "change", "cell"), parts, strict=True))))
    scorer = Scorer(shots, 4.0)
    step = np.array([1e-5] * 3 + [1e-4] * 3 + [1e-4])
    slope = [
        (scorer(row).score.sum() - scorer(-row).score.sum()) / (2 * size)
        for row, size in zip(np.diag(step), step, strict=True)
    ]
    gradient = scorer(np.zeros(7)).gradient.sum((0, 1))
    assert np.allclose(gradient, slope, rtol=0.05, atol=0.03 * np.abs(slope).max())


# --- the drive carries what is planted ---------------------------------------------------------


@pytest.mark.long
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


@pytest.mark.long
def test_the_default_drive_does_not_weave(drive: Drive) -> None:
    plain, weaving = SyntheticSource(80, 0), drive.source
    assert not np.allclose(plain.map_from_base(START + PERIOD), weaving.map_from_base(START + PERIOD))


# --- KITTI -------------------------------------------------------------------------------------

NAMES = tuple(f"{number:06}" for number in (1, 2, 3, 4, 5, 7, 8, 9, 10, 11))  # of one rig


@pytest.fixture(scope="module")
def ten(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Frame]:
    path = tmp_path_factory.mktemp("calib") / "kitti"
    with BagSource([bags.write(path, bags.kitti_items(shared, names=NAMES))], Config()) as source:
        return list(source)


@pytest.fixture(scope="module")
def kitti(ten: list[Frame]) -> list[Frame]:
    return [ten[i] for i in (0, 1, 3, 4, 5, 7)]


def of_kitti(frames: Sequence[Frame], **planted: float) -> Calibration:
    """Calibrate with a planted error. KITTI's own calibration is the ground truth."""
    wrong = stated_wrongly(frames, offsets(**planted))
    return calibrate(gather(wrong, ["camera"], lambda frame, stamp: None)["camera"])


def covers(result: Calibration, **planted: float) -> bool:
    """Whether every interval that a finding relies on holds the truth."""
    relied = result.by(AxisFinding.OFF) + result.by(AxisFinding.FINE)
    return all(abs(axis.offset - planted.get(axis.axis.name, 0.0)) < axis.interval for axis in relied)


@pytest.fixture(scope="module")
def of_six(kitti: list[Frame]) -> Calibration:
    return of_kitti(kitti)


@pytest.mark.long
def test_errors_of_kittis_calibration_are_near_zero(of_six: Calibration) -> None:
    """Six frames, no motion: the turns are sure, and what is not sure is said to be so."""
    result = of_six
    assert not result.by(AxisFinding.OFF)
    assert covers(result)
    assert max(abs(found(result)[name]) for name in ("rx", "ry", "rz")) < 0.2
    assert max(abs(found(result)[name]) for name in ("tx", "ty")) < 3.0
    for axis in result.axes[:3]:
        assert abs(axis.abscissa[axis.score.argmax()]) <= 0.2
    assert findings(result)["rx"] == "fine"
    assert findings(result)["dt"] == findings(result)["tz"] == "cannot tell"
    assert "motion of the robot is not known" in result.axes[TIME].reason
    assert np.allclose(result.corrected, result.stated)


@pytest.mark.long
@pytest.mark.parametrize(
    "planted",
    [{"ry": -2.0, "rx": 1.0}, {"rz": 2.0, "tx": -20.0, "ty": 20.0}, {"rx": -0.5, "tz": 20.0}],
    ids=str,
)
def test_planted_errors_are_found_in_kitti(kitti: list[Frame], planted: dict[str, float]) -> None:
    result = of_kitti(kitti, **planted)
    assert covers(result, **planted)
    assert {axis.axis.name for axis in result.by(AxisFinding.OFF)} == set(planted) - {"tz"}
    if "tz" in planted:  # what lies ahead hardly moves with it
        assert abs(found(result)["tz"] - planted["tz"]) < result.axes[5].interval


@pytest.mark.long
def test_repeated_views_count_as_three(kitti: list[Frame]) -> None:
    once, often = (calibrate(shots_of(kitti[:3] * times)) for times in (1, 4))
    assert once.by(AxisFinding.FINE)
    assert covers(often)
    for axis, again in zip(once.axes[:TIME], often.axes[:TIME], strict=True):
        assert again.interval > 0.6 * axis.interval


@pytest.mark.long
def test_one_real_view_gives_no_confident_answer(ten: list[Frame]) -> None:
    for times, frames in ((1, "1 frame"), (12, "12 frames, which show as much as 1 different one,")):
        result = calibrate(shots_of(ten[2:3] * times))
        assert set(findings(result).values()) == {"cannot tell"}
        assert f"too little data: in {frames} several alignments fit about as well" in result.answer


@pytest.mark.long
@pytest.mark.parametrize("planted", [{"ry": 1.0}, {"ty": 20.0}], ids=str)
def test_a_camera_that_moves_during_the_drive_is_reported(
    ten: list[Frame], planted: dict[str, float]
) -> None:
    moved = [*ten[:5], *stated_wrongly(ten[5:], offsets(**planted))]
    result = calibrate(shots_of(moved))
    assert set(findings(result).values()) == {"no agreement"}
    (axis,) = (axis.axis for axis in result.axes if axis.axis.name in planted)
    assert f"the two halves of the frames disagree on the {axis.what}" in result.answer
    assert not result.correction.any()


@pytest.mark.long
def test_images_of_other_frames_give_no_answer(kitti: list[Frame], of_six: Calibration) -> None:
    others = [frame.cameras[0] for frame in (*kitti[1:], kitti[0])]
    swapped = [
        replace(frame, cameras=(replace(frame.cameras[0], image=other.image),))
        for frame, other in zip(kitti, others, strict=True)
    ]
    result = calibrate(shots_of(swapped))
    assert set(findings(result).values()) == {"no agreement"}
    assert "no agreement: the edges of image and cloud do not agree anywhere within 3.5 deg" in result.answer
    assert not result.correction.any()
    assert best_score(swapped) < FIT / 1.2
    assert of_six.score_stated > 1.2 * FIT


@pytest.mark.long
def test_the_worst_agreement_of_a_right_calibration(shared: Path) -> None:
    """These four frames are among the real ones that score least."""
    assert best_score(Kitti(shared / "kitti_more", range(12, 16)).frames) > 1.2 * FIT


def test_an_image_beside_the_scan_changes_nothing(ten: list[Frame]) -> None:
    camera = ten[0].cameras[0]
    assert camera.camera_from_points is not None
    to_the_sky = np.eye(4)
    to_the_sky[:3, :3] = geometry.rotations(0, np.array([-np.pi / 2]))[0]
    upwards = replace(camera, camera_from_points=to_the_sky @ camera.camera_from_points)
    sky = replace(ten[0], cameras=(upwards,))
    assert not shots_of([sky]).edges
    free = np.array([True] * 3 + [False] * 4)
    alone, beside = (
        search(shots_of(f).shots, free, lambda done, what: None)[1] for f in ([ten[0]], [ten[0], sky])
    )
    np.testing.assert_allclose(beside[0].offsets, alone[0].offsets, atol=1e-6)


def best_score(frames: Sequence[Frame]) -> float:
    """Return the mean score of the highest peak."""
    name = frames[0].cameras[0].name
    shots = gather(frames, [name], lambda frame, stamp: None)[name].shots
    free = np.array([True] * TIME + [False])
    return search(shots, free, lambda done, what: None)[1][0].sums.mean


def shots_of(frames: Iterable[Frame]) -> Shots:
    return gather(frames, ["camera"], lambda frame, stamp: None)["camera"]


# --- what cannot be told -----------------------------------------------------------------------


@pytest.mark.long
def test_one_view_repeated_twelve_times_counts_once(drive: Drive) -> None:
    once, often = (
        calibrate(gather(drive.frames[3:4] * times, ["zed"], drive.pose)["zed"]) for times in (1, 12)
    )
    assert all(axis.interval < 1.0 for axis in once.axes[:3])
    ratio = np.array([b.interval / a.interval for a, b in zip(once.axes, often.axes, strict=True)])
    # Which of the edges are drawn differs; twelve views would give 0.29 of each.
    assert ratio.min() > 0.4 and np.exp(np.log(ratio[:5]).mean()) > 0.7


@pytest.mark.long
def test_two_frames_do_not_confirm_shift_along_z_and_time(drive: Drive) -> None:
    """These two have different speeds, so their intervals are small."""
    once = calibrate(gather(drive.frames[::5], ["zed"], drive.pose)["zed"])
    assert findings(once)["tz"] == findings(once)["dt"] == "cannot tell"
    assert once.axes[TIME].interval < once.axes[TIME].axis.sure
    assert once.axes[TIME].reason == "2 frames cannot hold it: it takes 6 or more"
    assert once.answer.endswith("From 2 frames it cannot tell the shift along z and time of the image.")


def changed(drive: Drive, change: object) -> Iterator[Frame]:
    for number, frame in enumerate(drive.frames):
        camera = frame.cameras[0]
        assert camera.image is not None and callable(change)
        bgr = change(number, camera.image.bgr)
        yield replace(frame, cameras=(replace(camera, image=replace(camera.image, bgr=bgr)),))


@pytest.mark.long
def test_images_without_edges_give_no_answer(drive: Drive) -> None:
    grey = changed(drive, lambda number, bgr: np.full_like(bgr, 90))
    result = calibrate(gather(grey, ["zed"], drive.pose)["zed"])
    assert set(findings(result).values()) == {"cannot tell"}
    assert "cannot tell: too little data: the images show no edges" in result.answer
    assert not result.correction.any()


def test_a_small_part_of_an_image_gives_no_answer(drive: Drive) -> None:
    """One frame, of which the image shows an eighth: that is little data, and no contradiction."""

    def blind(number: int, bgr: U8) -> U8:
        left = np.full_like(bgr, 90)
        left[:, 280:360] = bgr[:, 280:360]
        return left

    result = calibrate(gather(list(changed(drive, blind))[:1], ["zed"], drive.pose)["zed"])
    assert set(findings(result).values()) == {"cannot tell"}
    assert "too little data" in result.answer


def test_clouds_without_edges_give_no_answer(drive: Drive) -> None:
    few = [
        replace(frame, clouds=tuple(replace(c, xyz=c.xyz[:50], fields={}) for c in frame.clouds))
        for frame in drive.frames[:3]
    ]
    result = calibrate(gather(few, ["zed"], drive.pose)["zed"])
    assert set(findings(result).values()) == {"cannot tell"}
    assert "too little data: only 0 edges" in result.answer


def test_a_robot_at_rest_gives_no_time_offset(drive: Drive) -> None:
    still = gather(drive.frames[:3], ["zed"], lambda frame, stamp: drive.pose(frame, frame.stamp))["zed"]
    time = calibrate(still).axes[TIME]
    assert time.finding is AxisFinding.UNKNOWN
    assert "hardly moved" in time.reason


def test_a_drive_without_usable_frames_is_reported(drive: Drive) -> None:
    blind = [
        replace(f, cameras=(replace(f.cameras[0], image=None, problems=("no image",)),)) for f in drive.frames
    ]
    with pytest.raises(UserError, match=r"camera 'zed': no frame to calibrate with: no image \(10 frames\)"):
        calibrate(gather(blind, ["zed"], drive.pose)["zed"])


def test_depth_edges_lie_on_the_nearer_wall() -> None:
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
        assert not edges.bright.any()
        assert (edges.towards[:, 1] > 0).all()  # to the left it is farther
        near = 0.11 if fields else 0.31  # beams of two rings are taken for one
        assert np.allclose(np.degrees(np.arctan2(edges.xyz[:, 1], edges.xyz[:, 0])), 10.0, atol=near)
        assert np.allclose(edges.xyz[:, 0], 8.0, atol=0.1)


# --- the command -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def turned(drive: Drive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a bag of that drive whose stated camera mounting is 1 degree too far right."""
    path = tmp_path_factory.mktemp("calib") / "turned.mcap"
    source = SyntheticSource(80, 0, weave=True, plant=["turned_camera"])
    write_bag(source, path, drive.frames)
    return path


@pytest.mark.long
def test_the_command_reports_and_records_the_calibration(turned: Path, capsys: Capture) -> None:
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
    tree = json.loads(capsys.readouterr().out)
    documented_json.check(tree, "bevviz.calib/1")
    (again,) = tree["cameras"]
    assert not [name for name, axis in again["axes"].items() if axis["finding"] == "off"]


def test_unusable_bags_are_one_line(turned: Path, capsys: Capture) -> None:
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
        (
            [turned, "--write", "nowhere/fixed.yaml", "--frames", ":1"],
            "nowhere/fixed.yaml: there is no folder nowhere",
        ),
        (["nothing.mcap"], "nothing.mcap"),
    ):
        assert main(["calib", *map(str, arguments)]) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.strip().splitlines()[-1].startswith("bevviz: error: ")


def test_the_written_config_corrects_a_late_clock(faultless: Calibration) -> None:
    """Lateness that is found is taken from what is added to the stamps already."""
    late = replace(faultless, correction=np.array([0.0] * 6 + [0.03]))
    assert "sync:\n  offsets:\n    /zed2/zed/rgb/image_rect_color: 0.0700\n" in correction_yaml([late])
    assert late.moved and "sync" not in correction_yaml([replace(late, offset=0.0, correction=offsets())])
