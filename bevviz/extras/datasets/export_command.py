"""Command ``bevviz export``: write frames and results as a data set."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from bevviz.cli.command import Group, command, option
from bevviz.cli.options import ConfigOptions, DriveOptions, RangeOptions, load_config, open_bag
from bevviz.cli.outputs import print_hints, say, warn
from bevviz.cli.run import run_with_progress
from bevviz.support.extensions import registered

DESCRIPTION = """Write a drive, or a part of it, as a data set, with the objects that were found as labels to
be corrected: the folders of KITTI's object benchmark (velodyne, image_2, calib, label_2), or a scene with the
tables of nuScenes, with all cameras, poses and tracks. bevviz opens both."""

EPILOG = """examples:
  bevviz export drive.mcap --model yolo11n.onnx -o training --start 10 --end 20 --every 5
  bevviz evaluate training --model other.onnx        another detector against the corrected labels
  bevviz export drive.mcap --model yolo11n.onnx --format nuscenes -o scenes"""


@dataclass(frozen=True, kw_only=True)
class DatasetOutput:
    """Options for the data set that is written."""

    group: ClassVar = Group("what to write")

    folder: Path = option("FOLDER", "that is made", names=("-o", "--output"), file="written", required=True)
    format: str = option(
        "NAME",
        "%(choices)s (default: %(default)s)",
        choices=lambda: sorted(registered("exports")),
        default="kitti",
    )
    camera: str = option("NAME", "whose images (default: the first one for KITTI, else all)", default="")


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Options of ``export``."""

    drive: DriveOptions
    frames: RangeOptions
    config: ConfigOptions
    output: DatasetOutput


@command(
    "export",
    help="write frames as KITTI or nuScenes, with what was found as labels",
    description=DESCRIPTION,
    epilog=EPILOG,
)
def _export(options: ExportOptions) -> int:
    from bevviz.anomalies import FailureSummary
    from bevviz.drive import Drive
    from bevviz.extras.datasets.folder_export import FolderExport
    from bevviz.support.extensions import load_class

    output = options.output
    export_class = load_class(registered("exports")[output.format], FolderExport)  # type: ignore[type-abstract]
    config = load_config(options)
    with open_bag(options.drive, options.frames, config) as source:
        drive = Drive(source, config)
        print_hints(drive.scene, config)
        export = export_class(output.folder, output.camera)
        failures = FailureSummary()
        with drive.new_session() as session:
            end = run_with_progress(drive.frames, session, [export, failures, drive.checks])
        warn([*drive.checks.warnings, *failures.warnings])
    warn(f"{count} frame(s) left out: {why}" for why, count in export.skipped.items())
    if export.frames:
        say(f"{export.frames} frames with {export.labels} labels in {output.folder}")
    return 130 if end.interrupted else 0 if export.frames else 1
