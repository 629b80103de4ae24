"""Commands ``bevviz live`` and ``bevviz snap``: run beside a robot, and save the last seconds."""

from __future__ import annotations

import argparse
import os
import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from bevviz.cli.interrupts import interruptible
from bevviz.cli.options import (
    Commands,
    add_config,
    add_keep,
    add_output,
    add_ros_args,
    port,
    project_layers,
)
from bevviz.cli.outputs import has_display, say, warn
from bevviz.errors import UserError
from bevviz.support import progress
from bevviz.support.extensions import load_all

if TYPE_CHECKING:
    from bevviz.cli.parser import Parser
    from bevviz.config import Config
    from bevviz.config.reloading import ReloadableConfig
    from bevviz.live.publish import ResultSink, Watch
    from bevviz.live.raw_recorder import RawRecorder
    from bevviz.live.requests import Control
    from bevviz.live.runtime import Live, Status
    from bevviz.live.source import LiveSource
    from bevviz.live.status import Notes
    from bevviz.model.frame import Frame
    from bevviz.model.protocols import Items
    from bevviz.model.results import FrameResult
    from bevviz.pipeline.stage_loader import StageLoader


def add(commands: Commands) -> None:
    """Add the commands ``live`` and ``snap``."""
    live = commands.add_parser(
        "live",
        help="run the pipeline beside a robot",
        description="Run the pipeline on a running ROS 2 graph. It is never behind: the newest frame wins.",
    )
    choice = live.add_argument_group("what to run")
    choice.add_argument("--model", metavar="FILE.onnx", help="detector: YOLOv5, v8, v10, 11, 26 or YOLOX")
    choice.add_argument(
        "--observe", action="store_true", help="no pipeline: show only what the robot itself publishes"
    )
    choice.add_argument(
        "--publish", action="store_true", help="publish the results, as the nodes of the tutorial do"
    )
    choice.add_argument(
        "--diagnostics",
        action="store_true",
        help="publish how bevviz does and what is worth a look on /diagnostics; --publish does it, too",
    )
    choice.add_argument(
        "--robot",
        nargs="?",
        const="",
        metavar="TOPIC",
        help="compare our objects with the robot's (default: its fused Detection3DArray), frame by frame",
    )
    choice.add_argument("--every", metavar="N", help="run each N-th scan only")
    choice.add_argument("--max-rate", metavar="HZ", help="frames a second at most")
    choice.add_argument("--points", metavar="N", help="points kept of each scan")
    choice.add_argument("--nice", metavar="0..19", help="priority given up to other processes")
    add_config(live)
    output = add_output(live, blueprint="live", raw=True)
    add_keep(output)
    output.add_argument(
        "--split", type=_split, metavar="SIZE|TIME", help="--save in parts, e.g. 500MB or 10min"
    )
    output.add_argument(
        "--workbench",
        nargs="?",
        type=port,
        const=0,
        metavar="PORT",
        help="a page where a click answers why and parameters are changed (default: a free port)",
    )
    output.add_argument(
        "--flight", metavar="TIME", help="what the flight recorder holds (default: 30 s), for 'bevviz snap'"
    )
    add_ros_args(live)
    live.set_defaults(run=_live)
    live.add_later(lambda: _add_watches(live, choice))

    snap = commands.add_parser(
        "snap",
        help="save the last seconds of a running 'bevviz live'",
        description="Have a running 'bevviz live' save its flight recorder: FILE.rrd, and beside it "
        "FILE.mcap, the messages that it was made of. SIGUSR1 does the same.",
    )
    snap.add_argument("path", nargs="?", type=Path, metavar="FILE.rrd", help="default: named by the time")
    snap.add_argument("--pid", type=int, metavar="PID", help="which process, where several run")
    snap.set_defaults(run=_snap)


def _add_watches(live: Parser, group: argparse._ArgumentGroup) -> None:
    """Add the options of what is registered to watch the results."""
    watches = [*load_all("watches", lambda text: warn([text]))]
    for watch in watches:
        watch.add_options(group)
    live.set_defaults(watches=watches)


