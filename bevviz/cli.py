"""The command line: parse, call, print. Imports are inside the commands, so that --help is instant."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from bevviz import __version__
from bevviz.errors import UserError

if TYPE_CHECKING:
    from bevviz.config import Config
    from bevviz.frame import FrameResult
    from bevviz.live import Live, Notes, Settings, Status
    from bevviz.sources import Source
    from bevviz.sources.live import LiveSource
    from bevviz.sources.replay import Replay

EPILOG = """examples:
  bevviz demo                                 the synthetic drive, in the viewer
  bevviz info drive.mcap                      what is in a bag, and what is missing for a full run
  bevviz bag drive.mcap --model yolo11n.onnx  run the pipeline over a bag, in the viewer
  bevviz bag drive.mcap --save drive.rrd      the same, saved to send with a bug report
  bevviz live --model yolo11n.onnx --serve    the same beside a running robot, in a browser
  bevviz snap                                 save what it saw in the last 30 seconds
  bevviz config --preset reference            every parameter, with its unit and meaning
"""

SELECTION = """A time is in seconds from the start of the bag (12.5), since 1970 (1700000000.0) or
ISO 8601 (2026-11-21T10:00:00)."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run bevviz. Returns the exit status: 0 done, 1 nothing made, 2 wrong input, 130 interrupted."""
    options = _parser().parse_args(arguments)
    run: Callable[[argparse.Namespace], int] = options.run
    try:
        return run(options)
    except UserError as error:
        print(f"bevviz: error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of our output has gone, as in `bevviz info bag | head`
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, PTH123
        return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bevviz",
        description="See what a LiDAR-camera perception pipeline saw, made and decided, in Rerun.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"bevviz {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    bag = commands.add_parser(
        "bag",
        help="run the pipeline over a recorded bag",
        description="Run the pipeline over a bag: MCAP, sqlite3 (.db3) or ROS 1 (.bag), compressed or not.",
        epilog=SELECTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    bag.add_argument(
        "paths", nargs="+", type=Path, metavar="PATH", help="bag file or folder; several are one drive"
    )
    choice = bag.add_argument_group("what to run")
    choice.add_argument("--start", metavar="TIME", help="skip what is before this time")
    choice.add_argument("--end", metavar="TIME", help="stop at this time")
    choice.add_argument("--every", type=_positive, default=1, metavar="N", help="run each N-th scan only")
    choice.add_argument("--frames", type=_slice, metavar="A:B", help="run scans A to B-1, counted from 0")
    choice.add_argument("--model", metavar="FILE.onnx", help="detector: YOLOv5, v8, v10, 11, 26 or YOLOX")
    _add_config(bag)
    _add_output(bag)
    bag.set_defaults(run=_bag)

    info = commands.add_parser(
        "info",
        help="what is in a bag, and what is missing for a full run",
        description="Topics, rates, gaps and frames of a bag, the role of each topic, and what is missing.",
    )
    info.add_argument("paths", nargs="*", type=Path, metavar="PATH", help="bag file or folder")
    info.add_argument("--live", action="store_true", help="a running robot's topics instead of a bag's")
    _add_config(info)
    _add_ros_args(info)
    info.set_defaults(run=_info)

    demo = commands.add_parser(
        "demo",
        help="a synthetic drive through the whole pipeline",
        description="Simulate a drive past cars, pedestrians and cyclists, and run the pipeline on it.",
    )
    demo.add_argument(
        "--frames", type=_positive, default=100, metavar="N", help="scans, at 10 Hz (default: 100)"
    )
    demo.add_argument("--seed", type=int, default=0, help="another seed is another street (default: 0)")
    demo.add_argument(
        "--bag",
        type=Path,
        metavar="FILE.mcap",
        help="write the drive as a ROS 2 bag instead of running on it",
    )
    _add_config(demo)
    _add_output(demo)
    demo.set_defaults(run=_demo)

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
    choice.add_argument("--every", metavar="N", help="run each N-th scan only")
    choice.add_argument("--max-rate", metavar="HZ", help="frames a second at most")
    choice.add_argument("--points", metavar="N", help="points kept of each scan")
    choice.add_argument("--nice", metavar="0..19", help="priority given up to other processes")
    choice.add_argument(
        "--synthetic",
        nargs="?",
        type=_positive,
        const=30,
        metavar="N",
        help="instead of a robot N scans of the synthetic drive, forth and back (default: 30)",
    )
    _add_config(live)
    output = _add_output(live, blueprint="live")
    output.add_argument(
        "--split", type=_split, metavar="SIZE|TIME", help="--save in parts, e.g. 500MB or 10min"
    )
    output.add_argument(
        "--bind", default="127.0.0.1", metavar="ADDRESS", help="--serve at this address (0.0.0.0: at all)"
    )
    output.add_argument(
        "--flight", metavar="TIME", help="what the flight recorder holds (default: 30 s), for 'bevviz snap'"
    )
    _add_ros_args(live)
    live.set_defaults(run=_live)

    snap = commands.add_parser(
        "snap",
        help="save the last seconds of a running 'bevviz live'",
        description="Have a running 'bevviz live' save its flight recorder. SIGUSR1 does the same.",
    )
    snap.add_argument("path", nargs="?", type=Path, metavar="FILE.rrd", help="default: named by the time")
    snap.add_argument("--pid", type=int, metavar="PID", help="which process, where several run")
    snap.set_defaults(run=_snap)

    config = commands.add_parser(
        "config",
        help="print the effective configuration",
        description="Print every parameter with its unit and meaning, as YAML that --config reads back.",
    )
    _add_config(config)
    config.set_defaults(run=_config)
    return parser


def _add_config(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("configuration")
    group.add_argument(
        "--preset", choices=("default", "reference"), help="reference: as the ROS 2 tutorial pipeline"
    )
    group.add_argument("--config", type=Path, metavar="FILE", help="YAML, as 'bevviz config' prints it")
    group.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="one parameter, e.g. clustering.eps='60 cm'",
    )


def _add_output(parser: argparse.ArgumentParser, blueprint: str = "debug") -> argparse._ArgumentGroup:
    group = parser.add_argument_group(
        "output", "The viewer, where there is a display. Several can be given at once."
    )
    group.add_argument("--save", type=Path, metavar="FILE.rrd", help="save the recording, blueprint included")
    group.add_argument(
        "--serve",
        nargs="?",
        type=_port,
        const=9090,
        metavar="PORT",
        help="web viewer on this machine (default: 9090)",
    )
    group.add_argument(
        "--connect", metavar="URL", help="a viewer elsewhere, e.g. rerun+http://laptop:9876/proxy"
    )
    group.add_argument("--viewer", action="store_true", help="open the viewer, beside the other outputs")
    group.add_argument(
        "--blueprint",
        default=blueprint,
        metavar="NAME|FILE",
        help=f"layout: debug, live, bug_report, a .py or a .rbl (default: {blueprint})",
    )
    return group


def _add_ros_args(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--ros-args",
        nargs=argparse.REMAINDER,
        default=[],
        metavar="...",
        help="the rest is for ROS: remaps, namespace, parameters",
    )


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is no whole number of 1 or more")
    return int(text)


def _port(text: str) -> int:
    if not text.isdecimal() or not 0 < int(text) < 65535:
        raise argparse.ArgumentTypeError(f"'{text}' is no port (1 to 65534)")
    return int(text)


def _split(text: str) -> str:
    """The setting that is meant."""
    return f"live.split_{'size' if text.strip().endswith('B') else 'time'}={text}"


def _slice(text: str) -> tuple[int | None, int | None]:
    first, colon, last = text.partition(":")
    if not colon or not all(part == "" or part.isdecimal() for part in (first, last)):
        raise argparse.ArgumentTypeError(f"'{text}' is not A:B, for example 100:200, 100: or :50")
    return (int(first) if first else None, int(last) if last else None)


# --- commands ----------------------------------------------------------------------------------


def _bag(options: argparse.Namespace) -> int:
    from bevviz.sources.bag import BagSource

    settings = [f"detector.model={options.model}"] if options.model else []
    config = _load_config(options, settings)
    with BagSource(
        options.paths,
        config,
        start=options.start,
        end=options.end,
        every=options.every,
        frames=options.frames,
    ) as source:
        return _process(source, config, options, Path(options.paths[0].stem + ".rrd"))


def _info(options: argparse.Namespace) -> int:
    from bevviz.sources.info import describe, render

    if options.live:
        from bevviz.ros import info

        print(info.render(info.describe(_load_config(options), options.ros_args)))
        return 0
    if not options.paths:
        raise UserError("bevviz info: which bag? Give its path, or --live for a running robot")
    print(render(describe(options.paths, _load_config(options))))
    return 0


def _demo(options: argparse.Namespace) -> int:
    from bevviz.config import load
    from bevviz.sources.synthetic import SyntheticSource, write_bag

    source = SyntheticSource(frames=options.frames, seed=options.seed)
    if options.bag is not None:
        from tqdm import tqdm

        write_bag(
            source, options.bag, tqdm(source, total=source.total, unit="scan", desc="simulate", disable=None)
        )
        print(f"{options.bag}: {source.total} scans; 'bevviz bag {options.bag} --model demo' runs on it")
        return 0
    config = _load_config(options)
    if not config.detector.model:
        # The configuration is frozen: the demo's own network is one more setting under the user's.
        config = load(options.config, ["detector.model=demo", *options.set], options.preset)
    return _process(source, config, options, Path("demo.rrd"))


def _live(options: argparse.Namespace) -> int:
    # What Rerun would warn of is meant: files are indexed when they are complete.
    os.environ.setdefault("RUST_LOG", "warn,re_log_encoding=error")
    from bevviz.live import Notes, Settings

    given = {
        "detector.model": options.model,
        "live.every": options.every,
        "live.max_rate": options.max_rate,
        "live.points": options.points,
        "live.nice": options.nice,
        "live.flight_time": options.flight,
    }
    more = [f"{key}={value}" for key, value in given.items() if value is not None]
    if options.split is not None:
        more.append(options.split)
    settings = Settings(options.config, [*options.set, *more], options.preset)
    notes = Notes(_say)
    with _terminable():
        if options.synthetic:
            return _watch(_replay(options.synthetic), settings, options, notes)
        from bevviz.sources.live import LiveSource

        with LiveSource(settings.config, arguments=options.ros_args, tell=notes.info) as source:
            return _watch_robot(source, settings, options, notes)


def _watch_robot(source: LiveSource, settings: Settings, options: argparse.Namespace, notes: Notes) -> int:
    """Publish back and take orders, as far as that is asked for."""
    from bevviz.ros.orders import Orders
    from bevviz.ros.publish import Publisher

    said = ""
    with suppress(KeyboardInterrupt):
        while not source.wait(1.0):
            if source.missing != said:
                said = source.missing
                _say(f"waiting: {said}")
    if not source.wait(0):
        return 1
    publisher = Publisher(source.node, settings.config, notes.warn) if options.publish else None

    def follow(live: Live) -> Callable[[Config], None]:
        orders = Orders(source.node, live.config, live.update, live.save)

        def show(config: Config) -> None:
            orders.show(config)
            if publisher is not None:
                publisher.configure(config)

        return show

    return _watch(source, settings, options, notes, publisher.publish if publisher else None, follow)


def _replay(frames: int) -> Replay:
    from tqdm import tqdm

    from bevviz.sources.replay import Replay
    from bevviz.sources.synthetic import SyntheticSource

    source = SyntheticSource(frames=frames)
    drive = list(tqdm(source, total=source.total, unit="scan", desc="simulate", disable=None))
    return Replay(drive, source.scene)


def _watch(
    source: Source,
    settings: Settings,
    options: argparse.Namespace,
    notes: Notes,
    on_result: Callable[[FrameResult], None] | None = None,
    follow: Callable[[Live], Callable[[Config], None]] | None = None,
) -> int:
    """The live run, until the source ends or the user ends it."""
    from tqdm import tqdm

    from bevviz.live import Live, Outputs

    window = options.viewer
    unsaid = options.save is None and options.serve is None and options.connect is None and not window
    window = window or (unsaid and _has_display())
    connect = [options.connect] if options.connect else []
    outputs = Outputs(options.save, window, options.serve, options.bind, connect, options.blueprint)
    live = Live(source, settings, outputs, notes, observe=options.observe, on_result=on_result)
    if follow is not None:
        live.on_change = follow(live)
    for url in live.urls:
        _say(f"viewer at {url}")
    if unsaid and not window:
        _say("no display: 'bevviz snap' saves the last seconds, --serve shows them in a browser")
    with suppress(KeyboardInterrupt), tqdm(unit="frame", desc=source.scene.name, disable=None) as bar:

        def show(status: Status) -> None:
            bar.set_postfix_str(f"{1e3 * status.p50:.0f} ms, {sum(status.drops.values())} dropped", False)
            bar.update(status.frames - bar.n)

        live.run(show)
    for warning in source.warnings:
        _say(f"warning: {warning}")
    where = live.saver.paths if live.saver is not None else []
    target = f" in {where[0]}" + (f" and {len(where) - 1} more" if where[1:] else "") if where else ""
    _say(f"{live.frames} frames{target}, {sum(live.status.drops.values())} dropped")
    return 0 if live.frames else 1


def _snap(options: argparse.Namespace) -> int:
    from bevviz.live.control import snap

    print(snap(options.path, options.pid))
    return 0


def _config(options: argparse.Namespace) -> int:
    from bevviz.config import dump

    print(dump(_load_config(options)), end="")
    return 0


# --- what they share ---------------------------------------------------------------------------


def _load_config(options: argparse.Namespace, more: Sequence[str] = ()) -> Config:
    from bevviz.config import load

    return load(options.config, [*options.set, *more], options.preset)


def _process(source: Source, config: Config, options: argparse.Namespace, default: Path) -> int:
    """Run the pipeline over the source into every output that was asked for."""
    from tqdm import tqdm

    from bevviz.logging.logger import Logger
    from bevviz.logging.sinks import open_recording
    from bevviz.pipeline import Pipeline
    from bevviz.sources.prefetch import prefetch

    save, viewer = options.save, options.viewer
    unsaid = save is None and options.serve is None and options.connect is None and not viewer
    if unsaid and _has_display():
        viewer = True
    elif unsaid:
        save = default

    frames = 0
    interrupted = False
    with (
        Pipeline(config) as pipeline,
        open_recording(
            source.scene,
            config,
            save=save,
            serve=options.serve,
            connect=options.connect,
            spawn=viewer,
            blueprint=options.blueprint,
        ) as sinks,
    ):
        if unsaid and not viewer:
            _say(f"no display: saving {save} (--serve shows it in a browser)")
        for url in sinks.urls:
            _say(f"viewer at {url}")
        if source.scene.cameras and not config.detector.model:
            _say("no detector: give --model FILE.onnx to find objects in the images")
        logger = Logger(sinks.recording, config, source.scene)
        logger.log_static()
        try:
            with (
                _terminable(),
                tqdm(total=source.total, unit="frame", desc=source.scene.name, disable=None) as bar,
            ):
                for frame in prefetch(source, 2):
                    logger.log(pipeline.run(frame))
                    frames += 1
                    bar.update()
        except KeyboardInterrupt:
            interrupted = True
        for warning in source.warnings:
            _say(f"warning: {warning}")
        if options.serve is not None and frames and not interrupted:
            _say(f"{frames} frames; serving until Ctrl-C")
            sinks.recording.flush()
            _wait_for_interrupt()
    target = f" in {save}" if save is not None else ""
    if interrupted:
        _say(f"interrupted after {frames} frames; what was made until then is complete{target}")
        return 130
    _say(f"{frames} frames{target}")
    return 0 if frames else 1


def _say(line: str) -> None:
    print(f"bevviz: {line}", file=sys.stderr)


def _has_display() -> bool:
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM ends a run as Ctrl-C does: with a readable recording."""

    def interrupt(number: int, stack: object) -> NoReturn:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _wait_for_interrupt() -> None:
    with suppress(KeyboardInterrupt), _terminable():
        signal.pause()


if __name__ == "__main__":
    sys.exit(main())
