"""Which of the robot's own nodes lost an object: on a generated graph, and asked of a bag."""

from __future__ import annotations

import json
import time
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import bevviz
from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import load
from bevviz.config.reloading import ReloadableConfig
from bevviz.errors import UserError
from bevviz.extras.robot_chain.chain import ObjectMessage, RobotChain, verdict
from bevviz.extras.robot_chain.messages import FollowedObject
from bevviz.messages.encode import encode_boxes_3d
from bevviz.model.frame import Boxes3D
from bevviz.model.results import FrameResult
from bevviz.workbench.held_seconds import FrameFacts, HeldSeconds
from bevviz.workbench.recorded_drive import RecordedDrive
from tests.support import bags, chained_robot, documented_json
from tests.support.live_sessions import live_bench
from tests.support.robot_graphs import PARENT, TOPICS, Graph, Plant, make_graph
from tests.support.ros_graphs import own_graph
from tests.support.waiting import PATIENCE
from tests.support.workbench_pages import Talk, served

SEEDS = range(500, 508)
PARENTS = {TOPICS[node]: {TOPICS[parent]} for node, parent in PARENT.items()}
PARENTS["/merged"].add("/camera/objects")


@pytest.fixture(scope="module")
def graphs() -> list[Graph]:
    return [make_graph(seed) for seed in SEEDS]


def test_the_node_that_lost_an_object_is_named(graphs: list[Graph]) -> None:
    asked, right, frames = 0, 0, 0
    started = time.process_time()
    for graph in graphs:
        chain = RobotChain(graph.messages, graph.sensors)
        frames += len(graph.sensors["/points"])
        for plant in graph.plants:
            found = verdict(chain.follow(*graph.places[plant]))
            asked += 1
            right += found is not None and found.topic == TOPICS[plant.node]
    seconds = time.process_time() - started
    assert asked >= 100
    assert right >= 0.95 * asked
    assert seconds < 0.005 * (frames + asked)


def test_each_topic_is_made_from_its_parents(graphs: list[Graph]) -> None:
    found = []
    for graph in graphs:
        steps = {step.topic: step for step in RobotChain(graph.messages, graph.sensors).steps}
        assert next(iter(steps)).endswith("/objects"), "detectors come first"
        found += [set(steps[topic].parents) == parents for topic, parents in PARENTS.items()]
        assert steps["/lidar/objects"].parents == ("/points",)
        assert 0.02 < steps["/lidar/objects"].delay < 0.06
        assert steps["/planner/objects"].lost > 0.4, "it runs at half of the rate"
        assert steps["/display/objects"].names["person"] == "VRU"
        assert steps["/relevant"].keeps_ids and not steps["/tracks"].keeps_ids
    assert np.mean(found) >= 0.95


def test_an_untouched_object_is_not_accused() -> None:
    """With no losses but the planted ones, each other object that all nodes have is kept by all."""
    graph = make_graph(77, losses=0.0, plants=7)
    chain = RobotChain(graph.messages, graph.sensors)
    planted = {plant.frame for plant in graph.plants}
    kept = accused = 0
    last = {one.stamp: one for one in graph.messages["/display/objects"]}
    for frame, stamp in enumerate(graph.sensors["/points"]):
        if frame in planted or stamp not in last or frame < 2:
            continue
        for center in last[stamp].center:
            outcomes = chain.follow(stamp, center)
            kept += 1
            accused += verdict(outcomes) is not None
    assert kept > 100
    assert accused <= 0.01 * kept


def test_the_end_of_the_messages_accuses_no_node() -> None:
    graph = make_graph(77, losses=0.0, plants=0)
    last = graph.messages["/lidar/objects"][-1]
    cut = {
        topic: [one for one in messages if one.received <= last.received]
        for topic, messages in graph.messages.items()
    }
    for center in last.center:
        outcomes = RobotChain(cut, graph.sensors).follow(last.stamp, center)
        assert verdict(outcomes) is None
        assert "cannot be told" in outcomes[-1].text


