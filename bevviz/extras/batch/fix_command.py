"""Command ``bevviz fix``: search parameters that repair what a batch or a drive gets wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from bevviz.cli.command import Group, command, option
from bevviz.cli.options import ConfigOptions, DriveOptions, TruthOptions, collect_settings, load_config
from bevviz.cli.outputs import STDOUT, json_option, print_result, say
from bevviz.cli.values import positive
from bevviz.errors import UserError
from bevviz.support import progress

if TYPE_CHECKING:
    from bevviz.config import Config
    from bevviz.extras.batch.causes import Cause, Findings
    from bevviz.why.fix import DriveFrames


@dataclass(frozen=True, kw_only=True)
class SearchOptions:
    """Options for the search."""

    group: ClassVar = Group("search")

    cause: int | None = option("N", "of a batch, as 'bevviz causes' counts", parse=positive)
    parameter: tuple[str, ...] = option(
        "KEY",
        "search this one, several times for several (default: those that the misses depend on)",
        repeat=True,
    )
    trials: int = option("N", "settings tried (default: 72)", parse=positive, default=72)
    sample: int = option("N", "frames to choose and to confirm on (default: 60)", parse=positive, default=60)
    output: Path | None = option(
        "FILE.yaml", "write the changed parameters", names=("-o", "--output"), file="written"
    )
    json: Path | None = json_option()


@dataclass(frozen=True, kw_only=True)
class FixOptions:
    """Options of ``fix``."""

    drive: DriveOptions
    truth: TruthOptions
    config: ConfigOptions
    search: SearchOptions


@command(
    "fix",
    help="search parameters that find the missed objects, and check what they break",
    description="Search the parameters that the misses depend on, several at a time, on frames of some "
    "drives with ground truth. Confirm the best on frames of other drives, and write them as YAML.",
    epilog="PATH may also be the folder of a batch: its drives, with its configuration.",
    forms=("bevviz.why.fix:Fix",),
)
def _fix(options: FixOptions) -> int:
    from bevviz.config import parameter
    from bevviz.support.files import save_text
    from bevviz.why.fix import draw_samples, find_fix, keys_for

    search, truth = options.search, options.truth
    config, drives, keys = _of_batch(options) if _is_batch(options) else _of_drive(options)
    for key in search.parameter:
        if parameter(key, config) is None:
            raise UserError(f"--parameter {key}: unknown; 'bevviz config' lists all")
    with progress.bar(total=2 * search.sample, desc="read", unit="frame", leave=False) as bar:
        choosing, confirming, parts = draw_samples(
            drives, config, search.sample, truth.truth, truth.kitti_labels, bar.update
        )
    keys = list(search.parameter) or keys or keys_for(choosing.reasons(config), config)
    if not keys:
        say("nothing that a parameter decides is missed or false in the sample", always=True)
        return 1
    with progress.bar(total=search.trials, desc="try", unit="setting", leave=False) as bar:
        fix = find_fix(config, keys, choosing, confirming, search.trials, bar.update, parts=parts)
    print_result(search.json, "fix", fix, lambda: "\n".join(fix.lines()))
    if search.output is not None and fix.settings:
        save_text(search.output, fix.yaml(), "-o")
        say(f"{search.output}: written", always=search.json != STDOUT)
    return 0 if fix.confirmed else 1


def _is_batch(options: FixOptions) -> bool:
    """Return whether the path is the folder of a batch."""
    from bevviz.extras.batch.findings import FINDINGS

    paths = options.drive.paths
    is_batch = len(paths) == 1 and (paths[0] / f"{FINDINGS}.parquet").is_file()
    if options.search.cause and not is_batch:
        raise UserError("--cause N: PATH has to be the folder of a batch")
    return is_batch


def _of_batch(options: FixOptions) -> tuple[Config, list[DriveFrames], list[str]]:
    """Return the configuration and the drives of a batch, and the parameters to search."""
    from bevviz.extras.batch.causes import Findings, find_causes
    from bevviz.model.reasons import FACTS
    from bevviz.recording.source_lookup import find_source
    from bevviz.why.fix import keys_for

    folder, search = options.drive.paths[0], options.search
    findings = Findings.load(folder)
    cause = None
    if search.cause:
        causes = find_causes(findings).causes
        if search.cause > len(causes):
            raise UserError(f"--cause {search.cause}: there are {len(causes)}, see 'bevviz causes {folder}'")
        cause = causes[search.cause - 1]
        say(f"cause {search.cause}: {cause.title}", always=search.json != STDOUT)
        if cause.kind not in ("missed", "false"):
            raise UserError(
                f"--cause {search.cause}: {cause.kind}: no ground truth tells what is right there"
            )
        if not keys_for(cause.reasons) and not search.parameter:
            known = ", ".join(kind for kind, facts in FACTS.items() if facts.searched)
            raise UserError(f"--cause {search.cause}: no parameter decides it; one does for: {known}")
    drives = _drives_of(findings, cause)
    if not drives:
        raise UserError(f"{folder}: none of its bags exists any more")
    if not any(drive.of_cause for drive in drives):
        raise UserError(f"{folder}: nothing missed, nothing false; or the batch ran without --truth")
    recorded = find_source(folder / f"{drives[0].name}.rrd", (), collect_settings(options))
    reasons = findings.reasons() if cause is None else cause.reasons
    config = load_config(replace(options, config=replace(options.config, recorded=recorded)))
    return config, drives, keys_for(reasons, config)


def _drives_of(findings: Findings, cause: Cause | None) -> list[DriveFrames]:
    """Return the drives of a batch whose bags exist.

    Args:
        findings: of the batch.
        cause: cause to fix; None: every missed and every false object.
    """
    import numpy as np

    from bevviz.why.fix import DriveFrames

    if cause is not None:
        wanted = cause.rows
    else:
        wanted = np.flatnonzero(findings.is_word("outcome", "missed") | findings.is_word("outcome", "false"))
    names, drive = findings.words("recording")
    bags, bag = findings.words("bag")
    frame = findings.table["frame"].to_numpy()
    is_wanted = np.zeros(len(findings), bool)
    is_wanted[wanted] = True
    drives = []
    for code, name in enumerate(names):
        rows = np.flatnonzero(drive == code)
        path = Path(bags[bag[rows[0]]])
        if path.exists():
            numbers = sorted(set(frame[rows].tolist()))
            drives.append(
                DriveFrames((path,), name, numbers, frozenset(frame[rows[is_wanted[rows]]].tolist()))
            )
    return drives


def _of_drive(options: FixOptions) -> tuple[Config, list[DriveFrames], list[str]]:
    """Return the configuration and the frames of a drive. Its misses tell later what to search."""
    from bevviz.bags.source import BagSource
    from bevviz.why.fix import DriveFrames

    config = load_config(options)
    with BagSource(options.drive.paths, config) as source:
        numbers = range(len(source.scans))
    return config, [DriveFrames(options.drive.paths, "drive", numbers, frozenset())], []
