"""Options shared by several commands."""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from bevviz.errors import UserError

if TYPE_CHECKING:
    from bevviz.bags.source import BagSource
    from bevviz.config import Config, Layer, Preset
    from bevviz.evaluate.ground_truth import TruthLookup
    from bevviz.recording.source_lookup import RecordingSource
    from bevviz.why import Selection

Commands: TypeAlias = "argparse._SubParsersAction[Any]"


TIMES = """A time is in seconds from the start of the bag (12.5), since 1970 (1700000000.0) or
ISO 8601 (2026-11-21T10:00:00)."""

# Matches several numbers, the first of them negative.
_NEGATIVES = re.compile(r"-[\d.][-+\d.eE]*(,[-+\d.eE]+)+")


def parse_whole(least: int, most: float, problem: str) -> Callable[[str], int]:
    """Return a parser of whole numbers from ``least`` to ``most``."""

    def parse(text: str) -> int:
        if not text.isdecimal() or not least <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"'{text}' {problem}")
        return int(text)

    return parse


def parse_real(is_valid: Callable[[float], bool], problem: str) -> Callable[[str], float]:
    """Return a parser of numbers."""

    def parse(text: str) -> float:
        with suppress(ValueError):
            if is_valid(value := float(text)):
                return value
        raise argparse.ArgumentTypeError(f"'{text}' {problem}")

    return parse


number = parse_whole(0, inf, "is no number, counted from 0")
positive = parse_whole(1, inf, "is no whole number of 1 or more")
_metres = parse_real(lambda metres: 0 < metres < 1000, "is no length in metres")
port = parse_whole(1, 65534, "is no port (1 to 65534)")


