"""Options shared by several commands."""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, TypeAlias

from bevviz.cli.command import Group, option, option_values
from bevviz.cli.values import frame_range, metres, number, numbers, positive
from bevviz.errors import UserError

if TYPE_CHECKING:
    from bevviz.bags.source import BagSource
    from bevviz.config import Config, Layer, Preset
    from bevviz.evaluate.ground_truth import TruthLookup
    from bevviz.recording.source_lookup import RecordingSource
    from bevviz.why import Selection


TIMES = """A time is in seconds from the start of the bag (12.5), since 1970 (1700000000.0) or
ISO 8601 (2026-11-21T10:00:00)."""

# Matches several numbers, the first of them negative.
_NEGATIVES = re.compile(r"-[\d.][-+\d.eE]*(,[-+\d.eE]+)+")


# --- groups of options -----------------------------------------------------------------------

WHAT_TO_RUN = Group("what to run")


def model_option() -> Any:
    """Return the option for the detector."""
    return option(
        "FILE.onnx",
        "detector: YOLOv5, v8, v10, 11, 26 or YOLOX",
        parse=lambda path: path or None,
        key="detector.model",
        file="read",
    )


Keep: TypeAlias = Literal["everything", "inspect", "report"] | None


def keep_option() -> Any:
    """Return the option for how much of a run is saved. A command without it always saves everything."""
    return option(
        help="inspect: a fifth of everything, with some raw clouds; report: less (docs/recordings.md)",
        key="logging.keep",
    )


def ros_option() -> Any:
    """Return the option for the arguments of ROS."""
    text = "the rest is for ROS: remaps, namespace, parameters"
    return option("...", text, names=("--ros-args",), nargs=argparse.REMAINDER, default=())


@dataclass(frozen=True, kw_only=True)
class DatasetOptions:
    """Options that select a data set, a drive in it, and results in place of our own."""

    dataset: str | None = option(
        "NAME",
        "what kind of data set PATH is, where it is not recognised (docs/inputs.md)",
        key="source.dataset",
    )
    sequence: str | None = option(
        "NAME", "which drive, of a data set with several in one folder", key="source.sequence"
    )
    results: tuple[str, ...] = option(
        "[NAME=]PATH",
        "results (KITTI, nuScenes, COCO, Parquet, CSV) in place of our own; repeatable",
        repeat=True,
        key="source.results",
    )


@dataclass(frozen=True, kw_only=True)
class SensorOptions(DatasetOptions):
    """Options that select a drive."""

    group: ClassVar = Group(WHAT_TO_RUN.title, epilog=TIMES)

    paths: tuple[Path, ...] = option(
        "PATH",
        "bag file or folder, several are one drive; a data set's folder; or a recording (.rrd), whose "
        "bag is looked for",
        positional=True,
        nargs="+",
        file="read",
        required=True,
    )
    bags: tuple[Path, ...] = option(
        "PATH", "of a recording, where it is not found by itself", names=("--bag",), repeat=True
    )


@dataclass(frozen=True, kw_only=True)
class DriveOptions(SensorOptions):
    """Options that select a drive and the detector."""

    model: str | None = model_option()


@dataclass(frozen=True, kw_only=True)
class RangeOptions:
    """Options that select a range of frames."""

    group: ClassVar = WHAT_TO_RUN

    start: str | None = option("TIME", "skip what is before this time")
    end: str | None = option("TIME", "stop at this time")
    every: int = option("N", "run each N-th scan only", parse=positive, default=1)
    frames: tuple[int | None, int | None] | None = option(
        "A:B", "run scans A to B-1, counted from 0", parse=frame_range
    )


@dataclass(frozen=True, kw_only=True)
class FrameOptions:
    """Options that select one frame: by time, or by number for data without times."""

    group: ClassVar = WHAT_TO_RUN

    at: str | None = option("TIME", "the scan nearest to this time", one_of="frame", required=True)
    at_frame: int | None = option("N", "the same by its number, counted from 0", parse=number, one_of="frame")


@dataclass(frozen=True, kw_only=True)
class TruthOptions:
    """Options that select the ground truth."""

    group: ClassVar = Group("ground truth", "The bag's own (.../ground_truth) is found by itself.")

    truth: str | None = option("TOPIC", "a Detection3DArray that states what is there")
    kitti_labels: Path | None = option(
        "FILE|DIR", "label_2 of KITTI, calib beside it; one file for each scan", file="read"
    )

    def find(self, source: BagSource) -> TruthLookup | None:
        """Return the selected ground truth of a drive. None: it has none.

        Raises:
            UserError: as ``bevviz.evaluate.truth_source``.
        """
        from bevviz.evaluate import truth_source

        return truth_source(source, self.truth, self.kitti_labels)


