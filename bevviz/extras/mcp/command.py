"""Command ``bevviz mcp``: a server for agents by the Model Context Protocol."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bevviz.cli.command import command, option, option_values
from bevviz.cli.options import ConfigOptions, DriveOptions, TruthOptions, load_config
from bevviz.cli.outputs import say, set_up_notes, warn
from bevviz.errors import UserError
from bevviz.support.extensions import find

EXAMPLES = """examples:
  bevviz mcp drive.mcap --model yolo11n.onnx            over one drive
  bevviz mcp runs/                                      over the results of bevviz batch
  bevviz mcp drive.mcap --allow-write reports           may also write reports and pictures, there"""


@dataclass(frozen=True, kw_only=True)
class McpOptions:
    """Options of ``mcp``."""

    drive: DriveOptions
    allow_write: Path | None = option("FOLDER", "reports and pictures may be written in this folder")
    truth: TruthOptions
    config: ConfigOptions


@command(
    "mcp",
    help="a server for agents (Model Context Protocol) over a drive or a batch",
    description="Serve questions about a drive to an agent, by the Model Context Protocol on standard "
    "input and output: findings, why, other values, compare, evaluate. It reads only what is named here.",
    epilog=EXAMPLES,
)
def _mcp(options: McpOptions) -> int:
    try:
        from bevviz.extras.mcp.drives import AskedDrive, batch_drives
        from bevviz.extras.mcp.server import serve
        from bevviz.extras.mcp.tools import AgentTools
    except ImportError as error:
        raise UserError(
            f"an agent's server needs further packages ({error.name}): pip install 'bevviz[mcp]'"
        ) from None
    folder, paths = options.allow_write, options.drive.paths
    if folder is not None and not folder.is_dir():
        raise UserError(f"--allow-write {folder}: there is no such folder")
    results = find("commands", "batch").complete_bags(paths[0]) if paths[0].is_dir() else []
    if results:
        drives = batch_drives(results)
    else:
        config, truth = load_config(options), (options.truth.truth, options.truth.kitti_labels)
        asked = AskedDrive.of(_words(options), paths, config, truth)
        warn(asked.source.warnings)
        drives = {paths[0].name: lambda: asked}
    say(f"{', '.join(drives)}: for an agent on standard input and output; written is {folder or 'nothing'}")
    set_up_notes(quiet=True)
    serve(
        AgentTools(drives, results, None if folder is None else folder.resolve()), writes=folder is not None
    )
    return 0


def _words(options: McpOptions) -> list[str]:
    """Return the words that open the drive as it is opened here, for other commands."""
    words = [str(path) for path in options.drive.paths]
    for bound, value in option_values(options):
        if not bound.option.positional and bound.names[0] not in ("--bag", "--allow-write"):
            values = value if isinstance(value, tuple) else [value]
            words += [word for each in values if each is not None for word in (bound.names[0], str(each))]
    return words
