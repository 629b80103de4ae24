"""A recorded drive behind the workbench: clicks, findings, its recording, and tried values."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import bevviz
from bevviz.config import changed_config
from bevviz.errors import UserError
from bevviz.evaluate import match, truth_of
from bevviz.evaluate.matching import judge
from bevviz.findings.frame_findings import find_findings
from bevviz.model import geometry
from bevviz.model.frame import Frame, ImageLabels
from bevviz.model.results import FrameResult
from bevviz.pipeline.notes import HandledFinding, Note, Notes
from bevviz.pipeline.session import Session
from bevviz.recording import blueprints, entities
from bevviz.recording.addresses import RowCache
from bevviz.recording.frame_logger import logged_rows
from bevviz.why import FrameExplainer, Selection
from bevviz.why.click import select_click
from bevviz.why.kept_labels import box_of
from bevviz.workbench.buffers import RecordingBuffer
from bevviz.workbench.page_messages import controls
from bevviz.workbench.recorded_drive import RecordedDrive
from bevviz.workbench.run_results import RunResults
from bevviz.workbench.session import WorkbenchSession, recorded_session
from bevviz.workbench.thumbnails import MOST, WIDTH, Thumbnails
from tests.support.logged_frames import frame_with_image
from tests.support.workbench_pages import FRAMES, demo_bag


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return demo_bag(tmp_path_factory.mktemp("drive"))


@pytest.fixture(scope="module")
def result(bag: Path) -> Iterator[FrameResult]:
    some_are_set_aside = {"clustering.min_cluster_points": 30}
    with bevviz.open(bag, model="demo", set=some_are_set_aside) as drive:
        yield drive.at(frame=1)


def without_truth(result: FrameResult) -> FrameResult:
    return replace(result, frame=replace(result.frame, truth=None))


# --- what a click is on -------------------------------------------------------------------------


def test_rows_of_what_is_drawn_are_rows_of_the_result(result: FrameResult) -> None:
    """The viewer tells the row of what was logged, of which some things are left out."""
    camera = result.cameras[0]
    name, found = camera.camera.name, camera.detections
    assert found is not None
    assert result.objects is not None
    assert result.clusters is not None
    kept = [row for row, is_kept in enumerate(found.kept) if is_kept]
    weak = [row for row, is_kept in enumerate(found.kept) if not is_kept]
    aside = [row for row, is_kept in enumerate(result.clusters.kept) if not is_kept]
    assert kept and weak and aside and len(result.objects)
    rows = logged_rows(result)
    assert select_click(result, None, rows, entities.DETECTIONS.path(name), len(kept) - 1, ()) == Selection(
        detection=kept[-1], camera=name
    )
    assert select_click(result, None, rows, entities.WEAK.path(name), 0, ()) == Selection(
        detection=weak[0], camera=name
    )
    assert select_click(result, None, rows, entities.FUSED, 0, (1, 2, 3)) == Selection(object=0)
    assert select_click(
        result, None, rows, entities.OUTLINES.path(entities.FUSED), 0, (1, 2, 3)
    ) == Selection(object=0)
    assert select_click(
        result, None, rows, entities.OUTLINES.path(entities.DETECTIONS.path(name)), 0, ()
    ) == select_click(result, None, rows, entities.DETECTIONS.path(name), 0, ())
    assert select_click(result, None, rows, entities.TRUTH, 2, ()) == Selection(truth=2)
    lidar = result.frame.lidar
    assert select_click(result, None, rows, entities.SET_ASIDE.path(lidar), 0, ()) == Selection(
        cluster=aside[0]
    )
    assert select_click(result, None, rows, entities.IMAGE.path(name), None, (10.5, 20.5)) == Selection(
        box=(10.0, 20.0), camera=name
    )
    pose, intrinsics = camera.camera.camera_from_points, camera.camera.intrinsics
    assert pose is not None and intrinsics is not None
    shown = geometry.apply(geometry.inverse(pose), np.array([[0.1, 0.05, 0.5]]))  # an image in the 3D view
    pixel = intrinsics.K @ (0.2, 0.1, 1)
    in_image = select_click(result, None, rows, entities.IMAGE.path(name), None, shown[0].tolist())
    assert in_image is not None and in_image.box == pytest.approx(pixel[:2], abs=0.01)
    below = geometry.apply(geometry.inverse(pose), np.array([[0.0, 1.0, 0.5]]))  # a line of its frustum
    assert select_click(result, None, rows, entities.SENSOR.path(name), None, below[0].tolist()) is None
    assert select_click(result, None, rows, entities.BEV, None, (12.7, 3.2)) == Selection(cell=(3, 12))
    point = result.frame.points[5]
    assert select_click(result, None, rows, entities.POINTS.path(lidar), 5, ()) == Selection(
        point=tuple(map(float, point))
    )
    in_space = select_click(result, None, rows, entities.OBSTACLES.path(lidar), None, tuple(point.tolist()))
    assert in_space is not None
    assert in_space.place == pytest.approx(point, abs=1e-4)
    measured = result.objects.measured
    assert measured is not None
    drawn = [row for row, one in enumerate(measured.size != result.objects.boxes.size) if one.any()]
    last = len(drawn) - 1
    assert select_click(result, None, rows, entities.MEASURED, last, ()) == Selection(object=drawn[last])
    center = result.objects.boxes.center[0].tolist()
    assert select_click(result, None, rows, "/world/anything", None, center) == Selection(object=0)
    assert select_click(result, None, rows, entities.FUSED, 10_000, ()) is None
    assert select_click(result, None, rows, "/health/time_ms/total", None, ()) is None


@pytest.mark.parametrize(
    "one",
    [
        Selection(truth=3),
        Selection(detection=0, camera="a/b"),
        Selection(box=(1.5, 2.0), camera="zed"),
        Selection(cell=(3, 12)),
    ],
)
def test_selections_stand_in_an_address(one: Selection) -> None:
    assert Selection.parse(str(one)) == one


@pytest.mark.parametrize("text", ["", "car", "truth//", "truth//nan", "pixel/zed/1", "point//1,2", "x//1"])
def test_an_invalid_pick_is_one_line(text: str) -> None:
    with pytest.raises(UserError, match="nothing that can be asked"):
        Selection.parse(text)


# --- what is worth a look -----------------------------------------------------------------------


def test_objects_missed_against_the_truth_are_listed(result: FrameResult) -> None:
    """Every object that has to be found is found by an object of its class within 2 m, or is listed."""
    frame: Frame = result.frame
    assert frame.truth is not None
    assert result.objects is not None
    truth = truth_of(frame, frame.truth)
    found = find_findings(FrameExplainer(result))
    missed = {find.selection.truth for find in found if find.what == "missed" and find.selection is not None}
    assert missed
    for row, (label, must) in enumerate(zip(truth.labels, truth.must, strict=True)):
        near = [
            name.lower() == label.lower()
            and float(((center[:2] - truth.boxes.center[row, :2]) ** 2).sum()) <= 4
            for name, center in zip(result.objects.names, result.objects.boxes.center, strict=True)
        ]
        if row in missed:
            assert must
        elif must:
            assert any(near)


def test_an_overview_leaves_the_cause_of_a_miss_to_later(result: FrameResult) -> None:
    """It lists the same findings at the same places. A question afterwards gets the whole answer."""
    explainer = FrameExplainer(result)
    early, whole = find_findings(explainer, restore=False), find_findings(explainer)
    assert [find.reason for find in whole] == [find.reason for find in find_findings(FrameExplainer(result))]
    assert any(find.what == "missed" for find in early)
    for one, other in zip(early, whole, strict=True):
        assert (one.selection, one.position, one.in_way) == (other.selection, other.position, other.in_way)
        assert one.reason == ("" if one.what == "missed" else other.reason)


def test_without_truth_unexplained_objects_are_listed(result: FrameResult) -> None:
    few = changed_config(
        result.config, ["detector.conf_threshold=0.6"]
    )  # so that not every near cluster has a name
    unlabelled = Session(few).run(replace(result.frame, truth=None))
    listed = find_findings(FrameExplainer(unlabelled))
    assert {find.what for find in listed} <= {"doubtful", "unmatched", "unnamed"}
    assert any(find.what == "unnamed" for find in listed)
    assert all(not find.distance > 40 for find in listed)


# --- what is shown with other values ------------------------------------------------------------


@pytest.mark.long
def test_a_click_on_a_frame_with_other_values_is_about_these(bag: Path) -> None:
    """The rows are those of the result as tried; the sensors' input has those of the drive as opened."""
    settings = ("clustering.min_cluster_points=100000",)
    with bevviz.open(bag, model="demo") as drive, bevviz.open(bag, model="demo") as again:
        bench = RecordedDrive(drive, again.frames)
        bench.observe(drive.at(frame=0))
        bench.try_values(0, settings, bench.open_overlay().attempt())
        opened, tried = bench.look(0), bench.look(0, settings)
        assert opened.objects and tried.clusters is not None and not tried.clusters.kept.any()
        aside, last = entities.SET_ASIDE.path(opened.frame.lidar), len(tried.clusters) - 1
        clicks: list[tuple[Any, ...]] = [
            ((), entities.FUSED, 1, Selection(object=1)),
            (settings, entities.TRUTH, 2, Selection(truth=2)),
            (settings, aside, last, Selection(cluster=last)),
            (settings, entities.FUSED, 1, None),
        ]
        for _ in ("as drawn", "drawn again, because the rows of the frame were dropped"):
            for settings_then, path, row, selection in clicks:
                assert bench.select(0, settings_then, path, row, ()) == selection
            bench.recording._rows = RowCache()
        same = (f"clustering.eps={drive.config.clustering.eps}",)
        assert bench.look(0, same) is opened, "nothing is changed"
        bench.close()


