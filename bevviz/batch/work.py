"""What a worker does: one bag from beginning to end. The same on this machine and on a cluster."""

from __future__ import annotations

import heapq
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

from bevviz.batch.jobs import PARTIAL, Job
from bevviz.batch.table import RunInfo, judged, row, write
from bevviz.batch.task import JobResult
from bevviz.errors import UserError
from bevviz.evaluate.evaluation import Evaluation
from bevviz.evaluate.log import EvaluationRecorder
from bevviz.evaluate.truth import truth_in
from bevviz.files import unfinished
from bevviz.frame import FrameResult
from bevviz.logging.recorder import DiskWatch, Recorder
from bevviz.logging.sinks import open_recording
from bevviz.report.pictures import ahead, camera_picture, jpeg, shrink
from bevviz.run import Observer
from bevviz.run import run as run_frames
from bevviz.session import Session
from bevviz.text import path_text


class WithdrawnError(Exception):
    """The batch does not want the result any more: it was interrupted."""

    def __init__(self) -> None:
        super().__init__("its unfinished recording was removed")


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
    selection, rows = job.selection, list[dict[str, Any]]()
    try:
        recording.parent.mkdir(parents=True, exist_ok=True)
        with selection.source([job.bag], config) as source:
            session = Session(config)
            with open_recording(
                source.scene,
                config,
                save=recording,
                blueprint=job.blueprint,
                recording_id=job.recording_id,
                place=job.recording,
            ) as sinks:
                assert sinks.file is not None
                evaluation = None
                observers: list[Observer[FrameResult]] = [
                    Recorder(sinks.recording, config, session.stages.provider)
                ]
                if job.truth is not None:
                    evaluation = Evaluation(truth_in(source, job.truth or None))
                    observers += [evaluation, EvaluationRecorder(sinks.recording, evaluation)]
                table_rows = _Rows(job, sinks.file, on_frame, evaluation)
                observers += [table_rows, DiskWatch(sinks)]
                if run_frames(source, session, observers).interrupted:
                    raise KeyboardInterrupt
            rows = table_rows.rows
            scene, warnings = replace(source.scene, bag=(), topics=()), tuple(source.warnings)
        if not rows:
            raise UserError("; ".join([f"{job.bag.name}: no frame in it", *warnings]))
        seconds = time.perf_counter() - start
        info = RunInfo(
            job.key,
            path_text(job.bag),
            job.recording_id,
            len(rows),
            seconds,
            scene,
            warnings,
            None if evaluation is None else evaluation.as_tree()["metrics"],
        )
        write(table, rows, info)
        job.table.unlink(missing_ok=True)  # of an older result: it must not vouch for the new recording
        recording.replace(job.recording)
        table.replace(job.table)
    except UserError as error:
        return JobResult(job.name, len(rows), time.perf_counter() - start, str(error))
    finally:
        for path in (recording, unfinished(recording), table):
            path.unlink(missing_ok=True)
    return JobResult(job.name, len(rows), seconds)


class _Pictures:
    """Of the worst frames so far, two each."""

    COUNT, WIDTH, ABOVE = 12, 240, 150  # frames, pixels of a camera's picture, of the bird's-eye view's

    def __init__(self) -> None:
        self._worst: list[tuple[float, int, dict[str, bytes]]] = []  # a heap: badness, row, pictures

    def see(self, badness: float, row: int, result: FrameResult) -> None:
        place = (badness, -row)
        if len(self._worst) == self.COUNT and place <= self._worst[0][:2]:
            return
        entry = (*place, self._of(result))
        if len(self._worst) == self.COUNT:
            heapq.heapreplace(self._worst, entry)
        else:
            heapq.heappush(self._worst, entry)

    def __iter__(self) -> Iterator[tuple[int, dict[str, bytes]]]:
        return ((-row, pictures) for _, row, pictures in self._worst)

    def _of(self, result: FrameResult) -> dict[str, bytes]:
        found = {}
        cameras = (camera_picture(camera, self.WIDTH) for camera in result.cameras)
        if (picture := next((c for c in cameras if c is not None), None)) is not None:
            found["picture"] = jpeg(picture)
        if result.bev is not None:
            found["above"] = jpeg(shrink(ahead(result.bev), self.ABOVE)[0])
        return found


class _Rows(Observer[FrameResult]):
    """A row of the table for each frame; ends the run where its recording was removed."""

    def __init__(
        self, job: Job, recording: Path, on_frame: Callable[[], None], evaluation: Evaluation | None
    ) -> None:
        self.rows: list[dict[str, Any]] = []
        self._job, self._recording, self._on_frame = job, recording, on_frame
        self._evaluation = evaluation
        self._pictures = _Pictures()

    def see(self, result: FrameResult) -> None:
        found = row(result, result.config)
        if self._evaluation is not None and self._evaluation.last is not None:
            wrong = self._evaluation.now
            found = judged(found, wrong["missed"], wrong["false"])
        self._pictures.see(found["badness"], len(self.rows), result)
        self.rows.append({**found, "bag": path_text(self._job.bag), "recording": self._job.name})
        self._on_frame()
        if not self._recording.exists():
            raise WithdrawnError

    def end(self) -> None:
        for place, pictures in self._pictures:
            self.rows[place] |= pictures
