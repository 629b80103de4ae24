"""What does not arrive as it should is told when it begins, and when it is over."""

from __future__ import annotations

import pytest

from bevviz.live.inputs import AGAIN, TopicWatch


class Watched:
    """A watch with a clock that the test turns."""

    def __init__(self) -> None:
        self.now = 0.0
        self.said: list[str] = []
        self.watch = TopicWatch(self.said.append, lambda: self.now)

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
    assert watched.watch.states({"/image": True, "/camera_info": True, "/tf": False}) == {
        "/image": "silent",
        "/camera_info": "ok",
        "/tf": "no publisher",
    }
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
    assert watch.states({"/points": True}) == {"/points": "unusable"}
    assert watch.warnings == ["3 message(s) of /points could not be used, the first: /points: no field z"]
    watch.mark_usable("/points")
    assert said[1:] == ["/points: its messages can be used again"]
    assert watch.states({"/points": True}) == {"/points": "ok"}
    for _ in range(5):  # one now and then is counted
        watch.mark_unusable("/points", "/points: no field z")
        watch.mark_usable("/points")
    assert len(said) == 2
    for _ in range(AGAIN):
        watch.mark_unusable("/points", "/points: no field z")
    assert said[2:] == ["a message cannot be used: /points: no field z"]


def test_notes_are_told_when_they_begin_change_and_end() -> None:
    watched = Watched()
    watch, said = watched.watch, watched.said
    watch.report("camera", "", "never told")
    for text in ("gone", "gone", "gone for long"):
        watch.report("camera", text, "back")
    assert watch.warnings == ["gone for long"]
    watch.report("camera", "", "back")
    watch.report_once("found out")
    watch.report_once("found out")
    assert said == ["gone", "gone for long", "back", "found out"]
    assert watch.warnings == []
