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
    from bevviz.config.reloading import ReloadableConfig
    from bevviz.live.companions import Companion
    from bevviz.live.requests import Control
    from bevviz.live.run_outputs import Outputs
    from bevviz.live.runtime import Live
    from bevviz.live.source_wrappers import RobotFrames
    from bevviz.live.status import Notes
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
    values, outputs = collect_settings(options), _outputs(output)
    if output.split is not None:
        if not output.save:
            raise UserError("--split divides what --save writes: give --save FILE.rrd, too")
        values.append(output.split)
    if chosen.observe and chosen.robot is not None:
        raise UserError("--robot compares our objects with the robot's: leave --observe out")
    settings = ReloadableConfig(config.file, values, config.preset, config.project_layers)
    loader = StageLoader(store=False)  # no image of a robot comes twice
    if not chosen.observe:
        loader.load(settings.config)
    notes = Notes(say)
    with ExitStack() as stack:
        watches = extensions(options)
        requested = [watch.open(given, observe=chosen.observe) for watch, given in watches]
        companions = [stack.enter_context(companion) for companion in requested if companion is not None]
        return _run(settings, options, outputs, notes, loader, companions)


def _run(
    settings: ReloadableConfig,
    options: LiveOptions,
    outputs: Outputs,
    notes: Notes,
    loader: StageLoader,
    companions: Sequence[Companion],
) -> int:
    """Wait for the robot, then run beside it."""
    from bevviz.live.raw_recorder import RawRecorder
    from bevviz.live.requests import Control, answer_sigusr1
    from bevviz.live.source import LiveSource
    from bevviz.live.source_wrappers import warm_up

    observe = options.run.observe
    arguments, raw = options.ros_args, RawRecorder(settings)

    def refuse(path: Path | None = None) -> Path:
        raise UserError(f"there is nothing to save yet; waiting: {source.missing}")

    with (
        LiveSource(settings.config, arguments=arguments, tell=notes.info, raw=raw, results=observe) as source,
        Control(refuse, notes.warn) as control,
        answer_sigusr1(lambda: notes.warn("there is nothing to save yet")),
    ):
        for companion in companions:
            companion.join(source.nodes.node, settings, lambda: control.save(None))
        if not observe:  # Warm up while waiting for the robot.
            warm_up_stages = partial(warm_up, settings.config, loader)
            threading.Thread(target=warm_up_stages, name="warm up", daemon=True).start()
        with suppress(KeyboardInterrupt), interruptible(twice=True) as ended:
            source.wait_aloud(lambda missing: say(f"waiting: {missing}"))
        if ended.is_set():
            return 1
        return _watch(source, settings, options, outputs, notes, loader, companions, control)


def _outputs(options: LiveOutputs) -> Outputs:
    """Return the outputs that the options ask for. Check them before waiting for a robot."""
    from bevviz.live.files import check_name
    from bevviz.live.run_outputs import Outputs
    from bevviz.model.frame import Scene
    from bevviz.recording import blueprints
    from bevviz.recording.ports import check_port, own_address
    from bevviz.recording.sinks import check_viewer

    files: dict[str, Path] = {}
    for path in options.save:
        check_name(path, ".rrd", ".mcap")
        if path.suffix in files:
            raise UserError(f"--save {path}: {files[path.suffix]} is given already; one of each kind")
        files[path.suffix] = path
    if options.serve is not None:
        own_address(options.bind)
        check_port(options.serve)
    if options.workbench:
        check_port(options.workbench, "--workbench")
    if options.connect is not None:
        check_viewer(options.connect)
    blueprints.load(options.blueprint, Scene("live", "lidar", ("lidar",)))
    shown = (options.serve, options.connect, options.workbench) != (None, None, None)
    window = options.viewer or (not (files or shown) and has_display())
    connect = [options.connect] if options.connect else []
    recording, messages = files.get(".rrd"), files.get(".mcap")
    return Outputs(recording, window, options.serve, options.bind, connect, options.blueprint, messages)


def _watch(
    source: RobotFrames,
    settings: ReloadableConfig,
    options: LiveOptions,
    outputs: Outputs,
    notes: Notes,
    loader: StageLoader,
    companions: Sequence[Companion],
    control: Control,
) -> int:
    """Run until the source ends or the user ends it."""
    from bevviz.live.runtime import Live

    workbench = options.output.workbench
    live = Live(
        source,
        settings,
        outputs,
        notes,
        observe=options.run.observe,
        loader=loader,
        robot=options.run.robot,
    )
    control.save = live.flight.save
    for companion in companions:
        companion.begin(live)
    for url in live.outputs.urls:
        say(f"viewer at {url}", always=True)
    ports = outputs.serve, workbench
    if not (outputs.save or outputs.raw or outputs.window or outputs.connect) and ports == (None, None):
        say("no display: 'bevviz snap' saves the last seconds, --serve shows them in a browser")
    with (
        suppress(KeyboardInterrupt),
        interruptible(twice=True),
        _page(workbench, live),
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