def test_copies_of_one_topic_cannot_be_told_apart() -> None:
    """Two nodes that pass on the same at the same time are both named."""

    def message(stamp: int, late: float) -> ObjectMessage:
        center = np.array([[stamp / 1e9, 2, 0], [30, -5, 0]], np.float32)
        return ObjectMessage(stamp, stamp + round(late * 1e9), center, center * 0 + 2, ("car", "car"))

    stamps = [10**9 + row * 10**8 for row in range(20)]
    topics = {"/a": 0.02, "/b": 0.02, "/c": 0.03}
    chain = RobotChain({name: [message(stamp, late) for stamp in stamps] for name, late in topics.items()})
    assert {*chain["/c"].parents, *chain["/c"].rivals} == {"/a", "/b"}
    assert chain["/a"].parents == () and chain["/b"].parents == ()


# --- asked of a bag -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Graph]:
    """Return a bag with the topics of a graph. The detector's objects are in the frame of the LiDAR."""
    graph = make_graph(3, frames=40, plants=7, start=bags.START, jitter=0, losses=0.0)
    items = bags.small_items(scans=40)
    kind = "vision_msgs/msg/Detection3DArray"
    for topic, messages in graph.messages.items():
        for one in messages:
            moved = np.zeros(3)
            if topic == "/lidar/objects":
                moved = np.array([(one.stamp - bags.START) / bags.PERIOD, 0, 1.8])
            boxes = Boxes3D(
                (one.center - moved).astype(np.float32), one.size, np.zeros(len(one.size), np.float32)
            )
            frame = bags.LIDAR_FRAME if topic == "/lidar/objects" else "odom"
            results = [[(label, 0.9)] for label in one.labels]
            array = encode_boxes_3d(one.stamp, frame, boxes, results, ids=one.ids)
            items.append(bags.Item(topic, kind, one.received, array))
    return bags.write(tmp_path_factory.mktemp("chain") / "robot", items), graph


def asked(bag: Path, plant: Plant, graph: Graph, *more: str) -> list[str]:
    x, y, z = (graph.places[plant][1] - [plant.frame, 0, 1.8]).tolist()
    return ["why", str(bag), "--at-frame", str(plant.frame), "--robot", f"--point={x},{y},{z}", *more]


