"""A drive as KITTI's folders and as a scene of nuScenes, held against the readers that there are of them."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import bevviz
from bevviz.cli import main
from bevviz.datasets.kitti_labels import read_labels
from bevviz.errors import UserError
from bevviz.extras.datasets.folder_export import FolderExport, rectify
from bevviz.extras.datasets.kitti_export import KittiExport, label_lines
from bevviz.extras.datasets.nuscenes_export import TABLES, VERSION, NuScenesExport
from bevviz.model import geometry
from bevviz.model.frame import Boxes3D, Intrinsics
from bevviz.model.protocols import Observer
from bevviz.model.results import FrameResult, Objects
from tests.support import bags
from tests.support.commands import environment
from tests.support.small_disk import small_disk
from tests.support.waiting import PATIENCE

OPTICAL = geometry.inverse(geometry.transform(np.array([0.2, 0.1, -0.3]), np.array([-0.5, 0.5, -0.5, 0.5])))

MAKERS = pytest.mark.parametrize("make", [KittiExport, NuScenesExport])


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bevviz.Drive]:
    folder = tmp_path_factory.mktemp("export") / "training"
    drive = bevviz.simulate(8)
    drive.run([KittiExport(folder), NuScenesExport(folder.parent / "scenes")])
    return folder, drive


@pytest.mark.long
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
    ahead, across = (
        line.split() for line in label_lines(objects, intrinsics, OPTICAL)
    )  # none behind the camera
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
    rows, columns, _ = np.nonzero(rectify(bgr, intrinsics) > 128)
    np.testing.assert_allclose([columns.mean(), rows.mean()], flat, atol=1)


def test_a_folder_that_is_not_empty_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine").touch()
    with pytest.raises(UserError, match="is there already"):
        KittiExport(tmp_path)
    assert main(["export", "nothing.mcap", "-o", str(tmp_path / "new")]) == 2
    assert "nothing.mcap: no such file" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


@pytest.mark.long
@MAKERS
def test_a_folder_has_its_name_when_it_is_complete(tmp_path: Path, make: type[FolderExport]) -> None:
    target = tmp_path / "made"
    names: list[str] = []

    class Watcher(Observer[FrameResult]):
        def observe(self, result: FrameResult) -> None:
            names.extend(path.name for path in tmp_path.iterdir())
            if fails:
                raise RuntimeError("a stage failed")

    fails = True
    with pytest.raises(RuntimeError):
        bevviz.simulate(1).run([make(target), Watcher()])
    assert re.fullmatch(r"made\.partial-[0-9a-f]{8}", names[0])
    assert not list(tmp_path.iterdir())
    fails = False
    target.mkdir()  # An empty folder is replaced.
    bevviz.simulate(1).run([make(target), Watcher()])
    assert [path.name for path in tmp_path.iterdir()] == ["made"]


@pytest.mark.long
@MAKERS
def test_a_full_disk_leaves_no_folder(tmp_path: Path, make: type[FolderExport]) -> None:
    with small_disk(tmp_path / "small", "1m") as small:
        with pytest.raises(UserError, match=r"small/made: cannot be written: No space left on device"):
            bevviz.simulate(8).run([make(small / "made")])
        assert not list(small.iterdir())


@pytest.mark.long
def test_the_next_export_deletes_what_a_killed_one_left(tmp_path: Path) -> None:
    script = (
        "import os, signal, sys; from pathlib import Path\n"
        "from bevviz.support.unfinished_folder import UnfinishedFolder\n"
        "(UnfinishedFolder(Path(sys.argv[1])).path / 'half').touch(); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    target = tmp_path / "made"
    subprocess.run([sys.executable, "-c", script, target], env=environment(), timeout=PATIENCE)
    (left,) = tmp_path.iterdir()
    assert left.name.startswith("made.partial-")
    bevviz.simulate(1).run([KittiExport(target)])
    assert [path.name for path in tmp_path.iterdir()] == ["made"]


def test_two_exports_do_not_share_a_folder(tmp_path: Path) -> None:
    first, second = (KittiExport(tmp_path / "made") for _ in range(2))
    drive = bevviz.simulate(1)
    first.begin(drive.frames)
    with pytest.raises(UserError, match="another process is writing it"):
        second.begin(drive.frames)
    first.observe(drive.at(frame=0))
    first.end()
    assert [path.name for path in tmp_path.iterdir()] == ["made"]


def test_the_working_directory_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=r"^\.: cannot be replaced; give a folder inside of it"):
        KittiExport(Path())


def test_a_scene_of_nuscenes_has_the_same_frames(exported: tuple[Path, bevviz.Drive]) -> None:
    folder, drive = exported
    with bevviz.open(folder.parent / "scenes") as again:
        assert len(again) == 8
        for number in (0, 5):
            result, frame = drive.at(frame=number), again.raw(number)
            np.testing.assert_array_equal(frame.points, result.frame.points)
            np.testing.assert_allclose(frame.pose, result.frame.pose, atol=1e-9)
            (camera,), (there,) = result.frame.cameras, frame.cameras
            assert camera.image is not None and there.image is not None
            assert camera.intrinsics is not None and there.intrinsics is not None
            assert camera.camera_from_points is not None and there.camera_from_points is not None
            np.testing.assert_allclose(there.camera_from_points, camera.camera_from_points, atol=1e-9)
            np.testing.assert_allclose(there.intrinsics.K, camera.intrinsics.K)
            assert np.abs(there.image.bgr.astype(int) - camera.image.bgr).mean() < 3  # JPEG
            objects, truth = result.objects, frame.truth
            assert objects is not None and truth is not None
            assert len(truth.labels) == len(objects) > 0
            names = {"person": "pedestrian", "cyclist": "bicycle", "car": "car"}
            assert list(truth.labels) == [names[name] for name in objects.names]
            boxes = geometry.transform_boxes(objects.boxes, result.frame.pose)
            np.testing.assert_allclose(truth.boxes.center, boxes.center, atol=1e-4)
            np.testing.assert_allclose(truth.boxes.size, boxes.size, atol=1e-5)
            assert np.abs(np.sin(truth.boxes.yaw - boxes.yaw)).max() < 1e-3  # the road is not level


def test_the_nuscenes_tables_name_existing_files(exported: tuple[Path, bevviz.Drive]) -> None:
    """As the devkit goes through them: by tokens, from row to row, and from a track to its annotations."""
    root = exported[0].parent / "scenes"
    tables = {name: json.loads((root / VERSION / f"{name}.json").read_text()) for name in TABLES}
    by_token = {name: {row["token"]: row for row in rows} for name, rows in tables.items()}
    for name, rows in tables.items():
        assert len(by_token[name]) == len(rows)
        for key, value, token in ((*item, row["token"]) for row in rows for item in row.items()):
            table = key.removesuffix("_token")
            if table != key and table in by_token and value:
                assert value in by_token[table], (name, key)
            if key in ("prev", "next") and value:
                assert by_token[name][value]["next" if key == "prev" else "prev"] == token
    assert all((root / row["filename"]).is_file() for row in tables["sample_data"] + tables["map"])
    (scene,) = tables["scene"]
    token, seen = scene["first_sample_token"], 0
    while token:
        seen, last, token = seen + 1, token, by_token["sample"][token]["next"]
    assert (seen, last) == (scene["nbr_samples"], scene["last_sample_token"])
    for instance in tables["instance"]:
        token, count = instance["first_annotation_token"], 0
        while token:
            row = by_token["sample_annotation"][token]
            assert row["instance_token"] == instance["token"]
            count, last, token = count + 1, token, row["next"]
        assert (count, last) == (instance["nbr_annotations"], instance["last_annotation_token"])
    assert len(tables["sample_annotation"]) > 3 * len(tables["instance"])  # they are tracks


@pytest.mark.long
def test_a_track_has_its_most_frequent_class(tmp_path: Path) -> None:
    """A detector may begin with another name; an instance of nuScenes has one for all of its annotations."""

    class Beginning(NuScenesExport):
        def observe(self, result: FrameResult) -> None:
            objects = result.objects
            if self.frames == 0 and objects is not None:
                result = replace(result, objects=replace(objects, names=("bus",) * len(objects)))
            super().observe(result)

    bevviz.simulate(6).run([Beginning(tmp_path / "scenes")])
    tables = {name: json.loads((tmp_path / f"scenes/{VERSION}/{name}.json").read_text()) for name in TABLES}
    names = {row["token"]: row["name"] for row in tables["category"]}
    called = Counter(names[row["category_token"]] for row in tables["instance"] if row["nbr_annotations"] > 3)
    assert len(called) > 1 and "vehicle.bus.rigid" not in called


def test_tables_of_two_scenes_can_be_joined(tmp_path: Path) -> None:
    for name in ("one", "two"):
        bevviz.open(bags.write(tmp_path / f"{name}.mcap", bags.small_items(scans=2))).run(
            [NuScenesExport(tmp_path / name)]
        )
    for table in TABLES:
        one, two = (
            {row["token"] for row in json.loads((tmp_path / f"{name}/{VERSION}/{table}.json").read_text())}
            for name in ("one", "two")
        )
        assert one == two if table in ("sensor", "category", "visibility") else not one & two, table


@pytest.mark.long
def test_a_scene_is_written_by_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = tmp_path / "bag.mcap"
    assert main(["demo", "-o", str(made), "--frames", "3"]) == 0
    out = ["--format", "nuscenes", "-o", str(tmp_path / "scenes")]
    assert main(["export", str(made), "--model", "demo", *out]) == 0
    assert "3 frames with" in capsys.readouterr().err
    assert main(["info", str(tmp_path / "scenes")]) == 0
    assert "format  nuScenes" in capsys.readouterr().out
    assert main(["export", str(made), *out]) == 2
    assert "is there already" in capsys.readouterr().err
