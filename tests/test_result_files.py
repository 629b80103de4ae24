"""Results of detectors in files, as boxes of a drive's frames."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

import bevviz
from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import load
from bevviz.datasets.result_files import Labelled
from bevviz.model.results import FrameResult, Objects
from bevviz.report.facts import shareable
from tests.support import bags, datasets

LABEL = "Car 0.00 0 0.0 {left} 5 70 30 1.5 1.6 4.0 0.0 1.7 {ahead} -1.57 {score}\n"


TABLE = "frame, name, x, y, z, length, width, height, yaw\n{},Cars,12,0,-1,4,1.6,1.5,{}\n"
TWO_IMAGES = json.dumps(
    {
        "images": [{"id": 1, "file_name": "a/1.png"}, {"id": 2, "file_name": "a/001.png"}],
        "annotations": [{"image_id": 1, "bbox": [1, 2, 3, 4]}, {"image_id": 2, "bbox": [1, 2, 3, 4]}],
    }
)


def open_with(path: Path, stage: str, file: Path, **more: str) -> bevviz.Drive:
    settings = {"source.results": {"mine": str(file)}, stage: "topic:/results/mine"}
    return bevviz.open(path, set={**settings, **more})


def objects_of(result: FrameResult) -> Objects:
    assert result.objects is not None and result.failures == ()
    return result.objects


def test_kitti_results_rank_by_their_16th_column(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The labels themselves, and a wrong box that is surer of itself or less."""
    drive = datasets.kitti_object(tmp_path / "training")
    precision = {}
    for score in ("0.95", "0.10"):
        folder = tmp_path / f"surer_{score[2:]}"
        folder.mkdir()
        for label in sorted((drive / "label_2").glob("*.txt")):
            label.write_text(
                label.read_text().replace("14.00 70.00 28.00", "4.00 70.00 36.00")
            )  # 25 pixels count
            rows = [line for line in label.read_text().splitlines() if not line.startswith("DontCare")]
            wrong = LABEL.format(left=60, ahead=30, score=score)
            (folder / label.name).write_text("".join(f"{row} 0.5\n" for row in rows) + wrong)
        assert main(["evaluate", str(drive), "--results", str(folder), "--json"]) == 0
        metrics = json.loads(capsys.readouterr().out)["metrics"]
        precision[score] = {name: value for name, value in metrics.items() if name.startswith("ap_3d_0.5")}
        assert metrics["recall.car"] == 1
    assert precision["0.95"] and precision["0.95"] != precision["0.10"]
    assert all(value <= precision["0.10"][name] for name, value in precision["0.95"].items())
    objects = objects_of(open_with(drive, "objects.method", tmp_path / "surer_10").at(frame=1))
    assert objects.names == ("Car", "Car") and objects.score.tolist() == pytest.approx([0.5, 0.1])


def test_results_of_nuscenes_are_those_of_their_samples(tmp_path: Path) -> None:
    root = datasets.nuscenes(tmp_path / "nuscenes")
    rows = json.loads((root / "v1.0-mini" / "sample_annotation.json").read_text())
    results: dict[str, list[dict[str, object]]] = {}
    for row in rows:
        box = {key: row[key] for key in ("sample_token", "translation", "size", "rotation")}
        results.setdefault(row["sample_token"], []).append(
            {**box, "velocity": [0, 0], "detection_name": "car", "detection_score": 0.7, "attribute_name": ""}
        )
    file = tmp_path / "results_nusc.json"
    file.write_text(json.dumps({"meta": {"use_lidar": True}, "results": results}))
    drive = open_with(root, "objects.method", file, **{"source.sequence": "scene-0061"})
    frame = next(frame for n in range(len(drive)) if (frame := drive.raw(n)).truth is not None)
    (labelled,) = frame.robot_boxes
    assert frame.truth is not None and labelled.world_from_boxes is not None
    np.testing.assert_allclose(labelled.boxes.center[0], frame.truth.boxes.center[0])
    np.testing.assert_allclose(labelled.boxes.size[0], frame.truth.boxes.size[0])
    assert labelled.boxes.yaw[0] == pytest.approx(frame.truth.boxes.yaw[0])
    assert set(labelled.scores.tolist()) == {np.float32(0.7)}


