"""A notebook's viewer: what is clicked in it is what is asked about.

The events are those that the viewer sent in JupyterLab and Chromium; they take the way of a page's messages.
"""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest
import rerun as rr

import bevviz
from bevviz.drive import Drive
from bevviz.errors import UserError
from bevviz.notebook import NotebookViewer
from bevviz.recording import blueprints, entities
from bevviz.why import Selection

pytest.importorskip("rerun_notebook")

pytestmark = pytest.mark.long

ORIGIN = {"application_id": "bevviz", "recording_id": "74f3feed65624874a4fb98b371e8523b", "segment_id": None}
FRAMES = 3


@pytest.fixture(scope="module")
def shown() -> Iterator[Drive]:
    """Yield a drive that was run into a viewer."""
    with pytest.MonkeyPatch.context() as patch, bevviz.simulate(frames=FRAMES, seed=3) as drive:
        patch.setattr("bevviz.notebook.in_notebook", lambda: True)
        drive.show()
        yield drive


@pytest.fixture
def drive(shown: Drive) -> Iterator[Drive]:
    """Yield the shown drive at its first frame with no selection."""
    stamp = shown.raw(0).stamp
    tell(shown, type="selection_change", items=[])
    tell(shown, type="timeline_change", timeline="stamp", time=float(stamp))
    yield shown
    shown.configure("clustering.eps=0.5")


def viewer(drive: Drive) -> NotebookViewer:
    assert drive._viewer is not None
    return drive._viewer


def tell(drive: Drive, **event: object) -> None:
    """As the page does."""
    viewer(drive).viewer._viewer._handle_custom_msg(json.dumps({**ORIGIN, **event}), [])


def test_the_viewer_has_the_application_id_of_its_layout(drive: Drive) -> None:
    application = blueprints.application_id("workbench", drive.scene, drive.config)
    assert rr.get_application_id(viewer(drive).recording) == application


def click(drive: Drive, path: str, **more: object) -> None:
    item = {"type": "entity", "entity_path": path, "view_name": "3D", **more}
    tell(drive, type="selection_change", items=[item])


def test_nothing_is_selected_at_first(drive: Drive) -> None:
    assert drive.selected is None
    view = {"type": "view", "view_id": "dee4a5fa-67b5-4a5c-bdd1-f9d1b8f2b8b9", "view_name": "3D"}
    tell(drive, type="selection_change", items=[view])
    assert drive.selected is None
    said = [answer.verdict.text for answer in drive.why(hints=0)]
    assert said == [answer.verdict.text for answer in drive.why(frame=0, hints=0)]


def test_a_pixel_that_is_clicked_is_answered(drive: Drive) -> None:
    click(drive, "/world/zed/image", position=[319.70007, 100.58107, None])
    selected = drive.selected
    assert selected is not None
    assert (selected.frame, selected.path) == (0, "/world/zed/image")
    assert selected.pick is not None
    assert (selected.pick.kind, selected.pick.camera) == ("pixel", "zed")
    assert selected.pick.place == pytest.approx((319.2, 100.08107), abs=1e-3)
    (answer,) = drive.why(hints=0)
    assert "the LiDAR has no points there" in answer.verdict.text


def test_the_frame_is_that_of_the_click(drive: Drive) -> None:
    """On whichever timeline the viewer is; times come as doubles, which are 256 ns apart."""
    stamps = [drive.raw(number).stamp for number in range(FRAMES)]
    tell(drive, type="time_update", time=float(stamps[2]))
    click(drive, entities.TRUTH, instance_id=1)
    tell(drive, type="time_update", time=float(stamps[1]))
    assert drive.selected is not None
    assert drive.selected.frame == 2
    (answer,) = drive.why(hints=0)
    assert answer.subject.row == 1
    assert answer.subject.kind == "truth"
    tell(drive, type="timeline_change", timeline="frame", time=1.0)
    click(drive, entities.TRUTH, instance_id=1)
    assert drive.selected.frame == 1
    assert [a.subject.name for a in drive.why(cls="person", hints=0)] == [
        a.subject.name for a in drive.why(frame=1, cls="person", hints=0)
    ]


def test_rows_are_those_of_the_run_that_is_shown(drive: Drive) -> None:
    """With other values the object of that row is another one: then its place is asked about."""
    result = drive.at(frame=0)
    assert result.objects is not None
    row = len(result.objects) - 1
    click(drive, entities.FUSED, instance_id=row, position=[1, 2, 3])
    (as_shown,) = drive.why(hints=0)
    assert (as_shown.subject.kind, as_shown.subject.row) == ("object", row)
    drive.configure("clustering.min_cluster_points=100000")
    selected = drive.selected
    assert selected is not None
    assert selected.pick == Selection(object=row)
    (now,) = drive.why(hints=0)
    assert now.subject.box is not None
    assert now.subject.kind == "point"
    np.testing.assert_allclose(now.subject.box.center[0], result.objects.boxes.center[row], atol=1e-4)
    drive.configure("clustering.min_cluster_points=10")


def test_an_invalid_selection_is_explained(drive: Drive) -> None:
    click(drive, "/health/time_ms/total")
    assert drive.selected is not None
    assert drive.selected.pick is None
    with pytest.raises(UserError, match="nothing can be asked about /health/time_ms/total"):
        drive.why()


def test_an_answer_is_marked_in_the_viewer_at_its_frame(
    drive: Drive, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[dict[str, object]] = []
    widget = viewer(drive).viewer._viewer
    monkeypatch.setattr(widget, "send", lambda content, buffers=None: sent.append(content))
    drive.why(frame=2, cls="person", hints=0)
    assert any(one["type"] == "rrd" for one in sent)
    (moved,) = [one for one in sent if one["type"] == "time_ctrl"]
    assert (moved["timeline"], moved["timestamp_nanos"]) == ("stamp", str(drive.raw(2).stamp))


def test_without_a_viewer_a_scan_has_to_be_named(shown: Drive) -> None:
    with bevviz.simulate(frames=1) as other:
        assert other.selected is None
        with pytest.raises(UserError, match="which scan"):
            other.why()
