"""Command ``bevviz info``: describe a bag or a running robot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bevviz.cli.command import command, flag, option
from bevviz.cli.options import ConfigOptions, DatasetOptions, load_config, ros_option
from bevviz.cli.outputs import STDOUT, json_option, print_result
from bevviz.cli.values import positive
from bevviz.errors import UserError


@dataclass(frozen=True, kw_only=True)
class InfoOptions:
    """Options of ``info``."""

    paths: tuple[Path, ...] = option(
        "PATH",
        "bag file or folder, or a data set's folder",
        positional=True,
        nargs="*",
        file="read",
        default=(),
    )
    data: DatasetOptions
    sensors: bool = flag(
        "check the sensors in the whole drive, not in its first 100 frames or 2 s of work alone"
    )
    live: bool = flag("a running robot's topics instead of a bag's")
    seconds: int | None = option(
        "SECONDS",
        "--live: how long to listen, for rates, sizes and delays (default: 3); Ctrl-C ends it earlier",
        names=("--for",),
        parse=positive,
    )
    model: str | None = option(
        "FILE.onnx", "detector that is going to be used", key="detector.model", file="read"
    )
    json: Path | None = json_option()
    config: ConfigOptions
    ros_args: tuple[str, ...] = ros_option()


@command(
    "info",
    description="Topics, rates, gaps and frames of a bag, the role of each topic, what is missing, and "
    "faults of the sensors in the first seconds.",
    forms=(
        "bevviz.pipeline.bag_info:TopicContents",
        "bevviz.pipeline.bag_info:BagInfo",
        "bevviz.live.graph_info:LiveInfo",
    ),
)
def _info(options: InfoOptions) -> int:
    from bevviz.pipeline.bag_info import BagInfo, describe_bag, render_bag_contents, render_missing

    if options.live and options.sensors:
        raise UserError("bevviz info: --sensors is for a drive; a running robot's are watched by bevviz live")
    if options.live:
        from bevviz.live import graph_info as info

        seconds = options.seconds or info.LISTEN
        live = info.describe(load_config(options), options.ros_args, seconds)
        print_result(options.json, "info", live, lambda: info.render(live))
        return 0
    if options.seconds is not None:
        raise UserError("bevviz info: --for is for --live; a bag is read as a whole")
    if not options.paths:
        raise UserError("bevviz info: which bag? Give its path, or --live for a running robot")

    def show(info: BagInfo) -> None:
        if options.json != STDOUT:
            print(render_bag_contents(info), flush=True)

    config = load_config(options)
    bag_info = describe_bag(options.paths, config, all_frames=options.sensors, on_contents=show)
    print_result(options.json, "info", bag_info, lambda: render_missing(bag_info))
    return 0
