"""A run over a drive in windows, as ``bevviz.run`` has one over its frames."""

from __future__ import annotations

from collections.abc import Sequence
from threading import Event

from tqdm import tqdm

from bevviz.bags.source import BagSource
from bevviz.drive import Drive
from bevviz.engine.task import Engine
from bevviz.logging.sinks import Sinks
from bevviz.parallel.drive import AsTheyAre, InOrder, MadeWindows, Windows
from bevviz.protocols import Observer
from bevviz.results import FrameResult
from bevviz.run import RunEnd, run
from bevviz.session import Session
from bevviz.text import printable


def run_windows(
    drive: Drive,
    session: Session,
    sinks: Sinks,
    observers: Sequence[Observer[FrameResult]],
    engine: Engine,
    stop: Event | None = None,
) -> RunEnd:
    """Make every frame in one of many processes, and show the results in order to the observers.

    Args:
        drive: of a bag.
        session: remembers the drive.
        sinks: where the recording goes.
        observers: of results without what only their frame needs, see ``InOrder``.
        engine: what makes them.
        stop: ends the run after the window at hand.
    """
    source = drive.frames
    assert isinstance(source, BagSource)
    place = None if sinks.file is None else sinks.file.parent
    with (
        tqdm(total=source.total, unit="frame", desc=printable(source.scene.name), disable=None) as bar,
        Windows(source, drive.config, sinks.recording_id, engine.count, place) as windows,
    ):
        made = MadeWindows(windows, engine, lambda: _count(bar))
        in_order = InOrder(windows, session, sinks, observers)
        end = run(made, AsTheyAre(), [in_order], depth=0, stop=stop)
    return RunEnd(in_order.frames, end.interrupted)


def _count(bar: tqdm[None]) -> None:
    if bar.n < (bar.total or 0):  # a window that is run again is counted once
        bar.update()