@pytest.mark.long
def test_other_values_are_beside_what_the_drive_makes(bag: Path, tmp_path: Path) -> None:
    """On a timeline of its own: what was there is as it was, the sensors' data are there on both."""
    from rerun.chunk import RrdReader

    with bevviz.open(bag, model="demo") as drive, bevviz.open(bag, model="demo") as again:
        bench = RecordedDrive(drive, again.frames)
        session = WorkbenchSession(bench)
        bench.observe(drive.at(frame=0))
        overlay, other = bench.open_overlay(), bench.open_overlay()
        told = session.try_values(0, ("clustering.min_cluster_points=100000",), attempt=overlay.attempt())
        recoloured = session.try_values(0, ("ground.distance_threshold=0.5",), attempt=overlay.attempt())
        session.try_values(0, ("detector.conf_threshold=0.9",), attempt=overlay.attempt())
        result = drive.at(frame=0)
        pieces = [
            recording[row]
            for recording in (bench.recording.rows, overlay.buffer)
            for row in range(len(recording))
        ]
        assert len(other.buffer) == 0, "another page shows nothing of it"
        bench.close()
    assert result.objects is not None
    assert result.frame.truth is not None
    found, _ = match(result.objects, truth_of(result.frame, result.frame.truth))
    effects = asdict(told["effects"])
    assert len(effects["lost"]) == len(effects["right"]) == (found >= 0).sum() > 0
    assert len(effects["false_gone"]) == (found < 0).sum() > 0
    assert recoloured["effects"] != told["effects"]
    rows: dict[str, list[tuple[set[str], bool]]] = {}
    for number, piece in enumerate(pieces):  # each is a whole file
        (path := tmp_path / f"{number}.rrd").write_bytes(piece)
        for chunk in RrdReader(path).stream():
            if not chunk.is_static:
                cleared = any("Clear" in str(name) for name in chunk.to_record_batch().schema.names)
                rows.setdefault(chunk.entity_path, []).append((set(chunk.timeline_names), cleared))
    fused = rows[entities.FUSED]
    assert ({"stamp", "tried", "frame", "received"}, False) in fused
    assert ({"tried"}, True) in fused, "no object is left"
    assert not any("stamp" in timelines and cleared for timelines, cleared in fused)
    lidar, camera = result.frame.lidar, result.cameras[0].camera.name
    for path_of_input in (
        entities.POINTS.path(lidar),
        entities.IMAGE.path(camera),
        entities.SENSOR.path(camera),
    ):
        assert not any(cleared for _, cleared in rows[path_of_input])
    assert sum(timelines == {"tried"} for timelines, _ in rows[entities.POINTS.path(lidar)]) == 2, (
        "it is put back"
    )


