"""Folders of data sets, held against the sets' own readers where there are any, else their documents."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pykitti  # type: ignore[import-untyped]
import pytest

import bevviz
from bevviz.cli import main
from bevviz.drive import Drive
from bevviz.evaluate import truth_in
from bevviz.extras.batch.jobs import find_bags
from bevviz.model import geometry
from bevviz.model.frame import F64, Boxes3D, Frame
from tests.support import datasets
from tests.support.commands import environment
from tests.support.kept_drives import BAG
from tests.support.waiting import PATIENCE

Capture = pytest.CaptureFixture[str]
STILL = {"sync.motion_compensation": False}


def frames_of(drive: Drive) -> list[Frame]:
    return [drive.raw(i) for i in range(len(drive))]


def corners(frame: Frame) -> F64:
    """(8, 3) of the only labelled box, in the frame of the points."""
    truth = frame.truth
    assert truth is not None
    return np.asarray(geometry.corners(truth.boxes)[0], np.float64)


# --- KITTI -------------------------------------------------------------------------------------


def test_a_raw_drive_equals_what_pykitti_reads(tmp_path: Path) -> None:
    path = datasets.kitti_raw(tmp_path)
    theirs = pykitti.raw(str(tmp_path), "2011_09_26", "0001")
    with bevviz.open(path, set=STILL) as drive:
        frames = frames_of(drive)
        assert drive.warnings == []
    assert len(frames) == 3  # the third scan is missing
    for frame, number in zip(frames, (0, 1, 3), strict=True):
        np.testing.assert_array_equal(
            np.column_stack([frame.points, frame.fields["intensity"]]), datasets.scan(number)
        )
        assert frame.stamp == 1317042145_000000000 + number * 100_000_000  # 2011-09-26 13:02:25 UTC
        (camera,) = frame.cameras
        assert camera.image is not None
        assert camera.intrinsics is not None
        assert camera.camera_from_points is not None
        assert camera.image.stamp == frame.stamp + 2_000_000
        np.testing.assert_array_equal(camera.image.bgr[..., ::-1], np.asarray(theirs.get_cam2(number)))
        np.testing.assert_allclose(camera.camera_from_points, theirs.calib.T_cam2_velo, atol=1e-6)
        np.testing.assert_allclose(camera.intrinsics.K, theirs.calib.K_cam2)
    # Positions come 7 ms after the scans; at their own time they are pykitti's, counted from the first.
    first = np.linalg.inv(theirs.oxts[0].T_w_imu)
    imu_from_velo = np.linalg.inv(theirs.calib.T_velo_imu)
    with bevviz.open(
        path, set={"sync.motion_compensation": False, "sync.offsets": {"/velodyne_points": 0.007}}
    ) as drive:
        for frame, number in zip(frames_of(drive), (0, 1, 3), strict=True):
            expected = first @ theirs.oxts[number].T_w_imu @ imu_from_velo
            np.testing.assert_allclose(frame.pose, expected, atol=1e-5)


def test_tracklets_are_where_they_are_labelled(tmp_path: Path) -> None:
    with bevviz.open(datasets.kitti_raw(tmp_path)) as drive:
        frames = frames_of(drive)
        truth = truth_in(drive.frames)(frames[2])
    assert frames[0].truth is not None
    assert len(frames[0].truth.boxes) == 0  # nothing is labelled yet, which is known
    assert frames[1].truth is not None
    assert frames[1].truth.labels == ("Car",)
    assert frames[1].truth.ids == frames[2].truth.ids == ("0",)  # type: ignore[union-attr]
    c, s = np.cos(0.25), np.sin(0.25)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    local = np.array([[x, y, z] for x in (-2, 2) for y in (-0.8, 0.8) for z in (0, 1.5)])
    expected = local @ turn.T + [15, 0, -1.7]  # of the fourth frame: 12 m, and 1 m a frame
    found = corners(frames[2])
    np.testing.assert_allclose(
        found[np.lexsort(found.round(3).T)], expected[np.lexsort(expected.round(3).T)], atol=1e-4
    )
    assert truth is not None
    assert truth.must.tolist() == [True]


def test_info_describes_a_raw_drive(tmp_path: Path, capsys: Capture) -> None:
    path = datasets.kitti_raw(tmp_path)
    assert main(["info", str(path)]) == 0
    said = capsys.readouterr().out
    assert "KITTI raw drive" in said
    assert "/image_00/image_rect/compressed: not used: grey, beside a colour camera" in said
    assert "fixed frame of 'velodyne': map" in said
    assert re.search(r"missing for a full run\n  no detector", said)


def test_a_grey_camera_that_is_asked_for_is_used(tmp_path: Path) -> None:
    path = datasets.kitti_raw(tmp_path)
    theirs = pykitti.raw(str(tmp_path), "2011_09_26", "0001")
    grey = {"source.camera_topics": ["/image_00/image_rect/compressed"], **STILL}
    with bevviz.open(path, set=grey) as drive:
        (camera,) = drive.raw(0).cameras
    assert camera.camera_from_points is not None
    np.testing.assert_allclose(camera.camera_from_points, theirs.calib.T_cam0_velo, atol=1e-6)


def test_a_tracking_sequence_is_read(tmp_path: Path, capsys: Capture) -> None:
    root = datasets.kitti_tracking(tmp_path)
    theirs = pykitti.tracking(str(root), "0000")
    with bevviz.open(root, set={"source.sequence": "0000"}) as drive:
        frames = frames_of(drive)
    assert [frame.stamp for frame in frames] == [1_000_000_000, 1_100_000_000, 1_300_000_000]
    for row, (frame, number) in enumerate(zip(frames, (0, 1, 3), strict=True)):
        np.testing.assert_array_equal(frame.points, theirs.get_velo(row)[:, :3])
        camera, truth = frame.cameras[0], frame.truth
        assert camera.image is not None
        assert camera.camera_from_points is not None
        np.testing.assert_array_equal(camera.image.bgr[..., ::-1], np.asarray(theirs.get_cam2(number)))
        assert truth is not None
        assert truth.image is not None
        assert truth.ids == ("7",)
        np.testing.assert_array_equal(truth.image.xyxy, [[20, 10, 60, 30]])
        np.testing.assert_array_equal(truth.image.dont_care, [[80, 0, 99, 20]])
        # By the benchmark's words: the bottom's middle in the rectified reference camera.
        rectified = datasets.matrix(datasets.R_RECT) @ datasets.matrix(datasets.TR, 4)
        center = rectified @ [*truth.boxes.center[0].tolist(), 1.0]
        np.testing.assert_allclose(center, [0.1, 1.7 - 0.75, 12.0 + number], atol=1e-4)
    # By that of one sequence it is the same drive.
    with bevviz.open(root / "velodyne/0000") as drive:
        assert len(drive) == 3
    assert main(["info", str(root)]) == 2
    assert "2 drives; choose with --sequence NAME; there are 0000, 0001" in capsys.readouterr().err
    assert main(["info", str(root), "--sequence", "0007"]) == 2
    assert "there is no --sequence 0007; there are 0000, 0001" in capsys.readouterr().err


def test_tracking_is_evaluated_and_swept(tmp_path: Path, capsys: Capture) -> None:
    root = str(datasets.kitti_tracking(tmp_path))
    report = tmp_path / "found.json"
    assert main(["evaluate", root, "--model", "demo", "--sequence", "0001", "--json", str(report)]) in (0, 1)
    metrics = json.loads(report.read_text())["metrics"]
    assert metrics["missed"] == 3  # of each scan its car: no image shows one
    assert main(["sweep", root, "--sequence", "0001", "--set", "clustering.eps=0.4:0.6:0.2"]) == 0
    assert "recall" in capsys.readouterr().out


def test_an_odometry_sequence_equals_what_pykitti_reads(tmp_path: Path) -> None:
    sequence = datasets.kitti_odometry(tmp_path)
    theirs = pykitti.odometry(str(tmp_path), "00")
    with bevviz.open(sequence) as drive:
        frames = frames_of(drive)
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(
            np.column_stack([frame.points, frame.fields["intensity"]]), theirs.get_velo(number)
        )
        later = (frame.stamp - frames[0].stamp) * 1e-9
        assert later == pytest.approx(theirs.timestamps[number].total_seconds(), abs=1e-6)
        camera = frame.cameras[0]
        assert camera.camera_from_points is not None
        np.testing.assert_allclose(camera.camera_from_points, theirs.calib.T_cam2_velo, atol=1e-6)
        moved = np.linalg.inv(theirs.calib.T_cam0_velo) @ theirs.poses[number] @ theirs.calib.T_cam0_velo
        np.testing.assert_allclose(frame.pose, moved, atol=1e-6)


def test_semantic_kitti_has_objects_and_ground(tmp_path: Path, capsys: Capture) -> None:
    datasets.kitti_odometry(tmp_path)
    with bevviz.open(tmp_path) as drive:
        frame = drive.raw(1)
        truth = truth_in(drive.frames)(frame)
    assert np.unique(frame.fields["label"]).tolist() == [0, 40, 5 << 16 | 252]
    assert truth is not None
    assert truth.labels == ("car",)
    np.testing.assert_allclose(truth.boxes.center, [[13, 0, -0.9]], atol=0.05)
    np.testing.assert_allclose(truth.boxes.size, [[4, 1.6, 1.4]], atol=0.1)
    # No point of the object is outside of its box.
    mine = frame.fields["label"] >> 16 == 5
    grown = Boxes3D(truth.boxes.center, truth.boxes.size + np.float32(1e-3), truth.boxes.yaw)
    assert geometry.inside(frame.points[mine], grown, 0).all()
    assert main(["evaluate", str(tmp_path), "--model", "demo"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"^car +3 +0 +3", said, re.MULTILINE)
    assert "ground" in said


def test_real_frames_are_read_as_a_sequence(shared: Path) -> None:
    with bevviz.open(shared / "kitti_drive") as drive:
        assert len(drive) == 25
        frame = drive.raw(24)
    expected = np.fromfile(shared / "kitti_drive/velodyne/000024.bin", "<f4").reshape(-1, 4)
    np.testing.assert_array_equal(frame.points, expected[:, :3])
    image = frame.cameras[0].image
    assert image is not None
    assert image.encoded == (shared / "kitti_drive/image_2/000024.png").read_bytes()


def test_a_missed_object_is_asked_about(shared: Path, capsys: Capture) -> None:
    model = str(shared / "models/yolox_nano.onnx")
    command = ["why", str(shared / "kitti"), "--at-frame", "1", "--model", model, "--class", "Cyclist"]
    assert main(command) == 0
    assert "cyclist" in capsys.readouterr().out.lower()
    assert main(["why", str(shared / "kitti"), "--at", "3", "--model", model]) == 2
    assert "single frames, which have no times; give a number" in capsys.readouterr().err
    assert main(["open", str(shared / "kitti"), "--no-browser", "--at-frame", "12"]) == 2
    assert "frame 12: kitti has 12 scans, counted from 0" in capsys.readouterr().err


# --- nuScenes ----------------------------------------------------------------------------------


def test_a_nuscenes_scene_equals_what_its_devkit_reads(tmp_path: Path) -> None:
    """The reference is what nuscenes-devkit 1.2.0 makes of the same folder, see references/README.md."""
    expected = json.loads((Path(__file__).parents[2] / "references/metrics/nuscenes_devkit.json").read_text())
    root = datasets.nuscenes(tmp_path)
    with bevviz.open(root, set={"source.sequence": "scene-0061"}) as drive:
        frames = frames_of(drive)
        assert drive.warnings == []
    assert [str(frame.stamp) for frame in frames] == [f"{stamp}000" for stamp in expected]
    for frame, there in zip(frames, expected.values(), strict=True):
        some, camera = frame.points[::40][:5], frame.cameras[0]
        np.testing.assert_allclose(geometry.apply(frame.pose, some), there["map"], atol=2e-4)
        assert camera.camera_from_points is not None
        seen = geometry.apply(camera.camera_from_points, some)
        np.testing.assert_allclose(seen, there["camera"], atol=2e-4)
        assert frame.fields["ring"][:3].tolist() == [0, 1, 2]
        if not there["boxes"]:
            assert frame.truth is None  # a sweep between key frames
            continue
        (box,) = there["boxes"]  # the animal is of no class of the detection task
        assert frame.truth is not None
        assert frame.truth.labels == (box["name"],) == ("car",)
        assert frame.truth.ids == (box["instance"],)
        assert frame.truth.world_from_boxes is not None
        mine = geometry.apply(frame.truth.world_from_boxes, corners(frame))
        theirs = np.array(box["corners"])
        np.testing.assert_allclose(
            mine[np.lexsort(mine.round(2).T)], theirs[np.lexsort(theirs.round(2).T)], atol=1e-3
        )


def test_what_is_ahead_is_ahead_in_nuscenes(tmp_path: Path) -> None:
    """Its LiDAR has x to the right: the points are turned, digit by digit the same."""
    root = datasets.nuscenes(tmp_path)
    with bevviz.open(root, set={"source.sequence": "scene-0061"}) as drive:
        np.testing.assert_array_equal(drive.raw(0).points, datasets.scan(0)[:, :3] * [1, -1, 1])


def test_nuscenes_is_read_from_its_tables_folder(tmp_path: Path, capsys: Capture) -> None:
    root = datasets.nuscenes(tmp_path)
    assert main(["info", str(root)]) == 2
    assert "choose with --sequence NAME; there are scene-0061, scene-0103" in capsys.readouterr().err
    next((root / "sweeps/LIDAR_TOP").glob("*")).unlink()
    assert main(["info", str(root / "v1.0-mini"), "--sequence", "scene-0061"]) in (0, 2)
    said = capsys.readouterr().out
    assert "format  nuScenes" in said
    (root / "v1.0-mini/ego_pose.json").write_text('[{"token": "LIDAR_TOP-0-0", "timest')
    assert main(["info", str(root), "--sequence", "scene-0061"]) == 2
    assert "ego_pose.json: is cut, or no table of nuScenes" in capsys.readouterr().err


def test_a_part_of_nuscenes_is_read_and_missing_files_counted(tmp_path: Path, capsys: Capture) -> None:
    root = datasets.nuscenes(tmp_path)
    for file in root.glob("s*/*/*__153240298*"):  # of the second scene
        file.unlink()
    assert main(["info", str(root)]) == 0
    assert "1 of 2 scenes have no LiDAR scan here: scene-0061 has" in capsys.readouterr().out
    first = sorted(root.glob("samples/LIDAR_TOP/*"))[0]
    first.unlink()
    assert main(["evaluate", str(root), "--model", "demo"]) == 0
    said = capsys.readouterr()
    assert "1 of 6 files of scene-0061 are not there, 1 of its 2 samples lack one" in " ".join(
        (said.out + said.err).split()
    )
    assert main(["info", str(root), "--sequence", "scene-0103"]) == 2
    assert "1 of 2 scenes have scans here: scene-0061" in capsys.readouterr().err


def test_nuscenes_is_evaluated(tmp_path: Path, capsys: Capture) -> None:
    root = datasets.nuscenes(tmp_path)
    report = tmp_path / "found.json"
    assert (
        main(["evaluate", str(root), "--model", "demo", "--sequence", "scene-0061", "--json", str(report)])
        == 0
    )
    assert json.loads(report.read_text())["metrics"]["missed"] == 2  # no image shows one
    assert "2 frames, 1 without truth left out" in capsys.readouterr().out


# --- many drives -------------------------------------------------------------------------------


def test_a_batch_finds_the_drives_of_a_folder(tmp_path: Path) -> None:
    raw, tracking = datasets.kitti_raw(tmp_path / "raw"), datasets.kitti_tracking(tmp_path / "tracking")
    sequence = datasets.kitti_odometry(tmp_path / "odometry")
    scenes = datasets.nuscenes(tmp_path / "nuscenes")
    expected = [scenes, sequence, raw, tracking / "velodyne/0000", tracking / "velodyne/0001"]
    assert sorted(find_bags([tmp_path])) == sorted(expected)


# --- what is wrong -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        ("../calib_velo_to_cam.txt", "calib_velo_to_cam.txt: cannot be read: No such file or directory"),
        ("../calib_cam_to_cam.txt", "calib_cam_to_cam.txt: cannot be read: No such file or directory"),
        ("../calib_imu_to_velo.txt", "calib_imu_to_velo.txt: cannot be read: No such file or directory"),
        ("velodyne_points/timestamps.txt", "timestamps.txt: cannot be read: No such file or directory"),
    ],
)
def test_a_missing_file_is_named(tmp_path: Path, broken: str, message: str, capsys: Capture) -> None:
    path = datasets.kitti_raw(tmp_path)
    (path / broken).unlink()
    assert main(["info", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("../calib_velo_to_cam.txt", "R: 1 2\n", "calib_velo_to_cam.txt: no R and T, as KITTI writes them"),
        ("velodyne_points/timestamps.txt", "today\n", "timestamps.txt: line 1 is no time, as 2011-09-26"),
        ("oxts/data/0000000001.txt", "49 8 x 0 0 0\n", "line 1 has something that is no number"),
        ("tracklet_labels.xml", "<a>", "tracklet_labels.xml: no tracklets as KITTI writes them"),
    ],
)
def test_a_damaged_file_is_named(
    tmp_path: Path, file: str, content: str, message: str, capsys: Capture
) -> None:
    path = datasets.kitti_raw(tmp_path)
    (path / file).write_text(content)
    assert main(["info", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_a_cut_scan_is_told_and_read(tmp_path: Path) -> None:
    path = datasets.kitti_raw(tmp_path)
    cut = path / "velodyne_points/data/0000000001.bin"
    cut.write_bytes(cut.read_bytes()[:1003])
    with bevviz.open(path) as drive:
        frame = drive.raw(1)
        np.testing.assert_array_equal(frame.points, datasets.scan(1)[:62, :3])
        assert any("0000000001.bin: 1003 bytes are no whole number of points" in w for w in drive.warnings)


def test_a_label_that_is_cut_costs_that_scan_its_labels(tmp_path: Path, capsys: Capture) -> None:
    sequence = datasets.kitti_odometry(tmp_path)
    label = sequence / "labels/000001.label"
    label.write_bytes(label.read_bytes()[:-4])
    assert main(["evaluate", str(sequence), "--model", "demo"]) == 0
    said = capsys.readouterr()
    assert "000001.label: 399 labels for 400 points" in said.err


def test_the_kind_of_data_set_can_be_forced(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "empty").mkdir()
    assert main(["info", str(tmp_path / "empty"), "--dataset", "kitti-raw"]) == 2
    assert "no drive in it; KITTI raw drive has velodyne_points/data" in capsys.readouterr().err
    assert main(["info", str(tmp_path / "empty"), "--dataset", "kitti-row"]) == 2
    assert "--dataset kitti-row: did you mean kitti-raw? There are" in capsys.readouterr().err
    assert main(["info", str(tmp_path / "empty")]) == 2
    assert (
        "a folder without a bag (no .mcap, .db3 or .bag file), and no data set that is recognised"
        in capsys.readouterr().err
    )


def test_a_drive_below_wins_over_crops_of_its_objects(tmp_path: Path, capsys: Capture) -> None:
    """A detector's training leaves folders of cut-out objects beside ``training``."""
    root = tmp_path / "kitti"
    datasets.kitti_object(root / "training")
    (root / "kitti_gt_database").mkdir()
    for number in range(3):
        datasets.scan(number).tofile(root / f"kitti_gt_database/00000{number}_Car_0.bin")
    assert main(["info", str(root)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "no drive itself: its folder training is taken (KITTI object benchmark)" in out
    assert "/velodyne_points" in out and "gt_database" not in out.replace(str(root), "")
    datasets.kitti_object(root / "testing")
    assert main(["info", str(root)]) == 2
    message = capsys.readouterr().err
    assert "no drive itself, and 2 below it; give one of them, or --sequence NAME" in message
    assert "testing (KITTI object benchmark), training (KITTI object benchmark)" in message
    assert main(["info", str(root), "--sequence", "training"]) == 0
    capsys.readouterr()
    assert main(["info", str(root / "kitti_gt_database")]) == 0  # who asks for the crops gets them


@pytest.mark.long
def test_a_bag_needs_no_loader_of_data_sets() -> None:
    script = (
        "import sys; from bevviz.cli import main; main(['info', sys.argv[1]])\n"
        "loaders = 'bevviz.extras.datasets', 'bevviz.datasets.folder', 'bevviz.datasets.result_files'\n"
        "print([name for name in sys.modules if name.startswith(loaders)], file=sys.stderr)"
    )
    command = [sys.executable, "-c", script, str(BAG)]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0
    assert done.stderr.splitlines()[-1] == "[]"
