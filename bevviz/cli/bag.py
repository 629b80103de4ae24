"""Command ``bevviz bag``: run the pipeline over a bag."""

from __future__ import annotations

import argparse
from pathlib import Path

from bevviz.cli.options import (
    Commands,
    add_bag,
    add_config,
    add_keep,
    add_output,
    add_selection,
    load_config,
    open_bag,
)
from bevviz.cli.outputs import Outputs
from bevviz.cli.run import process
from bevviz.support.contexts import garbage_collection_off


def add(commands: Commands) -> None:
    """Add the command ``bag``."""
    bag = commands.add_parser(
        "bag",
        help="run the pipeline over a recorded bag",
        description="Run the pipeline over a bag: MCAP, sqlite3 (.db3) or ROS 1 (.bag), compressed or not.",
    )
    group = add_bag(bag)
    add_selection(group)
    add_config(bag)
    add_keep(add_output(bag))
    bag.set_defaults(run=_bag)


@garbage_collection_off()
def _bag(options: argparse.Namespace) -> int:
    from bevviz.drive import Drive

    config = load_config(options)
    with open_bag(options, config) as source:
        default = Path(options.paths[0].stem + ".rrd")
        return process(Drive(source, config), Outputs.of(options), default)
