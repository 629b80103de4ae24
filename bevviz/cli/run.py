"""What the commands share while they run."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from bevviz.config import Config
    from bevviz.sources import Source


def process(source: Source, config: Config, options: argparse.Namespace, default: Path) -> int:
    """Run the pipeline over the source into every output that was asked for."""
    from tqdm import tqdm

    from bevviz.logging.logger import Logger
    from bevviz.logging.sinks import open_recording
    from bevviz.pipeline import Pipeline
    from bevviz.sources.prefetch import prefetch

    save, viewer = options.save, options.viewer
    unsaid = save is None and options.serve is None and options.connect is None and not viewer
    if unsaid and has_display():
        viewer = True
    elif unsaid:
        save = default

    frames = 0
    interrupted = False
    with (
        Pipeline(config) as pipeline,
        open_recording(
            source.scene,
            config,
            save=save,
            serve=options.serve,
            connect=options.connect,
            spawn=viewer,
            blueprint=options.blueprint,
        ) as sinks,
    ):
        if unsaid and not viewer:
            say(f"no display: saving {save} (--serve shows it in a browser)")
        for url in sinks.urls:
            say(f"viewer at {url}")
        if source.scene.cameras and not config.detector.model:
            say("no detector: give --model FILE.onnx to find objects in the images")
        logger = Logger(sinks.recording, config, source.scene)
        logger.log_static()
        try:
            with (
                terminable() as ended,
                tqdm(total=source.total, unit="frame", desc=source.scene.name, disable=None) as bar,
                closing(prefetch(source, 2)) as ahead,
                closing(prefetch(map(pipeline.run, ahead), 2)) as results,
            ):
                for result in results:
                    logger.log(result)
                    frames += 1
                    bar.update()
                    if ended.is_set():
                        raise KeyboardInterrupt
        except KeyboardInterrupt:
            interrupted = True
        for warning in source.warnings:
            say(f"warning: {warning}")
        if options.serve is not None and frames and not interrupted:
            say(f"{frames} frames; serving until Ctrl-C")
            sinks.recording.flush()
            wait_for_interrupt()
    target = f" in {save}" if save is not None else ""
    if interrupted:
        say(f"interrupted after {frames} frames; what was made until then is complete{target}")
        return 130
    say(f"{frames} frames{target}")
    return 0 if frames else 1


def say(line: str) -> None:
    print(f"bevviz: {line}", file=sys.stderr)


def has_display() -> bool:
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@contextmanager
def terminable() -> Iterator[Event]:
    """SIGTERM ends a run as Ctrl-C does: with a readable recording.

    Both raise KeyboardInterrupt and set the event: an exception that comes while a library calls back
    into Python can get lost there.
    """
    ended = Event()

    def interrupt(number: int, stack: object) -> NoReturn:
        ended.set()
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield ended
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def wait_for_interrupt() -> None:
    with suppress(KeyboardInterrupt), terminable():
        signal.pause()
