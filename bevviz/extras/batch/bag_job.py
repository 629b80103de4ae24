"""Work on one bag, from opening it to its complete results, on this machine or on a cluster."""

from __future__ import annotations

import heapq
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

from bevviz.checks import InputChecks
from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.evaluate.evaluation import Evaluation
from bevviz.evaluate.ground_truth import truth_in
from bevviz.evaluate.log import EvaluationRecorder
from bevviz.extras.batch.findings import FINDINGS, FindingCollector
from bevviz.extras.batch.jobs import PARTIAL, Job, JobResult
from bevviz.extras.batch.table import RunInfo, write_table
from bevviz.findings.frame_findings import find_findings, has_detector
from bevviz.findings.frame_row import row
from bevviz.findings.marks import MarkRecorder
from bevviz.findings.run_table import ListKeeper, list_keeper
from bevviz.model.protocols import Observer
from bevviz.model.results import FrameResult
from bevviz.pipeline.run import run as run_frames
from bevviz.pipeline.session import Session
from bevviz.recording.recorder import DiskWatch, Recorder
from bevviz.recording.sinks import open_recording
from bevviz.report.pictures import camera_picture, crop_ahead, jpeg, shrink
from bevviz.support.files import file_hash, unfinished_files
from bevviz.support.text import path_text
from bevviz.why import RunExplainer

PICTURED = 12  # worst frames of a bag that have pictures in the table
WIDTH, ABOVE = 240, 150  # pixels, width of a camera's picture and of the bird's-eye view's


class WithdrawnError(Exception):
    """Error of a job whose batch was interrupted and does not want the result."""

    def __init__(self) -> None:
        super().__init__("its unfinished recording was removed")


def run(job: Job, threads: int, on_frame: Callable[[], None] = lambda: None) -> JobResult:
    """Run the pipeline over a bag. Recording and table get their final names when both are complete.

    Unfinished files are deleted at the end. If another process deletes the recording, the job ends.

    Args:
        job: the bag and its settings.
        threads: largest number of threads of the network, unless the configuration has one.
        on_frame: called after each frame.

    Raises:
        WithdrawnError: the unfinished recording was removed.
    """
    if info := job.complete():  # A worker that died before its report has completed it.
        return JobResult(job.name, info.frames, info.seconds)
    start, rows = time.perf_counter(), list[dict[str, Any]]()
    recording = job.folder / PARTIAL / f"{job.name}-{os.getpid()}-{uuid4().hex[:8]}.rrd"
    table = recording.with_suffix(".parquet")
    try:
        info = _fill(job, recording, rows, threads, on_frame, start)
        write_table(table, rows, info)
        job.table.unlink(missing_ok=True)  # An older table must not vouch for the new recording.
        recording.replace(job.recording)
        table.replace(job.table)
        return JobResult(job.name, info.frames, info.seconds)
    except UserError as error:
        return JobResult(job.name, len(rows), time.perf_counter() - start, str(error))
    finally:
        for path in (recording, *unfinished_files(recording), table):
            path.unlink(missing_ok=True)


