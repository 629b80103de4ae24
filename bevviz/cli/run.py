"""A run of the command line: with a progress bar, into the outputs that are asked for, until a signal."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from bevviz.cli.interrupts import terminable
from bevviz.cli.outputs import Outputs, hint, program, say, warn

if TYPE_CHECKING:
    from rerun import RecordingStream

    from bevviz.config import Config
    from bevviz.drive import Drive
    from bevviz.engine.task import Engine
    from bevviz.logging.sinks import Sinks
    from bevviz.protocols import Items, Observer, Processor
    from bevviz.results import FrameResult
    from bevviz.run import RunEnd
    from bevviz.session import Session

T = TypeVar("T")
R = TypeVar("R")


def through(items: Items[T], processor: Processor[T, R], observers: Sequence[Observer[R]]) -> RunEnd:
    """The run, with a progress bar; a signal ends it after the frame at hand."""
    from bevviz.progress import Progress
    from bevviz.run import run

    with terminable() as ended:
        return run(items, processor, [*observers, Progress()], stop=ended)


def process(drive: Drive, outputs: Outputs, default: Path, engine: Engine | None = None) -> int:
    """Every stage on every frame, logged to every output that is asked for.

    Args:
        drive: the frames.
        outputs: where to.
        default: file where there is no display.
        engine: what the drive is cut for.
    """
    from bevviz.anomalies import AnomalySummary, FailureSummary
    from bevviz.logging.recorder import OrderedRecorder, Recorder

    anomalies, failures = AnomalySummary(), FailureSummary()
    session = drive.new_session()
    windows = engine is not None and _can_be_cut(drive, session)
    if engine is not None and not windows:
        engine.close()

    recorders: list[Recorder] = []

    def observers(recording: RecordingStream) -> list[Observer[FrameResult]]:
        hint(drive.scene, drive.config)
        kind = OrderedRecorder if windows else Recorder
        recorders.append(kind(recording, drive.config, session.stages.provider))
        return [*recorders, anomalies, failures]

    def finish() -> None:
        warn(failures.warnings)
        warn(text for recorder in recorders for text in recorder.warnings)
        say(f"anomalies: {anomalies}")

    def in_windows(sinks: Sinks, seen: Sequence[Observer[FrameResult]]) -> RunEnd:
        from bevviz.parallel.run import run_windows

        assert engine is not None
        with terminable() as ended:
            return run_windows(drive, session, sinks, seen, engine, ended)

    return logged(
        drive.frames,
        session,
        drive.config,
        outputs.or_file(default),
        observers,
        finish,
        in_windows if windows else None,
    )


def _can_be_cut(drive: Drive, session: Session) -> bool:
    """Whether a drive can be made in windows; where it cannot, it is said why."""
    from bevviz.parallel.drive import obstacle

    reason = obstacle(drive.frames, session.stages)
    if reason:
        say(f"in one process: {reason}")
    return not reason


def logged(
    items: Items[T],
    processor: Processor[T, R],
    config: Config,
    outputs: Outputs,
    observers: Callable[[RecordingStream], Sequence[Observer[R]]],
    finish: Callable[[], None] = lambda: None,
    otherwise: Callable[[Sinks, Sequence[Observer[R]]], RunEnd] | None = None,
) -> int:
    """A run whose observers log.

    Args:
        items: frames, or what there is of each.
        processor: what makes a result of each.
        config: how they are made.
        outputs: where what is logged goes.
        observers: of the recording.
        finish: called after the last one, before what was made is served.
        otherwise: shows the results to observers in another way than ``through`` does, in parts.

    Returns:
        The exit status.
    """
    from bevviz.logging.recorder import DiskWatch

    with outputs.opened(items.scene, config, in_parts=otherwise is not None) as sinks:
        seen = [*observers(sinks.recording), DiskWatch(sinks)]
        early = list(items.warnings)  # known before an hour's work, and said before it
        warn(early)
        end = through(items, processor, seen) if otherwise is None else otherwise(sinks, seen)
        warn(warning for warning in items.warnings if warning not in early)
        finish()
        if end.frames and not end.interrupted:
            outputs.keep_serving(sinks, f"{end.frames} frames; ")
    target = f" in {outputs.save}" if outputs.save is not None else ""
    if end.interrupted:
        say(f"interrupted after {end.frames} frames; what was made until then is complete{target}")
        return 130
    say(f"{end.frames} frames{target}")
    if outputs.unseen:
        say(f"to look at it in a browser: {program()} {shlex.quote(str(outputs.save))}", always=True)
    return 0 if end.frames else 1
