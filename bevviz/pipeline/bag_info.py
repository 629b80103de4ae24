"""Summary of a bag: topics, sensors, transforms, and requirements of a full run that it does not meet."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from bevviz.bags.bag import Recording
from bevviz.bags.reader import megabytes
from bevviz.bags.remote import address_of
from bevviz.bags.source import SECOND, BagSource, iso
from bevviz.checks import InputChecks
from bevviz.config import (
    Config,
    DetectorConfig,
    ObjectsConfig,
    is_stage_file,
    stage_topics,
    stated_lines,
)
from bevviz.errors import UserError, printable
from bevviz.messages.roles import Roles, find_roles
from bevviz.messages.topics import Topic
from bevviz.model.frame import Camera, Frame
from bevviz.model.results import FrameResult
from bevviz.recording.provenance import model_path
from bevviz.support import progress, table
from bevviz.support.compile_clock import thread_clock
from bevviz.support.json_form import LEFT_OUT, json_form

if TYPE_CHECKING:
    from bevviz.pipeline.stage_loader import Stages

WIDTH = 100
FIRST_FRAMES = 100  # frames on which the input is checked without an option
FIRST_SECONDS = 2.0  # seconds after which that check ends
TRIAL_SCAN = 5  # Number of the scan to try. In earlier scans a camera or a transform may still be missing.
MAX_TIMED_MESSAGES = (
    2_000_000  # Most messages for which times are collected. For more, this would take seconds.
)


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic of the bag or of the graph."""

    name: str
    type: str
    """package/msg/Name"""
    count: int | None
    """messages; null: nothing subscribes to it"""
    frame_id: str
    rate: float | None
    """Hz, between the first and the last message"""
    role: str
    """use of the topic; empty: none"""
    pause: float | None = None
    """longest time between two messages, seconds"""
    pause_at: float | None = None
    """start of the longest pause, seconds from the start of the bag"""
    size: float | None = None
    """mean bytes of a message; --live"""
    delay: float | None = None
    """seconds from the stamp to the receipt; --live"""


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """A camera of one scan."""

    name: str
    """as options name it"""
    width: int | None
    """pixels"""
    height: int | None
    """pixels"""
    K: Sequence[Sequence[float]] | None
    """3 x 3 intrinsics"""
    distortion_model: str | None
    """empty: none"""
    D: Sequence[float] | None
    """distortion in the order of ROS"""
    camera_from_points: Sequence[Sequence[float]] | None
    """4 x 4 transform"""
    problems: Sequence[str]
    text: Annotated[str, LEFT_OUT]

    @classmethod
    def of(cls, camera: Camera) -> CameraInfo:
        """Return the summary of a camera."""
        image, model, transform = camera.image, camera.intrinsics, camera.camera_from_points
        return cls(
            name=camera.name,
            width=None if image is None else image.bgr.shape[1],
            height=None if image is None else image.bgr.shape[0],
            K=None if model is None else model.K.tolist(),
            distortion_model=None if model is None else model.distortion_model,
            D=None if model is None else model.D.tolist(),
            camera_from_points=None if transform is None else transform.tolist(),
            problems=camera.problems,
            text=_camera(camera),
        )


@json_form
@dataclass(frozen=True, slots=True, kw_only=True)
class TopicContents:
    """Topics, sensors and transforms, and what a full run lacks."""

    topics: Sequence[TopicInfo]
    lidars: Sequence[str] = ()
    """names of the LiDARs"""
    cameras: Sequence[CameraInfo] = ()
    transforms: Mapping[str, str] = field(default_factory=dict)
    """parent of each frame"""
    points_frame: str = ""
    """frame of the points"""
    world_frame: str = ""
    """fixed frame; empty: none"""
    network: str = ""
    """what the detector runs on, or why it does not; empty: no detector"""
    object_network: str = ""
    """the same of a 3D detector"""
    configured: Sequence[str] = ()
    """place: keys where parameters are stated"""
    missing: Sequence[str] = ()
    """what a full run lacks, with the option that gives it"""
    warnings: Sequence[str] = ()
    """faults of the bag"""


@json_form
@dataclass(frozen=True, slots=True, kw_only=True)
class BagInfo(TopicContents):
    """Contents of a bag."""

    paths: Sequence[str]
    """files of the bag"""
    formats: Sequence[str]
    """format of each file"""
    size: int
    """bytes on disk"""
    start: int
    """first log time, nanoseconds since 1970"""
    end: int
    """last log time, nanoseconds since 1970"""
    messages: int

    @property
    def duration(self) -> float:
        """Duration in seconds."""
        return (self.end - self.start) / SECOND


