"""What the commands share while they run."""

from __future__ import annotations

import argparse
import gc
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from bevviz.cli.interrupts import terminable, wait_for_interrupt
from bevviz.text import printable

if TYPE_CHECKING:
    from rerun import RecordingStream
    from rerun.blueprint import Blueprint

    from bevviz.config import Config
    from bevviz.frame import FrameResult, Scene, Source
    from bevviz.logging.sinks import Sinks

T = TypeVar("T")
R = TypeVar("R")
T_co = TypeVar("T_co", covariant=True)


class Items(Protocol[T_co]):
    """What ``run`` works through: a ``Source``, or something like it that is not of frames."""

    @property
    def scene(self) -> Scene: ...

    @property
    def total(self) -> int | None: ...

    @property
    def warnings(self) -> Sequence[str]: ...

    def __iter__(self) -> Iterator[T_co]: ...


def process(source: Source, config: Config, options: argparse.Namespace, default: Path) -> int:
    """Run the pipeline over the source into every output that was asked for."""
    from bevviz.anomalies import Summary
    from bevviz.logging.logger import Logger
    from bevviz.logging.writer import WAIT
    from bevviz.pipeline import Pipeline

    anomalies = Summary()
    with Pipeline(config) as pipeline:

        @contextmanager
        def begin(recording: RecordingStream) -> Iterator[Callable[[FrameResult], None]]:
            hint(source.scene, config)
            with Logger(recording, config, source.scene, wait=WAIT) as logger:
                logger.log_static()

                def handle(result: FrameResult) -> None:
                    result = pipeline.finish(result)
                    logger.log(result)
                    anomalies.add(result)

                yield handle

        def finish() -> None:
            say(f"anomalies: {anomalies}")

        return run(source, config, options, default, pipeline.perceive, begin, finish)


def run(
    items: Items[T],
    config: Config,
    options: argparse.Namespace,
    default: Path,
    work: Callable[[T], R],
    begin: Callable[[RecordingStream], AbstractContextManager[Callable[[R], None]]],
    finish: Callable[[], None] = lambda: None,
) -> int:
    """Log what is made of each item into every output that was asked for.

    Args:
        items: frames, or what there is of each.
        config: how they are made.
        options: of ``add_output``.
        default: file that is saved where nothing is asked for and nothing can be shown.
        work: what is to be made of an item.
        begin: called with the recording; its context is what logs that.
        finish: called after the last one, before what was made is served.

    Returns:
        The exit status.
    """
    save, viewer = options.save, options.viewer
    unsaid = save is None and options.serve is None and options.connect is None and not viewer
    if unsaid and has_display():
        viewer = True
    elif unsaid:
        save = default

    with outputs(items.scene, config, options, save=save, spawn=viewer) as sinks:
        if unsaid and not viewer:
            say(f"no display: saving {save} (--serve shows it in a browser)")
        with begin(sinks.recording) as handle:
            frames, interrupted = through(items, work, handle)
        for warning in items.warnings:
            say(f"warning: {warning}")
        finish()
        if options.serve is not None and frames and not interrupted:
            serve(sinks.recording, f"{frames} frames; ")
    target = f" in {save}" if save is not None else ""
    if interrupted:
        say(f"interrupted after {frames} frames; what was made until then is complete{target}")
        return 130
    say(f"{frames} frames{target}")
    return 0 if frames else 1


@contextmanager
def outputs(
    scene: Scene,
    config: Config,
    options: argparse.Namespace,
    blueprint: Blueprint | None = None,
    **instead: Any,
) -> Iterator[Sinks]:
    """What the options of ``add_output`` ask for, or ``instead``, opened; addresses are said."""
    from bevviz.logging.sinks import open_recording

    asked = {
        "save": options.save,
        "serve": options.serve,
        "connect": options.connect,
        "spawn": options.viewer,
        "blueprint": blueprint or options.blueprint,
    }
    with open_recording(scene, config, **asked | instead) as sinks:
        for url in sinks.urls:
            say(f"viewer at {url}")
        yield sinks


def serve(recording: RecordingStream, what: str = "") -> None:
    """Until the user ends it."""
    say(f"{what}serving until Ctrl-C")
    recording.flush()
    wait_for_interrupt()


def through(items: Items[T], work: Callable[[T], R], handle: Callable[[R], None]) -> tuple[int, bool]:
    """Items are worked on in a thread, while the next are made and the last handled, with a progress bar.

    Returns:
        How many there were, and whether that was interrupted.
    """
    from tqdm import tqdm

    from bevviz.prefetch import overlap

    done = 0
    gc.freeze()  # what was imported stays: it need not be looked through again and again
    try:
        with (
            terminable() as ended,
            tqdm(total=items.total, unit="frame", desc=printable(items.scene.name), disable=None) as bar,
            closing(overlap(items, work, 2)) as results,
        ):
            for result in results:
                handle(result)
                done += 1
                bar.update()
                if ended.is_set():
                    raise KeyboardInterrupt
    except KeyboardInterrupt:
        return done, True
    return done, False


def hint(scene: Scene, config: Config) -> None:
    """Say what would give the user more."""
    if scene.cameras and not config.detector.model:
        say("no detector: give --model FILE.onnx to find objects in the images")


def say(line: str) -> None:
    print(f"bevviz: {printable(line)}", file=sys.stderr)


def has_display() -> bool:
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