@pytest.mark.long
def test_a_stopped_try_shows_nothing(bag: Path) -> None:
    """The next try begins anew."""
    with bevviz.open(bag, model="demo") as drive, bevviz.open(bag, model="demo") as again:
        bench = RecordedDrive(drive, again.frames)
        bench.observe(drive.at(frame=0))
        overlay = bench.open_overlay()
        attempt = overlay.attempt()
        overlay.stop()
        with pytest.raises(UserError, match="cancelled"):
            overlay.add_tried(attempt)
        assert len(overlay.buffer) == 0
        bench.try_values(0, ("clustering.eps=0.9",), overlay.attempt())
        assert len(overlay.buffer) == 1
        bench.close()


@pytest.mark.long
def test_a_frame_that_has_not_been_run_yet_is_meant_by_its_time(bag: Path) -> None:
    """A page that is opened again asks for what it showed, long before the run is there."""
    with bevviz.open(bag, model="demo") as drive, bevviz.open(bag, model="demo") as again:
        stamps = [drive.raw(number).stamp for number in range(FRAMES)]
        bench = RecordedDrive(drive, again.frames, first=2)
        with pytest.raises(UserError, match="no frame"):
            bench.number_at(stamps[0])
        bench.show(bench.look(2), ())
        for ran in range(3):
            assert [bench.number_at(stamp) for stamp in stamps] == list(range(FRAMES)), f"{ran} were run"
            middle = (stamps[3] + stamps[4]) // 2
            assert bench.number_at(middle) == 3
            assert bench.number_at(stamps[-1] + 10**9) == FRAMES - 1
            bench.observe(drive.at(frame=ran))
        bench.close()


