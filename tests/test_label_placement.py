"""Names beside what is near: few, and none over another."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import rerun as rr
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from rerun.chunk import RrdReader

from bevviz.model.frame import F32, Boxes3D
from bevviz.recording.labels import MAX_NAMES, choose_named, choose_named_in_3d
from bevviz.recording.layers import Layer, Style, draw
from bevviz.recording.states import COLORS, StateLanes
from bevviz.recording.writer import Writer

NUMBERS = st.floats(-50, 50, width=32)
PLACES = arrays.arrays(np.float32, st.tuples(st.integers(0, 20), st.just(3)), elements=NUMBERS)


@given(places=PLACES)
def test_names_do_not_meet_and_the_nearest_has_one(places: F32) -> None:
    at, order = places[:, :2], places[:, 2]
    named = choose_named(at, order, (4.0, 2.0))
    assert named.sum() <= MAX_NAMES
    chosen = at[named]
    beside = np.abs(chosen[:, None] - chosen[None]) >= (4.0, 2.0)
    assert (beside.any(axis=2) | np.eye(len(chosen), dtype=bool)).all()
    if len(places):
        assert order[named].min() == order.min()
    if named.sum() < MAX_NAMES:  # whoever has none would meet one
        for place in at[~named]:
            assert (np.abs(chosen - place) < (4.0, 2.0)).all(axis=1).any()


def test_a_longer_name_has_more_room() -> None:
    at = np.array([[0, 0], [5, 0], [10, 0]], np.float32)
    order = np.arange(3, dtype=np.float32)
    assert choose_named(at, order, (np.array([4.0, 4.0, 4.0]), 1.0)).all()
    assert choose_named(at, order, (np.array([8.0, 4.0, 4.0]), 1.0)).tolist() == [True, False, True]


def test_earlier_objects_are_named_before_nearer_ones() -> None:
    places = np.array([[10, 0, 0], [10.5, 0.2, 0], [10, 9, 0]], np.float32)
    assert choose_named_in_3d(places).tolist() == [True, False, True]
    assert choose_named_in_3d(places, np.array([False, True, False])).tolist() == [False, True, True]


def test_a_lane_starts_with_its_first_state() -> None:
    class Lanes(Writer):
        def __init__(self) -> None:
            self.written: list[tuple[str, str]] = []

        def write(self, path: str, *archetypes: object) -> None:
            [change] = archetypes
            self.written.append((path, change.state.as_arrow_array()[0].as_py()))  # type: ignore[attr-defined]

        def static(self, path: str, *archetypes: object) -> None:
            self.written.append((path, "colours"))

    to, lanes = Lanes(), StateLanes(COLORS)
    for states in ({"/a": "", "/b": "ok"}, {"/a": "failed", "/b": "ok"}, {"/b": "ok"}):
        lanes.log(to, states)
    assert to.written == [
        *[("/b", "colours"), ("/b", "ok"), ("/a", "colours"), ("/a", "failed"), ("/a", "")],
    ]


def test_a_style_is_logged_once_and_again_after_a_refresh(tmp_path: Path) -> None:
    """A viewer may lack what was logged before a refresh."""
    recording = rr.RecordingStream("test")
    recording.save(tmp_path / "a.rrd")
    boxes = Layer("/world/fused", Boxes3D.empty(), Style(width=2.0, labels=False))
    box = Boxes3D(np.ones((1, 3), np.float32), np.ones((1, 3), np.float32), np.zeros(1, np.float32))
    with Writer(recording) as to:
        for index in range(4):
            to.begin(index, index + 1, 0)
            if index == 2:
                to.refresh()
            draw(to, boxes, replace(boxes, path="/world/missed", items=box))
            to.end()
    recording.disconnect()
    chunks = [c for c in RrdReader(tmp_path / "a.rrd").stream() if c.entity_path.startswith("/world")]
    assert {chunk.entity_path for chunk in chunks} == {"/world/missed"}, "a layer without items is left out"
    assert sum(chunk.num_rows for chunk in chunks if chunk.is_static) == 2
