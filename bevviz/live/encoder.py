"""Encoder that turns each frame into bytes once. Files, viewers and the flight recorder share the bytes.

A prelude followed by the bytes of consecutive frames is a complete recording.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb

from bevviz.compare.log import DifferenceLogger
from bevviz.compare.robot_comparison import RobotComparison
from bevviz.config import Config
from bevviz.evaluate.differences import FrameDifferences
from bevviz.model.frame import I64, LateBoxes, Scene
from bevviz.model.results import FrameResult
from bevviz.recording import blueprints
from bevviz.recording.addresses import RowCache
from bevviz.recording.components import Component, Components
from bevviz.recording.frame_logger import FrameLogger, RecordingContext
from bevviz.recording.stream import RecordingStream
from bevviz.support.contexts import Closable

WHOLE = 1.0  # seconds from one whole packet to the next
BATCH = 100_000  # bytes from which on Rerun's threads compress what is logged, while the rest is being logged


@dataclass(frozen=True, slots=True)
class Packet:
    """One encoded frame.

    A ``whole`` packet needs none before it: a recording may begin with it, after the prelude of its context.
    """

    data: bytes
    whole: bool
    context: RecordingContext
    time: float  # seconds, monotonic
    thinned: bytes | None = None  # the same frame with fewer points, for viewers; None: viewers get ``data``

    @property
    def shown(self) -> bytes:
        """Bytes for viewers."""
        return self.data if self.thinned is None else self.thinned


class _Stream(Closable):
    """Recording in a memory file whose bytes are read back as they are written."""

    def __init__(
        self, application: str, recording_id: str | None = None, blueprint: rrb.Blueprint | None = None
    ) -> None:
        self._file = os.memfd_create("recording")
        self._end = 0
        batches = rr.ChunkBatcherConfig(flush_num_bytes=BATCH)
        self.recording = RecordingStream(application, recording_id=recording_id, batcher_config=batches)
        self.recording.set_log_time_enabled(False)
        # A footer would keep a list of every logged chunk in memory.
        sink = rr.FileSink(f"/proc/self/fd/{self._file}", write_footer=False)
        self.recording.set_sinks(sink, default_blueprint=blueprint)

    def close(self) -> None:
        """Close the recording and its memory file."""
        self.recording.disconnect()
        os.close(self._file)

    def read(self) -> bytes:
        """Return the bytes logged since the last call and free their memory. The file only looks long."""
        self.recording.flush()
        start, end = self._end, os.fstat(self._file).st_size
        if end <= start:  # the file was truncated last time and nothing was logged since
            return b""
        self._end = end
        data = os.pread(self._file, end - start, start)
        os.ftruncate(self._file, 0)
        return data


class _FrameLogger(FrameLogger):
    """Logger that sets large clouds aside. The encoder writes each once in full and once thinned."""

    def __init__(self, recording: rr.RecordingStream, config: Config, scene: Scene, network: str) -> None:
        super().__init__(recording, config, scene, network=network)
        self.limit: int | None = None  # points
        self.clouds: list[tuple[str, rr.AsComponents]] = []  # path and cloud, set aside

    def write(self, path: str, *archetypes: rr.AsComponents) -> None:
        """Log archetypes, or set them aside if they are larger than ``limit``."""
        if self.limit is not None:
            clouds = [archetype for archetype in archetypes if is_cloud(archetype, self.limit)]
            self.clouds += [(path, archetype) for archetype in clouds]
            archetypes = tuple(archetype for archetype in archetypes if not is_cloud(archetype, self.limit))
        if archetypes:
            super().write(path, *archetypes)


class Encoder:
    """Converter of results to packets. Any thread may use it.

    Args:
        config: configuration of the results.
        scene: names of the sensors.
        blueprint: name of a layout, or a .py or .rbl file.
        whole: most seconds from one whole packet to the next.
        against: comparison with the robot. None: nothing is compared.
        clock: returns seconds, for tests.
        network: execution provider of the detector's network, stored in recordings.

    Attributes:
        rows: rows behind the entities of the newest frames, by number of the frame.

    Raises:
        UserError: there is no such blueprint.
    """

    def __init__(
        self,
        config: Config,
        scene: Scene,
        blueprint: str,
        whole: float = WHOLE,
        against: RobotComparison | None = None,
        clock: Callable[[], float] = time.monotonic,
        network: str = "",
    ) -> None:
        self._against, self.clock, self._network = against, clock, network
        self._differences: DifferenceLogger | None = None
        self._blueprint = blueprint
        self._step = whole
        blueprints.load(blueprint, scene)  # reports a wrong blueprint at the start
        self._config, self._scene = config, scene
        self.application = blueprints.application_id(blueprint, scene, config)
        self._stream = _Stream(self.application)
        self.recording_id: str = self._stream.recording.get_recording_id() or ""
        # Each style is encoded once. Each whole packet repeats the bytes of all styles so far.
        self._style_stream = _Stream(self.application, self.recording_id)
        self._style_stream.read()
        self._styles = b""
        self._logger = _FrameLogger(self._stream.recording, config, scene, network=network)
        self._logger.styles = self._style_stream.recording
        self.rows = RowCache()
        self._whole = float("-inf")
        self._lock = threading.Lock()
        self.header = self._stream.read()  # packets after it can be read, without static data

    def close(self) -> None:
        """Close the recording streams."""
        self._stream.close()
        self._style_stream.close()

    @property
    def context(self) -> RecordingContext:
        """Static context that the prelude of the next packet needs."""
        return self._logger.context

    def encode(
        self,
        result: FrameResult,
        scene: Scene,
        health: Mapping[str, float],
        notes: Sequence[tuple[str, str]],
        late: Sequence[LateBoxes] = (),
        states: Mapping[str, str] = MappingProxyType({}),
        compared: Sequence[FrameDifferences] = (),
    ) -> Packet:
        """Encode one frame, with changes of the configuration or scene since the last. See ``FrameLogger``.

        ``compared``: differences from the robot's results, for this frame and earlier ones.
        """
        with self._lock:
            self._follow(result.config, scene)
            now = self.clock()
            whole = now - self._whole >= self._step
            if whole:
                self._whole = now
                self._logger.refresh()
            self._logger.limit = result.config.live.viewer_points
            self._logger.log(result, health, notes, late, states)
            self._logger.limit = None
            self.rows.put(result.frame.index, self._logger.rows)
            self._log_differences(compared, whole)
            new_styles = self._style_stream.read()
            self._styles += new_styles
            data, thinned = (self._styles if whole else new_styles) + self._stream.read(), None
            if self._logger.clouds:
                everything, few = self._encode_clouds(result)
                data, thinned = data + everything, data + few
            return Packet(data, whole, self._logger.context, now, thinned)

    def _encode_clouds(self, result: FrameResult) -> tuple[bytes, bytes]:
        """Encode the clouds set aside for this frame. Return their bytes in full and thinned."""
        frame, points = result.frame, result.config.live.viewer_points
        assert points is not None
        clouds, self._logger.clouds = self._logger.clouds, []
        self._logger.set_time(frame.index, frame.stamp, frame.received)
        for path, cloud in clouds:
            self._logger.write(path, cloud)
        everything = self._stream.read()
        for path, cloud in clouds:
            self._stream.recording.log(path, thin_cloud(cloud, points, frame.index))
        return everything, self._stream.read()

    def encode_meanwhile(
        self, seconds: float, notes: Sequence[tuple[str, str]], states: Mapping[str, str]
    ) -> Packet:
        """Encode notes and states while no frame comes. See ``FrameLogger.log_meanwhile``."""
        with self._lock:
            self._logger.log_meanwhile(seconds, notes, states)
            return Packet(self._stream.read(), False, self._logger.context, self.clock())

    def _follow(self, config: Config, scene: Scene) -> None:
        """Log what changed in the configuration or the scene."""
        if (config, scene) == (self._config, self._scene):
            return
        if scene != self._scene:
            self._stream.recording.send_blueprint(blueprints.load(self._blueprint, scene, config))
        self._config, self._scene = config, scene
        self._logger.reconfigure(config, scene)

    def _log_differences(self, compared: Sequence[FrameDifferences], whole: bool) -> None:
        """Log differences from the robot's results."""
        if self._against is None or not (compared or self._differences):
            return
        if self._differences is None:
            self._differences = DifferenceLogger(self._stream.recording, self._against.names, "")
            self._differences.styles = self._style_stream.recording
        if whole:
            self._differences.refresh()
        for comparison in compared:
            self._differences.log(comparison)

    def prelude(self, context: RecordingContext, *, blueprint: bool = True) -> bytes:
        """Return the beginning of a recording whose first packet has this context. Any thread may call it."""
        layout = blueprints.load(self._blueprint, context.scene, context.config) if blueprint else None
        with _Stream(self.application, self.recording_id, layout) as stream:
            logger = FrameLogger(stream.recording, context.config, context.scene, network=self._network)
            logger.log_context(context)
            if self._against is not None:
                DifferenceLogger(stream.recording, self._against.names, "")
            return stream.read()


