"""Counts and oddities of the synchronisation, and their sentences."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial

from bevviz.config import Config, SyncConfig
from bevviz.config.plugins import TOPIC
from bevviz.messages.roles import Roles
from bevviz.model.frame import LabelledBoxes2D, LabelledBoxes3D
from bevviz.model.input_findings import InputFinding
from bevviz.sync.clocks import BY_RECEIPT, Clocks
from bevviz.sync.transform_tree import TransformBuffer

LARGE_LOSS = 0.1  # share of messages; above it, a loss is said before a run


class UnusableMessages:
    """Counts of unusable messages by topic, with the reason for the first one.

    Args:
        noun: name of the counted things.

    Attributes:
        counts: number by topic; of images, by camera.
        first: reason for the first one.
    """

    def __init__(self, noun: str = "message(s)") -> None:
        self._noun = noun
        self.counts: Counter[str] = Counter()
        self.first: dict[str, str] = {}

    def add(self, topic: str, reason: str) -> int:
        """Count a message. Return the count of its topic.

        Args:
            topic: topic of the message.
            reason: a sentence that names the topic.
        """
        self.counts[topic] += 1
        self.first.setdefault(topic, reason)
        return self.counts[topic]

    @property
    def sentences(self) -> list[str]:
        """A sentence for each topic."""
        return [
            f"{count} {self._noun} of {topic} could not be used, the first: {self.first[topic]}"
            for topic, count in self.counts.items()
        ]


@dataclass(slots=True)
class SyncReport:
    """Counts of arrived and lost messages, and oddities, so far.

    Attributes:
        driver: topic whose messages make the frames.
        noun: name of such a message: a cloud, or an image without a LiDAR.
        clouds: clouds of all LiDARs, or images of the camera that drives.
        queued: those of the driver.
        frames: frames that were delivered.
        reordered: clouds that came out of order and were put back in order.
        late: clouds that were dropped, because a newer one had been delivered.
        duplicates: clouds that were dropped, because another one had the same stamp.
        unwaited: clouds that were delivered early, because the queue was full.
        resets: how often the stamps of the clouds jumped back.
        gaps: how often the stamps of the clouds jumped forward, by a second and three usual steps or more.
        longest_gap: seconds.
        idle: topic of the driving LiDAR, if only others deliver.
        unstamped: messages with stamp zero, by topic.
        repeated: messages with the stamp of another message, by topic.
        without_image: frames without an image, by camera.
        images: decoded images of all cameras.
        undecodable: images that cannot be decoded, by camera.
        untold: gaps in video whose packets do not tell if one is lost, by topic and codec.
        unusable: messages of a bag that cannot be decoded when they come.
        damage: ground truth that cannot be decoded.
        boxes: boxes of ground truth and robot that cannot be used.
        problems: frames with a missing transform or CameraInfo, by sentence.
        tf: the transforms, with their problems.
        upright: a sentence for each doubtful vertical, by LiDAR frame.
        clocks: lags of the topics.
        clocked: topics whose clocks must agree.
        oddities: a sentence for each topic with suspicious content.
        overtaken: results that came after their frame had been delivered, by topic.
        slowest: longest delay of such a result after its stamp, seconds, by topic.
    """

    driver: str = ""
    noun: str = "cloud"
    clouds: int = 0
    queued: int = 0
    frames: int = 0
    reordered: int = 0
    late: int = 0
    duplicates: int = 0
    unwaited: int = 0
    resets: int = 0
    gaps: int = 0
    longest_gap: float = 0.0
    idle: str = ""
    unstamped: Counter[str] = field(default_factory=Counter)
    repeated: Counter[str] = field(default_factory=Counter)
    without_image: Counter[str] = field(default_factory=Counter)
    images: int = 0
    undecodable: UnusableMessages = field(default_factory=UnusableMessages)
    untold: Counter[tuple[str, str]] = field(default_factory=Counter)
    unusable: UnusableMessages = field(default_factory=UnusableMessages)
    damage: UnusableMessages = field(default_factory=UnusableMessages)
    boxes: UnusableMessages = field(default_factory=partial(UnusableMessages, "box(es)"))
    problems: Counter[str] = field(default_factory=Counter)
    tf: TransformBuffer = field(default_factory=TransformBuffer)
    upright: Mapping[str, str] = field(default_factory=dict)
    clocks: Clocks = field(default_factory=lambda: Clocks(SyncConfig(), ""))
    clocked: tuple[str, ...] = ()
    oddities: dict[str, str] = field(default_factory=dict)
    overtaken: Counter[str] = field(default_factory=Counter)
    slowest: dict[str, float] = field(default_factory=dict)

    def note_boxes(self, boxes: LabelledBoxes2D | LabelledBoxes3D) -> None:
        """Count the boxes of a message that were left out."""
        for why in boxes.unusable:
            self.boxes.add(boxes.topic, why)

    def complain(self, problems: list[str], text: str) -> None:
        """Add a sentence to the problems of a frame.

        Count it, too. Sentences that differ only in seconds count as one.
        """
        problems.append(text)
        self.problems[re.sub(r"\d+\.\d+ s ", "", text)] += 1

    @property
    def stale(self) -> int:
        """Messages of the driver that were dropped, because their stamps were not new."""
        return self.late + self.duplicates

    def receipt_helps(self) -> bool:
        """Return whether the dropped messages would be frames by their time of receipt."""
        return self.stale > LARGE_LOSS * self.queued and self.clocks.differ_from_receipt(self.driver)

    def doubts(self) -> Iterator[InputFinding]:
        """Yield a finding for each fault that may affect every frame, as of clocks and units."""
        for text in self.clocks.doubts(self.clocked):
            yield InputFinding("clock", text.partition(": ")[0], text)
        for text in (*self.tf.conflicts, *self.oddities.values(), *self.upright.values()):
            yield InputFinding("oddity", text, text)

    def losses(self) -> Iterator[InputFinding]:
        """Yield a finding for each camera and topic with content that could not be used."""
        for camera, first in self.undecodable.first.items():
            n = self.undecodable.counts[camera]
            text = f"camera '{camera}': an image could not be decoded {_times(n)}, the first: {first}"
            yield InputFinding("image", camera, text)
        for text in (*self.damage.sentences, *self.boxes.sentences):
            yield InputFinding("unusable", text, text)

    def findings(self) -> Iterator[InputFinding]:
        """Yield everything that is worth a line at the end of a run."""
        yield from self.doubts()
        for kind, subject, text in self._counted():
            yield InputFinding(kind, subject, text)
        yield from self.losses()
        for (topic, codec), n in self.untold.items():
            gaps = "1 gap" if n == 1 else f"{n} gaps"
            text = (
                f"{topic}: {gaps} between the stamps of its {codec.upper()} video, whose packets do not tell "
                "whether one is lost: pictures from a lost one to the next key frame are wrong"
            )
            yield InputFinding("video", topic, text)
        for problem, n in self.problems.items():
            yield InputFinding("transform", problem, f"{problem} ({n} of {self.frames} frames)")
        for text in self.tf.problems:
            yield InputFinding("oddity", text, text)

    def warnings(self) -> tuple[str, ...]:
        """Return all findings as sentences."""
        return tuple(map(str, self.findings()))

    def _counted(self) -> Iterator[tuple[str, str, str]]:
        """Yield kind, subject and sentence of what was counted in stamps and frames."""
        driver, remedy = self.driver, f"; {BY_RECEIPT}" if self.receipt_helps() else ""
        for n, kind, text in (
            (self.reordered, "count", "{} came out of order and {} put back in order"),
            (self.late, "order", "{} came after a newer one had gone on and {} dropped" + remedy),
            (self.duplicates, "order", "{} had the stamp of another one and {} dropped" + remedy),
            (self.unwaited, "count", "{} went on early because sync.queue was full"),
        ):
            if n:
                clouds = f"1 {self.noun}" if n == 1 else f"{n} {self.noun}s"
                yield kind, driver, text.format(clouds, "was" if n == 1 else "were")
        if self.resets:
            yield "count", driver, f"the stamps of the {self.noun}s jumped back {_times(self.resets)}"
        if self.gaps:
            gaps = "1 gap" if self.gaps == 1 else f"{self.gaps} gaps"
            longest = f"the longest {self.longest_gap:.2f} s"
            yield "count", driver, f"the stamps of the {self.noun}s have {gaps}, {longest}"
        if self.idle:
            setting = "source.lidar_topics" if self.noun == "cloud" else "source.camera_topics"
            why = f"no {self.noun} on {self.idle}, which should drive"
            yield "driver", self.idle, f"{why}: set {setting}, the driving one first"
        for topic, n in self.unstamped.items():
            text = f"{topic}: no stamp in the header {_times(n)}, time of receipt used instead"
            yield "stamp", topic, text
        for topic, n in (+self.repeated).items():
            text = f"{topic}: {n} of its messages had the stamp of another one, whose place they took"
            yield "count", topic, text
        for topic, n in self.overtaken.items():
            results = f"{n} result{'' if n == 1 else 's'} came when the frame of that time had gone on"
            text = f"{topic}: {results}, {_describe_delay(self.slowest[topic])}: shown at that stamp"
            yield "count", topic, text
        for camera, n in self.without_image.items():
            yield "count", camera, f"{n} of {self.frames} frames have no image of camera '{camera}'"


def _describe_delay(seconds: float) -> str:
    """Describe the delay of the latest result. Stamps may be ahead of their receipt."""
    if seconds < 0.005:
        return "none of them later than its stamp"
    return f"at worst {seconds:.2f} s after the stamp"


def why_no_images(config: Config, roles: Roles, report: SyncReport | None) -> list[str]:
    """Return why the detector's model got no image, as one sentence in a list; empty if it got one.

    Args:
        config: names the model.
        roles: roles of the topics.
        report: report of the frames so far; None: there were none.
    """
    model = config.detector.model
    if not model or model.startswith(TOPIC):
        return []
    if roles.no_camera:
        return [f"detector.model {model} sees nothing: {roles.no_camera}"]
    if report is None or not report.frames or report.images:
        return []
    reasons = [*report.undecodable.first.values(), "no image at the time of any scan"]
    return [f"detector.model {model} has seen nothing in {report.frames} frames: {reasons[0]}"]


def _times(n: int) -> str:
    return "once" if n == 1 else f"{n} times"
