"""Command ``bevviz causes``: what the missed and false objects of a batch have in common."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bevviz.cli.command import command, option
from bevviz.cli.outputs import json_option, print_result
from bevviz.cli.values import positive


@dataclass(frozen=True, kw_only=True)
class CausesOptions:
    """Options of ``causes``."""

    folder: Path = option("DIR", "folder of a batch", positional=True, required=True)
    against: Path | None = option("DIR", "an earlier batch: what is new, what is gone")
    top: int = option("N", "causes shown (default: 10)", parse=positive, default=10)
    json: Path | None = json_option()


@command(
    "causes",
    help="what the missed and false objects of a batch have in common",
    description="Group the missed objects, false objects and anomalies of a batch by what they have in "
    "common: class, range, direction, size, brightness, speed, drive and so on.",
    forms=("bevviz.extras.batch.causes:CausesResult",),
)
def _causes(options: CausesOptions) -> int:
    from bevviz.extras.batch.causes import Findings, compare_causes, comparison_lines, find_causes

    new = find_causes(Findings.load(options.folder))
    if options.against is None:
        print_result(
            options.json, "causes", new.result(options.top), lambda: "\n".join(new.lines(options.top))
        )
        return 0
    compared = compare_causes(new, find_causes(Findings.load(options.against)))
    result = new.result(options.top, compared)
    print_result(options.json, "causes", result, lambda: "\n".join(comparison_lines(compared)))
    return 0
