"""The workbench's side of a live run that is given its frames: no robot, no server."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from bevviz.bags.message import RawMessage
from bevviz.config.reloading import ReloadableConfig
from bevviz.live.publish import Receiver
from bevviz.live.raw_recorder import RawMessage as RecordedMessage
from bevviz.live.raw_recorder import RawRecorder
from bevviz.live.run_outputs import Outputs
from bevviz.live.runtime import Live
from bevviz.live.status import Notes
from bevviz.model.results import FrameResult
from bevviz.workbench.running_robot import RunningRobot
from tests.support import kept_drives
from tests.support.replay import Replay


class CalledReceiver(Receiver):
    """Receiver that passes each result to a function."""

    def __init__(self, call: Callable[[FrameResult], object]) -> None:
        self._call = call

    def observe(self, result: FrameResult) -> None:
        self._call(result)


def run_beside(live: Live, during: Callable[[], object]) -> None:
    """Run ``live`` until ``during`` ends, which runs in a thread beside it."""
    failed: list[BaseException] = []

    def work() -> None:
        try:
            during()
        except BaseException as error:
            failed.append(error)
        live.stop()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        live.run()
    finally:
        thread.join()
    if failed:
        raise failed[0]


@contextmanager
def live_bench(
    results: Sequence[FrameResult], *settings: str, messages: Sequence[RawMessage] = ()
) -> Iterator[RunningRobot]:
    """Yield the workbench's side of a run over the frames of these results, with ``key=value`` settings.

    ``messages`` are those that the frames were made of.
    """
    values = ReloadableConfig(None, ["detector.model=demo", *settings])
    raw = RawRecorder(values) if messages else None
    for message in messages:
        assert raw is not None
        raw.put(RecordedMessage(message.connection, message.received, message.received, bytes(message.data)))
    source = Replay([result.frame for result in results], kept_drives.scene())
    source.raw = raw
    live = Live(source, values, Outputs(), Notes(lambda line: None))
    with RunningRobot(live) as bench:
        yield bench
        live.encoder.close()
