"""What synchronising has counted and found odd, and its words."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial

from bevviz.config import Config
from bevviz.config.plugins import TOPIC
from bevviz.messages.roles import Roles
from bevviz.model.frame import LabelledBoxes2D, LabelledBoxes3D
from bevviz.sync.clocks import Clocks
from bevviz.sync.transform_tree import TransformBuffer
from bevviz.sync.unusable_messages import Damage


@dataclass(slots=True)
class SyncReport:
    """What arrived, what was lost and what looked wrong so far."""

    clouds: int = 0  # of every LiDAR
    frames: int = 0
    reordered: int = 0  # clouds that came out of order, put back in their place
    late: int = 0  # clouds dropped: a newer one had been delivered already
    duplicates: int = 0  # clouds dropped: same stamp as another
    unwaited: int = 0  # clouds sent on early, the queue being full
    resets: int = 0  # stamps of the clouds that jumped back
    gaps: int = 0  # stamps of the clouds that jumped forward, by a second and three usual steps or more
    longest_gap: float = 0.0  # seconds
    idle: str = ""  # topic of the LiDAR that should drive, while only others deliver
    unstamped: Counter[str] = field(default_factory=Counter)  # topic -> messages with stamp zero
    repeated: Counter[str] = field(default_factory=Counter)  # topic -> messages with the stamp of another one
    without_image: Counter[str] = field(default_factory=Counter)  # camera -> frames
    images: int = 0  # of all cameras, decoded
    undecodable: Counter[str] = field(default_factory=Counter)  # camera -> images
    first_undecodable: dict[str, str] = field(default_factory=dict)  # camera -> why the first was
    untold: Counter[tuple[str, str]] = field(default_factory=Counter)  # topic, codec -> gaps in its video
    damage: Damage = field(default_factory=Damage)  # ground truth that could not be decoded
    boxes: Damage = field(default_factory=partial(Damage, "box(es)"))  # of ground truth and the robot
    problems: Counter[str] = field(default_factory=Counter)  # missing transforms and CameraInfo -> frames
    tf: TransformBuffer = field(default_factory=TransformBuffer)  # for what looked wrong in the transforms
    upright: Mapping[str, str] = field(default_factory=dict)  # for what is doubtful about the vertical
    clocks: Clocks = field(default_factory=lambda: Clocks({}, "stamp"))
    clocked: tuple[str, ...] = ()  # topics whose clocks must be one
    oddities: dict[str, str] = field(default_factory=dict)  # topic -> what its messages should not say
    overtaken: Counter[str] = field(default_factory=Counter)  # topic -> results whose frame had gone on
    slowest: dict[str, float] = field(default_factory=dict)  # topic -> seconds after its stamp, at worst

    def note_boxes(self, found: LabelledBoxes2D | LabelledBoxes3D) -> None:
        """Count the boxes of a message that were left out."""
        for why in found.unusable:
            self.boxes.add(found.topic, why)

    def complain(self, problems: list[str], text: str) -> None:
        """Tell a frame, and count here, where sentences that differ in a number are one."""
        problems.append(text)
        self.problems[re.sub(r"\d+\.\d+ s ", "", text)] += 1

    def doubts(self) -> tuple[str, ...]:
        """One sentence for whatever may make every frame wrong: clocks, units, which way is up."""
        return (*self.clocks.doubts(self.clocked), *self.oddities.values(), *self.upright.values())

    def losses(self) -> list[str]:
        """Return one sentence for each camera and topic with content that could not be used."""
        images = [
            f"camera '{camera}': an image could not be decoded {_times(n)}, the first: "
            f"{self.first_undecodable[camera]}"
            for camera, n in self.undecodable.items()
        ]
        return [*images, *self.damage.sentences, *self.boxes.sentences]

    def warnings(self) -> tuple[str, ...]:
        """One sentence each."""
        counted = [
            (self.reordered, "{} came out of order and {} put back in order"),
            (self.late, "{} came after a newer one had gone on and {} dropped"),
            (self.duplicates, "{} had the stamp of another one and {} dropped"),
            (self.unwaited, "{} went on early because sync.queue was full"),
        ]
        found = [
            text.format("1 cloud" if n == 1 else f"{n} clouds", "was" if n == 1 else "were")
            for n, text in counted
            if n
        ]
        if self.resets:
            found.append(f"the stamps of the clouds jumped back {_times(self.resets)}")
        if self.gaps:
            gaps = "1 gap" if self.gaps == 1 else f"{self.gaps} gaps"
            found.append(f"the stamps of the clouds have {gaps}, the longest {self.longest_gap:.2f} s")
        if self.idle:
            found.append(
                f"no cloud on {self.idle}, which should drive: set source.lidar_topics, the driving one first"
            )
        for topic, n in self.unstamped.items():
            found.append(f"{topic}: no stamp in the header {_times(n)}, time of receipt used instead")
        for topic, n in (+self.repeated).items():
            found.append(f"{topic}: {n} of its messages had the stamp of another one, whose place they took")
        for topic, n in self.overtaken.items():
            found.append(
                f"{topic}: {n} result{'' if n == 1 else 's'} came when the frame of that time had gone on, "
                f"{_after(self.slowest[topic])}: shown at that stamp, and not compared"
            )
        for camera, n in self.without_image.items():
            found.append(f"{n} of {self.frames} frames have no image of camera '{camera}'")
        found += self.losses()
        for (topic, codec), n in self.untold.items():
            gaps = "1 gap" if n == 1 else f"{n} gaps"
            found.append(
                f"{topic}: {gaps} between the stamps of its {codec.upper()} video, whose packets do not tell "
                "whether one is lost: pictures from a lost one to the next key frame are wrong"
            )
        found += [f"{text} ({n} of {self.frames} frames)" for text, n in self.problems.items()]
        return (*self.doubts(), *found, *self.tf.problems)


def _after(seconds: float) -> str:
    """Of the latest one: stamps may be ahead of their receipt, too."""
    if seconds < 0.005:
        return "none of them later than its stamp"
    return f"at worst {seconds:.2f} s after the stamp"


def blindness(config: Config, roles: Roles, report: SyncReport | None) -> list[str]:
    """Why the detector's model was shown no image at all, in one sentence; empty where it was shown one.

    ``report``: of the frames so far; None: there were none yet.
    """
    model = config.detector.model
    if not model or model.startswith(TOPIC):
        return []
    if roles.no_camera:
        return [f"detector.model {model} sees nothing: {roles.no_camera}"]
    if report is None or not report.frames or report.images:
        return []
    reasons = [*report.first_undecodable.values(), "no image at the time of any scan"]
    return [f"detector.model {model} has seen nothing in {report.frames} frames: {reasons[0]}"]


def _times(n: int) -> str:
    return "once" if n == 1 else f"{n} times"