def describe_bag(
    paths: Sequence[Path],
    config: Config,
    *,
    all_frames: bool = False,
    on_contents: Callable[[BagInfo], None] = lambda info: None,
) -> BagInfo:
    """Read the index of a bag, and check its sensors.

    Args:
        paths: files or folders.
        config: configuration of the runs to come.
        all_frames: check the sensors in the whole drive, not in its first frames alone.
        on_contents: called with the contents before the sensors are checked. ``missing`` and ``warnings``
            are not complete then.

    Raises:
        UserError: there is no readable bag, or a stated topic is not in it.
    """
    try:
        source = BagSource(paths, config)
    except UserError as error:
        with Recording(paths, config.source) as recording:
            try:
                roles = find_roles(recording.topics, config.source, stage_topics(config))
            except UserError:  # A stage may need the topic of a result file, which is the first error.
                raise error from None
            info = _describe(recording, roles, config, missing=[str(error)])
            on_contents(info)
            return info
    with source:
        roles = source.roles
        frames, checks = first_frames(source, TRIAL_SCAN, all_frames), InputChecks(source, config)
        first = list(islice(frames, TRIAL_SCAN))
        frame = first[-1] if first else None
        info = _describe(source.recording, roles, config, find_missing(roles, frame, config), frame, source)
        on_contents(info)
        for result in _detected(first, config):
            checks.observe(result)
        for read in chain(first, frames):
            checks.observe_frame(read, follows=not source.recording.single_frames)
        missing = (*source.large_losses(), *info.missing)
        return replace(info, missing=missing, warnings=tuple(checks.warnings))


def _detected(frames: Sequence[Frame], config: Config) -> Iterator[FrameResult]:
    """Yield results of frames with the detections of the detector's file, if it can be used."""
    if model_path(config) is None:
        return
    try:
        stages = _alone(config, "detector")
    except UserError:  # It is listed as missing.
        return
    from bevviz.pipeline.perceive import perceive  # onnxruntime takes as long as half of all other imports.

    config = config.restated({"objects": ObjectsConfig()})
    for frame in frames:
        yield perceive(frame, config, stages)


def first_frames(source: BagSource, least: int, whole: bool) -> Iterator[Frame]:
    """Yield the frames on which the input is checked.

    Args:
        source: an open drive.
        least: frames that are yielded at any rate. Unrelated single frames are not compared, so no more come.
        whole: yield all frames.
    """
    if whole:
        yield from progress.bar(source, total=source.total, unit="scan", desc="check sensors")
        return
    start = thread_clock()
    for count, frame in enumerate(source, 1):
        yield frame
        if count >= least and (
            count >= FIRST_FRAMES or source.recording.single_frames or thread_clock() - start > FIRST_SECONDS
        ):
            return


def _describe(
    recording: Recording,
    roles: Roles,
    config: Config,
    missing: Sequence[str],
    frame: Frame | None = None,
    source: BagSource | None = None,
) -> BagInfo:
    """Collect the summary of an open bag."""
    networks, missing_networks = network_providers(config)
    missing = [*missing, *missing_networks]
    return BagInfo(
        paths=tuple(address_of(path) or str(path) for path in recording.paths),
        formats=tuple(", ".join(filter(None, [f.format, f.compression])) for f in recording.files),
        size=recording.size,
        start=recording.start,
        end=recording.end,
        messages=recording.message_count,
        topics=tuple(_topic(recording, topic, roles) for topic in recording.topics),
        lidars=roles.lidar_names,
        cameras=[*map(CameraInfo.of, frame.cameras)] if frame else (),
        transforms=dict(source.tree) if source else {},
        points_frame=frame.points_frame if frame else "",
        world_frame=frame.world_frame if frame and frame.world_from_points is not None else "",
        network=networks["detector"],
        object_network=networks["objects"],
        configured=tuple(stated_lines(config)),
        missing=tuple(missing),
        warnings=(*recording.warnings, *(source.doubts if source else ())),
    )


def network_provider(config: Config) -> str:
    """Return the provider of the detector's network, or the reason why it does not run.

    The text is empty without a network.
    """
    path = model_path(config)
    if path is None:
        return ""
    from bevviz.stages.detector.providers import network

    return network(path, config.detector.provider)


def network_providers(config: Config) -> tuple[dict[str, str], list[str]]:
    """Return the providers of the networks of the sections ``detector`` and ``objects``.

    Returns:
        The provider of each, or the reason why it does not run, or an empty text without a network. Then the
        missing requirements of a full run: a detector, or a file that can be used.
    """
    runs_on = {"detector": network_provider(config), "objects": ""}
    missing = [] if config.detector.model else ["no detector: --model FILE.onnx"]
    has_file = {
        "detector": model_path(config) is not None,
        "objects": is_stage_file("objects", config.objects.method),
    }
    for section in [section for section, named in has_file.items() if named]:
        try:
            provider = _alone(config, section).provider
        except UserError as error:
            provider = str(error)
            missing.append(provider)
        runs_on[section] = runs_on[section] or provider
    return runs_on, missing


