"""Command ``bevviz compare``: two configurations, or bevviz and the robot."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, cast

from bevviz.cli.options import (
    Commands,
    add_bag,
    add_config,
    add_output,
    add_selection,
    add_truth,
    collect_settings,
    find_truth,
    load_config,
    load_config_from,
    open_bag,
)
from bevviz.cli.outputs import Outputs, add_json, print_hints, print_result, say, warn
from bevviz.cli.run import run_logged
from bevviz.errors import UserError

if TYPE_CHECKING:
    from rerun import RecordingStream

    from bevviz.bags.source import BagSource
    from bevviz.compare.sides import ComparedFrame
    from bevviz.compare.summary import ComparisonSummary
    from bevviz.config import Config, Preset
    from bevviz.model.frame import Frame
    from bevviz.model.protocols import Observer, Processor

DESCRIPTION = """Run two configurations on the same frames and show how the results differ: objects that only
A or only B has, that have moved, or that have another class. Without --a, --b, --set-a, --set-b, --preset
and --config it is the reference preset (A) against the default one (B), or of a recording (.rrd) against
its own configuration."""


def add(commands: Commands) -> None:
    """Add the command ``compare``."""
    compare = commands.add_parser(
        "compare", help="what if? two configurations, or the robot", description=DESCRIPTION
    )
    group = add_bag(compare)
    add_selection(group)
    add_config(compare)
    sides = compare.add_argument_group("the two sides", "What --set, --config and --preset say is for both.")
    for side in "ab":
        sides.add_argument(f"--{side}", metavar="FILE|PRESET", help=f"configuration of {side.upper()}")
        sides.add_argument(
            f"--set-{side}",
            action="append",
            default=[],
            metavar="KEY=VALUE",
            help=f"one parameter of {side.upper()}",
        )
    sides.add_argument(
        "--robot",
        nargs="?",
        const="",
        metavar="TOPIC",
        help="A is bevviz, B what the robot published (default: its fused Detection3DArray)",
    )
    add_truth(compare)
    output = add_output(compare, blueprint="compare")
    add_json(output)
    output.add_argument("--csv", type=Path, metavar="FILE", help="a row for each object that differs")
    compare.set_defaults(run=_compare)


def _compare(options: argparse.Namespace) -> int:
    if options.robot is not None:
        return _robot(options)
    return _configurations(options)


def _configurations(options: argparse.Namespace) -> int:
    from bevviz.compare.sides import ComparedSessions
    from bevviz.pipeline.session import check_same_frames, common_frames

    names, (a, b) = _sides(options)
    check_same_frames({"A": a, "B": b})
    decoded = common_frames([a, b])
    with open_bag(options, decoded) as source:
        sessions = ComparedSessions(a, b, find_truth(options, source))
        return _run(sessions, source, decoded, names, (a, b), options)


def _robot(options: argparse.Namespace) -> int:
    from bevviz.compare.sides import ComparedRobot, robot_topic
    from bevviz.pipeline.session import Session

    if options.a or options.b or options.set_a or options.set_b:
        raise UserError("--robot: A is bevviz as --set, --config and --preset say; leave --a and --b out")
    config = load_config(options)
    with open_bag(options, config) as source:
        topic = robot_topic(source.roles.robot_detections_3d, options.robot)
        names = "bevviz", f"the robot's {topic}"
        compared = ComparedRobot(Session(config), topic, find_truth(options, source))
        return _run(compared, source, config, names, (config, config), options)


def _run(
    processor: Processor[Frame, ComparedFrame],
    source: BagSource,
    config: Config,
    names: tuple[str, str],
    configs: tuple[Config, Config],
    options: argparse.Namespace,
) -> int:
    from bevviz.compare.sides import ComparisonRecorder, SideFailures
    from bevviz.compare.summary import ComparisonSummary
    from bevviz.config import changes

    summary, failures = ComparisonSummary(names, changes(*configs)), SideFailures()

    def observers(recording: RecordingStream) -> list[Observer[ComparedFrame]]:
        print_hints(source.scene, config)
        return [ComparisonRecorder(recording, *configs, summary), summary, failures]

    def finish() -> None:
        warn(failures.warnings)
        if summary.without:
            say(f"{summary.without} frames for which the robot published nothing are left out")
        _report(summary, options)

    outputs = Outputs.of(options).or_file(_default(options))
    return run_logged(source, processor, config, outputs, observers, finish)


def _default(options: argparse.Namespace) -> Path:
    return Path(f"{options.paths[0].stem}_compare.rrd")


def _report(summary: ComparisonSummary, options: argparse.Namespace) -> None:
    print_result(options, "compare", summary.as_tree(), summary.table)
    if options.csv is not None:
        summary.write_csv(options.csv)


def _sides(options: argparse.Namespace) -> tuple[tuple[str, str], tuple[Config, Config]]:
    """Return the names and the configurations of the two sides."""
    side_options = options.a, options.b, options.set_a, options.set_b
    if not any(side_options) and options.preset is None and options.config is None:
        options.a, options.b = "reference", None if _recorded(options) else "default"
    a = _side(options, options.a, options.set_a)
    b = _side(options, options.b, options.set_b)
    return (a[0], b[0]), (a[1], b[1])


def _side(options: argparse.Namespace, base: str | None, settings: list[str]) -> tuple[str, Config]:
    presets = ("default", "reference")
    preset = options.preset if base not in presets else cast("Preset", base)
    files = [] if options.config is None else [options.config]
    files += [] if base is None or base in presets else [Path(base)]
    config = load_config_from(options, files, [*collect_settings(options), *settings], preset)
    default_name = options.config or (
        "as recorded" if _recorded(options) and preset is None else config.preset
    )
    return " ".join([base or str(default_name), *settings]), config


def _recorded(options: argparse.Namespace) -> bool:
    """Return whether the input is a recording. Its configuration then replaces the default one."""
    return getattr(options, "recorded", None) is not None