# --- thinned clouds ----------------------------------------------------------------------------


def sample_rows(count: int, points: int, seed: int) -> I64:
    """Return the rows of a random sample, in order.

    The rows are divided into ``points`` equal runs, and each run gives one row. If there are fewer rows than
    that, all are returned. The same seed gives the same rows.
    """
    if count <= points:
        return np.arange(count)
    edges = np.arange(points + 1) * count // points
    rows: I64 = np.random.default_rng(seed).integers(edges[:-1], edges[1:])
    return rows


def is_cloud(logged: rr.AsComponents, points: int) -> bool:
    """Return whether an archetype is a cloud with more than ``points`` points."""
    kind = logged.archetype if isinstance(logged, Components) else type(logged)
    return kind in (rr.Points3D, rr.Points2D) and _count(logged) > points


def thin_cloud(cloud: rr.AsComponents, points: int, seed: int) -> list[rr.DescribedComponentBatch]:
    """Return the components of the sampled points of a cloud."""
    count = _count(cloud)
    rows = pa.array(sample_rows(count, points, seed))
    thinned: list[rr.DescribedComponentBatch] = []
    for batch in cloud.as_component_batches():
        values = batch.as_arrow_array()
        kept = values.take(rows) if len(values) == count else values
        thinned.append(Component(kept, batch.component_descriptor()))
    return thinned


def _count(cloud: rr.AsComponents) -> int:
    return max((len(batch.as_arrow_array()) for batch in cloud.as_component_batches()), default=0)
