"""Command ``bevviz demo``: the synthetic drive."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from bevviz.cli.options import Commands, add_config, add_keep, add_output, positive
from bevviz.cli.outputs import Outputs, say
from bevviz.cli.run import process
from bevviz.errors import UserError
from bevviz.support import progress

if TYPE_CHECKING:
    from bevviz.config import Config, Preset

FRAMES = 100
BAG = Path("demo.mcap")  # drive of the workbench
PLANT = "small_child"  # fault of that drive; the reference preset misses it
FURTHER = 10  # frames after those in which the faults are seen best

# A test compares this text with bevviz.synthetic.faults. Importing that module would slow down --help.
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
        description="Simulate a drive past cars, pedestrians and cyclists, say why one of them is missed, "
        "and open the workbench on it. With an output: run the pipeline on the drive instead.",
    )
    demo.add_argument("--frames", type=positive, metavar="N", help="scans at 10 Hz (default: 100, or 15)")
    demo.add_argument("--seed", type=int, default=0, help="another seed is another street (default: 0)")
    demo.add_argument(
        "--plant",
        action="append",
        default=[],
        metavar="NAME",
        help="plant a fault that perception gets wrong, see below; several times for several",
    )
    demo.add_argument(
        "--weave", action="store_true", help="swerve, brake and speed up, as a drive to calibrate with should"
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
    outputs, frames = Outputs.of(options), options.frames or FRAMES
    if options.output is not None:
        _write(options, options.plant, frames, options.output)
        print(f"{options.output}: {frames} scans; 'bevviz bag {options.output} --model demo' runs on it")
        return 0
    if not outputs and find_spec("rerun_notebook") is not None:
        return _show_missed(options)
    from bevviz.drive import Drive
    from bevviz.synthetic import SyntheticSource

    source = SyntheticSource(frames, options.seed, plant=options.plant, weave=options.weave)
    return process(Drive(source, _config(options, options.preset)), outputs, Path("demo.rrd"))


def _config(options: argparse.Namespace, preset: Preset | None) -> Config:
    """Return the configuration. It ignores the project's sensors and network, to be the same everywhere."""
    from bevviz.config import Layer, load

    return load(options.config, options.set, preset, layers=[Layer("demo", {"detector.model": "demo"})])


def _write(options: argparse.Namespace, plants: Sequence[str], frames: int, path: Path) -> None:
    """Write the drive as a bag."""
    from bevviz.synthetic import SyntheticSource, write_bag

    source = SyntheticSource(frames, options.seed, plant=plants, weave=options.weave)
    write_bag(source, path, progress.bar(source, total=source.total, unit="scan", desc="simulate"))


def _show_missed(options: argparse.Namespace) -> int:
    """Say why the nearest missed object is missed, and open the workbench on it."""
    from bevviz.bags.source import BagSource
    from bevviz.cli.workbench import open_page
    from bevviz.pipeline.session import Session
    from bevviz.synthetic.faults import FAULTS
    from bevviz.why import FrameExplainer

    plants = options.plant or [PLANT]
    seen = [round(10 * FAULTS[name].time) for name in plants if name in FAULTS] or [0]
    config = _config(options, options.preset or (None if options.config else "reference"))
    if BAG.exists() and not (options.plant or options.frames or options.seed or options.weave):
        say(f"{BAG} is there already and is opened again; remove it for a new one")
    else:
        _write(options, plants, options.frames or max(seen) + FURTHER, BAG)
    with BagSource([BAG], config) as source:
        number = min(seen[0], len(source.scans) - 1)
        frame = source.frame(number)
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
