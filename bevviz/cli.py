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
    from bevviz.sources import Source

EPILOG = """examples:
  bevviz demo                                 the synthetic drive, in the viewer
  bevviz info drive.mcap                      what is in a bag, and what is missing for a full run
  bevviz bag drive.mcap --model yolo11n.onnx  run the pipeline over a bag, in the viewer
  bevviz bag drive.mcap --save drive.rrd      the same, saved to send with a bug report
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
    info.add_argument("paths", nargs="+", type=Path, metavar="PATH", help="bag file or folder")
    _add_config(info)
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


def _add_output(parser: argparse.ArgumentParser) -> None:
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
        default="debug",
        metavar="NAME|FILE",
        help="layout: debug, live, bug_report, a .py or a .rbl",
    )


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is no whole number of 1 or more")
    return int(text)


def _port(text: str) -> int:
    if not text.isdecimal() or not 0 < int(text) < 65535:
        raise argparse.ArgumentTypeError(f"'{text}' is no port (1 to 65534)")
    return int(text)


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
