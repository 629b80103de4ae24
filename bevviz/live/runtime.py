"""Live run: processes the newest frame, counts dropped frames, and feeds independent outputs."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from bevviz.checks import InputChecks
from bevviz.compare.robot_comparison import RobotComparison
from bevviz.config import Config
from bevviz.config.reloading import ReloadableConfig
from bevviz.errors import UserError
from bevviz.live.encoder import WHOLE, Encoder
from bevviz.live.flight_recorder import Triggers
from bevviz.live.live_settings import LiveSettings
from bevviz.live.outputs import Output
from bevviz.live.problems import CurrentProblems
from bevviz.live.publish import PublishingObserver
from bevviz.live.raw_recorder import RawRecorder
from bevviz.live.requests import Control, answer_sigusr1
from bevviz.live.result_problems import ResultProblems
from bevviz.live.run_outputs import Outputs, RunOutputs
from bevviz.live.source_wrappers import RobotFrames, thinned, warm_up
from bevviz.live.status import Health, Notes
from bevviz.model.frame import Frame, RobotContext, Scene
from bevviz.model.protocols import Items, Observer
from bevviz.model.results import FrameResult
from bevviz.pipeline.run import DropPolicy, run
from bevviz.pipeline.session import Session
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.recording import entities
from bevviz.support.freed_memory import return_freed_memory

LOOK = 1.0  # seconds between two checks of the configuration file and the clock
PAUSE = 1.0  # seconds without a frame after which the states of the topics are shown without one
GLANCE = 0.2  # seconds between two looks at them then
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Live:
    """Run of the pipeline beside a robot, until the source ends, ``stop`` is called, or Ctrl-C.

    Args:
        source: source of the frames.
        settings: the configuration and its origin.
        outputs: outputs of the run.
        notes: takes messages to the user.
        observe: skip the pipeline and log only the robot's topics.
        on_result: called with each result in its own thread. If it is too slow, it gets the newest.
        loader: loader that has the detector's network already.
        control: server for requests to save. None: the run opens its own.
        raw: recorder of the messages from which the source makes frames.
        robot: topic of the robot's boxes to compare with. Empty: its fused boxes. None: no comparison.
        problems: list of current problems, to which the run adds its own.

    Raises:
        UserError: the detector's model, an output or the blueprint cannot be used.
    """

    def __init__(
        self,
        source: RobotFrames,
        settings: ReloadableConfig,
        outputs: Outputs,
        notes: Notes,
        *,
        observe: bool = False,
        on_result: Callable[[FrameResult], None] | None = None,
        loader: StageLoader | None = None,
        control: Control | None = None,
        raw: RawRecorder | None = None,
        robot: str | None = None,
        problems: CurrentProblems | None = None,
    ) -> None:
        self.notes, self.raw, self._control = notes, raw, control
        self.on_change: Callable[[Config], None] = lambda config: None  # called in the thread of ``run``
        self.frames = 0  # frames logged so far
        self._source = source
        self.problems = problems or CurrentProblems(notes.warn)
        self._results = ResultProblems(self.problems)
        self._on_result = on_result
        self.checks = InputChecks(source, settings.config)
        self._shown = settings.config  # the configuration last passed to ``on_change``
        self._over = threading.Event()
        self._asked_to_save = False
        self._looked = self._logged = self._glanced = 0.0  # seconds, monotonic
        self._states: dict[str, str] = {}  # of the topics, as last logged while no frame came
        live = settings.config.live

        self._observes = observe
        self.session = (
            ObservingSession(settings.config) if observe else LiveSession(settings.config, loader=loader)
        )
        self._settings = LiveSettings(settings, self.session, notes, self._follow)
        self.against = None if robot is None else RobotComparison(robot, live)
        whole = WHOLE if live.viewer_rate is None else 1 / live.viewer_rate
        network = "" if observe else self.session.stages.provider
        self.encoder = Encoder(
            self.config, source.scene, outputs.blueprint, whole, self.against, network=network
        )
        self.outputs = RunOutputs(outputs, live, self.encoder, notes, self.problems, raw)
        self.flight = self.outputs.flight
        self._watchers: list[Callable[[FrameResult], None]] = []
        self._triggers = Triggers(live)
        self.health = Health()
        self._dropping = DropPolicy()

    @property
    def config(self) -> Config:
        """Current configuration."""
        return self.session.config

    @property
    def silence(self) -> str:
        """One sentence with the silent topics if no frame comes. Empty: frames come, or none has come yet."""
        if not self.frames or time.monotonic() - self._logged < PAUSE:
            return ""
        silent = [f"{topic} ({state})" for topic, state in self._source.states.items() if state != "ok"]
        return f"no frame comes: {', '.join(silent) or 'every topic is late'}"

    @property
    def summary(self) -> list[str]:
        """Sentences for the end: each problem with begin and end, and what only the whole run tells."""
        known = self.problems.all
        findings = [f for f in self.checks.findings if (f.kind, f.subject) not in known]
        return [*(problem.history for problem in known.values()), *map(str, findings)]

    @property
    def drops(self) -> dict[str, int]:
        """Dropped frames and messages by cause, without those thinned on purpose."""
        return {"source": self._source.dropped, **self._dropping.dropped, **self.outputs.dropped}

    # --- the frames, as the input of ``run`` ---------------------------------------------------

    @property
    def scene(self) -> Scene:
        """Names of the sensors."""
        return self._source.scene

    @property
    def total(self) -> int | None:
        """Number of frames, if known."""
        return self._source.total

    @property
    def warnings(self) -> Sequence[str]:
        """Suspicious data so far, one sentence each."""
        return self._source.warnings

    def __iter__(self) -> Iterator[Frame]:
        return thinned(self._source, lambda: self.config)

    # --- outputs and requests ------------------------------------------------------------------

    def attach(self, output: Output, watcher: Callable[[FrameResult], None]) -> None:
        """Add an output before the run. It is closed at the end of the run.

        Args:
            output: takes the packets.
            watcher: called with each logged result, in the logging thread.
        """
        self.outputs.attach(output)
        self._watchers.append(watcher)

    @property
    def numbers(self) -> dict[str, float]:
        """Statistics by name, for a monitor."""
        numbers = {
            "frames": float(self.frames),
            "latency p50, ms": 1e3 * self.health.percentile(50),
            "latency p99, ms": 1e3 * self.health.percentile(99),
            "CPU, percent of a core": self.health.cpu,
            "memory, MB": self.health.memory,
        }
        numbers |= {f"dropped: {where}": float(count) for where, count in self.drops.items()}
        numbers |= {f"lag of the {name} viewer, ms": 1e3 * lag for name, lag in self.outputs.lags.items()}
        return numbers | {path.rpartition("/")[2]: n for path, n in self.flight.scalars.items()}

    def save(self, path: Path | None = None) -> Path:
        """Save the last seconds, see ``FlightRecorder.save``. Any thread may call it."""
        return self.flight.save(path)

    def mark(self, text: str) -> None:
        """Mark the next frame, as a message on the topic of marks does."""
        self._source.mark(text)

    def stop(self) -> None:
        """End ``run``. Any thread may call it."""
        self._over.set()

    # --- the run -------------------------------------------------------------------------------

    def run(self, on_tick: Callable[[], None] = lambda: None) -> None:
        """Run until the end and close everything. Call it from the main thread.

        Raises:
            UserError: the source or the runtime failed. All outputs are closed then.
        """

        def ask_to_save() -> None:  # It takes no lock, because a signal may interrupt code that holds it.
            self._asked_to_save = True

        def tick() -> None:
            if self._asked_to_save:
                self._asked_to_save = False
                self.flight.save_soon("SIGUSR1")
            if time.monotonic() - self._glanced >= GLANCE:
                self._glanced = time.monotonic()
                self._log_meanwhile()
            if time.monotonic() - self._looked >= LOOK:
                self._looked = time.monotonic()
                self._check()
                on_tick()

        observers: list[Observer[FrameResult]] = [LoggingObserver(self), self.checks]
        if self._on_result is not None:
            observers.append(PublishingObserver(self._on_result, self.notes))
        return_freed_memory()
        with ExitStack() as stack:
            stack.callback(_handle, {number: signal.getsignal(number) for number in ENDING})
            stack.enter_context(self.session)
            stack.enter_context(self.outputs)
            if self._control is None:
                stack.enter_context(Control(self.save, self.notes.warn))
            stack.enter_context(answer_sigusr1(ask_to_save))
            # Closing takes a limited time. Whoever cannot wait for it sends the signal once more.
            stack.callback(_handle, dict.fromkeys(ENDING[2:], signal.SIG_IGN))
            try:
                drops, stop = self._dropping, self._over
                run(self, self.session, observers, dropping=drops, stop=stop, tick=tick)
            except UserError:
                raise
            except Exception as error:
                raise UserError(f"ended by {type(error).__name__}: {error}") from error

    def _check(self) -> None:
        """Check the configuration file, the clock, the topics and the viewers."""
        self._settings.look()
        if jump := self.health.clock_jump():
            self.notes.warn(f"the clock of this machine has jumped by {jump:+.1f} s")
        self.outputs.check()
        if self._shown is not self.config:
            self._shown = self.config
            self.on_change(self._shown)

    def warm_up(self) -> None:
        """Compile and load everything that the first frame needs. Scans of that time count as no drops."""
        if not self._observes:
            warm_up(self.config, self.session.loader)

    def log(self, result: FrameResult) -> None:
        """Encode a frame once, for every output."""
        drops = {entities.DROPS.path(where): float(count) for where, count in self.drops.items()}
        health = self.health.scalars() | drops | self.outputs.scalars
        result = self._with_marks(result)
        late, states = self._source.overtaken(), self._topic_states()
        boxes = [(late_result.frame_stamp, late_result.boxes) for late_result in late]
        compared = self.against.compare(result, boxes) if self.against is not None else ()
        notes, scene = self.notes.take(), self._source.scene
        self.outputs.put(self.encoder.encode(result, scene, health, notes, late, states, compared))
        self._results.observe(result)
        for watcher in self._watchers:
            watcher(result)
        self._logged = time.monotonic()
        self.health.logged(result.frame.received)
        self.frames += 1
        if reason := self._triggers.check(result):
            self.flight.save_soon(reason, self.config.live.trigger_after)
        if self.against is not None:
            self._check_robot(self.against)

    def _with_marks(self, result: FrameResult) -> FrameResult:
        """Return the result with the marks of earlier frames that were dropped. Each states its age."""
        frame = result.frame
        lost = [mark for mark in self._source.marks(frame.index) if mark.index < frame.index]
        if not lost:
            return result
        around = frame.around or RobotContext()
        texts = [
            f"{mark.text} ({(frame.stamp - mark.stamp) * 1e-9:.2f} s before this frame)" for mark in lost
        ]
        around = replace(around, marks=(*texts, *around.marks))
        return replace(result, frame=replace(frame, around=around))

    def _check_robot(self, against: RobotComparison) -> None:
        """Report problems of the comparison, and save when robot and ours differ for long."""
        self.problems.set("comparison", "robot", against.problem, f"compared with {against.names[1]}")
        if reason := against.reason():
            self.flight.save_soon(reason, self.config.live.trigger_after)

    def _log_meanwhile(self) -> None:
        """Log messages and topic states while no frame comes."""
        since, states = time.monotonic() - self._logged, self._topic_states()
        if not self.frames or since < PAUSE:
            return
        if (notes := self.notes.take()) or states != self._states:
            self._states = states
            self.outputs.put(self.encoder.encode_meanwhile(since, notes, states))

    def _topic_states(self) -> dict[str, str]:
        """Return the states of the topics, by entity path."""
        return {entities.TOPIC_STATE.path(topic): state for topic, state in self._source.states.items()}

    # --- changes -------------------------------------------------------------------------------

    def update(self, settings: Sequence[str], without: Sequence[str] = ()) -> None:
        """Apply settings, see ``LiveSettings.update``. Any thread may call it."""
        self._settings.update(settings, without)

    def _follow(self, config: Config) -> None:
        """Pass a new configuration to the buffers and to the comparison."""
        self.flight.config = self._triggers.config = config.live
        if self.raw is not None:
            self.raw.config = config.live
        if self.against is not None:
            self.against.config = config.live


def _handle(handlers: Mapping[signal.Signals, Any]) -> None:
    for number, handler in handlers.items():
        signal.signal(number, handler)


class LoggingObserver(Observer[FrameResult]):
    """Observer that logs in its own thread. The stages and the publisher do not wait for it."""

    name = "logging"

    def __init__(self, live: Live) -> None:
        self._live = live
        self.queue_size = live.config.live.log_queue

    def begin(self, items: Items[object]) -> None:
        """Warm up before the first frame."""
        self._live.warm_up()

    def observe(self, result: FrameResult) -> None:
        """Log a result."""
        self._live.log(result)


class LiveSession(Session):
    """Session that leaves the robot's motion to its transforms: an estimate would delay each result."""

    estimates_motion = False


class ObservingSession(Session):
    """Session that runs no stage. Only the robot's topics are shown."""

    def __init__(self, config: Config) -> None:
        super().__init__(config, detect=lambda camera: None)

    def perceive(self, frame: Frame, network: Executor | None = None) -> FrameResult:
        """Return the frame without results."""
        return FrameResult.unprocessed(frame, self.config)

    def finish(self, result: FrameResult) -> FrameResult:
        """Add the anomalies of the drive, without running the later stages."""
        return self.add_anomalies(result)
