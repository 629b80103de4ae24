"""Commands ``bevviz live`` and ``bevviz snap``: run beside a robot, and save the last seconds."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from bevviz.cli.command import command, extensions, flag, option
from bevviz.cli.interrupts import interruptible
from bevviz.cli.options import (
    WHAT_TO_RUN,
    ConfigOptions,
    Keep,
    collect_settings,
    keep_option,
    model_option,
    ros_option,
)
from bevviz.cli.outputs import ViewerOptions, has_display, layout_option, say, warn
from bevviz.cli.values import port
from bevviz.errors import UserError
from bevviz.support import progress

if TYPE_CHECKING:
    from bevviz.config import Config
    from bevviz.config.reloading import ReloadableConfig
    from bevviz.live.companions import Companion
    from bevviz.live.problems import CurrentProblems
    from bevviz.live.raw_recorder import RawRecorder
    from bevviz.live.requests import Control
    from bevviz.live.runtime import Live
    from bevviz.live.source import LiveSource
    from bevviz.live.source_wrappers import RobotFrames
    from bevviz.live.status import Notes
    from bevviz.model.results import FrameResult
    from bevviz.pipeline.stage_loader import StageLoader


def _split(text: str) -> str:
    """Return the setting for a size or a time, as ``key=value``."""
    return f"live.split_{'size' if text.strip().endswith('B') else 'time'}={text}"


@dataclass(frozen=True, kw_only=True)
class LiveRun:
    """Options that select what is run."""

    group: ClassVar = WHAT_TO_RUN

    model: str | None = model_option()
    observe: bool = flag("no pipeline: show only what the robot itself publishes")
    robot: str | None = option(
        "TOPIC",
        "compare our objects with the robot's (default: its fused Detection3DArray), frame by frame",
        const="",
    )
    every: str | None = option("N", "run each N-th scan only", key="live.every")
    max_rate: str | None = option("HZ", "frames a second at most", key="live.max_rate")
    points: str | None = option("N", "points kept of each scan", key="live.points")
    nice: str | None = option("0..19", "priority given up to other processes", key="live.nice")


@dataclass(frozen=True, kw_only=True)
class LiveOutputs(ViewerOptions):
    """Outputs of ``live``."""

    save: tuple[Path, ...] = option(
        "FILE.rrd|FILE.mcap",
        "save the recording, blueprint included; the messages as they come; both, given twice",
        repeat=True,
    )
    blueprint: str = layout_option("live")
    keep: Keep = keep_option()
    split: str | None = option("SIZE|TIME", "--save in parts, e.g. 500MB or 10min", parse=_split)
    workbench: int | None = option(
        "PORT",
        "a page where a click answers why and parameters are changed (default: a free port)",
        parse=port,
        const=0,
    )
    flight: str | None = option(
        "TIME", "what the flight recorder holds (default: 30 s), for 'bevviz snap'", key="live.flight_time"
    )


@dataclass(frozen=True, kw_only=True)
class LiveOptions:
    """Options of ``live``."""

    run: LiveRun
    config: ConfigOptions
    output: LiveOutputs
    ros_args: tuple[str, ...] = ros_option()


@dataclass(frozen=True, kw_only=True)
class SnapOptions:
    """Options of ``snap``."""

    path: Path | None = option("FILE.rrd", "default: named by the time", positional=True, nargs="?")
    pid: int | None = option("PID", "which process, where several run")


@command(
    "live",
    description="Run the pipeline on a running ROS 2 graph. It is never behind: the newest frame wins.",
    extended_by="watches",
)
def _live(options: LiveOptions) -> int:
    # Silence Rerun's warning about files without an index. They get one when they are complete.
    os.environ.setdefault("RUST_LOG", "warn,re_log_encoding::rrd::file_sink=error")
    from bevviz.config.reloading import ReloadableConfig
    from bevviz.live.status import Notes
    from bevviz.pipeline.stage_loader import StageLoader

    chosen, output, config = options.run, options.output, options.config
    values = collect_settings(options)
    if output.split is not None:
        values.append(output.split)
    _files(output.save)
    if output.split is not None and not output.save:
        raise UserError("--split divides what --save writes: give --save FILE.rrd, too")
    if chosen.observe and chosen.robot is not None:
        raise UserError("--robot compares our objects with the robot's: leave --observe out")
    settings = ReloadableConfig(config.file, values, config.preset, config.project_layers)
    _check_outputs(output)
    loader = StageLoader(store=False)  # no image of a robot comes twice
    if not chosen.observe:
        loader.load(settings.config)
    notes = Notes(say)
    with ExitStack() as stack:
        watches = extensions(options)
        requested = [watch.open(given, observe=chosen.observe) for watch, given in watches]
        companions = [stack.enter_context(companion) for companion in requested if companion is not None]
        return _run(settings, options, notes, loader, companions)


def _run(
    settings: ReloadableConfig,
    options: LiveOptions,
    notes: Notes,
    loader: StageLoader,
    companions: Sequence[Companion],
) -> int:
    """Run beside a robot."""
    from bevviz.live.raw_recorder import RawRecorder
    from bevviz.live.source import LiveSource

    raw = RawRecorder(settings.config.live)
    with LiveSource(
        settings.config, arguments=options.ros_args, tell=notes.info, raw=raw, results=options.run.observe
    ) as robot:
        return _watch_robot(robot, settings, options, notes, loader, raw, companions)


def _check_outputs(options: LiveOutputs) -> None:
    """Check the outputs before waiting for a robot."""
    from bevviz.model.frame import Scene
    from bevviz.recording import blueprints
    from bevviz.recording.ports import check_port, own_address
    from bevviz.recording.sinks import check_viewer

    if options.serve is not None:
        own_address(options.bind)
        check_port(options.serve)
    if options.workbench:
        check_port(options.workbench, "--workbench")
    if options.connect is not None:
        check_viewer(options.connect)
    blueprints.load(options.blueprint, Scene("live", "lidar", ("lidar",)))


def _watch_robot(
    source: LiveSource,
    settings: ReloadableConfig,
    options: LiveOptions,
    notes: Notes,
    loader: StageLoader,
    raw: RawRecorder,
    companions: Sequence[Companion],
) -> int:
    """Wait for the robot, then run."""
    from bevviz.live.requests import Control, answer_sigusr1
    from bevviz.live.source_wrappers import warm_up

    def refuse(path: Path | None = None) -> Path:
        raise UserError(f"there is nothing to save yet; waiting: {source.missing}")

    with (
        Control(refuse, notes.warn) as control,
        answer_sigusr1(lambda: notes.warn("there is nothing to save yet")),
    ):
        for companion in companions:
            companion.join(source.node, settings, refuse)
        if not options.run.observe:  # Warm up while waiting for the robot.
            warm_up_stages = partial(warm_up, settings.config, loader)
            threading.Thread(target=warm_up_stages, name="warm up", daemon=True).start()
        reported_missing = ""
        with suppress(KeyboardInterrupt), interruptible(twice=True) as ended:
            while not source.wait(1.0):
                missing = source.missing
                if missing and missing != reported_missing:
                    reported_missing = missing
                    say(f"waiting: {reported_missing}")
        if ended.is_set():
            return 1
        problems = source.problems
        return _watch(source, settings, options, notes, loader, companions, control, raw, problems)


def _watch(
    source: RobotFrames,
    settings: ReloadableConfig,
    options: LiveOptions,
    notes: Notes,
    loader: StageLoader,
    companions: Sequence[Companion],
    control: Control | None = None,
    raw: RawRecorder | None = None,
    problems: CurrentProblems | None = None,
) -> int:
    """Run until the source ends or the user ends it."""
    from bevviz.live.publish import Publisher
    from bevviz.live.run_outputs import Outputs
    from bevviz.live.runtime import Live

    takers = [companion for companion in companions if companion.takes_results]
    publisher = Publisher(settings.config, takers)

    def publish(result: FrameResult) -> None:
        publisher.publish(result)
        for companion in takers:
            companion.observe(result)

    def show_change(config: Config) -> None:
        publisher.configure(config)
        for companion in companions:
            companion.show(config)

    output = options.output
    show_window = output.viewer
    save, messages = _files(output.save)
    viewer_options = output.serve, output.connect, output.workbench
    no_output = not output.save and all(option is None for option in viewer_options) and not show_window
    show_window = show_window or (no_output and has_display())
    connect = [output.connect] if output.connect else []
    outputs = Outputs(save, show_window, output.serve, output.bind, connect, output.blueprint, messages)
    live = Live(
        source,
        settings,
        outputs,
        notes,
        observe=options.run.observe,
        on_result=publish if takers else None,
        loader=loader,
        control=control,
        raw=raw,
        robot=options.run.robot,
        problems=problems,
    )
    if control is not None:
        control.save = live.save
    live.on_change = show_change
    for companion in companions:
        companion.begin(live)
    for url in live.outputs.urls:
        say(f"viewer at {url}", always=True)
    if no_output and not show_window:
        say("no display: 'bevviz snap' saves the last seconds, --serve shows them in a browser")
    with (
        suppress(KeyboardInterrupt),
        interruptible(twice=True),
        _page(output.workbench, live),
        progress.bar(unit="frame", desc=source.scene.name) as bar,
    ):

        def show() -> None:
            median = 1e3 * live.health.percentile(50)
            bar.set_postfix_str(f"{median:.0f} ms, {sum(live.drops.values())} dropped", False)
            bar.update(live.frames - bar.n)

        live.run(show)
    if (comparison := live.against) is not None:
        text = (
            f"{comparison.differing} of {comparison.frames} compared frames differ from {comparison.names[1]}"
        )
        say(text if comparison.frames else f"the robot published nothing on {comparison.names[1]}")
        if comparison.without_ours:
            say(f"{comparison.without_ours} frames are not compared: no objects of ours were made of them")
        if comparison.late_images:
            late = f"{comparison.late_images} of the robot's detections in images"
            say(f"{late} came when their frames were compared already: not compared")
    warn(live.summary)
    targets = [
        f"{paths[0]}" + (f" and {len(paths) - 1} more" if paths[1:] else "") for paths in live.outputs.saved
    ]
    target = f" in {', '.join(targets)}" if targets else ""
    drops = [f"{count} ({place})" for place, count in live.drops.items() if count]
    say(f"{live.frames} frames{target}, {' + '.join(drops) or 'none'} dropped")
    return 0 if live.frames else 1


def _page(workbench: int | None, live: Live) -> AbstractContextManager[object]:
    """Return the workbench's page for the run, if it is requested."""
    if workbench is None:
        return nullcontext()
    try:
        from bevviz.workbench.running_robot import robot_session
        from bevviz.workbench.server import page_server
    except ImportError as error:
        raise UserError(
            f"the workbench needs further packages ({error.name}): pip install 'bevviz[workbench]'"
        ) from None
    session = robot_session(live)

    def ready(address: str) -> None:
        say(f"workbench at {address}", always=True)

    return page_server(lambda: session, "live", workbench or None, ready)


def _files(paths: Sequence[Path]) -> tuple[Path | None, Path | None]:
    """Return the paths of ``--save``: the recording's and the messages'."""
    from bevviz.live.files import check_name

    paths_by_suffix: dict[str, Path] = {}
    for path in paths:
        check_name(path, ".rrd", ".mcap")
        if path.suffix in paths_by_suffix:
            raise UserError(
                f"--save {path}: {paths_by_suffix[path.suffix]} is given already; one of each kind"
            )
        paths_by_suffix[path.suffix] = path
    return paths_by_suffix.get(".rrd"), paths_by_suffix.get(".mcap")


@command(
    "snap",
    description="Have a running 'bevviz live' save its flight recorder: FILE.rrd, and beside it "
    "FILE.mcap, the messages that it was made of. SIGUSR1 does the same.",
)
def _snap(options: SnapOptions) -> int:
    from bevviz.live.requests import snap

    recording = snap(options.path, options.pid)
    print(recording)
    if recording.with_suffix(".mcap").exists():
        print(recording.with_suffix(".mcap"))
    return 0