@dataclass(frozen=True, kw_only=True)
class LimitOptions:
    """Options for the limits of an evaluation."""

    group: ClassVar = Group(
        "gate", "METRIC[.CLASS][@RANGE]: recall=0.8, recall.person@0-10=0.9, ap_3d_0.7.car.moderate=0.5."
    )

    min: tuple[str, ...] = option("METRIC=NUMBER", "at least that", repeat=True)
    max: tuple[str, ...] = option("METRIC=NUMBER", "at most that", repeat=True)
    junit: Path | None = option("FILE.xml", "whether each limit is kept, for a CI", file="written")


@dataclass(frozen=True, kw_only=True)
class SubjectOptions:
    """Options that select an object of a frame."""

    label: str = option("NAME", "all of that class", names=("--class",), one_of="subject", default="")
    box: tuple[float, ...] = option(
        "U,V[,U1,V1]", "at that pixel, or in that box", parse=numbers(2, 4), one_of="subject", default=()
    )
    point: tuple[float, ...] = option(
        "X,Y,Z", "there, in metres of the points' frame", parse=numbers(3), one_of="subject", default=()
    )
    cell: tuple[float, ...] = option(
        "ROW,COLUMN",
        "what is in that cell of the bird's-eye view",
        parse=numbers(2),
        one_of="subject",
        default=(),
    )
    cluster: int | None = option("N", "the cluster of that number", parse=number, one_of="subject")
    object: int | None = option("N", "the object in that row", parse=number, one_of="subject")
    detection: int | None = option("N", "the detection in that row", parse=number, one_of="subject")
    radius: float = option("M", "around the point or cell (default: 0.5)", parse=metres, default=0.5)
    camera: str = option("NAME", "of pixel or detection, if there are several", default="")

    def selection(self) -> Selection:
        """Return the selected object."""
        from bevviz.why import Selection

        return Selection(
            label=self.label,
            box=self.box,
            point=self.point,
            radius=self.radius,
            cell=tuple(map(int, self.cell)),
            cluster=self.cluster,
            detection=self.detection,
            object=self.object,
            camera=self.camera,
        )


@dataclass(frozen=True, kw_only=True)
class ConfigOptions:
    """Options for the configuration."""

    group: ClassVar = Group(
        "configuration",
        "What a bevviz.toml in this folder or above, or BEVVIZ_MODEL, states need not be given; this wins.",
    )

    preset: Literal["default", "reference"] | None = option(help="reference: as the ROS 2 tutorial pipeline")
    file: Path | None = option("FILE", "YAML, as 'bevviz config' prints it", names=("--config",), file="read")
    set: tuple[str, ...] = option("KEY=VALUE", "one parameter, e.g. clustering.eps='60 cm'", repeat=True)
    recorded: Any = None  # RecordingSource of the input; None: it is no recording

    @cached_property
    def project_layers(self) -> list[Layer]:
        """Settings stated for the working directory, read once. None for a recording: it has its own.

        Raises:
            UserError: as ``bevviz.config.project.read_project_layers``.
        """
        from bevviz.config.project import read_project_layers

        return [] if self.recorded is not None else read_project_layers(Path.cwd())


class Configured(Protocol):
    """Options of a command that takes a configuration."""

    @property
    def config(self) -> ConfigOptions:
        """Options for the configuration."""


# --- what the options select -------------------------------------------------------------------


def open_bag(drive: SensorOptions, frames: RangeOptions, config: Config) -> BagSource:
    """Open the bag and the frames that the options select."""
    from bevviz.bags.source import BagSource

    return BagSource(
        drive.paths, config, start=frames.start, end=frames.end, every=frames.every, frames=frames.frames
    )


def load_config(options: Configured, settings: Sequence[str] = ()) -> Config:
    """Return the requested configuration: that of the command's options, and further settings."""
    chosen = options.config
    return load_config_from(options, chosen.file, [*collect_settings(options), *settings], chosen.preset)