def add_bag(parser: argparse.ArgumentParser, *, detector: bool = True) -> argparse._ArgumentGroup:
    """Add the arguments for the bag and, with ``detector``, for the model. Return their option group."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = f"{parser.epilog}\n\n{TIMES}" if parser.epilog else TIMES
    parser.add_argument(
        "paths",
        nargs="+",
        type=Path,
        metavar="PATH",
        help="bag file or folder, several are one drive; a data set's folder; or a recording (.rrd), whose "
        "bag is looked for",
    )
    group = parser.add_argument_group("what to run")
    add_dataset(group)
    group.add_argument(
        "--bag",
        dest="bags",
        action="append",
        default=[],
        type=Path,
        metavar="PATH",
        help="of a recording, where it is not found by itself",
    )
    if detector:
        group.add_argument("--model", metavar="FILE.onnx", help="detector: YOLOv5, v8, v10, 11, 26 or YOLOX")
    return group


def add_dataset(group: argparse._ActionsContainer) -> None:
    """Add the options that select a data set and a drive in it."""
    group.add_argument(
        "--dataset",
        dest="source_dataset",
        metavar="NAME",
        help="what kind of data set PATH is, where it is not recognised (docs/inputs.md)",
    )
    group.add_argument(
        "--sequence",
        dest="source_sequence",
        metavar="NAME",
        help="which drive, of a data set with several in one folder",
    )
    group.add_argument(
        "--results",
        dest="source_results",
        action="append",
        metavar="[NAME=]PATH",
        help="results (KITTI, nuScenes, COCO, Parquet, CSV) in place of our own; repeatable",
    )


def add_truth(parser: argparse.ArgumentParser) -> None:
    """Add the options for the ground truth."""
    truth = parser.add_argument_group("ground truth", "The bag's own (.../ground_truth) is found by itself.")
    truth.add_argument("--truth", metavar="TOPIC", help="a Detection3DArray that states what is there")
    truth.add_argument(
        "--kitti-labels",
        type=Path,
        metavar="FILE|DIR",
        help="label_2 of KITTI, calib beside it; one file for each scan",
    )


def find_truth(options: argparse.Namespace, source: BagSource) -> TruthLookup | None:
    """Return the ground truth that the options of ``add_truth`` name. None: the bag has none.

    Raises:
        UserError: as ``bevviz.evaluate.truth_source``.
    """
    from bevviz.evaluate import truth_source

    return truth_source(source.roles, options.truth, options.kitti_labels, len(source.scans))


def add_limits(parser: argparse.ArgumentParser) -> None:
    """Add the options for the limits of an evaluation."""
    gate = parser.add_argument_group(
        "gate", "METRIC[.CLASS][@RANGE]: recall=0.8, recall.person@0-10=0.9, ap_3d_0.7.car.moderate=0.5."
    )
    for side, what in (("min", "at least"), ("max", "at most")):
        gate.add_argument(
            f"--{side}", action="append", default=[], metavar="METRIC=NUMBER", help=f"{what} that"
        )
    gate.add_argument("--junit", type=Path, metavar="FILE.xml", help="whether each limit is kept, for a CI")


def add_at(group: argparse._ArgumentGroup, what: str, *, required: bool = False) -> None:
    """Add the options that select one frame: by time, or by number for data without times."""
    scan = group.add_mutually_exclusive_group(required=required)
    scan.add_argument("--at", metavar="TIME", help=what)
    scan.add_argument("--at-frame", type=number, metavar="N", help="the same by its number, counted from 0")


def add_subject(parser: argparse.ArgumentParser, default: str) -> argparse._ArgumentGroup:
    """Add the options that select an object of a frame. Return their group.

    Args:
        parser: of the command.
        default: sentence on what is meant without any of them.
    """
    targets = parser.add_argument_group("what to explain", default)
    target = targets.add_mutually_exclusive_group()
    target.add_argument("--class", dest="label", default="", metavar="NAME", help="all of that class")
    target.add_argument(
        "--box", type=_numbers(2, 4), default=(), metavar="U,V[,U1,V1]", help="at that pixel, or in that box"
    )
    target.add_argument(
        "--point", type=_numbers(3), default=(), metavar="X,Y,Z", help="there, in metres of the points' frame"
    )
    target.add_argument(
        "--cell",
        type=_numbers(2),
        default=(),
        metavar="ROW,COLUMN",
        help="what is in that cell of the bird's-eye view",
    )
    target.add_argument("--cluster", type=number, metavar="N", help="the cluster of that number")
    target.add_argument("--object", type=number, metavar="N", help="the object in that row")
    target.add_argument("--detection", type=number, metavar="N", help="the detection in that row")
    targets.add_argument(
        "--radius", type=_metres, default=0.5, metavar="M", help="around the point or cell (default: 0.5)"
    )
    targets.add_argument(
        "--camera", default="", metavar="NAME", help="of pixel or detection, if there are several"
    )
    return targets


def _numbers(*counts: int) -> Callable[[str], tuple[float, ...]]:
    def parse(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if len(values) not in counts or not all(abs(v) < 1e6 for v in values):
            wanted = " or ".join(map(str, counts))
            raise argparse.ArgumentTypeError(f"'{text}' is not {wanted} numbers with commas between")
        return values

    return parse


def selected_subject(options: argparse.Namespace) -> Selection:
    """Return the selection of the options of ``add_subject``."""
    from bevviz.why import Selection

    return Selection(
        label=options.label,
        box=options.box,
        point=options.point,
        radius=options.radius,
        cell=tuple(map(int, options.cell)),
        cluster=options.cluster,
        detection=options.detection,
        object=options.object,
        camera=options.camera,
    )


def add_selection(group: argparse._ArgumentGroup) -> None:
    """Add the options that select a range of frames."""
    group.add_argument("--start", metavar="TIME", help="skip what is before this time")
    group.add_argument("--end", metavar="TIME", help="stop at this time")
    group.add_argument("--every", type=positive, default=1, metavar="N", help="run each N-th scan only")
    group.add_argument("--frames", type=frame_range, metavar="A:B", help="run scans A to B-1, counted from 0")


def open_bag(options: argparse.Namespace, config: Config) -> BagSource:
    """Open the bag and the frames that the options of ``add_bag`` and ``add_selection`` select."""
    from bevviz.bags.source import BagSource

    return BagSource(
        options.paths,
        config,
        start=options.start,
        end=options.end,
        every=options.every,
        frames=options.frames,
    )


def add_config(parser: argparse.ArgumentParser) -> None:
    """Add the options for the configuration."""
    group = parser.add_argument_group(
        "configuration",
        "What a bevviz.toml in this folder or above, or BEVVIZ_MODEL, states need not be given; this wins.",
    )
    group.add_argument(
        "--preset", choices=("default", "reference"), help="reference: as the ROS 2 tutorial pipeline"
    )
    group.add_argument("--config", type=Path, metavar="FILE", help="YAML, as 'bevviz config' prints it")
    group.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="one parameter, e.g. clustering.eps='60 cm'",
    )


def add_output(
    parser: argparse.ArgumentParser, blueprint: str | None = "debug", *, raw: bool = False
) -> argparse._ArgumentGroup:
    """Add the options for the outputs.

    Args:
        parser: of the command.
        blueprint: default layout. None: the command has a layout of its own.
        raw: whether ``--save`` can also write the messages.
    """
    group = parser.add_argument_group(
        "output", "The viewer, where there is a display. Several can be given at once."
    )
    if raw:
        group.add_argument(
            "--save",
            type=Path,
            action="append",
            default=[],
            metavar="FILE.rrd|FILE.mcap",
            help="save the recording, blueprint included; the messages as they come; both, given twice",
        )
    else:
        group.add_argument(
            "--save", type=Path, metavar="FILE.rrd", help="save the recording, blueprint included"
        )
    group.add_argument(
        "--serve",
        nargs="?",
        type=port,
        const=9090,
        metavar="PORT",
        help="web viewer on this machine (default: 9090)",
    )
    add_bind(group, "--serve")
    group.add_argument(
        "--connect", metavar="URL", help="a viewer elsewhere, e.g. rerun+http://laptop:9876/proxy"
    )
    group.add_argument("--viewer", action="store_true", help="open the viewer, beside the other outputs")
    if blueprint is not None:
        group.add_argument(
            "--blueprint",
            default=blueprint,
            metavar="NAME|FILE",
            help=f"debug, live, explain, bug_report, compare, a .py or a .rbl (default: {blueprint})",
        )
    return group


def add_keep(group: argparse._ActionsContainer) -> None:
    """Add the option for how much of a run is saved. A command without it always saves everything."""
    group.add_argument(
        "--keep",
        choices=("everything", "inspect", "report"),
        help="inspect: a fifth of everything, with some raw clouds; report: less (docs/recordings.md)",
    )


def add_bind(group: argparse._ArgumentGroup, option: str) -> None:
    """Add the option for the address at which a server listens."""
    group.add_argument(
        "--bind",
        default="127.0.0.1",
        metavar="ADDRESS",
        help=f"{option} at this address (default: 127.0.0.1, for this machine alone; 0.0.0.0: for everybody)",
    )


def add_ros_args(parser: argparse.ArgumentParser) -> None:
    """Add the option for the arguments of ROS."""
    parser.add_argument(
        "--ros-args",
        nargs=argparse.REMAINDER,
        default=[],
        metavar="...",
        help="the rest is for ROS: remaps, namespace, parameters",
    )


def load_config(options: argparse.Namespace) -> Config:
    """Return the requested configuration, ``--model`` included."""
    return load_config_from(options, options.config, collect_settings(options), options.preset)


def collect_settings(options: argparse.Namespace) -> list[str]:
    """Return the settings of ``--set``, ``--model``, ``--keep`` and the data set, as ``key=value``."""
    values = {
        "detector.model": getattr(options, "model", None) or None,
        "source.dataset": getattr(options, "source_dataset", None),
        "source.sequence": getattr(options, "source_sequence", None),
        "logging.keep": getattr(options, "keep", None),
    }
    results = result_settings(getattr(options, "source_results", None) or [], options.set, values)
    return [*options.set, *results, *(f"{key}={value}" for key, value in values.items() if value is not None)]


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
    from bevviz.datasets.result_files import RESULTS, results_are_2d

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
        stages.setdefault(key, f"topic:{RESULTS}{name}")
    stated = {text.partition("=")[0] for text in settings} | {key for key, value in options.items() if value}
    chosen = [f"{key}={value}" for key, value in stages.items() if key not in stated]
    return [f"source.results={json.dumps(named)}", *chosen]


def load_config_from(
    options: argparse.Namespace,
    file: Path | Sequence[Path] | None,
    settings: Sequence[str],
    preset: Preset | None,
) -> Config:
    """Load a configuration on top of the recording's, if the input is one, else of the project's."""
    from bevviz.config import load

    recorded: RecordingSource | None = getattr(options, "recorded", None)
    if recorded is not None:
        config = recorded.load(file, settings, preset)
    else:
        config = load(file, settings, preset, layers=project_layers(options))
    if hasattr(options, "keep"):
        return config
    # A single frame is read from the bag and logged whole, even if the recording or the project keeps less.
    logging = config.logging.model_copy(update={"keep": "everything"})
    return config.model_copy(update={"logging": logging})


def project_layers(options: argparse.Namespace) -> list[Layer]:
    """Return the settings stated for the working directory. Return none for a recording: it has its own.

    The files are read once.

    Raises:
        UserError: as ``bevviz.config.project.read_project_layers``.
    """
    from bevviz.config.project import read_project_layers

    if getattr(options, "recorded", None) is not None:
        return []
    if not hasattr(options, "layers"):
        options.layers = read_project_layers(Path.cwd())
    project: list[Layer] = options.layers
    return project


def follow_recording(options: argparse.Namespace) -> None:
    """Replace a recording in ``options.paths`` by its bag, and tell the user which.

    A recording without a bag becomes ``options.shown`` if the command can show recordings.

    Raises:
        UserError: as ``bevviz.recording.source_lookup.find_source``; ``--bag`` without a recording.
    """
    if not hasattr(options, "bags") or getattr(options, "check", False):
        return
    paths: list[Path] = options.paths
    if len(paths) != 1 or paths[0].suffix != ".rrd":
        if options.bags:
            raise UserError("--bag says where the bag of a recording is: PATH has to be one .rrd file")
        return
    from bevviz.cli.outputs import say, warn
    from bevviz.recording.source_lookup import NoBagError, find_source

    try:
        recorded = find_source(paths[0], options.bags, collect_settings(options))
    except NoBagError:
        if not getattr(options, "shows_recordings", False) or options.bags:
            raise
        options.shown = paths[0]
        return
    options.recorded, options.recording, options.paths = recorded, paths[0], list(recorded.paths)
    say(f"{paths[0]}: made from {', '.join(map(str, recorded.paths))}")
    warn(recorded.warnings)


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


def frame_range(text: str) -> tuple[int | None, int | None]:
    """Parse ``A:B``. An empty end is None."""
    first, colon, last = text.partition(":")
    if not colon or not all(part == "" or part.isdecimal() for part in (first, last)):
        raise argparse.ArgumentTypeError(f"'{text}' is not A:B, for example 100:200, 100: or :50")
    return (int(first) if first else None, int(last) if last else None)
