"""``bevviz bag``."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from bevviz.cli.options import (
    Commands,
    add_bag,
    add_config,
    add_keep,
    add_output,
    add_selection,
    load_config,
    open_bag,
    processes,
)
from bevviz.cli.outputs import Outputs
from bevviz.cli.run import process
from bevviz.closing import without_collections

if TYPE_CHECKING:
    from bevviz.engine.task import Engine


def add(commands: Commands) -> None:
    bag = commands.add_parser(
        "bag",
        help="run the pipeline over a recorded bag",
        description="Run the pipeline over a bag: MCAP, sqlite3 (.db3) or ROS 1 (.bag), compressed or not.",
    )
    group = add_bag(bag)
    add_selection(group)
    group.add_argument(
        "--jobs",
        type=processes,
        default=1,
        metavar="N|auto",
        help="cut the drive into windows for so many processes; auto: one for each core (default: 1)",
    )
    group.add_argument(
        "--dask",
        default="",
        metavar="ADDRESS",
        help="windows for the workers of a Dask cluster instead, e.g. tcp://host:8786; with --save",
    )
    add_config(bag)
    add_keep(add_output(bag))
    bag.set_defaults(run=_bag)


@without_collections()
def _bag(options: argparse.Namespace) -> int:
    with ExitStack() as stack:
        engine: Engine | None = None
        if options.dask:
            from bevviz.engine.dask import Cluster

            engine = stack.enter_context(Cluster(options.dask))
        elif options.jobs > 1:
            from bevviz.engine.local import Processes

            # They start while this one does.
            engine = stack.enter_context(Processes(options.jobs, ["bevviz.parallel.work"]))
        from bevviz.drive import Drive

        config = load_config(options)
        source = stack.enter_context(open_bag(options, config))
        default = Path(options.paths[0].stem + ".rrd")
        return process(Drive(source, config), Outputs.of(options), default, engine)
