"""Command ``bevviz recover``: write a sound bag from a damaged one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bevviz.cli.command import command, option
from bevviz.cli.outputs import say, warn
from bevviz.errors import UserError


@dataclass(frozen=True, kw_only=True)
class RecoverOptions:
    """Options of ``recover``."""

    path: Path = option(
        "DAMAGED", "bag: .mcap, .db3, .bag or a folder", positional=True, file="read", required=True
    )
    output: Path = option("FIXED.mcap", "the copy", names=("-o", "--output"), file="written", required=True)


@command(
    "recover",
    help="a sound copy of a damaged bag",
    description="Write all messages that can be read of a damaged bag, or of one without an index, to an "
    "MCAP file, byte for byte.",
)
def _recover(options: RecoverOptions) -> int:
    from bevviz.bags.bag import Recording
    from bevviz.report.bag_window import ReportWindow, cut_bag

    path, output = options.path, options.output
    if output.suffix != ".mcap":
        raise UserError(f"--output {output}: expected a file name that ends in .mcap")
    if output.exists():
        raise UserError(f"--output {output}: is already there; give another name")
    with Recording([path]) as recording:
        if recording.is_dataset:
            raise UserError(f"{path}: is a data set, no bag")
        topics = [topic.name for topic in recording.topics]
        window = ReportWindow(recording.start, recording.start, recording.end + 1, recording.start)
        content = cut_bag(recording, window, topics, [], output)
        rescued = [file.rescued for file in recording.files if file.rescued is not None]
        if not rescued and not content.left_out:
            output.unlink()
            raise UserError(f"{path}: is not damaged: no copy is necessary")
        warn([*recording.warnings, *content.left_out])
    lost = sum(reader.report.lost for reader in rescued)
    read = f"{content.counts.total()} messages of {len(content.counts)} topics read"
    say(f"{output}: {read}, {lost} known to be lost")
    return 0
