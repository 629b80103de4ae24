"""The bag of a report: raw messages of a window, in every format, that give the same results again."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from collections import defaultdict
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rosbags.interfaces import Qos
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from bevviz.bags.bag import Recording
from bevviz.bags.source import MARGIN, SECOND, BagSource
from bevviz.config import Config, load
from bevviz.errors import UserError
from bevviz.extras.demo.bag import _qos
from bevviz.messages.roles import Roles
from bevviz.pipeline.session import Session
from bevviz.report.bag_window import (
    CutContent,
    Edit,
    Edited,
    ReportWindow,
    choose_topics,
    cut_bag,
    find_window,
    open_window,
    unchanged,
)
from bevviz.report.fingerprints import StageDigest, compare, digest
from tests.support import bags
from tests.support.waiting import PATIENCE

CONFIG = Config()


def cut_out(
    path: Path,
    target: Path,
    at: str = "4",
    before: float = 0.5,
    topics: list[str] | None = None,
    edit: Edit = unchanged,
) -> tuple[ReportWindow, CutContent]:
    with BagSource([path], CONFIG, at=at) as source:
        window = find_window(source, source.span[0], before, before)
        chosen = choose_topics(source.recording, source.roles, topics)
        return window, cut_bag(source.recording, window, chosen, source.roles.tf_static, target, edit)


def contents(path: Path, low: int = 0, high: int = 2**62) -> dict[str, list[tuple[int, bytes]]]:
    found = defaultdict(list)
    with Recording([path]) as recording:
        for m in recording.messages([t.name for t in recording.topics], low, high):
            found[m.topic].append((m.received, bytes(m.content())))
    return dict(found)


def digests(path: Path, config: Config, window: ReportWindow) -> list[tuple[StageDigest, ...]]:
    with open_window([path], config, window.low, window.high) as source:
        session = Session(config)
        return [digest(session.run(frame)) for frame in source]


@pytest.mark.long
@pytest.mark.parametrize(
    ("form", "compression"), [("mcap", "storage"), ("sqlite3", "message"), ("ros1", "bz2"), ("sqlite3", "")]
)
def test_raw_messages_give_the_same_results(form: str, compression: str, tmp_path: Path) -> None:
    messages = bags.Messages(form == "ros1")
    items = bags.small_items(messages, scans=60)
    path = bags.write(
        tmp_path / ("drive.bag" if form == "ros1" else "drive"),
        items,
        messages,
        form=form,
        compression=compression,
    )
    window, made = cut_out(path, tmp_path / "bug.mcap")
    there = contents(path, window.low - MARGIN, window.high + MARGIN)
    assert window.high - window.low == pytest.approx(SECOND, abs=2e6)
    here = contents(tmp_path / "bug.mcap")
    static = here.pop("/tf_static")
    assert here == there  # byte for byte, in the same order
    assert static == contents(path)["/tf_static"]  # of 4 seconds before
    assert made.counts.total() == sum(map(len, here.values())) + 1
    with Recording([tmp_path / "bug.mcap"]) as ours, Recording([path]) as whole:
        assert [(t.name, t.type, t.frame_id) for t in ours.topics] == [
            (t.name, t.type, t.frame_id) for t in whole.topics
        ]
        assert not ours.warnings
    then, now = (digests(p, CONFIG, window) for p in (path, tmp_path / "bug.mcap"))
    assert len(then) == 11
    assert [compare(a, b) for a, b in zip(then, now, strict=True)] == [None] * 11


@pytest.mark.long
def test_a_window_of_a_cut_bag_is_written(tmp_path: Path) -> None:
    path = bags.write(tmp_path / "drive", bags.small_items(scans=60, points=2000), compression="storage")
    whole = next(path.glob("*.mcap")).read_bytes()
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(whole[: len(whole) * 4 // 5])
    with Recording([torn]) as recording:
        assert recording.warnings
    window, _ = cut_out(torn, tmp_path / "bug.mcap", at="4.6", before=1)
    assert not Recording([tmp_path / "bug.mcap"]).warnings
    then, now = (digests(p, CONFIG, window) for p in (torn, tmp_path / "bug.mcap"))
    assert then and [compare(a, b) for a, b in zip(then, now, strict=True)] == [None] * len(then)


@pytest.mark.long
def test_other_readers_read_the_window(tmp_path: Path) -> None:
    qos: list[Qos] = [_qos(latched=True)]
    messages = bags.Messages()
    with Writer(tmp_path / "drive", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        known = {}
        for item in sorted(bags.small_items(messages), key=lambda i: i.received):
            if item.topic not in known:
                offered = qos if item.topic == "/tf_static" else []
                known[item.topic] = writer.add_connection(
                    item.topic, item.type, typestore=messages.store, offered_qos_profiles=offered
                )
            data = messages.store.serialize_cdr(item.message, item.type)
            writer.write(known[item.topic], item.received, data)
    folder = tmp_path / "out"
    folder.mkdir()
    cut_out(tmp_path / "drive", folder / "bug.mcap", at="1")
    with Reader(folder / "bug.mcap") as reader:
        kept: Any = {c.topic: c.ext for c in reader.connections}
        assert kept["/tf_static"].offered_qos_profiles == qos
        assert sum(1 for _ in reader.messages()) == reader.message_count > 0
    command = [sys.executable, "-m", "rerun", "mcap", "check", str(folder / "bug.mcap")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE)
    assert done.stdout.count("\nok ") == 5


def test_silent_topics_say_what_held(tmp_path: Path) -> None:
    """Of a topic without a message in the window the last one before it, else the first one after it."""
    messages = bags.Messages()
    items = bags.small_items(messages, scans=100)
    text, said = "std_msgs/msg/String", messages.make
    for topic, times in {"/early": (0, 1), "/late": (9,), "/now": (0, 5)}.items():
        for t in times:
            message = said(text, data=f"{topic} {t}")
            items.append(bags.Item(topic, text, bags.START + t * SECOND, message))
    path = bags.write(tmp_path / "drive", items, messages)
    cut_out(path, tmp_path / "bug.mcap", at="5")
    found = contents(tmp_path / "bug.mcap")
    seconds = {topic: [(t - bags.START) // SECOND for t, _ in found[topic]] for topic in found}
    assert (seconds["/early"], seconds["/late"], seconds["/now"]) == ([1], [9], [5])


def test_damaged_messages_are_dropped_and_counted(tmp_path: Path) -> None:
    path = bags.write(tmp_path / "drive", bags.small_items(), form="sqlite3", compression="message")
    with closing(sqlite3.connect(next(path.glob("*.db3")))) as database, database:
        images = "topic_id = (SELECT id FROM topics WHERE name = ?)"
        torn = f"id IN (SELECT id FROM messages WHERE {images} ORDER BY id LIMIT 2)"
        database.execute(f"UPDATE messages SET data = substr(data, 1, 20) WHERE {torn}", [bags.IMAGE])
    whole = contents(bags.write(tmp_path / "whole", bags.small_items()))
    _, made = cut_out(path, tmp_path / "bug.mcap", at="0", before=9)
    said = "2 message(s) of {0} could not be used, the first: {0}: it is damaged, and left out"
    assert made.left_out == (said.format(bags.IMAGE),)
    assert contents(tmp_path / "bug.mcap")[bags.IMAGE] == whole[bags.IMAGE][2:]


def test_topics_are_limited_to_what_is_needed_and_named(tmp_path: Path) -> None:
    messages = bags.Messages()
    text = "std_msgs/msg/String"
    more = [
        bags.Item(name, text, bags.START, messages.make(text, data="")) for name in ("/rosout", "/state/arm")
    ]
    path = bags.write(tmp_path / "drive", bags.small_items(messages) + more, messages)
    needed = {bags.CLOUD, bags.IMAGE, bags.INFO, "/tf", "/tf_static"}
    _, made = cut_out(path, tmp_path / "few.mcap", at="1", topics=[])
    assert set(made.counts) == needed
    _, made = cut_out(path, tmp_path / "some.mcap", at="1", topics=["/state/*"])
    assert set(made.counts) == needed | {"/state/arm"}
    with pytest.raises(UserError, match=r"--topics /absent: no topic fits"):
        cut_out(path, tmp_path / "none.mcap", at="1", topics=["/absent"])


def test_all_inputs_of_the_pipeline_are_needed() -> None:
    """Also those that only make results of another kind: gravity, and the robot's obstacle points."""
    names = ("/imu", "/obstacles", "/map", "/rosout")
    recording: Any = SimpleNamespace(topics=[SimpleNamespace(name=n, metadata_topic="") for n in names])
    roles = Roles(imus=("/imu",), robot_clouds=("/obstacles",))
    assert choose_topics(recording, roles, ["/map"]) == ["/imu", "/obstacles", "/map"]


