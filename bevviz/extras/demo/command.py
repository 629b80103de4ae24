"""Command ``bevviz demo``: the synthetic drive."""

from __future__ import annotations

import argparse
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import bevviz
from bevviz.cli.options import Commands, add_config, add_keep, add_output, positive
from bevviz.cli.outputs import Outputs, say
from bevviz.cli.run import process
from bevviz.errors import UserError
from bevviz.support import progress
from bevviz.support.files import atomic_write, write_all

if TYPE_CHECKING:
    from bevviz.config import Config, Preset
    from bevviz.extras.demo.drive import SyntheticSource

FRAMES = 100
BAG = Path("demo.mcap")  # drive of the workbench
# The drive in the package, which sample.py made; the reference preset misses a child in it.
SHIPPED = Path(bevviz.__file__).parent / "data" / "demo.mcap"
SHIPPED_FRAMES = 16
SHIPPED_CHILD = 5  # frame in which the child is seen best
FURTHER = 10  # frames of a simulated drive after those in which its faults are seen best

# A test compares this text with bevviz.extras.demo.faults. Importing that module would slow down --help.
PLANTS = """faults to --plant:
  hidden_person   at 1 s: a person hidden behind a parked van: no point, no pixel
  flat_car        at 3 s: a car half a metre high, which the reference preset takes for ground
  merged_people   at 5 s: two people a hand's breadth apart: one cluster
  shared_box      at 7 s: a person beside a switch cabinet: the reference preset names both 'person'
  small_child     at 0.5 s: a small child at the roadside, whom the reference preset takes for ground
  turned_camera   always: the camera is stated 1 degree too far right
  shifted_camera  always: the camera is stated 5 cm too far right
  late_image      always: the stamps of the images are 40 ms late
'bevviz why' explains them: bevviz demo --plant flat_car -o flat.mcap, then
bevviz why flat.mcap --at 3 --class car --model demo --preset reference
'bevviz calib' finds the last three: bevviz demo --weave --plant late_image -o late.mcap"""


def add(commands: Commands) -> None:
    """Add the command ``demo``."""
    demo = commands.add_parser(
        "demo",
        help="a missed pedestrian in a synthetic drive, and why",
        description="Take a simulated drive past cars, pedestrians and cyclists, say why one of them is "
        "missed, and open the workbench on it. With an output: run the pipeline on the drive instead. The "
        "options of the simulator make another drive, with Open3D.",
    )
    demo.add_argument(
        "--frames", type=positive, metavar="N", help="simulate a drive of N scans at 10 Hz (default: 100)"
    )
    demo.add_argument("--seed", type=int, default=0, help="simulate another street (default: 0)")
    demo.add_argument(
        "--plant",
        action="append",
        default=[],
        metavar="NAME",
        help="simulate a fault that perception gets wrong, see below; several times for several",
    )
    demo.add_argument(
        "--weave",
        action="store_true",
        help="simulate a vehicle that swerves, as it should to calibrate sensors",
    )
    demo.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FILE.mcap",
        help="write the drive as a ROS 2 bag instead of running on it",
    )
    demo.formatter_class = argparse.RawDescriptionHelpFormatter
    demo.epilog = PLANTS
    add_config(demo)
    add_keep(add_output(demo))
    demo.set_defaults(run=_demo)


def _demo(options: argparse.Namespace) -> int:
    outputs = Outputs.of(options)
    if options.output is not None:
        frames = _make_bag(options, options.output)
        print(f"{options.output}: {frames} scans; 'bevviz bag {options.output} --model demo' runs on it")
        return 0
    if not outputs and find_spec("rerun_notebook") is not None:
        return _show_missed(options)
    from bevviz.drive import Drive

    config = _config(options, options.preset)
    if _is_simulated(options):
        return process(Drive(_simulated(options, FRAMES), config), outputs, Path("demo.rrd"))
    from bevviz.bags.source import BagSource

    with BagSource([SHIPPED], config) as source:
        return process(Drive(source, config), outputs, Path("demo.rrd"))


def _is_simulated(options: argparse.Namespace) -> bool:
    """Return whether a drive is asked for that does not ship with bevviz."""
    return bool(options.plant or options.frames or options.seed or options.weave)


def _config(options: argparse.Namespace, preset: Preset | None) -> Config:
    """Return the configuration. It ignores the project's sensors and network, to be the same everywhere."""
    from bevviz.config import Layer, load

    return load(options.config, options.set, preset, layers=[Layer("demo", {"detector.model": "demo"})])


def _simulated(options: argparse.Namespace, frames: int) -> SyntheticSource:
    """Return the simulated drive; ``frames`` is its length if none is stated."""
    from bevviz.extras.demo.drive import SyntheticSource

    return SyntheticSource(options.frames or frames, options.seed, plant=options.plant, weave=options.weave)


def _make_bag(options: argparse.Namespace, path: Path, frames: int = FRAMES) -> int:
    """Copy the shipped drive, or simulate one of ``frames`` scans. Return the number of its scans."""
    if not _is_simulated(options):
        if path.suffix != ".mcap":
            raise UserError(f"{path}: a bag is written as MCAP, so its name must end in .mcap")
        if path.exists():
            raise UserError(f"{path} exists already; remove it or give another name")
        with atomic_write(path, "drive") as unfinished:
            write_all(unfinished.handle, SHIPPED.read_bytes())
        return SHIPPED_FRAMES
    from bevviz.extras.demo.bag import write_bag

    source = _simulated(options, frames)
    write_bag(source, path, progress.bar(source, total=source.total, unit="scan", desc="simulate"))
    return source.total


def _show_missed(options: argparse.Namespace) -> int:
    """Say why the nearest missed object is missed, and open the workbench on it."""
    from bevviz.bags.source import BagSource
    from bevviz.cli.workbench import open_page
    from bevviz.pipeline.session import Session
    from bevviz.why import FrameExplainer

    config = _config(options, options.preset or (None if options.config else "reference"))
    number = _frame_of_interest(options)
    if BAG.exists() and not _is_simulated(options):
        say(f"{BAG} is there already and is opened again; remove it for a new one")
    else:
        _make_bag(options, BAG, number + FURTHER)
    with BagSource([BAG], config) as source:
        frame = source.frame(min(number, len(source.scans) - 1))
        if frame is None:
            raise UserError(f"{BAG}: scan {number} cannot be read; remove the file for a new one")
        session = Session(config)
        explainer = FrameExplainer(session.run_explained(frame), session.loader, session.stages.class_names)
        missed = explainer.missed()
        where = {"bag": source.recording.name, "at": str(frame.stamp)}
    for answer in missed[:1]:
        print(f"{number / 10:.1f} s into {BAG}: {explainer.with_hints(answer).text}", flush=True)
        where["pick"] = str(answer.selection)
    page = argparse.Namespace(**vars(options), paths=[BAG], at=None, at_frame=number, port=None, browser=True)
    page.truth = page.kitti_labels = None
    return open_page(page, config, where)


def _frame_of_interest(options: argparse.Namespace) -> int:
    """Return the frame in which the first planted fault is seen best."""
    if not _is_simulated(options):
        return SHIPPED_CHILD
    from bevviz.extras.demo.faults import FAULTS

    return next((round(10 * FAULTS[name].time) for name in options.plant if name in FAULTS), 0)