@pytest.mark.long
def test_a_frame_shows_nothing_of_frames_before_it(bag: Path, tmp_path: Path) -> None:
    """It was drawn before all others, or came before those just before it."""
    from rerun.chunk import RrdReader

    def blind(result: FrameResult) -> FrameResult:
        cameras = tuple(replace(c, detections=None, fusion=None) for c in result.cameras)
        return replace(result, cameras=cameras, objects=None, splits=None)

    def left(pieces: list[bytes], stamp: int) -> list[bool]:
        """Whether the last detections up to that time are cleared, for each timeline of the stamp."""
        rows = []
        for number, piece in enumerate(pieces):
            (path := tmp_path / f"{number}.rrd").write_bytes(piece)
            for chunk in RrdReader(path).stream():
                if chunk.entity_path == seen and not chunk.is_static:
                    batch = chunk.to_record_batch()
                    cleared = any("Clear" in name for name in batch.schema.names)
                    rows += [(at.value, cleared) for at in batch.column("stamp") if at.value <= stamp]
        return [cleared for at, cleared in rows if at == max(rows)[0]]

    with bevviz.open(bag, model="demo") as drive, bevviz.open(bag, model="demo") as again:
        results = [drive.at(frame=number) for number in range(4)]
        seen = entities.DETECTIONS.path(results[0].cameras[0].camera.name)
        bench = RecordedDrive(drive, again.frames, first=3)
        bench.show(blind(results[3]), ())
        for result in (results[0], blind(results[1]), blind(results[2])):
            bench.observe(result)
        first, *others = [bench.recording.rows[row] for row in range(len(bench.recording.rows))]
        application = blueprints.application_id("workbench", bench.recording.scene, drive.config)
        bench.close()
    (whole := tmp_path / "first.rrd").write_bytes(first)
    assert {store.application_id for store in RrdReader(whole).recordings()} == {application}
    assert left([first, others[0]], results[3].frame.stamp) == [True]
    assert left([others[0], others[2]], results[2].frame.stamp) == [True]
    assert left([others[0]], results[0].frame.stamp) == [False]


# --- parts --------------------------------------------------------------------------------------


def test_pieces_of_a_recording_are_read_back_unchanged() -> None:
    told = []
    with RecordingBuffer() as recording:
        end = recording.news.listen(lambda: told.append(len(recording)))
        for piece in (b"one", b"", None, b"two" * 1000):
            recording.add(piece)
        end()
        recording.add(b"three")
        assert [recording[row] for row in range(len(recording))] == [b"one", b"two" * 1000, b"three"]
        assert told == [1, 2]
        with pytest.raises(IndexError):
            recording[3]


