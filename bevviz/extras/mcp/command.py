"""Command ``bevviz mcp``: a server for agents by the Model Context Protocol."""

from __future__ import annotations

import argparse
from pathlib import Path

from bevviz.cli.options import Commands, add_bag, add_config, add_truth, load_config
from bevviz.cli.outputs import say, set_up_notes, warn
from bevviz.errors import UserError

EXAMPLES = """examples:
  bevviz mcp drive.mcap --model yolo11n.onnx            over one drive
  bevviz mcp runs/                                      over the results of bevviz batch
  bevviz mcp drive.mcap --allow-write reports           may also write reports and pictures, there"""


def add(commands: Commands) -> None:
    """Add the command ``mcp``."""
    command = commands.add_parser(
        "mcp",
        help="a server for agents (Model Context Protocol) over a drive or a batch",
        description="Serve questions about a drive to an agent, by the Model Context Protocol on standard "
        "input and output: findings, why, other values, compare, evaluate. It reads only what is named here.",
        epilog=EXAMPLES,
    )
    add_bag(command)
    command.add_argument(
        "--allow-write",
        type=Path,
        metavar="FOLDER",
        help="reports and pictures may be written in this folder",
    )
    add_truth(command)
    add_config(command)
    command.set_defaults(run=_mcp)


def _mcp(options: argparse.Namespace) -> int:
    try:
        from bevviz.extras.mcp.drives import AskedDrive, batch_drives
        from bevviz.extras.mcp.server import serve
        from bevviz.extras.mcp.tools import AgentTools
    except ImportError as error:
        raise UserError(
            f"an agent's server needs further packages ({error.name}): pip install 'bevviz[mcp]'"
        ) from None
    from bevviz.fleet.jobs import intact_results

    folder: Path | None = options.allow_write
    if folder is not None and not folder.is_dir():
        raise UserError(f"--allow-write {folder}: there is no such folder")
    paths: list[Path] = options.paths
    results = intact_results(paths[0].resolve(), lambda text: warn([text])) if paths[0].is_dir() else []
    if results:
        drives = batch_drives(results)
    else:
        config, truth = load_config(options), (options.truth, options.kitti_labels)
        asked = AskedDrive.of(_words(options), paths, config, truth)
        warn(asked.source.warnings)
        drives = {paths[0].name: lambda: asked}
    say(f"{', '.join(drives)}: for an agent on standard input and output; written is {folder or 'nothing'}")
    set_up_notes(quiet=True)
    serve(
        AgentTools(drives, results, None if folder is None else folder.resolve()), writes=folder is not None
    )
    return 0


def _words(options: argparse.Namespace) -> list[str]:
    """Return the words that open the drive as it is opened here, for other commands."""
    words = [str(path) for path in options.paths]
    for name in ("source_dataset", "source_sequence", "model", "preset", "config", "truth", "kitti_labels"):
        if (value := getattr(options, name, None)) is not None:
            words += [f"--{name.removeprefix('source_').replace('_', '-')}", str(value)]
    repeated = (("--results", options.source_results or ()), ("--set", options.set))
    return words + [word for option, given in repeated for value in given for word in (option, value)]
