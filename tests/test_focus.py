"""Views that go to the subject of a question, and dim the rest."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import bevviz
from bevviz.model.frame import F32
from bevviz.recording.focus import ABOVE, FROM_ABOVE, IMAGE_WIDTH, SPACE, Focus
from bevviz.why import Selection
from bevviz.why.log import cameras_of
from bevviz.workbench.page_overlay import PageOverlay
from bevviz.workbench.recorded_drive import RecordedDrive
from tests.support.recordings import Recording
from tests.support.workbench_pages import demo_bag

FRAME = 3


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RecordedDrive]:
    """Yield a drive of which one frame is shown."""
    bag = demo_bag(tmp_path_factory.mktemp("focus"))
    with bevviz.open(bag, model="demo") as drive, bevviz.open(bag, model="demo") as again:
        source = RecordedDrive(drive, again.frames)
        result = source.look(FRAME)
        source.first = result.frame.stamp - 300_000_000
        source.show(result, [])
        yield source
        source.close()


@pytest.fixture
def overlay(source: RecordedDrive) -> Iterator[PageOverlay]:
    overlay = source.open_overlay()
    yield overlay
    source.close_overlay(overlay)


def mark(source: RecordedDrive, overlay: PageOverlay, row: int) -> F32:
    """Mark a ground truth object, and return its place."""
    result = source.look(FRAME)
    answer = source.explainer(result).about(Selection(truth=row))
    source.mark(result, answer, overlay)
    assert answer.subject.box is not None
    return np.asarray(answer.subject.box.center[0], np.float32)


def test_a_click_is_where_the_view_has_gone(source: RecordedDrive, overlay: PageOverlay) -> None:
    """The middle of each view is the subject, and the place before the first answer is as usual."""
    stamp = source.look(FRAME).frame.stamp
    assert overlay.position(stamp, "3D", (0, 0, 0)) == pytest.approx((10, 0, -1))
    place = mark(source, overlay, 0)
    for view in ("3D", FROM_ABOVE):
        assert overlay.position(stamp, view, (0, 0, 0)) == pytest.approx(place, abs=1e-3)
    assert overlay.position(stamp - 10**8, "3D", (0, 0, 0)) == pytest.approx((10, 0, -1))
    # The eye looks from the robot's side: behind the middle of the view is farther away.
    behind = overlay.position(stamp, "3D", (10, 0, 0))
    assert np.linalg.norm(behind[:2]) > np.linalg.norm(place[:2])
    ahead = overlay.position(stamp, FROM_ABOVE, (10, 0, 0))
    assert ahead == pytest.approx((place[0] + 10, place[1], place[2]), abs=1e-3)


def test_the_camera_that_shows_most_of_it_comes_first(source: RecordedDrive) -> None:
    result = source.look(FRAME)
    answer = source.explainer(result).about(Selection(object=0))
    (camera,) = result.frame.cameras
    assert camera.camera_from_points is not None
    turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ camera.camera_from_points
    nearer = camera.camera_from_points.copy()
    nearer[2, 3] -= 2.0
    cameras = (
        replace(camera, name="behind", camera_from_points=turned),
        camera,
        replace(camera, name="nearer", camera_from_points=nearer),
    )
    assert cameras_of(replace(result.frame, cameras=cameras), answer) == ["nearer", camera.name]


def test_each_answer_has_poses_of_its_own_time(
    source: RecordedDrive, overlay: PageOverlay, tmp_path: Path
) -> None:
    """Of two poses at one time the viewer may take the older one."""
    places = [mark(source, overlay, row) for row in (0, 1)]
    times: list[int] = []
    for piece in (overlay.buffer[number] for number in range(len(overlay.buffer))):
        (path := tmp_path / "a.rrd").write_bytes(piece)
        recording = Recording(path)
        [translation] = recording.column("/focus/space", "Transform3D:translation")
        assert np.allclose(translation, places[len(times)])
        times += [row["stamp"] for row in recording.rows["/focus/space"]]
    assert times[0] < times[1] <= source.look(FRAME).frame.stamp


def test_the_rest_of_the_frame_is_dimmed(source: RecordedDrive, overlay: PageOverlay, tmp_path: Path) -> None:
    mark(source, overlay, 0)
    (path := tmp_path / "a.rrd").write_bytes(overlay.buffer[0])
    objects = source.look(FRAME).objects
    assert objects is not None
    recording = Recording(path)
    [colors] = recording.column("/world/fused", "Boxes3D:colors")
    assert len(colors) == len(objects)
    assert all(max(color >> shift & 255 for shift in (24, 16, 8)) < 110 for color in colors)
    assert recording.column("/world/missed", "LineStrips3D:colors")


@pytest.mark.parametrize(
    "box", [(0, 100, 20, 160), (600, 100, 639, 170), (300, 150, 320, 200), (560, 20, 639, 359)]
)
def test_a_subject_is_never_at_the_border_of_its_view(
    source: RecordedDrive, box: tuple[float, float, float, float]
) -> None:
    """Its name has room beside it, however near to the border of the image it is."""
    frame = source.look(FRAME).frame
    [camera] = frame.cameras
    part = Focus.on(frame, None, 2.0, {camera.name: np.array(box, np.float32)}).images[camera.name]
    assert part.scale * IMAGE_WIDTH <= 640
    u = ((box[0] + box[2]) / 2 - part.corner[0]) / part.scale
    assert 0.25 * IMAGE_WIDTH < u < 0.75 * IMAGE_WIDTH


def test_a_large_subject_is_seen_whole(source: RecordedDrive) -> None:
    frame, center = source.look(FRAME).frame, np.array([20.0, 0, 0], np.float32)
    near, far = (Focus.on(frame, center, length, {}).views[SPACE].scale[0] for length in (1.8, 12.0))
    assert 2 < far / near < 4
    assert Focus.on(frame, center, 12.0, {}).views[ABOVE].scale[:2] == (1, 1)