def test_nothing_is_left_of_a_bag_that_fails(tmp_path: Path) -> None:
    path = bags.write(tmp_path / "drive", bags.small_items())

    def fail(message: object, data: bytes | memoryview) -> Edited:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cut_out(path, tmp_path / "bug.mcap", at="1", edit=fail)
    assert [p.name for p in tmp_path.iterdir()] == ["drive"]
    with pytest.raises(UserError, match="cannot write the bag"):
        cut_out(path, tmp_path / "no" / "bug.mcap", at="1")


@pytest.mark.long
def test_kitti_gives_the_same_through_the_bag(shared: Path, tmp_path: Path) -> None:
    config = load(settings=[f"detector.model={shared / 'models' / 'yolox_nano.onnx'}"])
    items = bags.kitti_items(shared, step=2)
    path = bags.write(
        tmp_path / "kitti.bag", bags.kitti_items(shared, bags.Messages(True), step=2), form="ros1"
    )
    both = bags.write(tmp_path / "kitti", items, form="sqlite3")
    window, _ = cut_out(path, tmp_path / "bug.mcap", at="0.1", before=1)
    runs = [digests(p, config, window) for p in (tmp_path / "bug.mcap", both)]
    assert [compare(a, b) for a, b in zip(*runs, strict=True)] == [None, None]
    found = {s.name: s.whole for s in runs[0][0]}
    assert "person" in found["detector camera"]["names"]
    assert len(found["fusion camera"]["pairs.cost"])