def _alone(config: Config, section: str) -> Stages:
    """Load one section's stage, with built-in methods for the others.

    Raises:
        UserError: the stage cannot be loaded.
    """
    from bevviz.pipeline.stage_loader import StageLoader

    runs_on = {"provider": config.detector.provider, "threads": config.detector.threads}
    detector = config.detector if section == "detector" else DetectorConfig().model_copy(update=runs_on)
    objects = config.objects if section == "objects" else ObjectsConfig()
    return StageLoader().load(config.restated({"detector": detector, "objects": objects}))


def _topic(recording: Recording, topic: Topic, roles: Roles) -> TopicInfo:
    """Return the summary of a topic."""
    rate = pause = pause_at = None
    if (topic.count or 0) > 1 and recording.message_count < MAX_TIMED_MESSAGES:
        times = recording.times(topic.name)
        steps = np.diff(times)
        if len(steps):  # A damaged bag may have fewer messages than its index counts.
            longest = int(np.argmax(steps))
            pause = float(steps[longest]) / SECOND
            pause_at = float(times[longest] - recording.start) / SECOND
        if len(steps) and times[-1] > times[0]:
            rate = float(len(steps) / ((times[-1] - times[0]) / SECOND))
    return TopicInfo(
        name=topic.name,
        type=topic.type,
        count=topic.count or 0,
        frame_id=topic.frame_id,
        rate=rate,
        pause=pause,
        pause_at=pause_at,
        role=roles.notes.get(topic.name, ""),
    )


def find_missing(roles: Roles, frame: Frame | None, config: Config) -> list[str]:
    """Return the requirements of a full run that one frame does not meet, with the option that meets each."""
    if frame is None:
        return [f"no {'scan' if roles.lidars else 'image'} could be read"]
    missing = []
    if roles.no_camera:
        missing.append(roles.no_camera)
    if roles.no_lidar:
        missing.append(roles.no_lidar)
    for role, camera in zip(roles.cameras, frame.cameras, strict=True):
        name = f"camera '{role.name}'"
        is_placed = camera.camera_from_points is not None or camera.image is None
        if not role.info_topic:
            advice = "and no topic of that kind is free: record it"
            if roles.camera_infos:
                advice = f"--set source.camera_info_topics='{{{role.topic}: {roles.camera_infos[0]}}}'"
            missing.append(f"{name} has no CameraInfo{': ' if roles.camera_infos else ', '}{advice}")
        if not is_placed and camera.image is not None and not (frame.points_frame and camera.image.frame_id):
            subject = "its images state" if frame.points_frame else "the points state"
            topic = role.topic if frame.points_frame else roles.driver
            missing.append(
                f"{name} is not placed: {subject} no frame_id, name it: "
                f"--set source.frames='{{{topic}: name}}'"
            )
        elif not is_placed and camera.image is not None:
            frames = f"'{frame.points_frame}' to '{camera.image.frame_id}'"
            edge = f"{frame.points_frame} {camera.image.frame_id}"
            setting = f"source.extrinsics='{{{edge}: [x, y, z, qx, qy, qz, qw]}}'"
            missing.append(f"{name} is not placed, no transform from {frames}: --set {setting}")
        if role.info_topic and is_placed:
            missing += [f"{name}: {problem}" for problem in camera.problems]
    if not frame.lidar:
        pass
    elif frame.world_from_points is None and not frame.points_frame:
        missing.append("no fixed frame, so that motion is not compensated: the points state no frame_id")
    elif frame.world_from_points is None:
        missing.append(
            f"no fixed frame above '{frame.points_frame}', so that {_without_motion(config)}: "
            "record nav_msgs/Odometry or the transforms above it, or name another frame that stands still: "
            "--set source.fixed_frame=name"
        )
    return [*missing, *frame.problems]


def _without_motion(config: Config) -> str:
    """Return what a run does where no fixed frame is known."""
    if config.odometry.method == "none":
        return "motion is not compensated"
    return "runs over the drive estimate the motion from the scans (odometry.method)"


def render_bag_info(info: BagInfo) -> str:
    """Return the summary of a bag as text for a terminal of 100 columns."""
    return f"{render_bag_contents(info)}\n{render_missing(info)}"


def render_bag_contents(info: BagInfo) -> str:
    """Return the summary of a bag but what is missing and the warnings."""
    kinds = sorted(set(info.formats))
    files = f"{len(info.formats)} files of " if len(info.formats) > 1 else ""
    header = {
        "bag": ", ".join(info.paths),
        "format": f"{files}{'; '.join(kinds)}; {megabytes(info.size)}",
        "time": f"{info.duration:.2f} s from {iso(info.start)}, {info.messages} messages",
    }
    return render_contents(header, info)


