"""Command ``bevviz sweep``: run one or two parameters over a range."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from bevviz.cli.machine import add_json, json_on_stdout, write_json
from bevviz.cli.options import (
    Commands,
    add_bag,
    add_config,
    add_output,
    add_selection,
    add_truth,
    load_config_from,
    open_bag,
)
from bevviz.cli.outputs import Outputs, print_hints, say, warn
from bevviz.cli.run import run_with_progress

if TYPE_CHECKING:
    from bevviz.config import Config


def add(commands: Commands) -> None:
    """Add the command ``sweep``."""
    sweep = commands.add_parser(
        "sweep",
        help="a parameter over a range: counts, times, precision and recall",
        description="Run every value of one or two parameters on the same frames. --set takes ranges "
        "(clustering.eps=0.3:0.9:0.1) and lists (ground.method=polar,plane) besides plain values.",
    )
    group = add_bag(sweep)
    add_selection(group)
    add_truth(sweep)
    add_config(sweep)
    output = add_output(sweep, blueprint=None)
    add_json(output)
    output.add_argument("--csv", type=Path, metavar="FILE", help="the table, with each stage and class")
    sweep.set_defaults(run=_sweep)


def _sweep(options: argparse.Namespace) -> int:
    from bevviz.config import flatten
    from bevviz.evaluate import truth_source
    from bevviz.pipeline.variants import common_frames
    from bevviz.sweep import Sweep, combine, parse
    from bevviz.sweep.log import layout, log_sweep

    parameters, constant = parse(options.set)
    model = [f"detector.model={options.model}"] if options.model else []

    def configured(settings: list[str]) -> Config:
        return load_config_from(options, options.config, [*constant, *model, *settings], options.preset)

    configs = combine(parameters, configured)
    config = common_frames(configs.values())
    with open_bag(options, config) as source:
        truth = truth_source(source.roles, options.truth, options.kitti_labels, len(source.scans))
        sweep = Sweep(parameters, configs, truth)
        outputs = Outputs.of(options)._replace(blueprint=layout(sweep))
        with ExitStack() as stack:
            # The run may take long. Report an output that cannot be opened before it.
            sinks = stack.enter_context(outputs.opened(source.scene, source.config)) if outputs else None
            print_hints(source.scene, config)
            end = run_with_progress(source, sweep, [])
            warn(source.warnings)
            if not json_on_stdout(options):
                print(sweep.table())
            write_json(options, "sweep", sweep.as_tree())
            if options.csv is not None:
                sweep.write_csv(options.csv)
            if sinks is not None:
                values = flatten(configured([]).model_dump())
                present = {p.key: f"{values.get(p.key, '')}" for p in parameters}
                log_sweep(sinks.recording, sweep, source.scene.name, present)
                if not end.interrupted:
                    outputs.keep_serving(sinks)
    if end.interrupted:
        say(f"interrupted after {end.frames} frames; the table is of these")
        return 130
    return 0 if end.frames else 1