def _split(text: str) -> str:
    """Return the setting for a size or a time, as ``key=value``."""
    return f"live.split_{'size' if text.strip().endswith('B') else 'time'}={text}"


def _live(options: argparse.Namespace) -> int:
    # Silence Rerun's warning about files without an index. They get one when they are complete.
    os.environ.setdefault("RUST_LOG", "warn,re_log_encoding=error")
    from bevviz.config.reloading import ReloadableConfig
    from bevviz.live.status import Notes
    from bevviz.pipeline.stage_loader import StageLoader

    option_values = {
        "detector.model": options.model,
        "live.every": options.every,
        "live.max_rate": options.max_rate,
        "live.points": options.points,
        "live.nice": options.nice,
        "logging.keep": options.keep,
        "live.flight_time": options.flight,
    }
    option_settings = [f"{key}={value}" for key, value in option_values.items() if value is not None]
    if options.split is not None:
        option_settings.append(options.split)
    _files(options.save)
    if options.split is not None and not options.save:
        raise UserError("--split divides what --save writes: give --save FILE.rrd, too")
    if options.observe and options.publish:
        raise UserError("--observe makes no results that --publish could send: leave one of them out")
    if options.observe and options.robot is not None:
        raise UserError("--robot compares our objects with the robot's: leave --observe out")
    settings = ReloadableConfig(
        options.config, [*options.set, *option_settings], options.preset, project_layers(options)
    )
    _check_outputs(options)
    loader = StageLoader()
    if not options.observe:
        loader.load(settings.config)
    notes = Notes(say)
    with ExitStack() as open_sinks:
        watches: list[Watch] = options.watches
        sinks = [open_sinks.enter_context(sink) for watch in watches if (sink := watch.open_sink(options))]
        return _run(settings, options, notes, loader, sinks)


def _run(
    settings: ReloadableConfig,
    options: argparse.Namespace,
    notes: Notes,
    loader: StageLoader,
    sinks: Sequence[ResultSink],
) -> int:
    """Run beside a robot."""
    from bevviz.live.raw_recorder import RawRecorder
    from bevviz.live.source import LiveSource

    raw = RawRecorder(settings.config.live)
    with LiveSource(
        settings.config, arguments=options.ros_args, tell=notes.info, raw=raw, results=options.observe
    ) as robot:
        return _watch_robot(robot, settings, options, notes, loader, raw, sinks)


def _check_outputs(options: argparse.Namespace) -> None:
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
    options: argparse.Namespace,
    notes: Notes,
    loader: StageLoader,
    raw: RawRecorder,
    watching_sinks: Sequence[ResultSink],
) -> int:
    """Wait for the robot, then run. Publish results and take requests as the options say."""
    from bevviz.live.publish import Publisher, RosTopics
    from bevviz.live.requests import Control, RosRequests, answer_sigusr1
    from bevviz.live.source_wrappers import warm_up
    from bevviz.live.status import Diagnostics

    def refuse(path: Path | None = None) -> Path:
        raise UserError(f"there is nothing to save yet; waiting: {source.missing}")

    with (
        Control(refuse, notes.warn) as control,
        answer_sigusr1(lambda: notes.warn("there is nothing to save yet")),
    ):

        def take(more: list[str]) -> None:
            settings.take(more)
            if orders is not None:
                orders.config = settings.config

        orders: RosRequests | None = None
        orders = RosRequests(source.node, settings.config, take, refuse)
        orders.config = settings.config
        if not options.observe:  # Warm up while waiting for the robot.
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
        sinks: list[ResultSink] = [RosTopics(source.node, notes.warn)] if options.publish else []
        sinks += watching_sinks
        publisher = Publisher(settings.config, sinks) if sinks else None
        diagnostics: Diagnostics | None = None
        if options.publish or options.diagnostics:
            try:
                diagnostics = Diagnostics(source.node)
            except UserError as error:
                notes.warn(f"/diagnostics is not published: {error}")

        def on_result(result: FrameResult) -> None:
            if publisher is not None:
                publisher.publish(result)
            if diagnostics is not None:
                diagnostics.observe(result)

        def follow(live: Live, orders: RosRequests = orders) -> Callable[[Config], None]:
            control.save = orders.save = live.save
            orders.change = live.update
            if diagnostics is not None:
                diagnostics.every_second(lambda: diagnostics.publish(live.numbers, source.warnings))

            def show(config: Config) -> None:
                orders.show(config)
                if publisher is not None:
                    publisher.configure(config)

            return show

        callback = on_result if publisher is not None or diagnostics is not None else None
        return _watch(source, settings, options, notes, loader, callback, follow, control, raw)


