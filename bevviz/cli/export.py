"""Command ``bevviz export``: write frames and results as a data set."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from bevviz.cli.options import Commands, add_bag, add_config, add_selection, load_config, open_bag
from bevviz.cli.outputs import print_hints, say, warn
from bevviz.cli.run import run_with_progress

DEFAULT = "kitti"
DESCRIPTION = """Write a drive, or a part of it, as a data set, with the objects that were found as labels to
be corrected: the folders of KITTI's object benchmark (velodyne, image_2, calib, label_2), or a scene with the
tables of nuScenes, with all cameras, poses and tracks. bevviz opens both."""

EPILOG = """examples:
  bevviz export drive.mcap --model yolo11n.onnx -o training --start 10 --end 20 --every 5
  bevviz evaluate training --model other.onnx        another detector against the corrected labels
  bevviz export drive.mcap --model yolo11n.onnx --format nuscenes -o scenes"""


def add(commands: Commands) -> None:
    """Add the command ``export``."""
    export = commands.add_parser(
        "export",
        help="write frames as KITTI or nuScenes, with what was found as labels",
        description=DESCRIPTION,
        epilog=EPILOG,
    )
    group = add_bag(export)
    add_selection(group)
    add_config(export)
    output = export.add_argument_group("what to write")
    output.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="that is made")
    output.add_argument(
        "--format",
        choices=_Formats(),
        default=DEFAULT,
        metavar="NAME",
        help=f"%(choices)s (default: {DEFAULT})",
    )
    output.add_argument(
        "--camera",
        default="",
        metavar="NAME",
        help="whose images (default: the first one for KITTI, else all)",
    )
    export.set_defaults(run=_export)


class _Formats:
    """Names of the registered formats. To find them takes 40 ms, so it happens only where they are needed."""

    def __iter__(self) -> Iterator[str]:
        from bevviz.support.extensions import registered

        return iter(sorted(registered("exports")))


def _export(options: argparse.Namespace) -> int:
    from bevviz.anomalies import FailureSummary
    from bevviz.drive import Drive
    from bevviz.export.folder import FolderExport
    from bevviz.support.extensions import load_class, registered

    export_class = load_class(registered("exports")[options.format], FolderExport)  # type: ignore[type-abstract]
    config = load_config(options)
    with open_bag(options, config) as source:
        drive = Drive(source, config)
        print_hints(drive.scene, config)
        export = export_class(options.output, options.camera)
        failures = FailureSummary()
        end = run_with_progress(drive.frames, drive.new_session(), [export, failures])
        warn([*source.warnings, *failures.warnings])
    warn(f"{count} frame(s) left out: {why}" for why, count in export.skipped.items())
    if export.frames:
        say(f"{export.frames} frames with {export.labels} labels in {options.output}")
    return 130 if end.interrupted else 0 if export.frames else 1
