"""Live run: processes the newest frame, counts dropped frames, and feeds independent outputs."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

from bevviz.checks import InputChecks
from bevviz.compare.robot_comparison import RobotComparison
from bevviz.config import Config
from bevviz.config.reloading import FIXED_KEYS, ReloadableConfig
from bevviz.errors import UserError
from bevviz.live.encoder import WHOLE, Encoder
from bevviz.live.flight_recorder import Triggers
from bevviz.live.publish import Publisher, Receiver
from bevviz.live.requests import answer_sigusr1
from bevviz.live.result_problems import ResultProblems
from bevviz.live.run_outputs import Outputs, RunOutputs
from bevviz.live.source_wrappers import RobotFrames, thinned, warm_up
from bevviz.live.status import Health, Notes, set_nice
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
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Live:
    """Run of the pipeline beside a robot, until the source ends, ``stop`` is called, or Ctrl-C.

    Args:
        source: source of the frames.
        settings: the configuration and its origin.
        outputs: outputs of the run.
        notes: takes messages to the user.
        observe: skip the pipeline and log only the robot's topics.
        loader: loader that has the detector's network already.
        robot: topic of the robot's boxes to compare with. Empty: its fused boxes. None: no comparison.

    Attributes:
        source: source of the frames, with the messages they are made of.
        problems: list of current problems, to which the run adds its own.
        receivers: receivers of the results.
        watchers: functions that the logging thread calls with each logged result.
        followers: functions that the thread of ``run`` calls with each new configuration.
        settings: the configuration, which any thread may change.

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
        loader: StageLoader | None = None,
        robot: str | None = None,
    ) -> None:
        self.source, self.notes, self.problems = source, notes, source.problems
        self.receivers: list[Receiver] = []
        self.frames = 0  # frames logged so far
        self.followers: list[Callable[[Config], None]] = []
        self._results = ResultProblems(self.problems)
        self.checks = InputChecks(source, settings.config)
        self._over = threading.Event()
        self._asked_to_save = False
        self._looked = self._logged = 0.0  # seconds, monotonic
        self._states: dict[str, str] = {}  # of the topics, as last logged while no frame came
        live = settings.config.live

        config = settings.config
        self._shown = config  # the configuration that the followers have
        self.session = ObservingSession(config) if observe else Session(config, loader=loader)
        self.session.estimates_motion = False  # The robot's transforms tell it, and an estimate takes time.
        self.settings, settings.apply = settings, self._apply
        self._set_nice(live.nice)
        self.against = None if robot is None else RobotComparison(robot)
        whole = WHOLE if live.viewer_rate is None else 1 / live.viewer_rate
        network = "" if observe else self.session.stages.provider
        self.encoder = Encoder(
            self.config, source.scene, outputs.blueprint, whole, self.against, network=network
        )
        self.outputs = RunOutputs(outputs, settings, self.encoder, notes, source)
        self.flight = self.outputs.flight
        self.watchers: list[Callable[[FrameResult], None]] = []
        self._triggers = Triggers()
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
        silent = [f"{topic} ({state})" for topic, state in self.source.states.items() if state != "ok"]
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
        return {"source": self.source.dropped, **self._dropping.dropped, **self.outputs.dropped}

    # --- the frames, as the input of ``run`` ---------------------------------------------------

    @property
    def scene(self) -> Scene:
        """Names of the sensors."""
        return self.source.scene

    @property
    def total(self) -> int | None:
        """Number of frames, if known."""
        return self.source.total

    @property
    def warnings(self) -> Sequence[str]:
        """Suspicious data so far, one sentence each."""
        return self.source.warnings

    def __iter__(self) -> Iterator[Frame]:
        return thinned(self.source, lambda: self.config)

    # --- the state of the run ------------------------------------------------------------------

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
            self._log_meanwhile()
            if time.monotonic() - self._looked >= LOOK:
                self._looked = time.monotonic()
                self._check()
                on_tick()

        observers: list[Observer[FrameResult]] = [LoggingObserver(self), self.checks]
        if self.receivers:
            observers.append(Publisher(self.receivers, self.notes))
        return_freed_memory()
        with ExitStack() as stack:
            stack.callback(_handle, {number: signal.getsignal(number) for number in ENDING})
            stack.enter_context(self.session)
            stack.enter_context(self.outputs)
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
        if self.settings.changed():
            try:
                self.settings.take()
            except UserError as error:
                self.notes.warn(f"{error}; the configuration stays as it was")
        if jump := self.health.clock_jump():
            self.notes.warn(f"the clock of this machine has jumped by {jump:+.1f} s")
        self.outputs.check()
        if self._shown is not self.config:
            self._shown = self.config
            for follow in self.followers:
                follow(self._shown)

    def log(self, result: FrameResult) -> None:
        """Encode a frame once, for every output."""
        drops = {entities.DROPS.path(where): float(count) for where, count in self.drops.items()}
        health = self.health.scalars() | drops | self.outputs.scalars
        result = self._with_marks(result)
        late, states = self.source.overtaken(), self._topic_states()
        boxes = [(late_result.frame_stamp, late_result.boxes) for late_result in late]
        compared = self.against.compare(result, boxes) if self.against is not None else ()
        notes, scene = self.notes.take(), self.source.scene
        self.outputs.put(self.encoder.encode(result, scene, health, notes, late, states, compared))
        self._results.observe(result)
        for watch in self.watchers:
            watch(result)
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
        lost = [mark for mark in self.source.marks(frame.index) if mark.index < frame.index]
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
        return {entities.TOPIC_STATE.path(topic): state for topic, state in self.source.states.items()}

    def _apply(self, config: Config) -> None:
        """Apply a configuration and report what changed. The thread that changes it calls this."""
        nice = self.config.live.nice
        changed = self.session.configure(config)
        if config.live.nice != nice:
            self._set_nice(config.live.nice)
        for key, change in changed.items():
            if ".params." in key and "absent" in (change.before, change.after):
                continue  # the change of the method is reported instead
            late = "; takes effect at the next start" if key.startswith(FIXED_KEYS) else ""
            self.notes.info(f"configuration: {key} {change}{late}")

    def _set_nice(self, nice: int) -> None:
        """Set the priority of the process, or warn if that is not permitted."""
        try:
            set_nice(nice)
        except PermissionError:
            self.notes.warn(f"live.nice={nice}: only root may take priority back")


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
        """Compile and load everything that the first frame needs. Scans of that time count as no drops."""
        if not isinstance(self._live.session, ObservingSession):
            warm_up(self._live.config, self._live.session.loader)

    def observe(self, result: FrameResult) -> None:
        """Log a result."""
        self._live.log(result)


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