def _watch(
    source: Items[Frame],
    settings: ReloadableConfig,
    options: argparse.Namespace,
    notes: Notes,
    loader: StageLoader,
    on_result: Callable[[FrameResult], None] | None,
    follow: Callable[[Live], Callable[[Config], None]],
    control: Control | None = None,
    raw: RawRecorder | None = None,
) -> int:
    """Run until the source ends or the user ends it."""
    from bevviz.live.runtime import Live, Outputs

    show_window = options.viewer
    save, messages = _files(options.save)
    viewer_options = options.serve, options.connect, options.workbench
    no_output = not options.save and all(option is None for option in viewer_options) and not show_window
    show_window = show_window or (no_output and has_display())
    connect = [options.connect] if options.connect else []
    outputs = Outputs(save, show_window, options.serve, options.bind, connect, options.blueprint, messages)
    live = Live(
        source,
        settings,
        outputs,
        notes,
        observe=options.observe,
        on_result=on_result,
        loader=loader,
        control=control,
        raw=raw,
        robot=options.robot,
    )
    live.on_change = follow(live)
    for url in live.urls:
        say(f"viewer at {url}", always=True)
    if no_output and not show_window:
        say("no display: 'bevviz snap' saves the last seconds, --serve shows them in a browser")
    with (
        suppress(KeyboardInterrupt),
        interruptible(twice=True),
        _page(options, live),
        progress.bar(unit="frame", desc=source.scene.name) as bar,
    ):

        def show(status: Status) -> None:
            bar.set_postfix_str(f"{1e3 * status.p50:.0f} ms, {sum(status.drops.values())} dropped", False)
            bar.update(status.frames - bar.n)

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
    warn(source.warnings)
    written_paths = [
        saver.paths for saver in (live.saver, live.raw_saver) if saver is not None and saver.paths
    ]
    targets = [
        f"{paths[0]}" + (f" and {len(paths) - 1} more" if paths[1:] else "") for paths in written_paths
    ]
    target = f" in {', '.join(targets)}" if targets else ""
    drops = [f"{count} ({place})" for place, count in live.status.drops.items() if count]
    say(f"{live.frames} frames{target}, {' + '.join(drops) or 'none'} dropped")
    return 0 if live.frames else 1


def _page(options: argparse.Namespace, live: Live) -> AbstractContextManager[object]:
    """Return the workbench's page for the run, if it is requested."""
    if options.workbench is None:
        return nullcontext()
    try:
        from bevviz.workbench.running_robot import robot_session
        from bevviz.workbench.server import LivePage
    except ImportError as error:
        raise UserError(
            f"the workbench needs further packages ({error.name}): pip install 'bevviz[workbench]'"
        ) from None
    page = LivePage(robot_session(live), options.workbench or None)
    say(f"workbench at {page.address}", always=True)
    return page


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


def _snap(options: argparse.Namespace) -> int:
    from bevviz.live.requests import snap

    recording = snap(options.path, options.pid)
    print(recording)
    if recording.with_suffix(".mcap").exists():
        print(recording.with_suffix(".mcap"))
    return 0
