"""Command ``bevviz bag``: run the pipeline over a bag."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bevviz.cli.command import command
from bevviz.cli.options import (
    ConfigOptions,
    DriveOptions,
    Keep,
    RangeOptions,
    keep_option,
    load_config,
    open_bag,
)
from bevviz.cli.outputs import Outputs, layout_option
from bevviz.cli.run import process
from bevviz.support.contexts import garbage_collection_off


@dataclass(frozen=True, kw_only=True)
class BagOutputs(Outputs):
    """Outputs of a run of all stages."""

    blueprint: str = layout_option("debug")
    keep: Keep = keep_option()


@dataclass(frozen=True, kw_only=True)
class BagOptions:
    """Options of ``bag``."""

    drive: DriveOptions
    frames: RangeOptions
    config: ConfigOptions
    output: BagOutputs


@command(
    "bag",
    description="Run the pipeline over a bag: MCAP, sqlite3 (.db3) or ROS 1 (.bag), compressed or not.",
)
@garbage_collection_off()
def _bag(options: BagOptions) -> int:
    from bevviz.drive import Drive

    config = load_config(options)
    with open_bag(options.drive, options.frames, config) as source:
        default = Path(options.drive.paths[0].stem + ".rrd")
        return process(Drive(source, config), options.output, default)
