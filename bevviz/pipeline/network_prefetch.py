"""Runs whose networks are run ahead, on several frames at once. The run goes on in order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Generic, Protocol, TypeVar

from bevviz.config import Config, object_network_params
from bevviz.config.plugins import TOPIC, is_user_function
from bevviz.model.frame import Frame
from bevviz.model.protocols import Processor
from bevviz.pipeline.dask_frames import ClusterFrames
from bevviz.pipeline.frame_workers import FrameParts, FrameWorkers
from bevviz.pipeline.result_store import open_store
from bevviz.support import progress

R = TypeVar("R")


@contextmanager
def working_ahead(
    processor: Processor[Frame, R], source: FrameParts, configs: Sequence[Config], jobs: int | str
) -> Iterator[Processor[Frame, R]]:
    """Return a context with a processor that has worker processes beside it.

    Args:
        processor: the processor of the run.
        source: source of the run.
        configs: configurations that the processor runs.
        jobs: number of worker processes, 1: none; or the address of a Dask cluster's scheduler.

    Raises:
        UserError: no scheduler answers at the address.
    """
    configs = [config for config in configs if has_networks(config)]
    if jobs == 1:
        yield processor
    elif not configs or (store := open_store(configs[0].store.size)) is None or not store.usable:
        option = "--dask" if isinstance(jobs, str) else "--jobs"
        progress.say(f"{option}: one process runs, since there is no network, or no store for its results")
        yield processor
    else:
        with (
            ClusterFrames(source, configs, store, jobs)
            if isinstance(jobs, str)
            else FrameWorkers(source, configs, jobs)
        ) as workers:
            yield _AfterWorkers(processor, workers)


def has_networks(config: Config) -> bool:
    """Return whether a configuration has networks whose results the store keeps."""
    model = config.detector.model
    is_file = bool(model) and not model.startswith(TOPIC) and not is_user_function(model)
    return is_file or object_network_params(config) is not None


class _Workers(Protocol):
    """Workers that are ahead of a run."""

    def wait_for(self, number: int) -> None:
        """Wait until a frame is done, or nobody is going to do it."""
        ...


class _AfterWorkers(Generic[R]):
    """Processor that takes a frame when the workers have finished it."""

    def __init__(self, processor: Processor[Frame, R], workers: _Workers) -> None:
        self._processor, self._workers = processor, workers

    def perceive(self, frame: Frame, network: Executor | None = None) -> R:
        self._workers.wait_for(frame.index)
        return self._processor.perceive(frame, network)

    def finish(self, result: R) -> R:
        return self._processor.finish(result)
