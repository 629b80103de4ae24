"""Command ``bevviz report``: make a bug report, or check one."""

from __future__ import annotations

import argparse
from pathlib import Path

from bevviz.cli.options import (
    Commands,
    add_bag,
    add_config,
    add_keep,
    add_subject,
    load_config,
    parse_real,
    selected_subject,
)
from bevviz.cli.outputs import say, warn
from bevviz.errors import UserError
from bevviz.support.files import CONFIG_LIMIT, read_text

_seconds = parse_real(lambda seconds: 0 <= seconds < 1e6, "is no time in seconds")


def add(commands: Commands) -> None:
    """Add the command ``report``."""
    report = commands.add_parser(
        "report",
        help="a bug report that stands on its own, and its check",
        description="Cut a window out of a bag, run it, and save a recording (bug.rrd), a page for any "
        "browser (bug.html) and the raw messages (bug.mcap) to send on. With --check: run a report again and "
        "compare.",
        epilog="examples:\n"
        "  bevviz report drive.mcap --at 12.5 --model yolo11n.onnx --class person --note 'no match for her'\n"
        "  bevviz report --check bug.rrd",
    )
    group = add_bag(report)
    group.add_argument("--at", metavar="TIME", help="the time that the report is about")
    group.add_argument("--before", type=_seconds, default=5.0, metavar="SECONDS", help="(default: 5)")
    group.add_argument("--after", type=_seconds, default=5.0, metavar="SECONDS", help="(default: 5)")
    add_subject(report, "The object that the report is about. Nothing: the worst of the frame.")
    add_config(report)
    content = report.add_argument_group("the report")
    content.add_argument(
        "-o", "--output", type=Path, default=Path("bug.rrd"), metavar="FILE.rrd", help="(default: bug.rrd)"
    )
    note = content.add_mutually_exclusive_group()
    note.add_argument("--note", default="", metavar="TEXT", help="what went wrong, in your words")
    note.add_argument("--note-file", type=Path, metavar="FILE", help="the same, from a text file")
    content.add_argument(
        "--topics",
        nargs="*",
        metavar="TOPIC",
        help="topics (* and ? match) in the bag beside those that the pipeline reads; default: all",
    )
    content.add_argument(
        "--redact", action="store_true", help="hide the people and vehicles that the detector finds"
    )
    content.add_argument(
        "--unredacted",
        nargs="+",
        default=[],
        metavar="TOPIC",
        help="with --redact: topics that are kept although nobody can tell what they show",
    )
    content.add_argument("--include-model", action="store_true", help="copy the detector's file beside it")
    add_keep(content)
    content.add_argument("--force", action="store_true", help="overwrite an older report")
    report.add_argument(
        "--check", action="store_true", help="PATH is a report's .rrd: run its bag again and compare"
    )
    report.set_defaults(run=_report)


def _report(options: argparse.Namespace) -> int:
    if options.check:
        return _check(options)
    from bevviz.bags.reader import megabytes
    from bevviz.pipeline.notes import Notes
    from bevviz.report.make import ReportRequest, make

    if options.at is None:
        raise UserError("--at TIME is missing: the time that the report is about")
    if options.unredacted and not options.redact:
        raise UserError("--unredacted: everything is, without --redact")
    report = make(
        ReportRequest(
            paths=options.paths,
            config=load_config(options),
            at=options.at,
            before=options.before,
            after=options.after,
            output=options.output,
            selection=selected_subject(options),
            note=options.note if options.note_file is None else _read(options.note_file),
            topics=options.topics,
            redact=options.redact,
            unredacted=options.unredacted,
            include_model=options.include_model,
            force=options.force,
            notes=list(Notes(options.paths)),
        )
    )
    warn(report.warnings)
    files = ", ".join(f"{path} ({megabytes(path.stat().st_size)})" for path in report.files)
    if report.interrupted:
        say(f"interrupted after {report.frames} frames; what was made until then is complete: {files}")
        return 130
    say(f"{report.frames} frames: {files}")
    return 0 if report.frames else 1


def _check(options: argparse.Namespace) -> int:
    from bevviz.report.check import check

    if len(options.paths) != 1:
        raise UserError("--check takes one report: bevviz report --check bug.rrd")
    verdict = check(
        options.paths[0], model=None if options.model is None else Path(options.model), settings=options.set
    )
    for line in verdict.lines():
        print(line)
    return 0 if verdict.same else 1


def _read(path: Path) -> str:
    return read_text(path, CONFIG_LIMIT, problem=f"--note-file {path}: cannot be read", pipe=True).strip()
