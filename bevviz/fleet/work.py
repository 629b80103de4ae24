"""Work on one bag, from opening it to its complete results, on this machine or on a cluster."""

from __future__ import annotations

import heapq
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from uuid import uuid4

from bevviz.bags.source import BagSource
from bevviz.errors import UserError
from bevviz.evaluate.evaluation import Evaluation
from bevviz.evaluate.ground_truth import truth_in
from bevviz.evaluate.log import EvaluationRecorder
from bevviz.fleet.engine.task import JobResult
from bevviz.fleet.jobs import PARTIAL, Job
from bevviz.fleet.table import RunInfo, add_judgement, row, write_table
from bevviz.model.protocols import Observer
from bevviz.model.results import FrameResult
from bevviz.pipeline.run import run as run_frames
from bevviz.pipeline.session import Session
from bevviz.recording.provenance import file_hash
from bevviz.recording.recorder import DiskWatch, Recorder
from bevviz.recording.sinks import OpenRecording, open_recording
from bevviz.report.pictures import camera_picture, crop_ahead, jpeg, shrink
from bevviz.support.contexts import Closable
from bevviz.support.files import unfinished_files
from bevviz.support.text import path_text


class WithdrawnError(Exception):
    """Error of a job whose batch was interrupted and does not want the result."""

    def __init__(self) -> None:
        super().__init__("its unfinished recording was removed")


@dataclass(frozen=True, slots=True)
class BagTask:
    """Task of an engine: one bag of a batch."""

    job: Job

    @property
    def name(self) -> str:
        """Name of the job."""
        return self.job.name

    @property
    def identity(self) -> str:
        """Folder, name and key of the job."""
        return f"{self.job.folder}-{self.job.name}-{self.job.key}"

    def run(self, threads: int, on_frame: Callable[[], None]) -> JobResult:
        """Run the pipeline over the bag, see ``run``."""
        return run(self.job, threads, on_frame)


def run(job: Job, threads: int, on_frame: Callable[[], None] = lambda: None) -> JobResult:
    """Run the pipeline over a bag. Recording and table get their final names when both are complete.

    Args:
        job: the bag and its settings.
        threads: largest number of threads of the network, unless the configuration has one.
        on_frame: called after each frame.

    Raises:
        WithdrawnError: the unfinished recording was removed.
    """
    if info := job.complete():  # A worker that died before its report has completed it.
        return JobResult(job.name, info.frames, info.seconds)
    detector = job.config.detector
    detector = detector.model_copy(update={"threads": detector.threads or threads})
    config = job.config.model_copy(update={"detector": detector})  # used by the stages only
    with JobOutput(job) as output:
        try:
            with job.selection.source([job.bag], job.config) as source:
                session = Session(config)
                with output.opened(source) as sinks:
                    recorder = Recorder(sinks.recording, job.config, session.stages.provider)
                    observers = output.observers(source, sinks, recorder, on_frame)
                    if run_frames(source, session, observers).interrupted:
                        raise KeyboardInterrupt
                return output.complete(source)
        except UserError as error:
            return output.failed(error)


