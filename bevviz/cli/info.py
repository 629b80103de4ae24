"""Command ``bevviz info``: describe a bag or a running robot."""

from __future__ import annotations

import argparse
from pathlib import Path

from bevviz.cli.options import Commands, add_config, add_dataset, add_ros_args, load_config, positive
from bevviz.cli.outputs import add_json, json_on_stdout, print_result
from bevviz.errors import UserError


def add(commands: Commands) -> None:
    """Add the command ``info``."""
    info = commands.add_parser(
        "info",
        help="what is in a bag, and what is missing for a full run",
        description="Topics, rates, gaps and frames of a bag, the role of each topic, what is missing, and "
        "faults of the sensors in the first seconds.",
    )
    info.add_argument(
        "paths", nargs="*", type=Path, metavar="PATH", help="bag file or folder, or a data set's folder"
    )
    add_dataset(info)
    info.add_argument(
        "--sensors",
        action="store_true",
        help="check the sensors in the whole drive, not in its first 100 frames or 2 s of work alone",
    )
    info.add_argument("--live", action="store_true", help="a running robot's topics instead of a bag's")
    info.add_argument(
        "--for",
        dest="seconds",
        type=positive,
        metavar="SECONDS",
        help="--live: how long to listen, for rates, sizes and delays (default: 3); Ctrl-C ends it earlier",
    )
    info.add_argument("--model", metavar="FILE.onnx", help="detector that is going to be used")
    add_json(info)
    add_config(info)
    add_ros_args(info)
    info.set_defaults(run=_info)


def _info(options: argparse.Namespace) -> int:
    from bevviz.pipeline.bag_info import (
        BagInfo,
        contents_tree,
        describe_bag,
        render_bag_contents,
        render_missing,
    )

    if options.live and options.sensors:
        raise UserError("bevviz info: --sensors is for a drive; a running robot's are watched by bevviz live")
    if options.live:
        from bevviz.live import graph_info as info

        seconds = options.seconds or info.LISTEN
        live = info.describe(load_config(options), options.ros_args, seconds)
        print_result(options, "info", contents_tree(live), lambda: info.render(live))
        return 0
    if options.seconds is not None:
        raise UserError("bevviz info: --for is for --live; a bag is read as a whole")
    if not options.paths:
        raise UserError("bevviz info: which bag? Give its path, or --live for a running robot")

    def show(info: BagInfo) -> None:
        if not json_on_stdout(options):
            print(render_bag_contents(info), flush=True)

    config = load_config(options)
    bag_info = describe_bag(options.paths, config, all_frames=options.sensors, on_contents=show)
    print_result(options, "info", contents_tree(bag_info), lambda: render_missing(bag_info))
    return 0
