"""What does not arrive as it should is told when it begins, and when it is over."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from bevviz.config import load
from bevviz.live.inputs import AGAIN, TopicWatch
from bevviz.live.problems import CurrentProblems
from bevviz.live.result_problems import LASTING, OVER, ResultProblems
from bevviz.model.frame import Frame
from bevviz.model.results import Anomaly, FrameResult


class Watched:
    """A watch with a clock that the test turns."""

    def __init__(self) -> None:
        self.now = 0.0
        self.said: list[str] = []
        self.problems = CurrentProblems(self.said.append)
        self.watch = TopicWatch(self.problems, lambda: self.now)

    def stream(self, topic: str, seconds: float, step: float = 0.1, size: int = 100) -> None:
        end = self.now + seconds
        while self.now < end:
            self.watch.count(topic, size)
            self.now += step


def test_a_stopped_stream_is_silent_but_a_latched_topic_is_not() -> None:
    watched = Watched()
    watched.watch.count("/camera_info", 10)
    watched.stream("/image", 2.0)
    assert watched.watch.silent_for("/image") == watched.watch.silent_for("/camera_info") == 0
    watched.now += 3.0
    assert watched.watch.silent_for("/image") == pytest.approx(3.1)
    assert watched.watch.silent_for("/camera_info") == watched.watch.silent_for("/never") == 0
    assert watched.watch.state("/image", published=True) == "silent"
    assert watched.watch.state("/camera_info", published=True) == "ok"
    assert watched.watch.state("/tf", published=False) == "no publisher"
    assert watched.watch.received == {"/image": 20, "/camera_info": 1}
    assert watched.watch.volume["/image"] == 2000


def test_a_slow_stream_is_not_silent_between_two_messages() -> None:
    watched = Watched()
    watched.stream("/map", 10.0, step=1.0)
    watched.now += 3.0
    assert watched.watch.silent_for("/map") == 0
    watched.now += 3.0
    assert watched.watch.silent_for("/map") > 5


def test_an_unusable_topic_is_reported_once_at_its_start() -> None:
    watched = Watched()
    watch, said = watched.watch, watched.said
    for _ in range(3):
        watch.count("/points", 10)
        watch.mark_unusable("/points", "/points: no field z")
    assert said == ["a message cannot be used: /points: no field z"]
    assert watch.state("/points", published=True) == "unusable"
    assert watch.damage.sentences == [
        "3 message(s) of /points could not be used, the first: /points: no field z"
    ]
    watch.mark_usable("/points")
    assert said[1:] == ["/points: its messages can be used again"]
    assert watch.state("/points", published=True) == "ok"
    for _ in range(5):  # one now and then is counted
        watch.mark_unusable("/points", "/points: no field z")
        watch.mark_usable("/points")
    assert len(said) == 2
    for _ in range(AGAIN):
        watch.mark_unusable("/points", "/points: no field z")
    assert said[2:] == ["a message cannot be used: /points: no field z"]


def test_problems_are_told_when_they_begin_change_and_end() -> None:
    said: list[str] = []
    problems = CurrentProblems(said.append)
    problems.set("clock", "/lidar", "", "never told")
    for text in ("0.70 s ahead", "0.71 s ahead", "0.72 s behind"):
        problems.set("clock", "/lidar", text, "right again", "set sync.offsets")
    assert [*map(str, problems.current)] == ["0.72 s behind: set sync.offsets"]
    (problem,) = problems.of("/lidar")
    assert problem.finding.kind == "clock" and problem.since == pytest.approx(time.time(), abs=60)
    for count in (900, 1_000):
        problems.set("blind", "/lidar2", f"/lidar2: all {count:,} points are NaN in {count} frames")
    problems.set("blind", "/lidar2", "", "seen")
    problems.set("clock", "/lidar", "")
    problems.tell_once("found out")
    problems.tell_once("found out")
    first, second = "0.70 s ahead: set sync.offsets", "0.72 s behind: set sync.offsets"
    blind = "/lidar2: all 900 points are NaN in 900 frames"
    assert said == [first, second, blind, "seen", "right again", "found out"]
    assert problems.current == []


def test_a_faulty_sensor_is_a_problem_while_it_lasts() -> None:
    """One frame without an image is none, and a flickering object is no matter of the input."""
    said: list[str] = []
    problems = CurrentProblems(said.append)
    checks, text = ResultProblems(problems), "camera zed: frozen image"
    frame = Frame(0, 0, 0, "lidar", np.zeros((0, 3), np.float32), "lidar")
    clean = FrameResult.unprocessed(frame, load())
    flicker = Anomaly("flicker", "car 3", "flickers")
    faulty = replace(clean, anomalies=(Anomaly("sensor", "zed", text), flicker))
    for result in [faulty] * (LASTING - 1) + [clean] + [faulty] * (LASTING - 1):
        checks.observe(result)
    assert not said
    checks.observe(faulty)
    assert said == [text] and [str(problem) for problem in problems.of("zed")] == [text]
    for _ in range(OVER - 1):
        checks.observe(clean)
    assert said == [text]
    checks.observe(clean)
    assert said == [text, f"over: {text}"] and not problems.current
