"""What a worker does: one window of a drive, as far as it needs no other. The same here and on a cluster."""

from __future__ import annotations

import os
import pickle
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast
from uuid import uuid4

import numpy as np
import rerun as rr

from bevviz.bags.source import BagSource, FrameSelection, Window
from bevviz.bags.state import Losses
from bevviz.config import Config
from bevviz.engine.task import JobResult
from bevviz.errors import UserError
from bevviz.frame import Camera, Cloud
from bevviz.logging.logger import Logger
from bevviz.logging.sinks import APPLICATION, batches
from bevviz.parallel import handed
from bevviz.perceive import describe, perceive
from bevviz.results import FrameResult, Ground, Voxels
from bevviz.stage_loader import StageLoader, Stages
from bevviz.stages.visibility import range_image

_TOLD_IN_ORDER = ("detection", "object", "fused")  # explanations that boxes are logged with
LABEL = "label"  # field that says what each point is of, see ``evaluate.ground``


@dataclass(frozen=True)
class Batched:
    """What is made of each frame for a batch, too.

    Attributes:
        name: of the drive.
        extras: what is kept of it beside its result.
        judged: it is held to the truth.
    """

    name: str
    extras: Callable[[FrameResult], Mapping[str, bytes]]
    judged: bool = False


@dataclass(frozen=True, slots=True)
class Found:
    """A frame, as a worker hands it on."""

    result: FrameResult  # without what only its frame needs
    explanations: bytes  # all of them, pickled; the result has those of detections and objects
    extras: Mapping[str, bytes]  # see ``Batched``

    def explained(self, result: FrameResult) -> FrameResult:
        """What was made of the result, with all of them."""
        return replace(result, explanations=pickle.loads(self.explanations))


@dataclass(frozen=True)
class WindowJob:
    """One window. Everything that a worker needs, also one on another machine that shares the file system."""

    window: Window
    paths: tuple[Path, ...]  # absolute
    config: Config
    selection: FrameSelection
    folder: Path  # absolute, for what is made
    recording_id: str
    batch: Batched | None = None

    @property
    def name(self) -> str:
        name = f"window {self.window.number}"
        return name if self.batch is None else f"{self.batch.name}, {name}"

    @property
    def identity(self) -> str:
        return f"{self.recording_id}-{self.folder}-{self.window.number}"

    @property
    def recording(self) -> Path:
        """What each frame has by itself."""
        return self.folder / f"{self.window.number:08}.rrd"

    @property
    def results(self) -> Path:
        """What the rest is made of, see ``results_in``. It is there last."""
        return self.recording.with_suffix(".results")

    def run(self, threads: int, on_frame: Callable[[], None] = lambda: None) -> JobResult:
        """Make both. ``threads``: at most so many for the network, where the configuration does not say."""
        start, frames = time.perf_counter(), 0
        recording = self.folder / f"{self.recording.stem}-{os.getpid()}-{uuid4().hex[:8]}.rrd"
        results = recording.with_suffix(".results")
        try:
            source, stages = _opened(self, threads)
            stream = rr.RecordingStream(
                APPLICATION,
                recording_id=self.recording_id,
                send_properties=False,
                batcher_config=batches(self.config),
            )
            stream.set_log_time_enabled(False)
            stream.save(recording)
            logger = Logger(cast("rr.RecordingStream", _Nowhere()), self.config, source.scene)
            with results.open("wb") as file:
                for frame, mine in source.window(self.window):
                    result = describe(perceive(frame, self.config, stages))
                    if mine:
                        logger.recording = stream
                    logger.log_alone(result)
                    if mine:
                        handed.put(file, self._found(result))
                        frames += 1
                        on_frame()
                handed.put(file, source.losses)
            logger.close()
            stream.disconnect()
            recording.replace(self.recording)
            results.replace(self.results)
        except UserError as error:
            return JobResult(self.name, frames, time.perf_counter() - start, str(error))
        finally:
            for path in (recording, results):
                with suppress(OSError):
                    path.unlink(missing_ok=True)
        return JobResult(self.name, frames, time.perf_counter() - start)

    def _found(self, result: FrameResult) -> Found:
        explanations = pickle.dumps(result.explanations, pickle.HIGHEST_PROTOCOL)
        if self.batch is None:
            return Found(_kept(result), explanations, {})
        return Found(_kept(result, judged=self.batch.judged), explanations, self.batch.extras(result))


