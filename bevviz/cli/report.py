"""Command ``bevviz report``: make a bug report, or check one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from bevviz.cli.command import Group, command, flag, option
from bevviz.cli.options import (
    WHAT_TO_RUN,
    ConfigOptions,
    DriveOptions,
    Keep,
    SubjectOptions,
    keep_option,
    load_config,
)
from bevviz.cli.outputs import say, warn
from bevviz.cli.values import seconds
from bevviz.errors import UserError
from bevviz.support.files import read_text
from bevviz.support.limits import CONFIG_LIMIT


@dataclass(frozen=True, kw_only=True)
class ReportWindowOptions:
    """Options that select the time of the report."""

    group: ClassVar = WHAT_TO_RUN

    at: str | None = option("TIME", "the time that the report is about")
    before: float = option("SECONDS", "(default: 5)", parse=seconds, default=5.0)
    after: float = option("SECONDS", "(default: 5)", parse=seconds, default=5.0)


@dataclass(frozen=True, kw_only=True)
class ReportSubject(SubjectOptions):
    """Options that select the object of the report."""

    group: ClassVar = Group(
        "what to explain", "The object that the report is about. Nothing: the worst of the frame."
    )


@dataclass(frozen=True, kw_only=True)
class ContentOptions:
    """Options for the content of the report."""

    group: ClassVar = Group("the report")

    output: Path = option(
        "FILE.rrd", "(default: bug.rrd)", names=("-o", "--output"), file="written", default=Path("bug.rrd")
    )
    note: str = option("TEXT", "what went wrong, in your words", one_of="note text", default="")
    note_file: Path | None = option("FILE", "the same, from a text file", one_of="note text", file="read")
    topics: tuple[str, ...] | None = option(
        "TOPIC",
        "topics (* and ? match) in the bag beside those that the pipeline reads; default: all",
        nargs="*",
    )
    redact: bool = flag("hide the people and vehicles that the detector finds")
    unredacted: tuple[str, ...] = option(
        "TOPIC",
        "with --redact: topics that are kept although nobody can tell what they show",
        nargs="+",
        default=(),
    )
    include_model: bool = flag("copy the detector's file beside it")
    keep: Keep = keep_option()
    force: bool = flag("overwrite an older report")


@dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """Options of ``report``."""

    drive: DriveOptions
    window: ReportWindowOptions
    subject: ReportSubject
    config: ConfigOptions
    content: ContentOptions
    check: bool = flag("PATH is a report's .rrd: run its bag again and compare")


@command(
    "report",
    description="Cut a window out of a bag, run it, and save a recording (bug.rrd), a page for any "
    "browser (bug.html) and the raw messages (bug.mcap) to send on. With --check: run a report again and "
    "compare.",
    epilog="examples:\n"
    "  bevviz report drive.mcap --at 12.5 --model yolo11n.onnx --class person --note 'no match for her'\n"
    "  bevviz report --check bug.rrd",
)
def _report(options: ReportOptions) -> int:
    if options.check:
        return _check(options)
    from bevviz.bags.reader import megabytes
    from bevviz.pipeline.notes import Notes
    from bevviz.report.make import ReportRequest, make

    window, content = options.window, options.content
    if window.at is None:
        raise UserError("--at TIME is missing: the time that the report is about")
    if content.unredacted and not content.redact:
        raise UserError("--unredacted: everything is, without --redact")
    report = make(
        ReportRequest(
            paths=options.drive.paths,
            config=load_config(options),
            at=window.at,
            before=window.before,
            after=window.after,
            output=content.output,
            selection=options.subject.selection(),
            note=content.note if content.note_file is None else _read(content.note_file),
            topics=content.topics,
            redact=content.redact,
            unredacted=content.unredacted,
            include_model=content.include_model,
            force=content.force,
            notes=list(Notes(options.drive.paths)),
        )
    )
    warn(report.warnings)
    files = ", ".join(f"{path} ({megabytes(path.stat().st_size)})" for path in report.files)
    if report.interrupted:
        say(f"interrupted after {report.frames} frames; what was made until then is complete: {files}")
        return 130
    say(f"{report.frames} frames: {files}")
    return 0 if report.frames else 1


def _check(options: ReportOptions) -> int:
    from bevviz.report.check import check

    drive = options.drive
    if len(drive.paths) != 1:
        raise UserError("--check takes one report: bevviz report --check bug.rrd")
    verdict = check(
        drive.paths[0], model=None if drive.model is None else Path(drive.model), settings=options.config.set
    )
    for line in verdict.lines():
        print(line)
    return 0 if verdict.same else 1


def _read(path: Path) -> str:
    return read_text(path, CONFIG_LIMIT, problem=f"--note-file {path}: cannot be read", pipe=True).strip()
