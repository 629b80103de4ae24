"""Command ``bevviz causes``: what the missed and false objects of a batch have in common."""

from __future__ import annotations

import argparse
from pathlib import Path

from bevviz.cli.options import Commands, positive
from bevviz.cli.outputs import add_json, print_result


def add(commands: Commands) -> None:
    """Add the command ``causes``."""
    causes = commands.add_parser(
        "causes",
        help="what the missed and false objects of a batch have in common",
        description="Group the missed objects, false objects and anomalies of a batch by what they have in "
        "common: class, range, direction, size, brightness, speed, drive and so on.",
    )
    causes.add_argument("folder", type=Path, metavar="DIR", help="folder of a batch")
    causes.add_argument(
        "--against", type=Path, metavar="DIR", help="an earlier batch: what is new, what is gone"
    )
    causes.add_argument("--top", type=positive, default=10, metavar="N", help="causes shown (default: 10)")
    add_json(causes)
    causes.set_defaults(run=_causes)


def _causes(options: argparse.Namespace) -> int:
    from bevviz.fleet.causes import Findings, compare_causes, comparison_lines, find_causes

    new = find_causes(Findings.load(options.folder))
    tree = new.as_tree(options.top)
    if options.against is None:
        print_result(options, "causes", tree, lambda: "\n".join(new.lines(options.top)))
        return 0
    compared = compare_causes(new, find_causes(Findings.load(options.against)))
    tree["compared"] = [
        {
            "state": c.state,
            "kind": c.cause.kind,
            "reason": c.cause.reason,
            "text": c.cause.text,
            "count": c.cause.count,
            "among": c.cause.among,
            "other": c.other,
            "other_among": c.other_among,
        }
        for c in compared
    ]
    print_result(options, "causes", tree, lambda: "\n".join(comparison_lines(compared)))
    return 0
