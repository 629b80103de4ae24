"""Checks of a robot's input while it comes: topics, clocks, transforms, and what the frames wait for."""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Callable, Mapping
from statistics import median

from bevviz.live.graph import PublishedTopic, Subscriptions, full_name
from bevviz.live.inputs import SILENCE, Inputs
from bevviz.live.node import Node
from bevviz.messages.topics import CLOUDS, Topic
from bevviz.model.frame import Frame
from bevviz.sync.report import why_no_images

LASTING = 5  # frames with a missing transform or CameraInfo from which on it is reported
RECENT = 1.5  # seconds without a further case after which a problem is over
RECENT_LOSS = 10.0  # the same for lost messages: a busy machine loses some now and then
BLIND = 3  # clouds without a point in a row that are reported
WAITING, WAITS = 0.2, 20  # seconds that frames may wait, median of this many frames
SLOW = 0.3  # seconds between two messages of a topic that frames wait for
LATE = 0.15  # seconds that a topic may come later than the LiDAR
PIECE = 65_000  # bytes, largest message that DDS sends in one piece
HUGE = 10_000_000  # bytes of a cloud beside which images are lost even with a larger segment
PROFILE = (
    "give the publishers of the clouds ros/config/fastdds.xml by FASTRTPS_DEFAULT_PROFILES_FILE, see "
    "'Clouds were lost on the way' in docs/live.md"
)


