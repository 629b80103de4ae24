"""Command ``bevviz demo``: the synthetic drive."""

from __future__ import annotations

import argparse
from pathlib import Path

from bevviz.cli.options import Commands, add_config, add_keep, add_output, positive
from bevviz.cli.outputs import Outputs
from bevviz.cli.run import process
from bevviz.support import progress

# A test compares this text with bevviz.synthetic.faults. Importing that module would slow down --help.
PLANTS = """faults to --plant:
  hidden_person   at 1 s: a person hidden behind a parked van: no point, no pixel
  flat_car        at 3 s: a car half a metre high, which the reference preset takes for ground
  merged_people   at 5 s: two people a hand's breadth apart: one cluster
  shared_box      at 7 s: a person beside a switch cabinet: the reference preset names both 'person'
  turned_camera   always: the camera is stated 1 degree too far right
  shifted_camera  always: the camera is stated 5 cm too far right
  late_image      always: the stamps of the images are 40 ms late
'bevviz why' explains them: bevviz demo --plant flat_car --bag flat.mcap, then
bevviz why flat.mcap --at 3 --class car --model demo --preset reference
'bevviz calib' finds the last three: bevviz demo --weave --plant late_image --bag late.mcap"""


def add(commands: Commands) -> None:
    """Add the command ``demo``."""
    demo = commands.add_parser(
        "demo",
        help="a synthetic drive through the whole pipeline",
        description="Simulate a drive past cars, pedestrians and cyclists, and run the pipeline on it.",
    )
    demo.add_argument(
        "--frames", type=positive, default=100, metavar="N", help="scans, at 10 Hz (default: 100)"
    )
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
        "--bag",
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
    from bevviz.config import Layer, load
    from bevviz.drive import Drive
    from bevviz.synthetic import SyntheticSource, write_bag

    source = SyntheticSource(options.frames, options.seed, plant=options.plant, weave=options.weave)
    if options.bag is not None:
        write_bag(source, options.bag, progress.bar(source, total=source.total, unit="scan", desc="simulate"))
        print(f"{options.bag}: {source.total} scans; 'bevviz bag {options.bag} --model demo' runs on it")
        return 0
    # The demo ignores the project's sensors and network, so that it is the same everywhere.
    config = load(
        options.config, options.set, options.preset, layers=[Layer("demo", {"detector.model": "demo"})]
    )
    return process(Drive(source, config), Outputs.of(options), Path("demo.rrd"))