def test_results_of_coco_are_detections(tmp_path: Path) -> None:
    drive = datasets.kitti_object(tmp_path / "training")
    file = tmp_path / "coco.json"
    file.write_text(json.dumps([{"image_id": 1, "category_id": 3, "bbox": [10, 5, 40, 20], "score": 0.8}]))
    detections = open_with(drive, "detector.model", file).at(frame=1).cameras[0].detections
    assert detections is not None and detections.names == ("car",)
    assert detections.xyxy.tolist() == [[10, 5, 50, 25]] and detections.score[0] == np.float32(0.8)
    whole = {
        "images": [{"id": 77, "file_name": "image_2/000002_png.rf.0a1b2c3d.jpg"}],
        "categories": [{"id": 9, "name": "van"}],
        "annotations": [{"image_id": 77, "category_id": 9, "bbox": [1, 2, 3, 4]}],
    }
    file.write_text(json.dumps(whole))
    detections = open_with(drive, "detector.model", file).at(frame=2).cameras[0].detections
    assert detections is not None and detections.names == ("van",)
    assert main(["why", str(drive), "--results", f"net={file}", "--at-frame", "2"]) == 0


@pytest.mark.long
def test_a_table_of_our_own_objects_comes_back(tmp_path: Path) -> None:
    with bevviz.simulate(frames=3) as source:
        made = objects_of(source.at(frame=1))
    table = made.to_arrow().append_column("frame", pa.array([1] * len(made)))
    parquet.write_table(table, tmp_path / "boxes.parquet")
    drive = datasets.kitti_object(tmp_path / "training")
    objects = objects_of(open_with(drive, "objects.method", tmp_path / "boxes.parquet").at(frame=1))
    assert objects.names == made.names
    np.testing.assert_allclose(objects.boxes.center, made.boxes.center)
    np.testing.assert_allclose(objects.boxes.yaw, made.boxes.yaw)


def numbered_results(folder: Path, scans: int) -> dict[str, str]:
    """Write 3D and image boxes for each scan, whose names are the number of the scan."""
    columns = {name: [1.0] * scans for name in ("x", "y", "z", "length", "width", "height", "yaw")}
    named = {"frame": range(scans), "name": [f"n{n}" for n in range(scans)], "score": [0.5] * scans}
    parquet.write_table(pa.table({**named, **columns}), folder / "boxes.parquet")
    rows = [{"image_id": n, "category_id": n, "bbox": [n, 5, 40, 20], "score": 0.8} for n in range(scans)]
    names = [{"id": n, "name": f"n{n}"} for n in range(scans)]
    (folder / "coco.json").write_text(json.dumps({"categories": names, "annotations": rows}))
    return {"mine": str(folder / "boxes.parquet"), "net": str(folder / "coco.json")}


def labels_of(source: BagSource) -> list[tuple[float, set[str]]]:
    """Return the time and the labels of each frame."""
    labels = []
    for frame in source:
        boxes: list[Labelled] = [*frame.robot_boxes, *frame.robot_detections]
        labels.append((frame.stamp * 1e-9, {name for labelled in boxes for name in labelled.labels}))
    return labels


def test_a_part_of_a_drive_has_the_rows_of_its_scans(tmp_path: Path) -> None:
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=20))
    config = load(settings=[f"source.results={json.dumps(numbered_results(tmp_path, 20))}"])
    with BagSource([bag], config) as source:
        whole = labels_of(source)
        assert [names for _, names in whole] == [{f"n{n}"} for n in range(20)]
    with BagSource([bag], config, start="1") as source:
        assert labels_of(source) == whole[-source.total :] and source.total < 20