class JobOutput(Closable):
    """Unfinished results of a bag. They are deleted if they do not get complete.

    Deleting the unfinished recording ends the job.
    """

    def __init__(self, job: Job) -> None:
        self._job, self._start = job, time.perf_counter()
        self._recording = job.folder / PARTIAL / f"{job.name}-{os.getpid()}-{uuid4().hex[:8]}.rrd"
        self._table = self._recording.with_suffix(".parquet")
        self._rows: _RowCollector | None = None
        self._evaluation: Evaluation | None = None

    def close(self) -> None:
        """Delete the unfinished files."""
        for path in (self._recording, *unfinished_files(self._recording), self._table):
            path.unlink(missing_ok=True)

    def opened(self, source: BagSource) -> AbstractContextManager[OpenRecording]:
        """Open the recording."""
        self._recording.parent.mkdir(parents=True, exist_ok=True)
        return open_recording(
            source.scene,
            source.config,
            save=self._recording,
            blueprint=self._job.blueprint,
            recording_id=self._job.recording_id,
            place=self._job.recording,
        )

    def observers(
        self,
        source: BagSource,
        sinks: OpenRecording,
        recorder: Recorder,
        on_frame: Callable[[], None],
    ) -> list[Observer[FrameResult]]:
        """Return the observers of the run.

        Args:
            source: the bag.
            sinks: outputs of the recording.
            recorder: writes to the recording.
            on_frame: called after each frame.
        """
        observers: list[Observer[FrameResult]] = [recorder]
        if self._job.truth is not None:
            self._evaluation = Evaluation(truth_in(source, self._job.truth or None))
            observers += [self._evaluation, EvaluationRecorder(sinks.recording, self._evaluation)]
        assert sinks.file is not None
        self._rows = _RowCollector(self._job, sinks.file, on_frame, self._evaluation)
        return [*observers, self._rows, DiskWatch(sinks)]

    @property
    def frames(self) -> int:
        """Number of frames so far."""
        return 0 if self._rows is None else len(self._rows.rows)

    @property
    def seconds(self) -> float:
        """Run time so far."""
        return time.perf_counter() - self._start

    def failed(self, error: UserError) -> JobResult:
        """Return the outcome of a run that ended with an error."""
        return JobResult(self._job.name, self.frames, self.seconds, str(error))

    def complete(self, source: BagSource) -> JobResult:
        """Complete the results after the last frame, with the recording closed.

        Raises:
            UserError: there was no frame.
        """
        job, warnings = self._job, tuple(source.warnings)
        if self._rows is None or not self._rows.rows:
            raise UserError("; ".join([f"{job.bag.name}: no frame in it", *warnings]))
        info = RunInfo(
            job.key,
            path_text(job.bag),
            job.recording_id,
            self.frames,
            self.seconds,
            replace(source.scene, bag=(), topics=()),
            warnings,
            None if self._evaluation is None else self._evaluation.as_tree()["metrics"],
            self._recording.stat().st_size,
            file_hash(self._recording),
        )
        write_table(self._table, self._rows.rows, info)
        job.table.unlink(missing_ok=True)  # An older table must not vouch for the new recording.
        self._recording.replace(job.recording)
        self._table.replace(job.table)
        return JobResult(job.name, info.frames, info.seconds)


WIDTH, ABOVE = 240, 150  # pixels, width of a camera's picture and of the bird's-eye view's


def pictures(result: FrameResult) -> Mapping[str, bytes]:
    """Return JPEGs of the first camera and of the bird's-eye view, by column of the table."""
    jpegs = {}
    cameras = (camera_picture(camera, WIDTH) for camera in result.cameras)
    if (picture := next((c for c in cameras if c is not None), None)) is not None:
        jpegs["picture"] = jpeg(picture)
    if result.bev is not None:
        jpegs["above"] = jpeg(shrink(crop_ahead(result.bev), ABOVE)[0])
    return jpegs


class _WorstPictures:
    """Collector of the pictures of the worst frames so far."""

    COUNT = 12

    def __init__(self) -> None:
        self._worst: list[tuple[float, int, Mapping[str, bytes]]] = []  # a heap of (badness, -row, pictures)

    def see(self, badness: float, row: int, result: FrameResult) -> None:
        rank = (badness, -row)
        if len(self._worst) == self.COUNT and rank <= self._worst[0][:2]:
            return
        candidate = (*rank, pictures(result))
        if len(self._worst) == self.COUNT:
            heapq.heapreplace(self._worst, candidate)
        else:
            heapq.heappush(self._worst, candidate)

    def __iter__(self) -> Iterator[tuple[int, Mapping[str, bytes]]]:
        return ((-row, jpegs) for _, row, jpegs in self._worst)


class _RowCollector(Observer[FrameResult]):
    """Observer that makes a row for each frame. It ends the run if the recording was removed."""

    def __init__(
        self,
        job: Job,
        recording: Path,
        on_frame: Callable[[], None],
        evaluation: Evaluation | None,
    ) -> None:
        self.rows: list[dict[str, Any]] = []
        self._job, self._recording, self._on_frame = job, recording, on_frame
        self._evaluation = evaluation
        self._worst = _WorstPictures()

    def see(self, result: FrameResult) -> None:
        values = row(result, result.config)
        if self._evaluation is not None and self._evaluation.last is not None:
            judgement = self._evaluation.now
            values = add_judgement(values, judgement["missed"], judgement["false"])
        self._worst.see(values["badness"], len(self.rows), result)
        self.rows.append({**values, "bag": path_text(self._job.bag), "recording": self._job.name})
        self._on_frame()
        if not self._recording.exists():
            raise WithdrawnError

    def end(self) -> None:
        for row_number, jpegs in self._worst:
            self.rows[row_number] |= jpegs