class InputProblems:
    """Checks of the input at each look at the graph. Only the receiving thread may use it.

    Args:
        node: the nodes of bevviz.
        inputs: roles, and what was received. Their problems take the findings.
        subscriptions: subscriptions of the topics with a role.

    Attributes:
        apart: topics whose clock is told to be apart from the others. No frame waits for them.
    """

    def __init__(self, node: Node, inputs: Inputs, subscriptions: Subscriptions) -> None:
        self._node, self._inputs, self._subscriptions = node, inputs, subscriptions
        self._watch, self._problems = inputs.watch, inputs.problems
        self.apart: frozenset[str] = frozenset()
        self._counts: dict[tuple[str, str], tuple[int, float]] = {}  # count, and when it last rose
        self._resets = self._frames = 0  # as of the last look
        self._driver = ""  # the same
        self._waits: deque[float] = deque(maxlen=WAITS)  # seconds from the receipt of a cloud to its frame
        self._begun = time.monotonic()

    def observe(self, frame: Frame) -> None:
        """Check a frame when it is complete."""
        self._waits.append(1e-9 * (time.time_ns() - frame.received))
        for cloud in frame.clouds:
            why = (
                f"all {cloud.dropped:,} points are NaN, infinite or (0, 0, 0)"
                if cloud.dropped
                else "0 points"
            )
            text = "" if len(cloud.xyz) else f"LiDAR {cloud.topic} sees nothing: {why}"
            over = f"LiDAR {cloud.topic} sees points again"
            self._problems.set("blind", cloud.topic, text, over, begins=BLIND)

    def look(self, topics: Mapping[str, PublishedTopic], *, complete: bool) -> None:
        """Check everything.

        Args:
            topics: published topics.
            complete: whether the scene is known.
        """
        roles = self._inputs.roles
        no_clouds = complete and self._watch.without(roles.lidars) > SILENCE
        shown = {name for name, _, _ in roles.around}
        for name in self._subscriptions.topics:
            if name in topics or name not in shown:  # topics shown around the robot come and go
                self._check_topic(topics.get(name, PublishedTopic(name, "", ())), no_clouds)
                self._check_losses(name)
        self._check_graph(topics, complete, no_clouds)
        self._check_clocks()
        frames = self._inputs.sync.report.frames
        if frames != self._frames:  # Without frames the counts say nothing.
            self._frames = frames
            self._check_report(complete)
            self._check_waits()

    # --- topics --------------------------------------------------------------------------------

    def _check_topic(self, topic: PublishedTopic, no_clouds: bool) -> None:
        """Check the publishers of a topic that has a role, and whether it is silent."""
        roles, note, name = self._inputs.roles, self._problems.set, topic.name
        gone = f"{name} has no publisher any more; waiting for it to come back"
        note("no publisher", name, "" if topic.publishers else gone, f"{name} is published again")
        note("types", name, topic.clash, f"{name} has one type")
        unheard = "; ".join(self._subscriptions.mismatches(topic))
        note("quality", name, unheard, f"{name}: every publisher is received")
        silent = bool(topic.publishers) and self._watch.silent_for(name) > 0
        silent = silent and not (name in roles.lidars and no_clouds)
        quiet = f"no message on {name} for {SILENCE:g} s, though it has a publisher"
        note("silent", name, quiet if silent else "", f"{name} is back")
        sensors = {*roles.lidars, *(camera.topic for camera in roles.cameras)}
        several = name in sensors and len(topic.publishers) > 1
        names = ", ".join(map(full_name, topic.publishers))
        mixed = f"{name} has several publishers, taken for one sensor: {names}; remap all but one"
        note("publishers", name, mixed if several else "", f"{name} has one publisher")
        video = self._inputs.sync.videos.get(name)
        keyless = f"{name}: the video has no key frame yet; its camera shows nothing until one comes"
        awaited = video is not None and video.awaits_key
        note("key frame", name, keyless if awaited else "", f"{name}: a key frame has come")

    def _check_losses(self, name: str) -> None:
        size = self._watch.volume[name] / max(1, self._watch.received[name])
        sizes = (self._watch.volume[other] / n for other, n in self._watch.received.items())
        text = f"messages of {name} are lost on the way: {remedy(size, max(sizes, default=0.0))}"
        over = f"no message of {name} is lost any more"
        self._follow(
            "lost", {name: self._watch.lost[name]}, lambda _: text, lambda _: over, within=RECENT_LOSS
        )

    def _check_graph(self, topics: Mapping[str, PublishedTopic], complete: bool, no_clouds: bool) -> None:
        """Check names, the driver of the frames, and what the configuration states."""
        roles, note, node = self._inputs.roles, self._problems.set, self._node
        twin = (
            f"another node is called {node.node.get_fully_qualified_name()}: orders for one may reach "
            f"the other; --ros-args -r __node:=bevviz_2 gives this one another name"
        )
        note("name", "bevviz", "" if node.is_alone else twin, "no other node has the name of this one now")
        quiet = f"no cloud for {SILENCE:g} s on {', '.join(roles.lidars)}"
        note("silent", "clouds", quiet if no_clouds else "", "the clouds are back")
        first, driver = roles.driver, self._inputs.sync.driver
        why = "has a clock apart from the others" if first in self.apart else "does not deliver"
        deputy = f"{first} {why}: the frames follow {driver} until it is right"
        changed = complete and driver != first
        note("driver", first, deputy if changed else "", f"the frames follow {first} again")
        begun = time.monotonic() - self._begun > RECENT
        misstated = self._inputs.misstated(topics.values()) if begun else {}
        for name in self._inputs.stated:
            over = f"{name} is there, as the configuration states"
            note("stated", name, misstated.get(name, ""), over)
        merged = "" if node.namespace.strip("/") else merged_robots(topics, self._inputs.frame_ids)
        note("robots", "namespaces", merged or roles.robots, "one robot is received")

    # --- time ----------------------------------------------------------------------------------

    def _check_clocks(self) -> None:
        """Check that the clocks agree. A doubt is told at the second look that has it."""
        sync, lidars = self._inputs.sync, self._inputs.roles.lidars
        report, doubts = sync.report, dict[str, str]()
        for text in report.clocks.doubts(report.clocked):
            doubts[text.partition(": ")[0]] = text
        for topic in report.clocked:
            over = f"{topic}: its clock agrees with the others again"
            self._problems.set("clock", topic, doubts.get(topic, ""), over, quiet=True, begins=2)
        told = {p.finding.subject for p in self._problems.current if p.finding.kind == "clock"}
        told &= {*report.clocked}
        clocks = report.clocks
        right = clocks.reference(report.clocked)
        wrong = {topic for topic in told if clocks.wrong(topic, right)}  # not only late
        if lidars and wrong.issuperset(lidars):  # Frames follow a wrong clock, and the right ones are apart.
            wrong |= {name for name in report.clocked if clocks.wrong(name, sync.driver)}
        self.apart = frozenset(wrong)

    def _check_waits(self) -> None:
        """Check how long frames wait, and name the topic that they wait for."""
        wait = median(self._waits) if len(self._waits) == WAITS else 0.0
        text, advice = self._awaited(wait) if wait > WAITING else ("", "")
        self._problems.set("wait", "frames", text, "frames do not wait any more", advice)

    def _awaited(self, wait: float) -> tuple[str, str]:
        """Return a sentence about what frames wait for, and the remedy."""
        roles, clocks = self._inputs.roles, self._inputs.sync.clocks
        needed = [
            *roles.tf,
            *filter(None, [roles.odometry]),
            *(c.topic for c in roles.cameras),
            *roles.lidars[1:],
        ]
        needed = [name for name in needed if name not in self.apart]
        steps = {name: step for name in needed if (step := self._watch.step(name, newest=3)) > SLOW}
        usual = clocks.lag(self._inputs.sync.driver) or 0.0
        late = {name: lag for name in needed if (lag := (clocks.lag(name) or usual) - usual) > LATE}
        sooner = "--set sync.max_wait=0.1 makes frames at once, without what comes late"
        if steps:
            slowest = max(steps, key=lambda name: steps[name])
            step = steps[slowest]
            whole = f"--set sync.max_wait={step + 0.1:.1f} waits for all"
            return (
                f"frames wait {wait:.2f} s for {slowest}, which comes each {step:.2f} s",
                f"{whole}; {sooner}",
            )
        if late:
            latest = max(late, key=lambda name: late[name])
            text = f"frames wait {wait:.2f} s for {latest}, which comes {late[latest]:.2f} s after the clouds"
            return text, PROFILE if latest in roles.tf and self._has_pieces() else sooner
        return f"frames wait {wait:.2f} s for their images and transforms", sooner

    def _has_pieces(self) -> bool:
        """Return whether messages are received that DDS sends in pieces."""
        received, volume = self._watch.received, self._watch.volume
        return any(volume[name] / count > PIECE for name, count in received.items())

    # --- frames --------------------------------------------------------------------------------

    def _check_report(self, complete: bool) -> None:
        """Check what the synchroniser counts."""
        problems, report = self._problems, self._inputs.sync.report
        for name in report.overtaken:
            problems.tell_once(f"{name} comes when its frame has gone on: shown at its own stamp")
        for text in report.oddities.values():
            problems.tell_once(text)
        for text in (*report.upright.values(), *report.tf.problems):
            problems.tell_once(re.sub(r" \(\d+ times?\)$", "", text))
        if report.resets > self._resets and self._driver == self._inputs.sync.driver:
            problems.tell("the stamps of the clouds jumped back: a simulation or a bag that began anew")
        self._resets, self._driver = report.resets, self._inputs.sync.driver
        self._follow(
            "stamp",
            report.unstamped,
            lambda name: f"{name}: no stamp in the header, time of receipt is used instead",
            lambda name: f"{name}: its headers have stamps again",
        )
        self._follow(
            "image",
            report.undecodable.counts,
            lambda name: f"camera '{name}': an image could not be decoded: {report.undecodable.first[name]}",
            lambda name: f"camera '{name}': its images can be decoded again",
        )
        self._follow(
            "transform", report.problems, lambda text: text, lambda text: f"over: {text}", least=LASTING
        )
        dropped = {report.driver: report.late + report.duplicates}
        self._follow(
            "order",
            dropped,
            lambda name: (
                f"{name}: clouds are dropped, as their stamps are not newer than that of the last frame"
            ),
            lambda name: f"{name}: its stamps are in order again",
            least=LASTING,
        )
        blind = why_no_images(self._inputs.config, self._inputs.roles, report) if complete else []
        model = self._inputs.config.detector.model
        self._problems.set(
            "detector", model, blind[0] if blind else "", f"detector.model {model} gets images"
        )

    def _follow(
        self,
        kind: str,
        counts: Mapping[str, int],
        sentence: Callable[[str], str],
        over: Callable[[str], str],
        *,
        least: int = 1,
        within: float = RECENT,
    ) -> None:
        """Take counts for problems while they rise.

        Args:
            kind: kind of the problems.
            counts: cases so far, by subject.
            sentence: returns the sentence of a subject.
            over: returns the sentence for its end.
            least: cases from which on it is a problem.
            within: seconds without a further case after which it is over.
        """
        now = time.monotonic()
        for name, count in list(counts.items()):
            before, rose = self._counts.get((kind, name), (0, -within))
            if count != before:
                rose = now
                self._counts[kind, name] = count, now
            holds = count >= least and now - rose < within
            self._problems.set(kind, name, sentence(name) if holds else "", over(name))
            self._problems.count(kind, name, count)