@pytest.mark.long
def test_a_bag_tells_which_step_lost_an_object(
    bag: tuple[Path, Graph], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, graph = bag
    right = 0
    for plant in graph.plants:
        file = tmp_path / f"{plant.frame}.json"
        assert main(asked(path, plant, graph, "--json", str(file))) == 0
        tree = json.loads(file.read_text())
        documented_json.check(tree, "bevviz.why/1")
        (one,) = tree["robot"]["objects"]
        right += one["step"] == TOPICS[plant.node]
    assert right >= len(graph.plants) - 1
    capsys.readouterr()
    plant = next(plant for plant in graph.plants if plant.node == "tracker")
    main(["why", str(path), "--at-frame", str(plant.frame), "--robot"])
    text = capsys.readouterr().out
    assert "/relevant: from /tracks, " in text
    assert "by the step that makes /tracks" in text


def test_what_cannot_be_asked_is_said(
    bag: tuple[Path, Graph], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["why", str(bag[0]), "--at-frame", "5", "--robot", "--box", "20,20"]) == 2
    assert "give the object with --point, or all of a class with --class" in capsys.readouterr().err
    plain = bags.write(tmp_path / "plain", bags.small_items(scans=5))
    assert main(["why", str(plain), "--at-frame", "2", "--robot"]) == 2
    assert "no topic has objects of the robot around that frame" in capsys.readouterr().err


# --- shown by the workbench ----------------------------------------------------------------------


def place_of(plant: Plant, graph: Graph) -> np.ndarray:
    """Return where a planted thing is in the frame of the points."""
    return graph.places[plant][1] - [plant.frame, 0, 1.8]


@pytest.mark.long
def test_the_page_shows_which_node_lost_it(bag: tuple[Path, Graph]) -> None:
    path, graph = bag
    plant = next(plant for plant in graph.plants if plant.node == "tracker")
    pick = "point//" + ",".join(f"{value:.3f}" for value in place_of(plant, graph))
    (file,) = path.glob("*.mcap")
    with served(file) as address, Talk(address) as talk:
        time = bags.START + plant.frame * bags.PERIOD
        robot = talk.asked("robot", type="ask", time=time, set=[], pick=pick)
    assert robot["text"].endswith("by the step that makes /tracks")
    (changed,) = (step for step in robot["steps"] if step["changed"])
    assert changed["text"].startswith("/tracks: ") and changed["about"].startswith("from /merged, ")
    assert len(robot["steps"]) == len(TOPICS)


def test_the_page_reads_the_chain_once(bag: tuple[Path, Graph], tmp_path: Path) -> None:
    path, graph = bag
    with bevviz.open(path) as drive, RecordedDrive(drive, BagSource([path], load())) as bench:
        asked = [bench.follow_robot(plant.frame, place_of(plant, graph)) for plant in graph.plants]
        followed = [one for one in asked if isinstance(one, FollowedObject)]
        right = [
            one.change is not None and one.change.topic == TOPICS[plant.node]
            for plant, one in zip(graph.plants, followed, strict=True)
        ]
        assert sum(right) >= len(right) - 1
        assert len({id(one.chain) for one in followed}) == 1
        with pytest.raises(UserError, match="where the object is in space"):
            bench.follow_robot(3, None)
    plain = bags.write(tmp_path / "plain", bags.small_items(scans=5))
    with bevviz.open(plain) as drive, RecordedDrive(drive, BagSource([plain], load())) as bench:
        assert bench.follow_robot(2, np.zeros(3)) is None
        assert bench.robot_bag is None, "there is nothing to read"


def test_a_running_robot_is_asked_for_its_nodes(bag: tuple[Path, Graph]) -> None:
    path, graph = bag
    with bevviz.open(path) as drive, BagSource([path], load()) as source:
        topics = [topic.name for topic in source.recording.topics]
        messages = list(source.recording.messages(topics))
        results = [drive.at(frame=plant.frame) for plant in graph.plants]
        with live_bench(results, messages=messages) as bench:
            for result in results:
                bench.observe(result)
            right = 0
            for plant in graph.plants:
                followed = bench.follow_robot(plant.frame, place_of(plant, graph))
                assert isinstance(followed, FollowedObject)
                change = followed.change
                right += change is not None and change.topic == TOPICS[plant.node]
    assert right >= len(graph.plants) - 1


# --- asked beside a robot -------------------------------------------------------------------------


@pytest.mark.long
def test_the_nodes_of_a_running_robot_are_named() -> None:
    """The results come after their frames, and the newest frames of the buffer have no later messages."""
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")
    from bevviz.live.raw_recorder import RawRecorder
    from bevviz.live.source import LiveSource

    config = load()
    raw = RawRecorder(ReloadableConfig())
    with (
        own_graph(),
        chained_robot.chained_robot(),
        LiveSource(config, raw=raw) as robot,
    ):
        assert robot.wait(PATIENCE), robot.missing
        frames = list(islice(robot, 33))[:30]  # those after them have the results of the last one
        assert raw.object_topics == set(chained_robot.TOPICS.values())
        assert sum(len(frame.robot_boxes) for frame in frames) < len(frames), "the results came in time"
        messages = raw.messages()
    with HeldSeconds(messages, {}) as held:
        delivered = [FrameFacts.of(FrameResult.unprocessed(frame, config)) for frame in frames]
        place = chained_robot.PLACES[chained_robot.DROPPED].astype(np.float64)
        texts = []
        for frame, facts in zip(frames, delivered, strict=True):
            robot_object = held.robot_questions(facts, frame).at(place)
            assert isinstance(robot_object, FollowedObject)
            texts.append(robot_object.text)
        steps = [step["about"] for step in robot_object.page_form()["steps"]]
    assert sorted(about.partition(", from ")[0] for about in steps) == [
        f"by /{node}" for node in sorted(chained_robot.NODES)
    ]
    # A busy machine may receive them so late that a step seems to be made from the cloud.
    if any(about.startswith("by /tracker, from /detector/objects") for about in steps):
        assert any(text.endswith("dropped by /tracker, which makes /tracker/objects") for text in texts)
    assert not any("dropped by /detector" in text or "dropped by /planner" in text for text in texts)
