"""Every drawn entity can be clicked, and the answer is about it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

import bevviz
from bevviz.model import geometry
from bevviz.pipeline.run import run
from bevviz.recording import entities
from bevviz.why import Answer
from bevviz.why.subject import points_in_box
from bevviz.workbench.recorded_drive import RecordedDrive
from bevviz.workbench.session import WorkbenchSession
from tests.support.workbench_pages import demo_bag

pytestmark = pytest.mark.long

FRAME = 3
ROWS = 8  # of each entity that are clicked
MARGIN = 0.3  # metres around the box of an answer
SAME: dict[str, float] = {
    entities.MEASURED: 3.0
}  # metres between a drawn box and its object; a measured box is a part of it
OUTSIDE = ("/world/bev", "/world/fused/names")  # a grid and texts: their positions are those of others


class Drawn(NamedTuple):
    """One row of an entity."""

    path: str
    row: int
    position: NDArray[np.float64]  # pixels of an image, else metres of the fixed frame
    is_box: bool


@pytest.fixture(
    scope="module",
    params=[{}, {"objects.method": "topic:/ground_truth"}],
    ids=["fusion", "robot's objects"],
)
def source(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[RecordedDrive]:
    """Yield a drive that has been run."""
    bag = demo_bag(tmp_path_factory.mktemp("entities"))
    settings = {"clustering.min_cluster_points": 30, **request.param}
    with (
        bevviz.open(bag, model="demo", set=settings) as drive,
        bevviz.open(bag, model="demo", set=settings) as again,
    ):
        source = RecordedDrive(drive, again.frames)
        run(again.frames, drive.new_session(), [source])
        yield source
        source.close()


def drawn(source: RecordedDrive, folder: Path) -> Iterator[Drawn]:
    """Yield rows of all entities of a frame that a user can see in a view."""
    from rerun.chunk import RrdReader

    stamp = source.look(FRAME).frame.stamp
    poses: dict[str, NDArray[np.float64]] = {}
    rows: dict[str, dict[str, Any]] = {}
    for number in range(len(source.recording.rows)):
        (path := folder / f"{number}.rrd").write_bytes(source.recording.rows[number])
        for chunk in RrdReader(path).stream():
            batch = chunk.to_record_batch()
            columns = {name: batch.column(name) for name in batch.schema.names}
            at = 0
            if not chunk.is_static:
                at = next((i for i, time in enumerate(columns["stamp"]) if time.value == stamp), -1)
            if at < 0:
                continue
            values = {name: column[at].as_py() for name, column in columns.items() if ":" in name}
            values = {name: value for name, value in values.items() if value}
            if "Transform3D:translation" in values:
                poses[chunk.entity_path] = _matrix(values)
            if not chunk.is_static:
                rows.setdefault(chunk.entity_path, {}).update(values)
    for entity, values in rows.items():
        if not entity.startswith((entities.WORLD, entities.BEV)) or entity in OUTSIDE:
            continue
        for name in ("Boxes3D:centers", "LineStrips3D:strips", "Points3D:positions", "Boxes2D:centers",
                     "LineStrips2D:strips", "Points2D:positions"):  # fmt: skip
            if name in values:
                content, is_box = values[name], name.startswith("Boxes")
                for row in np.linspace(0, len(content) - 1, min(ROWS, len(content))).astype(int).tolist():
                    point = np.atleast_2d(content[row]).mean(axis=0)
                    yield Drawn(entity, row, _fixed(poses, entity, point), is_box)
                break


def _matrix(values: dict[str, Any]) -> NDArray[np.float64]:
    quaternion = values.get("Transform3D:quaternion", [(0.0, 0.0, 0.0, 1.0)])[0]
    return geometry.transform(values["Transform3D:translation"][0], quaternion)


def _fixed(
    poses: dict[str, NDArray[np.float64]], path: str, point: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a point of an entity in the fixed frame; one with two coordinates stays."""
    while len(point) == 3 and path:
        point = (poses.get(path, np.eye(4)) @ [*point, 1])[:3]
        path = path.rpartition("/")[0]
    return point


def _is_at(answer: Answer, place: NDArray[np.float64], path: str) -> bool:
    """Whether the object of an answer is at the centre of a drawn box, or holds it."""
    box, center = answer.subject.box, answer.center
    inside = box is not None and points_in_box(box, place[None].astype(np.float32), MARGIN).any()
    near = center is not None and np.linalg.norm(place - center) <= SAME.get(path, 1.0)
    return bool(inside or near)


def test_every_drawn_entity_answers_about_itself(source: RecordedDrive, tmp_path: Path) -> None:
    session, result = WorkbenchSession(source), source.look(FRAME)
    seen, silent, others = set(), [], []
    for one in drawn(source, tmp_path):
        seen.add(one.path)
        place = one.position
        if len(place) == 3:  # The 3D view shows the frame of the points, and tells clicks in it.
            place = geometry.apply(geometry.inverse(result.frame.pose), place[None])[0]
        selection = source.select(FRAME, (), one.path, one.row, place.tolist())
        if selection is None:
            silent.append(f"{one.path}[{one.row}]")
            continue
        answer = session.ask(FRAME, (), selection)[0]
        if one.is_box and len(one.position) == 3:
            if not _is_at(answer, place, one.path):
                others.append(f"{one.path}[{one.row}]: {answer.verdict.text}")
        elif one.is_box and answer.subject.xyxy is not None:
            u0, v0, u1, v1 = answer.subject.xyxy
            if not (u0 <= one.position[0] <= u1 and v0 <= one.position[1] <= v1):
                others.append(f"{one.path}[{one.row}]: {answer.verdict.text}")
    assert not silent
    assert not others, "\n".join(others)
    assert len(seen) >= 15
    assert {entities.FUSED, entities.TRACKS, entities.FRUSTUMS} <= seen