def results_in(path: Path, config: Config) -> Iterator[Found | Losses]:
    """The results of a window, and what its frames lacked."""
    for found in handed.take(path):
        assert isinstance(found, Found | Losses)
        yield (
            found
            if isinstance(found, Losses)
            else replace(found, result=replace(found.result, config=config))
        )


class _Nowhere:
    """Takes what is logged of a frame that another window has."""

    def log(self, *args: object, **more: object) -> None: ...

    def send_columns(self, *args: object, **more: object) -> None: ...

    def set_time(self, *args: object, **more: object) -> None: ...

    def reset_time(self) -> None: ...


class _Opened(threading.local):
    """Kept by each thread from window to window: a bag, and the stages, which many bags have in common."""

    source: tuple[object, BagSource] | None = None
    stages: tuple[object, Stages] | None = None


_kept_open = _Opened()


def _opened(job: WindowJob, threads: int) -> tuple[BagSource, Stages]:
    config = job.config.model_dump_json()
    if _kept_open.stages is None or _kept_open.stages[0] != (config, threads):
        found = Config.model_validate_json(config)
        detector = found.detector.model_copy(update={"threads": found.detector.threads or threads})
        stages = StageLoader().load(found.model_copy(update={"detector": detector}))
        _kept_open.stages = (config, threads), stages
    if _kept_open.source is None or _kept_open.source[0] != (job.paths, config, job.selection):
        if _kept_open.source is not None:
            _kept_open.source[1].close()
        source = job.selection.source(job.paths, job.config)
        _kept_open.source = (job.paths, config, job.selection), source
    return _kept_open.source[1], _kept_open.stages[1]


# --- what the ordered pass needs ---------------------------------------------------------------


def _kept(result: FrameResult, *, judged: bool = False) -> FrameResult:
    """Tracks, anomalies and counts are made of this. Of what is only counted, the rows are left."""
    labels = {LABEL: result.frame.fields[LABEL]} if judged and LABEL in result.frame.fields else {}
    cameras = {id(camera): _without_pixels(camera) for camera in result.frame.cameras}
    frame = replace(
        result.frame,
        fields=labels,
        clouds=tuple(map(_without_points, result.frame.clouds)),
        robot_clouds=(),
        cameras=tuple(cameras.values()),
    )
    voxels, ground, ranges = result.voxels, result.ground, result.ranges
    if ranges is None:
        ranges = range_image(result.frame.points)  # half of what anomalies take, and needs no order
    # Which raw clouds are kept is known only when the anomalies are.
    clouds_too = result.config.logging.keep == "inspect"
    if clouds_too:
        frame = replace(frame, clouds=tuple(replace(cloud, fields={}) for cloud in result.frame.clouds))
    rows_too = voxels is not None and (clouds_too or bool(labels))
    inverse = voxels.inverse if voxels is not None and rows_too else np.zeros(0, np.int32)
    return replace(
        result,
        frame=frame,
        config=cast("Config", None),  # the reader has it
        voxels=None if voxels is None else Voxels(_rows(len(voxels.points)), inverse),
        ground=None if ground is None else Ground(ground.mask, np.zeros(0, np.float32)),
        cameras=tuple(
            replace(camera, camera=cameras[id(camera.camera)], uv=None, depth=None)
            for camera in result.cameras
        ),
        bev=None,
        explanations=tuple(e for e in result.explanations if e.subject in _TOLD_IN_ORDER),
        ranges=ranges,
    )


def _without_points(cloud: Cloud) -> Cloud:
    return replace(cloud, xyz=_rows(len(cloud.xyz)), fields={})


def _without_pixels(camera: Camera) -> Camera:
    image = camera.image
    if image is None:
        return camera
    return replace(camera, image=replace(image, bgr=image.bgr[..., :0].copy(), encoded=None, clip=None))


def _rows(count: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """So many of nothing."""
    return np.zeros((count, 0), np.float32)