def merged_robots(topics: Mapping[str, PublishedTopic], frame_ids: Mapping[str, str]) -> str:
    """Return one sentence if clouds of two robots are taken for those of one. Empty: they are not.

    Two robots have equal names below two namespaces, and there equal frames, or transforms of their own.

    Args:
        topics: published topics.
        frame_ids: frame of the first message of each received topic.
    """
    spaces: dict[str, list[str]] = {}  # name below the namespace -> namespaces
    for name, topic in topics.items():
        if name in frame_ids and name.count("/") > 1 and Topic(name, topic.type).kind in CLOUDS:
            _, space, below = name.split("/", 2)
            spaces.setdefault(below, []).append(f"/{space}")
    for below, found in spaces.items():
        frames = {frame_ids[f"{space}/{below}"] for space in found}
        if len(found) > 1 and (len(frames) == 1 or all(f"{space}/tf" in topics for space in found)):
            return (
                f"{' and '.join(sorted(found))} are two robots with equal names ({below}), taken for one: "
                f"--ros-args -r __ns:={min(found)} takes the first alone"
            )
    return ""


def remedy(size: float, largest: float) -> str:
    """Return advice for lost messages, given their size and that of the largest messages here, in bytes."""
    if size < HUGE <= largest:
        return (
            f"clouds of {largest / 1e6:.0f} MB fill the transport: give their publisher a larger segment, "
            "and this one's a queue of a second (depth), see 'Clouds were lost on the way' in docs/live.md"
        )
    if size > PIECE:
        return "a larger segment of the publisher's helps, see 'Clouds were lost on the way' in docs/live.md"
    if largest > PIECE:
        return (
            "clouds or images fill the transport, which a larger segment of their publishers mends, see "
            "'Clouds were lost on the way' in docs/live.md"
        )
    return "small ones are where a machine is too busy; a longer queue (depth) of the publisher's helps"
