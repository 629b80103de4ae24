"""A drive as KITTI's folders, held against the readers that there are of them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

import bevviz
from bevviz import geometry
from bevviz.cli import main
from bevviz.datasets.kitti import read_labels
from bevviz.errors import UserError
from bevviz.export.kitti import KittiExport, labels, rectified
from bevviz.frame import Boxes3D, Intrinsics, Objects

OPTICAL = geometry.inverse(geometry.transform(np.array([0.2, 0.1, -0.3]), np.array([-0.5, 0.5, -0.5, 0.5])))


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bevviz.Drive]:
    folder = tmp_path_factory.mktemp("export") / "training"
    drive = bevviz.simulate(8)
    drive.run([KittiExport(folder)])
    return folder, drive


def test_our_own_reader_and_pykitti_have_the_same_frames(exported: tuple[Path, bevviz.Drive]) -> None:
    from pykitti.utils import load_velo_scan, read_calib_file  # type: ignore[import-untyped]

    folder, drive = exported
    with bevviz.open(folder) as again:
        assert len(again) == 8
        for number in (0, 5):
            result, frame = drive.at(frame=number), again.raw(number)
            np.testing.assert_array_equal(frame.points, result.frame.points)
            scan = load_velo_scan(str(folder / f"velodyne/{number:06}.bin"))
            np.testing.assert_array_equal(scan[:, :3], result.frame.points)
            calibrated = read_calib_file(str(folder / f"calib/{number:06}.txt"))
            (camera,), (there,) = result.frame.cameras, frame.cameras
            assert camera.image is not None
            assert there.image is not None
            assert camera.intrinsics is not None
            assert there.camera_from_points is not None
            assert camera.camera_from_points is not None
            np.testing.assert_array_equal(there.image.bgr, camera.image.bgr)
            np.testing.assert_allclose(calibrated["P2"].reshape(3, 4)[:, :3], camera.intrinsics.K)
            np.testing.assert_allclose(there.camera_from_points, camera.camera_from_points, atol=1e-6)


def test_labels_are_the_objects_that_were_found(exported: tuple[Path, bevviz.Drive]) -> None:
    folder, drive = exported
    objects = drive.at(frame=5).objects
    stated = read_labels(folder / "label_2/000005.txt")
    assert objects is not None
    assert 0 < len(stated.labels) <= len(objects)
    for center, size, yaw in zip(stated.boxes.center, stated.boxes.size, stated.boxes.yaw, strict=True):
        row = int(np.linalg.norm(objects.boxes.center - center, axis=1).argmin())
        np.testing.assert_allclose(objects.boxes.center[row], center, atol=1e-3)
        np.testing.assert_allclose(objects.boxes.size[row], size, atol=1e-3)
        assert abs(np.sin(objects.boxes.yaw[row] - yaw)) < 1e-2


def test_what_is_evaluated_against_its_own_labels_is_right(
    exported: tuple[Path, bevviz.Drive], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = exported
    with bevviz.open(folder, model="demo") as again:
        metrics = again.evaluate().metrics
    assert metrics["recall"] == 1.0
    assert metrics["precision"] > 0.9
    assert main(["info", str(folder)]) == 0
    assert "/ground_truth: ground truth" in capsys.readouterr().out


def test_a_label_has_kittis_columns_in_its_terms() -> None:
    """A car that drives away has a turn of -90 degrees, and one across of 0 or 180."""
    boxes = Boxes3D(
        np.array([[20, 0, -1], [20, 3, -1], [-5, 0, 0]], np.float32),
        np.full((3, 3), (4, 2, 1.5), np.float32),
        np.array([0, np.pi / 2, 0], np.float32),
    )
    numbers = np.zeros(3, np.int32)
    objects = Objects(boxes, ("car", "unicorn", "car"), np.ones(3, np.float32), numbers, ("",) * 3, numbers)
    intrinsics = Intrinsics(1000, 500, np.array([[500.0, 0, 500], [0, 500, 250], [0, 0, 1]]))
    ahead, across = (line.split() for line in labels(objects, intrinsics, OPTICAL))  # none behind the camera
    assert (ahead[0], across[0]) == ("Car", "Misc")
    assert len(ahead) == 16
    assert float(ahead[14]) == pytest.approx(-np.pi / 2, abs=1e-3)
    assert abs(np.sin(float(across[14]))) < 1e-3
    assert [float(v) for v in ahead[8:11]] == [1.5, 2, 4]
    assert float(ahead[1]) == 0


def test_images_are_rectified() -> None:
    K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    intrinsics = Intrinsics(64, 48, K, "plumb_bob", np.array([-0.3, 0.1, 0, 0, 0]))
    bgr = np.zeros((48, 64, 3), np.uint8)
    point = np.array([[0.3, 0.2, 1]], np.float32)
    (bent,), _ = geometry.project(point, intrinsics)
    cv2.circle(bgr, tuple(np.rint(bent).astype(int).tolist()), 2, (255, 255, 255), -1)
    (flat,), _ = geometry.project(point, Intrinsics(64, 48, K))
    rows, columns, _ = np.nonzero(rectified(bgr, intrinsics) > 128)
    np.testing.assert_allclose([columns.mean(), rows.mean()], flat, atol=1)


def test_a_folder_that_holds_something_is_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine").touch()
    with pytest.raises(UserError, match="is there already"):
        KittiExport(tmp_path)
    assert main(["export", "nothing.mcap", "-o", str(tmp_path / "new")]) == 2
    assert "nothing.mcap: no such file" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
