"""Rows of tables that a logger notes for the entities that it draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import rerun as rr

from bevviz.config import load
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.pipeline.session import Session
from bevviz.recording import entities
from bevviz.recording.addresses import Address, RowCache, Rows
from bevviz.recording.frame_logger import logged_rows
from bevviz.recording.layers import Layer, draw
from bevviz.recording.writer import Writer


def test_an_item_that_is_drawn_twice_has_one_address() -> None:
    writer = Writer(rr.RecordingStream("addresses"))
    writer.begin(0, 0, 0)
    line = np.zeros((1, 2, 3), np.float32)
    draw(writer, Layer("/line", line, says=["one"], rows=Rows("detection", [7], ["front"])))
    rows = writer.rows["/line"]
    assert [rows.at(instance) for instance in (-1, 0, 1, 2)] == [
        None,
        Address("detection", 7, "front"),
        Address("detection", 7, "front"),
        None,
    ]
    writer.begin(1, 1, 0)
    assert not writer.rows, "the next frame has not drawn it"


@pytest.mark.long
def test_frustums_have_the_rows_of_their_detections() -> None:
    frame = SyntheticSource(frames=12).snapshot(8).frame
    result = Session(load(settings=["detector.model=demo"])).run_single(frame)
    [first] = result.cameras
    second = replace(first, camera=replace(first.camera, name="rear"))
    rows = logged_rows(replace(result, cameras=(first, second)))[entities.FRUSTUMS]
    assert first.detections is not None
    kept = np.flatnonzero(first.detections.kept).tolist()
    assert len(kept) > 1 and [rows.at(i) for i in range(2 * len(kept))] == [
        Address("detection", row, name) for name in (first.camera.name, "rear") for row in kept
    ]


def test_the_rows_of_the_oldest_frames_are_dropped() -> None:
    cache = RowCache(2)
    for number in (1, 2, 1, 3):
        cache.put(number, {"/world/fused": Rows("object", range(number))})
    assert cache.get(2) is None
    assert [len(rows["/world/fused"].rows) for n in (1, 3) if (rows := cache.get(n))] == [1, 3]