def collect_settings(options: Configured) -> list[str]:
    """Return ``key=value`` of ``--set`` and of every option that sets a parameter."""
    values = {bound.option.key: value for bound, value in option_values(options) if bound.option.key}
    results = result_settings(values.pop("source.results", ()), options.config.set, values)
    stated = [f"{key}={value}" for key, value in values.items() if value is not None]
    return [*options.config.set, *results, *stated]


def result_settings(
    results: Sequence[str], settings: Sequence[str], options: Mapping[str, str | None]
) -> list[str]:
    """Return the settings for ``--results``: the files, and the first as the stage whose results they are.

    Args:
        results: ``PATH`` or ``NAME=PATH`` each.
        settings: those of ``--set``, which win.
        options: those of other options, which win.

    Raises:
        UserError: a file is missing or of no known kind, or a name comes twice.
    """
    if not results:
        return []
    from bevviz.datasets.result_files import results_are_2d
    from bevviz.messages.topics import RESULT_TOPICS

    named = dict[str, str]()
    for text in results:
        name, equals, path = text.partition("=")
        path = path if equals else name
        name = re.sub(r"\W+", "_", name if equals else Path(path).stem).strip("_") or "results"
        if name in named:
            raise UserError(f"--results {text}: {name} is the name of {named[name]} already; give NAME=PATH")
        named[name] = path
    stages = dict[str, str]()
    for name, path in named.items():
        key = "detector.model" if results_are_2d(Path(path).expanduser()) else "objects.method"
        stages.setdefault(key, f"topic:{RESULT_TOPICS}{name}")
    stated = {text.partition("=")[0] for text in settings} | {key for key, value in options.items() if value}
    chosen = [f"{key}={value}" for key, value in stages.items() if key not in stated]
    return [f"source.results={json.dumps(named)}", *chosen]


def load_config_from(
    options: Configured,
    file: Path | Sequence[Path] | None,
    settings: Sequence[str],
    preset: Preset | None,
) -> Config:
    """Load a configuration. Without ``--keep`` a command logs everything, even if a recording keeps less."""
    config = load_stated(options.config, file, settings, preset)
    if any(bound.option.key == "logging.keep" for bound, _ in option_values(options)):
        return config
    logging = config.logging.model_copy(update={"keep": "everything"})
    return config.model_copy(update={"logging": logging})


def load_stated(
    options: ConfigOptions,
    file: Path | Sequence[Path] | None,
    settings: Sequence[str],
    preset: Preset | None,
) -> Config:
    """Load a configuration on top of the recording's, if the input is one, else of the project's."""
    from bevviz.config import load

    recorded: RecordingSource | None = options.recorded
    if recorded is not None:
        return recorded.load(file, settings, preset)
    return load(file, settings, preset, layers=options.project_layers)


def follow_recording(options: Any) -> Any:
    """Return the options with the bag of a recording in place of the recording, and tell the user which.

    A command that can show a recording without a bag has a field ``shown``, which becomes that recording.

    Raises:
        UserError: as ``bevviz.recording.source_lookup.find_source``; ``--bag`` without a recording.
    """
    drive = getattr(options, "drive", None)
    if not isinstance(drive, SensorOptions) or getattr(options, "check", False):
        return options
    if len(drive.paths) != 1 or drive.paths[0].suffix != ".rrd":
        if drive.bags:
            raise UserError("--bag says where the bag of a recording is: PATH has to be one .rrd file")
        return options
    from bevviz.cli.outputs import say, warn
    from bevviz.recording.source_lookup import NoBagError, find_source

    recording, settings = drive.paths[0], collect_settings(options)
    try:
        recorded = find_source(recording, drive.bags, settings)
    except NoBagError:
        if not hasattr(options, "shown") or drive.bags:
            raise
        return replace(options, shown=recording)
    say(f"{recording}: made from {', '.join(map(str, recorded.paths))}")
    warn(recorded.warnings)
    config = replace(options.config, recorded=recorded)
    return replace(options, drive=replace(drive, paths=tuple(recorded.paths)), config=config)


def join_negative_numbers(arguments: Iterable[str]) -> list[str]:
    """Return the arguments with ``--point -5,1,0`` replaced by ``--point=-5,1,0``.

    Argparse takes the negative number for an option.
    """
    joined: list[str] = []
    for argument in arguments:
        option = joined[-1] if joined else ""
        if option.startswith("--") and "=" not in option and _NEGATIVES.fullmatch(argument):
            joined[-1] = f"{option}={argument}"
        else:
            joined.append(argument)
    return joined
