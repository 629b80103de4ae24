"""The tracker on objects whose ways are known, and its figures on the synthetic drive."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import bevviz
from bevviz.config import TrackingConfig, load
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.extras.demo.sensors import Lidar, PinholeCamera
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, Boxes3D, Frame, LabelledBoxes3D
from bevviz.model.results import Clusters, Objects, Tracks
from bevviz.pipeline.session import Session
from bevviz.stages.tracking import Tracker
from tests.support import kept_drives
from tests.support.track_metrics import IdentityCounter, Tallies, TrackTally, Truth, add_tracks, truth_of
from tests.support.tracking_scenes import CAR, PERSON, scene

CONFIG = TrackingConfig()


def step(tracker: Tracker, *args: Any, config: TrackingConfig = CONFIG, **more: Any) -> Tracks:
    frame, clusters, objects = scene(*args, **more)
    tracks = tracker.update(frame, clusters, np.ones(len(clusters), bool), objects, config)
    check(tracks, clusters, objects)
    return tracks


def check(tracks: Tracks, clusters: Clusters, objects: Objects) -> None:
    """Check the properties of every tracking result."""
    assert len(set(tracks.id.tolist())) == len(tracks)
    for array in (*(tracks.boxes.center, tracks.boxes.size, tracks.boxes.yaw), tracks.velocity, tracks.age):
        assert np.isfinite(array).all()
    assert (tracks.boxes.size > 0).all()
    seen = tracks.cluster[tracks.cluster >= 0]
    assert sorted(seen.tolist()) == list(range(len(clusters))), "each cluster has one track"
    assert ((tracks.cluster >= 0) == (tracks.coasting == 0)).all()
    assert ((tracks.object >= 0) <= (tracks.cluster >= 0)).all()
    assert len(set(tracks.object[tracks.object >= 0].tolist())) == (tracks.object >= 0).sum()
    assert np.isfinite(tracks.trail[:, -1]).all()
    np.testing.assert_array_equal(tracks.trail[:, -1], tracks.boxes.center)


def walk(frames: int, speed: float = 1.4, pose: Any = None) -> tuple[Tracker, Tracks]:
    """Track a person who walks along y, 10 m ahead."""
    tracker = Tracker()
    for i in range(frames):
        place = pose(i) if pose is not None else None
        tracks = step(tracker, i, [(10, speed * i / 10, 0.5)], PERSON, ("person",), pose=place)
    return tracker, tracks


def test_a_person_keeps_the_id_and_has_the_right_speed() -> None:
    _, tracks = walk(20)
    assert tracks.id.tolist() == [0]
    assert tracks.names == ("person",)
    assert tracks.confirmed.all()
    assert tracks.absolute
    np.testing.assert_allclose(tracks.velocity, [[0, 1.4, 0]], atol=0.02)
    np.testing.assert_allclose(tracks.speed, [1.4], atol=0.02)
    np.testing.assert_allclose(tracks.age, [1.9], atol=1e-3)
    assert tracks.hits.tolist() == [20]
    np.testing.assert_allclose(tracks.trail[0, :, 1], 0.14 * np.arange(20), atol=0.25)


def test_the_robots_own_motion_is_no_speed() -> None:
    def turning(i: int) -> F64:
        half = 0.02 * i
        return geometry.transform(
            np.array([0.8 * i, 0.1 * i, 1.9]), np.array([0, 0, np.sin(half), np.cos(half)])
        )

    _, tracks = walk(20, 0.0, turning)
    np.testing.assert_allclose(tracks.speed, [0], atol=0.01)
    np.testing.assert_allclose(tracks.boxes.center, [[10, 0, 0.5]], atol=1e-3)


def test_without_a_fixed_frame_speeds_are_relative_to_the_robot() -> None:
    tracker = Tracker()
    for i in range(20):
        tracks = step(tracker, i, [(30 - 0.8 * i, 2, 0)], CAR, ("car",), lost=True)
    assert not tracks.absolute
    assert tracks.frame_id == "lidar"
    np.testing.assert_allclose(tracks.velocity, [[-8, 0, 0]], atol=0.1)


def test_a_fast_car_is_tracked_from_its_second_frame_on() -> None:
    tracker = Tracker()
    for i in range(8):
        tracks = step(tracker, 5 * i, [(80 - 7 * i, 2, 0)], CAR, ("car",))
    assert tracks.id.tolist() == [0]
    np.testing.assert_allclose(tracks.velocity[0], [-14, 0, 0], atol=0.2)


def test_tracks_need_sightings_and_end_after_a_time() -> None:
    tracker = Tracker()
    shown = [bool(step(tracker, i, [(5, 0, 0)], PERSON, ("person",)).confirmed[0]) for i in range(4)]
    assert shown == [False, False, True, True]
    gone = [step(tracker, i, []) for i in range(4, 15)]
    assert [len(tracks) for tracks in gone] == [1] * 10 + [0]
    np.testing.assert_allclose(gone[4].coasting, [0.5], atol=1e-6)
    assert gone[0].cluster.tolist() == [-1]


def test_young_tracks_end_with_the_first_miss() -> None:
    tracker = Tracker()
    step(tracker, 0, [(5, 0, 0)])
    assert len(step(tracker, 1, [])) == 0


def test_an_object_comes_back_from_behind_another_with_its_id() -> None:
    tracker, tracks = walk(15)
    for i in range(15, 22):
        tracks = step(tracker, i, [])
    np.testing.assert_allclose(tracks.boxes.center[0, 1], 0.14 * 21, atol=0.05)
    tracks = step(tracker, 22, [(10, 0.14 * 22, 0.5)], PERSON, ("person",))
    assert tracks.id.tolist() == [0]


def test_two_who_pass_each_other_keep_their_ids() -> None:
    tracker = Tracker()
    for i in range(40):
        there, back = (10, -2.8 + 0.14 * i, 0), (10.7, 2.66 - 0.14 * i, 0)
        tracks = step(tracker, i, [there, back], PERSON, ("person", "person"))
    assert tracks.id[np.argsort(tracks.boxes.center[:, 0])].tolist() == [0, 1]


def test_the_class_has_most_votes_and_expires_only_in_view() -> None:
    tracker = Tracker()
    for i in range(10):
        name = "bicycle" if i in (3, 7) else "person"
        tracks = step(tracker, i, [(5, 0, 0)], PERSON, (name,))
    assert tracks.names == ("person",)
    for i in range(10, 110):  # in nobody's view
        frame, clusters, objects = scene(i, [(5, 0, 0)])
        tracks = tracker.update(frame, clusters, np.zeros(1, bool), objects, CONFIG)
    assert tracks.confirmed.all()
    for i in range(110, 150):
        tracks = step(tracker, i, [(5, 0, 0)])
    assert not tracks.confirmed.any()


def test_a_rectangle_turned_by_a_quarter_is_the_same_car() -> None:
    tracker = Tracker()
    for i in range(20):
        quarter = i % 2
        size = (CAR[1], CAR[0], CAR[2]) if quarter else CAR
        tracks = step(tracker, i, [(30 - 0.9 * i, 2, 0)], size, ("car",), yaw=0.1 + quarter * np.pi / 2)
    np.testing.assert_allclose(tracks.boxes.size, [CAR], atol=1e-3)
    turn = np.arctan2(np.sin(tracks.boxes.yaw[0]), np.cos(tracks.boxes.yaw[0]))
    assert abs(turn) == pytest.approx(np.pi - 0.1, abs=1e-3) or abs(turn - 0.1 - np.pi) < 1e-3
    assert np.cos(turn) < 0, "it comes: its front is the side towards the robot"


def test_a_track_keeps_its_largest_size() -> None:
    """A car of which only the rear is seen: named with all of its length, then not named any more."""
    tracker = Tracker()
    for i in range(12):
        frame, clusters, objects = scene(i, [(18.2, 0, 0)], (0.4, 1.7, 1.5), ("car",) if 2 <= i < 8 else ())
        if len(objects):
            whole = Boxes3D(
                objects.boxes.center + f32(1.8, 0, 0), f32(4.0, 1.7, 1.5)[None], objects.boxes.yaw
            )
            sides = np.array([[False, True, False, False]])
            objects = replace(objects, boxes=whole, measured=objects.boxes, seen=sides)
        tracks = tracker.update(frame, clusters, np.ones(1, bool), objects, CONFIG)
        assert tracks.id.tolist() == [0]
        length = 4.0 if i >= 2 else 1.7
        assert tracks.boxes.size[0, :2].max() == pytest.approx(length, abs=0.05)
        assert tracks.boxes.center[0, 0] == pytest.approx(20.0 if i >= 2 else 18.2, abs=0.05)
        assert tracks.speed[0] < 0.1, "to become whole is no motion"


def f32(*values: float) -> F32:
    return np.array(values, np.float32)


@pytest.mark.parametrize("stamp", [5, 100], ids=["back", "far forward"])
def test_a_jump_of_the_clock_begins_anew(stamp: int) -> None:
    tracker, _ = walk(20)
    tracks = step(tracker, stamp, [(10, 2, 0.5)], PERSON, ("person",))
    assert tracks.id.tolist() == [1], "an id is never given twice"
    assert tracks.trail.shape[1] == 1


def test_the_same_frame_again_changes_nothing_but_its_counts() -> None:
    tracker, before = walk(20)
    again = step(tracker, 19, [(10, 1.4 * 1.9, 0.5)], PERSON, ("person",))
    assert again.id.tolist() == before.id.tolist()
    np.testing.assert_allclose(again.boxes.center, before.boxes.center, atol=0.01)


def test_tracks_end_where_the_fixed_frame_is_lost() -> None:
    tracker, _ = walk(10)
    lost = step(tracker, 10, [(10, 1.4, 0.5)], lost=True)
    assert lost.id.tolist() == [1]
    assert step(tracker, 11, [(10, 1.5, 0.5)]).id.tolist() == [2]


def test_trails_go_back_as_far_as_asked_for() -> None:
    tracker = Tracker()
    config = replace_trail(0.5)
    for i in range(20):
        tracks = step(tracker, i, [(5, 0.1 * i, 0)], PERSON, ("person",), config=config)
    assert tracks.trail.shape == (1, 6, 3)
    assert step(tracker, 20, [(5, 2, 0)], config=replace_trail(0)).trail.shape == (1, 1, 3)


def replace_trail(seconds: float) -> TrackingConfig:
    return CONFIG.model_copy(update={"trail": seconds})


TRUCK = (12.0, 2.5, 3.0)
HALF = (6.0, 2.5, 3.0)


def shown_ids(tracks: Tracks) -> list[int]:
    return [int(i) for i in tracks.id[tracks.confirmed]]


@pytest.mark.parametrize("speed", [0.0, 8.0])
def test_a_truck_that_falls_into_two_clusters_keeps_one_id(speed: float) -> None:
    """A truck seen in turn as a whole, as two halves, and as the rear half alone."""
    tracker = Tracker()
    for i in range(50):
        x = 20 + speed * i / 10
        turn = "whole" if i % 10 < 3 else "halves" if i % 10 < 8 else "rear"
        parts = {"whole": [x], "halves": [x - 3, x + 3], "rear": [x - 3]}[turn]
        size = TRUCK if turn == "whole" else HALF
        tracks = step(tracker, i, [(part, 4, 0) for part in parts], size, ("truck",) * len(parts))
        assert shown_ids(tracks) == ([0] if i >= 2 else []), i
        if i >= 15:
            row = tracks.id.tolist().index(0)
            assert tracks.velocity[row, 0] == pytest.approx(speed, abs=1.0), "another part is no motion"


def test_older_track_continues_where_the_younger_is_seen() -> None:
    tracker = Tracker()
    for i in range(20):
        parts = [20] if i < 10 else [17, 23] if i < 12 else [23]
        places = [(part, 4, 0) for part in parts]
        tracks = step(tracker, i, places, TRUCK if i < 10 else HALF, ("truck",) * len(parts))
        if i >= 12:
            assert shown_ids(tracks) == [0]
            assert tracks.cluster[tracks.id == 0].tolist() == [0], "it is the object that is seen"


def test_who_stands_at_a_truck_has_a_track_beside_it() -> None:
    tracker = Tracker()
    for i in range(20):
        tracks = step(tracker, i, [(20, 4, 0), (18, 3, 0)], np.array([TRUCK, PERSON]), ("truck", "person"))
    assert shown_ids(tracks) == [0, 1]
    assert tracks.names == ("truck", "person")


def test_two_trucks_in_a_queue_have_two_ids() -> None:
    tracker = Tracker()
    for i in range(20):
        tracks = step(tracker, i, [(20, 4, 0), (33, 4, 0)], TRUCK, ("truck", "truck"))
    assert shown_ids(tracks) == [0, 1]


@pytest.mark.long
def test_trucks_in_a_real_queue_keep_their_ids(shared: Path) -> None:
    """A lorry and an articulated truck beside the robot, in clusters that change from frame to frame."""
    model = shared / "models" / "yolox_nano.onnx"
    counter = IdentityCounter()
    with bevviz.open(shared / "kitti_drive", model=model) as opened:
        for result in opened:
            assert result.tracks is not None
            counter.add(result.tracks)
    assert counter.shown >= 100
    assert counter.switches <= 4, "without the overlap of the boxes: 10"
    assert counter.doubles <= 4, "without merging: 7"


Drive = list[list[tuple[float, float, float]]]


@st.composite
def crowds(draw: st.DrawFn) -> tuple[F32, F32, int]:
    """Objects that start at least 4 m apart, and how they move."""
    cells = draw(st.lists(st.tuples(st.integers(-8, 8), st.integers(-8, 8)), max_size=12, unique=True))
    speeds = draw(st.lists(st.tuples(*[st.floats(-1, 1)] * 2), min_size=len(cells), max_size=len(cells)))
    start = np.array([(4.0 * x, 4.0 * y, 0.0) for x, y in cells], np.float32).reshape(-1, 3)
    velocity = np.array([(*speed, 0.0) for speed in speeds], np.float32).reshape(-1, 3)
    return start, velocity, draw(st.integers(0, 2**31))


@given(crowds())
@settings(max_examples=25)
def test_the_order_of_the_clusters_does_not_matter(crowd: tuple[F32, F32, int]) -> None:
    start, velocity, seed = crowd
    rng = np.random.default_rng(seed)
    plain, shuffled = Tracker(), Tracker()
    names = ("person",) * len(start)
    ids: dict[tuple[Tracker, int], int] = {}
    for i in range(6):
        places = start + velocity * np.float32(0.1 * i)
        order = rng.permutation(len(places))
        a = step(plain, i, places, PERSON, names)
        b = step(shuffled, i, places[order], PERSON, names)
        for tracker, tracks, rows in ((plain, a, np.arange(len(places))), (shuffled, b, order)):
            for number, k in zip(tracks.id.tolist(), tracks.cluster.tolist(), strict=True):
                assert ids.setdefault((tracker, int(rows[k])), number) == number, "none is mixed up"
        in_order = [tracks.boxes.center[np.lexsort(tracks.boxes.center.T)] for tracks in (a, b)]
        np.testing.assert_allclose(in_order[0], in_order[1], atol=1e-4)


@given(st.lists(st.lists(st.tuples(*[st.floats(-60, 60)] * 3), max_size=8), max_size=8), st.booleans())
@settings(max_examples=25)
def test_whatever_comes_ids_are_unique_and_numbers_finite(drive: Drive, lost: bool) -> None:
    tracker, known = Tracker(), set[int]()
    for i, places in enumerate(drive):
        tracks = step(tracker, i * 1.7, places, (1e-3, 5.0, 1.0), lost=lost and i % 3 == 0)
        born = {n for n, age in zip(tracks.id.tolist(), tracks.age, strict=True) if age == 0}
        assert not born & known
        known |= set(tracks.id.tolist())


def test_metrics_of_a_known_id_switch_are_right() -> None:
    """Two objects, 14 frames; in the last four their tracks are swapped, and a third track is false."""
    tally = TrackTally()
    truth = Truth(np.array([[0, 0, 0], [8, 0, 0]], np.float32), np.zeros((2, 3)),
                  np.array([5, 6], np.int32), ("car", "car"), np.ones(2, bool))  # fmt: skip
    tracker = Tracker()
    for i in range(14):
        tracks = step(tracker, i, [(0, 0, 0), (8, 0, 0), (30, 0, 0)], CAR, ("car",) * 3)
        if i >= 10:
            tracks = replace(tracks, id=tracks.id[[1, 0, 2]])
        tally.add(0, tracks, [0, 1, 2], truth, [0, 1])
    assert tally.counts == {"tp": 28, "fp": 14, "fn": 0, "switches": 2}
    assert tally.mota == pytest.approx(1 - 16 / 28)
    assert tally.idf1 == pytest.approx(2 * 20 / (2 * 28 + 14))
    assert max(tally.speeds) < 0.01


@pytest.mark.long
def test_true_boxes_are_tracked_without_a_mistake() -> None:
    """The tracker alone: what it is given is exact, so every switch and every speed error is its own."""
    few = Lidar(beams=2, azimuths=8), PinholeCamera(width=8, height=4, focal=5.0)
    source = SyntheticSource(frames=20, seed=3, lidar=few[0], camera=few[1])
    tracker, tallies = Tracker(), Tallies(TrackTally)
    for i in range(20):
        shot = source.snapshot(i)
        assert shot.frame.truth is not None
        frame, clusters, objects = of_truth(i, shot.frame.truth)
        seen = np.ones(len(clusters), bool)
        tracks = tracker.update(frame, clusters, seen, objects, CONFIG)
        check(tracks, clusters, objects)
        add_tracks(tallies, 0, tracks, truth_of(source, shot, seen & (i > 2)))
    for name in ("person", "cyclist", "car"):
        tally = tallies[name]
        assert tally.counts["switches"] == 0
        assert tally.idf1 > 0.97, name
        assert np.median(tally.speeds) < 0.1
        assert np.quantile(tally.speeds, 0.9) < 0.5


def of_truth(index: int, stated: LabelledBoxes3D) -> tuple[Frame, Clusters, Objects]:
    assert stated.world_from_boxes is not None
    places = geometry.apply(stated.world_from_boxes, stated.boxes.center)
    yaw = stated.boxes.yaw + np.float32(geometry.yaw(stated.world_from_boxes))
    return scene(index, places, stated.boxes.size, stated.labels, yaw=yaw, pose=stated.world_from_boxes)


@pytest.fixture(scope="module")
def drive() -> list[Frame]:
    return list(kept_drives.frames()[:4])


def test_the_pipeline_runs_the_tracker(drive: list[Frame]) -> None:
    session = Session(load(settings=["detector.model=demo"]))
    results = [session.run(frame) for frame in drive]
    last = results[-1]
    assert last.tracks is not None and last.objects is not None and last.clusters is not None
    assert "tracking" in last.timings
    assert last.tracks.frame_id == "map"
    assert last.tracks.confirmed.sum() >= 3
    for row in np.flatnonzero(last.tracks.object >= 0).tolist():
        j = last.tracks.object[row]
        assert last.objects.cluster[j] == last.tracks.cluster[row]


def test_the_reference_has_no_tracks(drive: list[Frame]) -> None:
    assert load(preset="reference").tracking.method == "none"
    session = Session(load(settings=["tracking.method=none"]))
    result = session.run(drive[0])
    assert result.clusters is not None
    assert result.tracks is None
