"""Command ``bevviz compare``: two configurations, or bevviz and the robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, cast

from bevviz.cli.command import Group, command, option
from bevviz.cli.options import (
    ConfigOptions,
    DriveOptions,
    RangeOptions,
    TruthOptions,
    collect_settings,
    load_config,
    load_config_from,
    open_bag,
)
from bevviz.cli.outputs import Outputs, json_option, layout_option, print_hints, print_result, say, warn
from bevviz.cli.run import run_logged
from bevviz.errors import UserError

if TYPE_CHECKING:
    from rerun import RecordingStream

    from bevviz.bags.source import BagSource
    from bevviz.compare.sides import ComparedFrame
    from bevviz.config import Config, Preset
    from bevviz.model.frame import Frame
    from bevviz.model.protocols import Observer, Processor

DESCRIPTION = """Run two configurations on the same frames and show how the results differ: objects that only
A or only B has, that have moved, or that have another class. Without --a, --b, --set-a, --set-b, --preset
and --config it is the reference preset (A) against the default one (B), or of a recording (.rrd) against
its own configuration."""


@dataclass(frozen=True, kw_only=True)
class SideOptions:
    """Options for the two configurations."""

    group: ClassVar = Group("the two sides", "What --set, --config and --preset say is for both.")

    a: str | None = option("FILE|PRESET", "configuration of A", file="read")
    set_a: tuple[str, ...] = option("KEY=VALUE", "one parameter of A", repeat=True)
    b: str | None = option("FILE|PRESET", "configuration of B", file="read")
    set_b: tuple[str, ...] = option("KEY=VALUE", "one parameter of B", repeat=True)
    robot: str | None = option(
        "TOPIC", "A is bevviz, B what the robot published (default: its fused Detection3DArray)", const=""
    )


@dataclass(frozen=True, kw_only=True)
class CompareOutputs(Outputs):
    """Outputs of ``compare``."""

    blueprint: str = layout_option("compare")
    json: Path | None = json_option()
    csv: Path | None = option("FILE", "a row for each object that differs", file="written at the end")


@dataclass(frozen=True, kw_only=True)
class CompareOptions:
    """Options of ``compare``."""

    drive: DriveOptions
    frames: RangeOptions
    config: ConfigOptions
    sides: SideOptions
    truth: TruthOptions
    output: CompareOutputs


@command(
    "compare",
    description=DESCRIPTION,
    forms=("bevviz.compare.summary:ComparisonResult",),
)
def _compare(options: CompareOptions) -> int:
    return _configurations(options) if options.sides.robot is None else _robot(options, options.sides.robot)


def _configurations(options: CompareOptions) -> int:
    from bevviz.compare.sides import Comparison
    from bevviz.pipeline.session import check_same_frames, common_frames

    names, (a, b) = _sides(options)
    check_same_frames({"A": a, "B": b})
    decoded = common_frames([a, b])
    with open_bag(options.drive, options.frames, decoded) as source:
        comparison = Comparison((a, b), truth=options.truth.find(source))
        return _run(comparison, source, decoded, names, (a, b), options)


def _robot(options: CompareOptions, requested: str) -> int:
    from bevviz.compare.sides import Comparison, robot_topic

    sides = options.sides
    if sides.a or sides.b or sides.set_a or sides.set_b:
        raise UserError("--robot: A is bevviz as --set, --config and --preset say; leave --a and --b out")
    config = load_config(options)
    with open_bag(options.drive, options.frames, config) as source:
        topic = robot_topic(source.roles.robot_detections_3d, requested)
        names = "bevviz", f"the robot's {topic}"
        comparison = Comparison((config,), topic, options.truth.find(source))
        return _run(comparison, source, config, names, (config, config), options)


def _run(
    processor: Processor[Frame, ComparedFrame],
    source: BagSource,
    config: Config,
    names: tuple[str, str],
    configs: tuple[Config, Config],
    options: CompareOptions,
) -> int:
    from bevviz.checks import InputChecks
    from bevviz.compare.log import ComparisonRecorder
    from bevviz.compare.sides import FirstSide, SideFailures
    from bevviz.compare.summary import ComparisonSummary
    from bevviz.config import changes

    summary, failures = ComparisonSummary(names, changes(*configs)), SideFailures()
    checks = InputChecks(source, configs[0])

    def observers(recording: RecordingStream) -> list[Observer[ComparedFrame]]:
        print_hints(source.scene, config)
        return [ComparisonRecorder(recording, *configs, summary), summary, failures, FirstSide(checks)]

    def finish() -> None:
        warn([*checks.warnings_beside(source.warnings), *failures.warnings])
        if summary.without:
            say(f"{summary.without} frames for which the robot published nothing are left out")
        print_result(output.json, "compare", summary.result(), summary.table)
        if output.csv is not None:
            summary.write_csv(output.csv)

    output = options.output
    outputs = output.or_file(Path(f"{options.drive.paths[0].stem}_compare.rrd"))
    return run_logged(source, processor, config, outputs, observers, finish)


def _sides(options: CompareOptions) -> tuple[tuple[str, str], tuple[Config, Config]]:
    """Return the names and the configurations of the two sides."""
    sides, config = options.sides, options.config
    base_a, base_b = sides.a, sides.b
    if not any((base_a, base_b, sides.set_a, sides.set_b, config.preset, config.file)):
        base_a, base_b = "reference", None if config.recorded else "default"
    a = _side(options, base_a, sides.set_a)
    b = _side(options, base_b, sides.set_b)
    return (a[0], b[0]), (a[1], b[1])


def _side(options: CompareOptions, base: str | None, settings: Sequence[str]) -> tuple[str, Config]:
    presets, chosen = ("default", "reference"), options.config
    preset = chosen.preset if base not in presets else cast("Preset", base)
    files = [] if chosen.file is None else [chosen.file]
    files += [] if base is None or base in presets else [Path(base)]
    config = load_config_from(options, files, [*collect_settings(options), *settings], preset)
    default_name = chosen.file or ("as recorded" if chosen.recorded and preset is None else config.preset)
    return " ".join([base or str(default_name), *settings]), config
