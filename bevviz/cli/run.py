"""Runs of the command line: progress bar, outputs, and an orderly end after a signal."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from bevviz.cli.interrupts import interruptible
from bevviz.cli.outputs import Outputs, print_hints, program, say, warn

if TYPE_CHECKING:
    from rerun import RecordingStream

    from bevviz.config import Config
    from bevviz.drive import Drive
    from bevviz.model.protocols import Items, Observer, Processor
    from bevviz.model.results import FrameResult
    from bevviz.pipeline.run import RunEnd

T = TypeVar("T")
R = TypeVar("R")


def run_with_progress(
    items: Items[T], processor: Processor[T, R], observers: Sequence[Observer[R]]
) -> RunEnd:
    """Run the frames with a progress bar. After a signal the run ends with the current frame."""
    from bevviz.pipeline.run import Progress, run

    with interruptible() as ended:
        return run(items, processor, [*observers, Progress()], stop=ended)


def table_status(end: RunEnd) -> int:
    """Return the exit status of a run whose result is a table. Tell the user if the run was interrupted."""
    if end.interrupted:
        say(f"interrupted after {end.frames} frames; the table is of these")
        return 130
    return 0 if end.frames else 1


def process(drive: Drive, outputs: Outputs, default: Path) -> int:
    """Run every stage on every frame and log the results to every output. Return the exit status.

    Args:
        drive: the frames.
        outputs: requested outputs.
        default: file to save if nothing can be shown.
    """
    from bevviz.anomalies import AnomalySummary, FailureSummary
    from bevviz.findings.marks import MarkRecorder
    from bevviz.recording.recorder import Recorder

    anomalies, failures = AnomalySummary(), FailureSummary()
    session = drive.new_session()
    recorders: list[Recorder] = []

    def observers(recording: RecordingStream) -> list[Observer[FrameResult]]:
        print_hints(drive.scene, drive.config)
        recorders.append(Recorder(recording, drive.config, session.stages.provider))
        return [*recorders, MarkRecorder(recording), anomalies, failures, drive.checks]

    def finish() -> None:
        warn(drive.checks.warnings_beside(drive.frames.warnings))
        warn(failures.warnings)
        warn(text for recorder in recorders for text in recorder.warnings)
        say(f"anomalies: {anomalies}")

    return run_logged(drive.frames, session, drive.config, outputs.or_file(default), observers, finish)


def run_logged(
    items: Items[T],
    processor: Processor[T, R],
    config: Config,
    outputs: Outputs,
    observers: Callable[[RecordingStream], Sequence[Observer[R]]],
    finish: Callable[[], None] = lambda: None,
) -> int:
    """Run the frames with observers that log.

    Args:
        items: frames, or other inputs of the processor.
        processor: makes a result of each item.
        config: configuration of the run.
        outputs: outputs of the recording.
        observers: makes the observers for the recording.
        finish: called after the last frame, before results are served.

    Returns:
        The exit status.
    """
    from bevviz.recording.recorder import DiskWatch

    with outputs.opened(items.scene, config) as sinks:
        all_observers = [*observers(sinks.recording), DiskWatch(sinks)]
        early_warnings = list(items.warnings)  # Print these warnings before the long run, not after it.
        warn(early_warnings)
        end = run_with_progress(items, processor, all_observers)
        warn(warning for warning in items.warnings if warning not in early_warnings)
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
