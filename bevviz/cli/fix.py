"""Command ``bevviz fix``: search parameters that repair what a batch or a drive gets wrong."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from bevviz.cli.options import (
    Commands,
    add_bag,
    add_config,
    add_truth,
    collect_settings,
    load_config,
    positive,
)
from bevviz.cli.outputs import add_json, json_on_stdout, print_result, say
from bevviz.errors import UserError
from bevviz.support import progress

if TYPE_CHECKING:
    from bevviz.config import Config
    from bevviz.fleet.fix import DriveFrames


def add(commands: Commands) -> None:
    """Add the command ``fix``."""
    fix = commands.add_parser(
        "fix",
        help="search parameters that find the missed objects, and check what they break",
        description="Search the parameters that the misses depend on, several at a time, on frames of some "
        "drives with ground truth. Confirm the best on frames of other drives, and write them as YAML.",
        epilog="PATH may also be the folder of a batch: its drives, with its configuration.",
    )
    add_bag(fix)
    add_truth(fix)
    add_config(fix)
    group = fix.add_argument_group("search")
    group.add_argument("--cause", type=positive, metavar="N", help="of a batch, as 'bevviz causes' counts")
    group.add_argument(
        "--parameter",
        action="append",
        default=[],
        metavar="KEY",
        help="search this one, several times for several (default: those that the misses depend on)",
    )
    group.add_argument(
        "--trials", type=positive, default=72, metavar="N", help="settings tried (default: 72)"
    )
    group.add_argument(
        "--sample",
        type=positive,
        default=60,
        metavar="N",
        help="frames to choose and to confirm on (default: 60)",
    )
    group.add_argument("-o", "--output", type=Path, metavar="FILE.yaml", help="write the changed parameters")
    add_json(group)
    fix.set_defaults(run=_fix)


def _fix(options: argparse.Namespace) -> int:
    from bevviz.config import parameter
    from bevviz.fleet.fix import draw_samples, find_fix, keys_for
    from bevviz.support.files import save_text

    config, drives, keys = _of_batch(options) if _is_batch(options) else _of_drive(options)
    for key in options.parameter:
        if parameter(key, config) is None:
            raise UserError(f"--parameter {key}: unknown; 'bevviz config' lists all")
    with progress.bar(total=2 * options.sample, desc="read", unit="frame", leave=False) as bar:
        choosing, confirming, parts = draw_samples(
            drives, config, options.sample, options.truth, options.kitti_labels, bar.update
        )
    keys = options.parameter or keys or keys_for(choosing.reasons(config), config)
    if not keys:
        say("nothing that a parameter decides is missed or false in the sample", always=True)
        return 1
    with progress.bar(total=options.trials, desc="try", unit="setting", leave=False) as bar:
        fix = find_fix(config, keys, choosing, confirming, options.trials, bar.update, parts=parts)
    print_result(options, "fix", fix.as_tree(), lambda: "\n".join(fix.lines()))
    if options.output is not None and fix.settings:
        save_text(options.output, fix.yaml(), "-o")
        say(f"{options.output}: written", always=not json_on_stdout(options))
    return 0 if fix.confirmed else 1


def _is_batch(options: argparse.Namespace) -> bool:
    """Return whether the path is the folder of a batch."""
    from bevviz.fleet.findings import FINDINGS

    is_batch = len(options.paths) == 1 and (options.paths[0] / f"{FINDINGS}.parquet").is_file()
    if options.cause and not is_batch:
        raise UserError("--cause N: PATH has to be the folder of a batch")
    return is_batch


def _of_batch(options: argparse.Namespace) -> tuple[Config, list[DriveFrames], list[str]]:
    """Return the configuration and the drives of a batch, and the parameters to search."""
    from bevviz.fleet.causes import Findings, find_causes
    from bevviz.fleet.fix import PARAMETERS, drives_of, keys_for
    from bevviz.recording.source_lookup import find_source

    folder = options.paths[0]
    findings = Findings.load(folder)
    cause = None
    if options.cause:
        causes = find_causes(findings).causes
        if options.cause > len(causes):
            raise UserError(f"--cause {options.cause}: there are {len(causes)}, see 'bevviz causes {folder}'")
        cause = causes[options.cause - 1]
        say(f"cause {options.cause}: {cause.title}", always=not json_on_stdout(options))
        if cause.kind not in ("missed", "false"):
            raise UserError(
                f"--cause {options.cause}: {cause.kind}: no ground truth tells what is right there"
            )
        if not keys_for(cause.reasons) and not options.parameter:
            known = ", ".join(PARAMETERS)
            raise UserError(f"--cause {options.cause}: no parameter decides it; one does for: {known}")
    drives = drives_of(findings, cause)
    if not drives:
        raise UserError(f"{folder}: none of its bags exists any more")
    if not any(drive.of_cause for drive in drives):
        raise UserError(f"{folder}: nothing missed, nothing false; or the batch ran without --truth")
    options.recorded = find_source(folder / f"{drives[0].name}.rrd", (), collect_settings(options))
    reasons = findings.reasons() if cause is None else cause.reasons
    config = load_config(options)
    return config, drives, keys_for(reasons, config)


def _of_drive(options: argparse.Namespace) -> tuple[Config, list[DriveFrames], list[str]]:
    """Return the configuration and the frames of a drive. Its misses tell later what to search."""
    from bevviz.bags.source import BagSource
    from bevviz.fleet.fix import DriveFrames

    config = load_config(options)
    with BagSource(options.paths, config) as source:
        numbers = range(len(source.scans))
    return config, [DriveFrames(tuple(options.paths), "drive", numbers, frozenset())], []