def _fill(
    job: Job,
    recording: Path,
    rows: list[dict[str, Any]],
    threads: int,
    on_frame: Callable[[], None],
    start: float,
) -> RunInfo:
    """Write the recording and append a row for each frame. Return the description of the run.

    Raises:
        UserError: the bag cannot be used, or has no frame.
    """
    config = _with_threads(job.config, threads)  # used by the stages only
    evaluation: Evaluation | None = None
    with job.selection.source([job.bag], job.config) as source, Session(config) as session:
        explainer = RunExplainer(session.loader, session.stages.class_names)
        recording.parent.mkdir(parents=True, exist_ok=True)
        with open_recording(
            source.scene,
            source.config,
            save=recording,
            blueprint=job.blueprint,
            recording_id=job.recording_id,
            place=job.recording,
            keep=False,
        ) as sinks:
            observers: list[Observer[FrameResult]] = [
                Recorder(sinks.recording, job.config, session.stages.provider)
            ]
            if job.truth is not None or (source.scene.truth and has_detector(job.config)):
                evaluation = Evaluation(truth_in(source, job.truth or None), explainer.false_causes)
                observers += [evaluation, EvaluationRecorder(sinks.recording, evaluation)]
            assert sinks.file is not None
            # The workbench takes stated labels for the frames' own.
            keeper = None if job.truth else list_keeper(source, session, explainer, job.config)
            marks = MarkRecorder(sinks.recording)
            collector = _RowCollector(job, rows, sinks.file, on_frame, evaluation, explainer, marks, keeper)
            checks = InputChecks(source, job.config)
            watchers = [*observers, checks, collector, DiskWatch(sinks)]
            if run_frames(source, session, watchers).interrupted:
                raise KeyboardInterrupt
        warnings = tuple(checks.warnings)
        if not rows:
            raise UserError("; ".join([f"{job.bag.name}: no frame in it", *warnings]))
        return RunInfo(
            job.key,
            path_text(job.bag),
            job.recording_id,
            len(rows),
            time.perf_counter() - start,
            replace(source.scene, bag=(), topics=()),
            warnings,
            None if evaluation is None else dict(evaluation.result().metrics),
            recording.stat().st_size,
            file_hash(recording),
        )


def _with_threads(config: Config, threads: int) -> Config:
    """Return a configuration whose networks have this number of threads, unless it states another one."""
    detector = config.detector
    detector = detector.model_copy(update={"threads": detector.threads or threads})
    return config.model_copy(update={"detector": detector})


class _RowCollector(Observer[FrameResult]):
    """Observer that makes a row for each frame. It ends the run if the recording was removed."""

    def __init__(
        self,
        job: Job,
        rows: list[dict[str, Any]],
        recording: Path,
        on_frame: Callable[[], None],
        evaluation: Evaluation | None,
        explainer: RunExplainer,
        marks: MarkRecorder,
        keeper: ListKeeper | None,
    ) -> None:
        self._explainer, self._marks, self._keeper = explainer, marks, keeper
        self._job, self._rows, self._recording = job, rows, recording
        self._on_frame, self._evaluation = on_frame, evaluation
        self._findings = FindingCollector()
        self._worst: list[tuple[float, int, Mapping[str, bytes]]] = []  # a heap of (badness, -row, pictures)

    def observe(self, result: FrameResult) -> None:
        explainer = self._explainer.of(result)
        findings = find_findings(explainer)
        is_evaluated = self._evaluation is not None and self._evaluation.last is not None
        values = row(result, findings, evaluated=is_evaluated)
        values[FINDINGS] = self._findings.of_frame(explainer.traces, findings)
        rank = values["badness"], -len(self._rows)
        if len(self._worst) < PICTURED or rank > self._worst[0][:2]:
            heapq.heappush(self._worst, (*rank, _pictures(result)))
        if len(self._worst) > PICTURED:
            heapq.heappop(self._worst)
        self._marks.log(result, findings)
        if self._keeper is not None:
            self._keeper.add(result.frame, findings)
        self._rows.append({**values, "bag": path_text(self._job.bag), "recording": self._job.name})
        self._on_frame()
        if not self._recording.exists():
            raise WithdrawnError

    def end(self) -> None:
        if self._keeper is not None:
            self._keeper.end()
        for _, negative_row, jpegs in self._worst:
            self._rows[-negative_row] |= jpegs


def _pictures(result: FrameResult) -> Mapping[str, bytes]:
    """Return JPEGs of the first camera and of the bird's-eye view, by column of the table."""
    jpegs = {}
    cameras = (camera_picture(camera, WIDTH) for camera in result.cameras)
    if (picture := next((c for c in cameras if c is not None), None)) is not None:
        jpegs["picture"] = jpeg(picture)
    if result.bev is not None:
        jpegs["above"] = jpeg(shrink(crop_ahead(result.bev), ABOVE)[0])
    return jpegs
