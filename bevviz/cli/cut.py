"""Command ``bevviz cut``: write a part of a drive as a bag."""

from __future__ import annotations

import argparse
from pathlib import Path

from bevviz.cli.options import TIMES, Commands, add_dataset
from bevviz.cli.outputs import say, warn
from bevviz.errors import UserError


def add(commands: Commands) -> None:
    """Add the command ``cut``."""
    cut = commands.add_parser(
        "cut",
        help="a window of a drive with chosen topics, as a bag",
        description="Write the messages of a window to an MCAP file, byte for byte, with what was published "
        f"once before it. Data sets and network captures become a bag. {TIMES}",
    )
    cut.add_argument("paths", nargs="+", type=Path, metavar="PATH", help="bag, network capture or data set")
    cut.add_argument("-o", "--output", type=Path, required=True, metavar="PART.mcap", help="the new bag")
    cut.add_argument("--start", metavar="TIME", help="default: the start")
    cut.add_argument("--end", metavar="TIME", help="default: the end")
    cut.add_argument(
        "--topics",
        nargs="+",
        metavar="PATTERN",
        help="topics (* and ? match); transforms always come; default: all",
    )
    add_dataset(cut)
    cut.set_defaults(run=_cut)


def _cut(options: argparse.Namespace) -> int:
    from fnmatch import fnmatchcase

    from bevviz.bags.bag import Recording
    from bevviz.bags.source import parse_time
    from bevviz.config import SourceConfig
    from bevviz.report.bag_window import ReportWindow, check_patterns, cut_bag

    output: Path = options.output
    if output.suffix != ".mcap":
        raise UserError(f"--output {output}: expected a file name that ends in .mcap")
    if output.exists():
        raise UserError(f"--output {output}: is already there; give another name")
    config = SourceConfig(dataset=options.source_dataset or "", sequence=options.source_sequence or "")
    with Recording(options.paths, config) as recording:
        start = parse_time(options.start, recording.start) if options.start else recording.start
        end = parse_time(options.end, recording.start) if options.end else recording.end + 1
        if not start < end or end <= recording.start or start > recording.end:
            seconds = (recording.end - recording.start) / 1e9
            asked = f"{options.start or 'its start'} to {options.end or 'its end'}"
            raise UserError(f"no message from {asked}: the drive has {seconds:.1f} s")
        names = [topic.name for topic in recording.topics]
        patterns = options.topics or ["*"]
        check_patterns(recording, patterns, "--topics")
        transforms = [topic.name for topic in recording.topics if topic.kind == "TFMessage"]
        chosen = [n for n in names if n in transforms or any(fnmatchcase(n, p) for p in patterns)]
        static = [name for name in transforms if name.endswith("tf_static")]
        part = ReportWindow(start, start, end, recording.start)
        content = cut_bag(recording, part, chosen, static, output, margin=0)
        warn([*recording.warnings, *content.left_out])
    say(f"{output}: {content.counts.total()} messages of {len(content.counts)} topics")
    return 0