@pytest.mark.long
@pytest.mark.parametrize("form", ["mcap", "ros1"])
def test_a_report_has_the_boxes_of_its_result_files(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    messages = bags.Messages(form == "ros1")
    bag = bags.write(tmp_path / "drive.bag", bags.small_items(messages, scans=60), messages, form=form)
    results = numbered_results(tmp_path, 60)
    given = [part for name, path in results.items() for part in ("--results", f"{name}={path}")]
    whole = dict(labels_of(BagSource([bag], load(settings=[f"source.results={json.dumps(results)}"]))))
    out = tmp_path / "report" / "bug.rrd"
    out.parent.mkdir()
    monkeypatch.chdir(out.parent)
    window = ["--at", "4", "--before", "0.3", "--after", "0.3"]
    assert main(["report", str(bag), *given, *window, "--redact"]) == 2
    assert "--redact needs a detector" in capsys.readouterr().err
    assert main(["report", str(bag), *given, *window, "-o", str(out)]) == 0
    for path in results.values():
        Path(path).unlink()
    assert main(["report", "--check", str(out)]) == 0
    assert "the same in every bit" in capsys.readouterr().out
    page = out.with_suffix(".html").read_text()
    assert "topic:/results/mine" in page and "boxes.parquet" not in page
    stages = ["objects.method=topic:/results/mine", "detector.model=topic:/results/net"]
    with BagSource([out.with_suffix(".mcap")], load(settings=stages)) as source:
        reported = labels_of(source)
    assert len(reported) > 7 and all(whole[time] == names for time, names in reported)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("gone.json", None, "no such file or folder; expected a folder of KITTI"),
        ("boxes.json", "{", "is no JSON"),
        ("boxes.json", "[1]", "neither results of nuScenes nor of COCO"),
        ("boxes.json", '{"results": {"a": []}}', "are of nuScenes' samples, which the drive lacks"),
        ("boxes.json", '[{"image_id": 99, "bbox": [0, 0, 1, 1]}]', "is of one of the 3 frames"),
        (
            "boxes.json",
            '[{"image_id": 2, "bbox": [0, 0, 1, 1]}, {"image_id": 3, "bbox": [0, 0, 1, 1]}]',
            "numbered to 3, those of this drive from 0",
        ),
        ("boxes.json", TWO_IMAGES, "a/1.png and a/001.png both end in 1, the number of their frame"),
        ("000001.txt", "2 0.3 0.5 0.2 0.3\n", "a line has 5 columns, a result of KITTI has 16"),
        ("boxes.csv", "frame,name\n1,car\n", "its columns are frame, name; expected"),
        ("boxes.csv", TABLE.format(1, 90), "a yaw of 90 is no angle in radians: is it in degrees?"),
        ("boxes.parquet", "no table", "cannot be read as a table"),
        ("boxes.xyz", "", "is not read; expected"),
    ],
)
def test_unusable_result_files_are_one_line(
    tmp_path: Path, name: str, text: str | None, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = datasets.kitti_object(tmp_path / "training")
    if text is not None:
        (tmp_path / name).write_text(text)
    assert main(["info", str(drive), "--results", str(tmp_path / name)]) == 2
    assert said in " ".join(capsys.readouterr().err.split())


def test_results_of_another_drive_are_told(tmp_path: Path) -> None:
    drive = datasets.kitti_object(tmp_path / "training")
    (tmp_path / "boxes.csv").write_text(TABLE.format(1, 0) + "9,Cars,12,0,-1,4,1.6,1.5,0\n")
    opened = open_with(drive, "objects.method", tmp_path / "boxes.csv")
    said = "its frames are numbered to 9, those of this drive from 0 to 2: is it of another drive?"
    assert any(said in warning for warning in opened.warnings)


@pytest.mark.parametrize(
    ("stage", "rows", "why"),
    [
        (
            "objects.method",
            TABLE.format(1, 0) + "1,Car,,0,-1,4,1.6,1.5,0\n",
            "its centre is not finite: nan, 0, -1",
        ),
        ("objects.method", TABLE.format(1, 0) + "1,Car,9,0,-1,4,-1,1,0\n", "its size is negative: 4, -1, 1"),
        (
            "detector.model",
            "frame,name,x0,y0,x1,y1\n1,Car,5,6,50,60\n1,Car,9,9,3,3\n",
            "its size is negative: -6, -6, 0",
        ),
    ],
)
def test_unusable_boxes_of_a_result_file_are_told(tmp_path: Path, stage: str, rows: str, why: str) -> None:
    drive = datasets.kitti_object(tmp_path / "training")
    (tmp_path / "boxes.csv").write_text(rows)
    opened = open_with(drive, stage, tmp_path / "boxes.csv")
    frame = opened.raw(1)
    (labelled,) = frame.robot_boxes or frame.robot_detections
    assert len(labelled.labels) == len(labelled.scores) == 1
    assert any(
        warning.endswith(f"of /results/mine could not be used, the first: box 1 (Car): {why}")
        for warning in opened.warnings
    )


def test_labels_that_no_object_name_fits_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive, results = datasets.kitti_object(tmp_path / "training"), tmp_path / "preds"
    results.mkdir()
    for label in (drive / "label_2").glob("*.txt"):
        row, _ = label.read_text().splitlines()
        (results / label.name).write_text(f"{row.replace('Car', 'Cars')} 0.9\n")
    command = ["evaluate", str(drive), "--results", str(results)]
    assert main(command) == 0
    said = "no 'Car' was found, but 3 of 3 have an object named 'cars' within 2 m"
    out = " ".join(capsys.readouterr().out.split())
    assert said in out
    rule = 'source.labels={"Car": ["cars"]}'
    assert f"--set '{rule}'" in out
    assert main([*command, "--set", rule, "--json"]) == 0
    found = capsys.readouterr()
    assert json.loads(found.out)["metrics"]["recall"] == 1 and said not in found.err


def test_a_report_names_result_files_without_their_folder() -> None:
    config = load(settings=['source.results={"mine": "/home/me/preds/boxes.json"}'])
    assert shareable(config).source.results == {"mine": "boxes.json"}
