"""The workbench's side of a live run that is given its frames: no robot, no server."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from bevviz.config.reloading import ReloadableConfig
from bevviz.live.frames import Replay
from bevviz.live.runtime import Live, Outputs
from bevviz.live.status import Notes
from bevviz.model.results import FrameResult
from bevviz.synthetic import SyntheticSource
from bevviz.workbench.running_robot import RunningRobot


@contextmanager
def live_bench(results: Sequence[FrameResult], *settings: str) -> Iterator[RunningRobot]:
    """Yield the workbench's side of a run over the frames of these results, with ``key=value`` settings."""
    source = Replay([result.frame for result in results], SyntheticSource(frames=1).scene)
    live = Live(
        source,
        ReloadableConfig(None, ["detector.model=demo", *settings]),
        Outputs(),
        Notes(lambda line: None),
    )
    with RunningRobot(live) as bench:
        yield bench
        live.encoder.close()
