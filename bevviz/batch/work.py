"""What a worker does: one bag from beginning to end. The same on this machine and on a cluster."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass
from typing import TypeAlias
from uuid import uuid4

from bevviz.bags.source import BagSource
from bevviz.batch.jobs import PARTIAL, Job
from bevviz.batch.table import RunInfo, row, write
from bevviz.errors import UserError
from bevviz.logging.logger import Logger
from bevviz.logging.sinks import open_recording
from bevviz.logging.writer import WAIT
from bevviz.pipeline import Pipeline
from bevviz.prefetch import overlap


class WithdrawnError(Exception):
    """The batch does not want the result any more: it was interrupted."""

    def __init__(self) -> None:
        super().__init__("its unfinished recording was removed")


@dataclass(frozen=True, slots=True)
class JobResult:
    """How a job ended. ``error`` is empty where its results are complete."""

    name: str
    frames: int = 0
    seconds: float = 0.0
    error: str = ""


JobResults: TypeAlias = Generator[JobResult, None, None]


def run(job: Job, threads: int, on_frame: Callable[[], None] = lambda: None) -> JobResult:
    """Run the pipeline over a bag. Recording and table get their names when both are complete.

    The unfinished recording is the worker's licence to go on: whoever removes it ends the job.

    Args:
        job: what to do.
        threads: at most so many for the network, where the configuration does not say.
        on_frame: called after each frame.

    Raises:
        WithdrawnError: the unfinished recording was removed.
    """
    if info := job.complete():  # by a worker that died before it could say so
        return JobResult(job.name, info.frames, info.seconds)
    start = time.perf_counter()
    recording = job.folder / PARTIAL / f"{job.name}-{os.getpid()}-{uuid4().hex[:8]}.rrd"
    table = recording.with_suffix(".parquet")
    detector = job.config.detector
    detector = detector.model_copy(update={"threads": detector.threads or threads})
    config = job.config.model_copy(update={"detector": detector})
    selection, rows = job.selection, []
    try:
        recording.parent.mkdir(parents=True, exist_ok=True)
        with (
            BagSource(
                [job.bag],
                config,
                start=selection.start,
                end=selection.end,
                every=selection.every,
                frames=selection.frames,
            ) as source,
            Pipeline(config) as pipeline,
        ):
            with (
                open_recording(
                    source.scene,
                    config,
                    save=recording,
                    blueprint=job.blueprint,
                    recording_id=job.recording_id,
                ) as sinks,
                closing(overlap(source, pipeline.perceive, 2)) as results,
                Logger(sinks.recording, config, source.scene, wait=WAIT) as logger,
            ):
                logger.log_static()
                for result in map(pipeline.finish, results):
                    logger.log(result)
                    rows.append({**row(result, config), "bag": str(job.bag), "recording": job.name})
                    on_frame()
                    if not recording.exists():
                        raise WithdrawnError
            scene, warnings = source.scene, tuple(source.warnings)
        if not rows:
            raise UserError("; ".join([f"{job.bag.name}: no frame in it", *warnings]))
        seconds = time.perf_counter() - start
        info = RunInfo(job.key, str(job.bag), job.recording_id, len(rows), seconds, scene, warnings)
        write(table, rows, info)
        job.table.unlink(missing_ok=True)  # of an older result: it must not vouch for the new recording
        recording.replace(job.recording)
        table.replace(job.table)
    except UserError as error:
        return JobResult(job.name, len(rows), time.perf_counter() - start, str(error))
    finally:
        for path in (recording, table):
            path.unlink(missing_ok=True)
    return JobResult(job.name, len(rows), seconds)