def render_contents(header: Mapping[str, str], info: TopicContents) -> str:
    """Return the contents as text, below some lines about the whole, with an empty line at the end.

    Args:
        header: name and text of each of these lines.
        info: the contents.
    """
    lines = [
        *(_row(name, text) for name, text in header.items()),
        "",
        *_topic_table(info.topics),
        "",
        *_section("roles", [f"{t.name}: {t.role}" for t in info.topics if t.role]),
        *_section("cameras", [camera.text for camera in info.cameras]),
        *_section("transforms", list(_tree(info))),
        *_section("network runs on", [info.network] if info.network else []),
        *_section("3D detector runs on", [info.object_network] if info.object_network else []),
        *_section("configured by", info.configured),
    ]
    return "\n".join(lines)


def render_missing(info: TopicContents) -> str:
    """Return what is missing and the warnings as text."""
    lines = _section("missing for a full run", info.missing or ["nothing"])
    return "\n".join([*lines, *_section("warnings", info.warnings)]).rstrip()


def _row(name: str, text: str) -> str:
    """Return a wrapped line with a name at its start."""
    return textwrap.fill(printable(text), WIDTH, initial_indent=f"{name:<8}", subsequent_indent=" " * 8)


def _section(title: str, items: Sequence[str]) -> list[str]:
    """Return a section with a title, or nothing without items."""
    return [title, *(line for item in items for line in _item(item)), ""] if items else []


def _item(text: str) -> Iterator[str]:
    """Yield wrapped lines. An option at the end stays on one line, so that users can copy it."""
    sentence, separator, option = printable(text).partition(": --")
    depth = len(sentence) - len(sentence.lstrip())
    yield from textwrap.wrap(
        sentence.lstrip() + separator[:1],
        WIDTH,
        initial_indent=" " * (2 + depth),
        subsequent_indent=" " * (4 + depth),
        break_on_hyphens=False,
    )
    if option:
        yield f"      --{option}"


def _topic_table(topics: Sequence[TopicInfo]) -> Iterator[str]:
    """Yield the table of topics. A value that no topic has gets no column."""
    columns: list[tuple[str, str, list[str]]] = [
        ("topic", "l", [t.name for t in topics]),
        ("type", "l", [t.type.rpartition("/")[2] for t in topics]),
        ("count", "r", ["" if t.count is None else str(t.count) for t in topics]),
        ("Hz", "r", ["" if t.rate is None else f"{t.rate:.1f}" for t in topics]),
    ]
    if any(t.size is not None for t in topics):
        columns.append(("kB", "r", ["" if t.size is None else f"{t.size / 1e3:.1f}" for t in topics]))
    if any(t.delay is not None for t in topics):
        columns.append(("delay", "r", ["" if t.delay is None else f"{1e3 * t.delay:.0f} ms" for t in topics]))
    if any(t.pause is not None for t in topics):
        pauses = ["" if t.pause is None else f"{t.pause:.2f} s at {t.pause_at:.1f} s" for t in topics]
        columns.append(("longest gap", "l", pauses))
    columns.append(("frame_id", "l", [t.frame_id for t in topics]))
    heads, sides, cells = zip(*columns, strict=True)
    return table.lines([heads, *zip(*cells, strict=True)], "".join(sides))


def _camera(camera: Camera) -> str:
    """Return the summary of a camera in one line."""
    words = [f"{camera.name}:"]
    if camera.image is not None:
        height, width = camera.image.bgr.shape[:2]
        words.append(f"{width} x {height} {camera.image.media_type or 'uncompressed'},")
    if camera.intrinsics is None:
        words.append("no intrinsics")
    else:
        k = camera.intrinsics.K
        words.append(f"fx {k[0, 0]:.1f} fy {k[1, 1]:.1f} cx {k[0, 2]:.1f} cy {k[1, 2]:.1f},")
        words.append(camera.intrinsics.distortion_model or "no distortion")
        if camera.intrinsics.assumed:
            words.append("(assumed)")
    words.append(", not placed" if camera.camera_from_points is None else ", placed by TF")
    return " ".join(words).replace(" ,", ",")


def _tree(info: TopicContents) -> Iterator[str]:
    """Yield the transforms as an indented tree."""
    children: dict[str, list[str]] = {}
    for child, parent in sorted(info.transforms.items()):
        children.setdefault(parent, []).append(child)

    def subtree(frame: str, depth: int) -> Iterator[str]:
        yield "  " * depth + frame
        for child in children.get(frame, ()):
            yield from subtree(child, depth + 1)

    for root in sorted(children.keys() - info.transforms.keys()):
        yield from subtree(root, 0)
    if info.points_frame:
        yield f"fixed frame of '{info.points_frame}': {info.world_frame or 'none'}"
