"""Command ``bevviz cut``: write a part of a drive as a bag."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bevviz.cli.command import command, option
from bevviz.cli.options import TIMES, DatasetOptions
from bevviz.cli.outputs import say, warn
from bevviz.errors import UserError


@dataclass(frozen=True, kw_only=True)
class CutOptions:
    """Options of ``cut``."""

    paths: tuple[Path, ...] = option(
        "PATH", "bag, network capture or data set", positional=True, nargs="+", file="read", required=True
    )
    output: Path = option("PART.mcap", "the new bag", names=("-o", "--output"), file="written", required=True)
    start: str | None = option("TIME", "default: the start")
    end: str | None = option("TIME", "default: the end")
    topics: tuple[str, ...] = option(
        "PATTERN", "topics (* and ? match); transforms always come; default: all", nargs="+", default=()
    )
    data: DatasetOptions


@command(
    "cut",
    description="Write the messages of a window to an MCAP file, byte for byte, with what was published "
    f"once before it. Data sets and network captures become a bag. {TIMES}",
)
def _cut(options: CutOptions) -> int:
    from fnmatch import fnmatchcase

    from bevviz.bags.bag import Recording
    from bevviz.bags.source import parse_time
    from bevviz.config import SourceConfig
    from bevviz.report.bag_window import ReportWindow, check_patterns, cut_bag

    output, data = options.output, options.data
    if output.suffix != ".mcap":
        raise UserError(f"--output {output}: expected a file name that ends in .mcap")
    if output.exists():
        raise UserError(f"--output {output}: is already there; give another name")
    config = SourceConfig(dataset=data.dataset or "", sequence=data.sequence or "")
    with Recording(options.paths, config) as recording:
        start = parse_time(options.start, recording.start) if options.start else recording.start
        end = parse_time(options.end, recording.start) if options.end else recording.end + 1
        if not start < end or end <= recording.start or start > recording.end:
            seconds = (recording.end - recording.start) / 1e9
            asked = f"{options.start or 'its start'} to {options.end or 'its end'}"
            raise UserError(f"no message from {asked}: the drive has {seconds:.1f} s")
        names = [topic.name for topic in recording.topics]
        patterns = options.topics or ("*",)
        check_patterns(recording, patterns, "--topics")
        transforms = [topic.name for topic in recording.topics if topic.kind == "TFMessage"]
        chosen = [n for n in names if n in transforms or any(fnmatchcase(n, p) for p in patterns)]
        static = [name for name in transforms if name.endswith("tf_static")]
        part = ReportWindow(start, start, end, recording.start)
        content = cut_bag(recording, part, chosen, static, output, margin=0)
        warn([*recording.warnings, *content.left_out])
    say(f"{output}: {content.counts.total()} messages of {len(content.counts)} topics")
    return 0
