"""``bevviz demo``."""

from __future__ import annotations

import argparse
from pathlib import Path

from bevviz.cli.options import Commands, add_config, add_output, load_config, positive
from bevviz.cli.run import process


def add(commands: Commands) -> None:
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
        "--bag",
        type=Path,
        metavar="FILE.mcap",
        help="write the drive as a ROS 2 bag instead of running on it",
    )
    add_config(demo)
    add_output(demo)
    demo.set_defaults(run=_demo)


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
    config = load_config(options)
    if not config.detector.model:
        # The configuration is frozen: the demo's own network is one more setting under the user's.
        config = load(options.config, ["detector.model=demo", *options.set], options.preset)
    return process(source, config, options, Path("demo.rrd"))