def test_kept_results_of_a_run_are_judged_as_its_frames(result: FrameResult) -> None:
    """An object is not false if most of its image box, but not its centre, is in a region without labels."""
    objects, camera, labels = result.objects, result.cameras[0], result.frame.truth
    assert objects is not None and camera.detections is not None and labels is not None
    label = int(match(objects, truth_of(result.frame, labels))[0][0])
    others = [row for row in range(len(labels.labels)) if row != label]
    names, none = tuple(labels.labels[row] for row in others), np.zeros((0, 4), np.float32)
    left, top, _, bottom = camera.detections.xyxy[objects.detection[0]].tolist()
    region = np.array([[left, top, 335, bottom]], np.float32)  # 53 % of the box; the centre is at 336
    truth = replace(
        truth_of(result.frame, replace(labels, boxes=labels.boxes.chosen(others), labels=names, ids=())),
        image=ImageLabels(none, none[:, 0], none[:, 0].astype(np.int32), region),
    )
    with RunResults() as results:
        results.add(result)
        kept = results.get(1)
        assert results.get(0) is None and 0 not in results and 1 in results
    assert kept is not None and kept.objects is not None
    assert judge(kept.objects, truth).false.tolist() == [True] + [False] * 7
    assert not judge(kept.objects, truth, kept.cameras).false.any()


def test_controls_are_made_of_the_fields() -> None:
    from bevviz.config import load

    made = {control["key"]: control for control in controls(load())}
    eps = made["clustering.eps"]
    assert (eps["value"], eps["unit"], eps["low"], eps["high"]) == (0.5, "metres", 0, 20)
    assert made["clustering.boxes"]["choices"] == ["oriented", "axis_aligned"]
    assert made["voxel.average"]["kind"] == "switch"
    assert made["clustering.max_cluster_points"]["kind"] == "whole"
    assert not any(key.startswith("live.") for key in made)


def test_marks_and_notes_share_a_file(tmp_path: Path) -> None:
    notes = Notes([tmp_path / "drive.mcap"])
    done = HandledFinding(1, "missed", "person", "truth//3", 6.3, "done")
    notes.handle(done)
    notes.add(note := Note(5, 6, "a note"))
    notes.handle(HandledFinding(1, "missed", "person", "truth//3", 6.3, "ignored", "why"))
    assert list(notes) == [note]
    assert [(one.state, one.text) for one in notes.handled()] == [("ignored", "why")]
    notes.remove(note)
    notes.handle(HandledFinding(1, "missed", "person", "truth//3", 6.3, ""))
    assert not notes.path.exists()
    with pytest.raises(UserError, match="done or ignored, not 'lost'"):
        notes.handle(HandledFinding(1, "missed", "person", "truth//3", 6.3, "lost"))


def test_thumbnails_are_bounded() -> None:
    """A long drive has one for each of its parts, the first frame of the part that came."""
    thumbnails = Thumbnails(10 * MOST)
    for number in range(0, 10 * MOST, 3):
        thumbnails.add(frame_with_image(number, np.full((2 * WIDTH, 4 * WIDTH, 3), number % 256, np.uint8)))
    shown = [thumbnails.near(number) for number in range(10 * MOST)]
    assert len({id(picture) for picture in shown}) == MOST
    picture = cv2.imdecode(np.frombuffer(shown[25] or b"", np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None and picture.shape == (WIDTH // 2, WIDTH, 3)
    assert abs(picture.mean() - 21) < 2  # frames 20 to 29 are a part
    assert Thumbnails(10).near(3) is None


@pytest.mark.long
def test_a_label_is_kept_changed_and_removed(bag: Path, tmp_path: Path) -> None:
    """It is there in the next session, and the answer is about its object."""
    copy = Path(shutil.copy(bag, tmp_path / "drive.mcap"))
    changed = "person", box_of((9, 2, 0, 4, 2, 2, 0.5))
    for label, kept in ((None, True), (changed, True), (None, False)):
        with bevviz.open(copy, model="demo") as drive, bevviz.open(copy, model="demo") as again:
            session = recorded_session(drive, again.frames, [copy])
            result = session.source._results[0, ()] = without_truth(drive.at(frame=0))
            camera = result.cameras[0].camera.name
            selection = Selection(detection=0, camera=camera)
            before = session.ask(0, (), selection)[0]
            about = session.identity(0, (), selection, before, None)
            drawn = session.draw_label(0, about, label)
            assert (before.label < 0) == (not list(session.tools.notes))
            if kept:
                assert str(tmp_path / "drive.mcap.notes.json") in session.keep_label(0, drawn)
            else:
                assert drawn.label == "person" and drawn.box.center[0].tolist() == [9, 2, 0], "that is kept"
                (note,) = session.tools.notes
                session.remove_note(note.stamp, note.text)
            assert (session.ask(0, (), selection)[0].label == 0) == kept
            assert len(list(session.tools.notes)) == kept
            session.close()
