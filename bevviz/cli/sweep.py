"""Command ``bevviz sweep``: run one or two parameters over a range."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from bevviz.cli.options import (
    Commands,
    add_bag,
    add_config,
    add_output,
    add_selection,
    add_truth,
    collect_settings,
    find_truth,
    load_config_from,
    open_bag,
)
from bevviz.cli.outputs import Outputs, add_json, print_hints, print_result, warn
from bevviz.cli.run import run_with_progress, table_status

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
    from bevviz.pipeline.session import common_frames
    from bevviz.sweep import Sweep, combine, parse
    from bevviz.sweep.log import layout, log_sweep

    parameters, options.set = parse(options.set)

    def configured(settings: list[str]) -> Config:
        return load_config_from(
            options, options.config, [*collect_settings(options), *settings], options.preset
        )

    configs = combine(parameters, configured)
    config = common_frames(configs.values())
    with open_bag(options, config) as source:
        sweep = Sweep(parameters, configs, find_truth(options, source))
        outputs = Outputs.of(options)._replace(blueprint=layout(sweep))
        with ExitStack() as stack:
            # The run may take long. Report an output that cannot be opened before it.
            sinks = stack.enter_context(outputs.opened(source.scene, source.config)) if outputs else None
            print_hints(source.scene, config)
            end = run_with_progress(source, sweep, [])
            warn(source.warnings)
            print_result(options, "sweep", sweep.as_tree(), sweep.table)
            if options.csv is not None:
                sweep.write_csv(options.csv)
            if sinks is not None:
                values = flatten(configured([]).model_dump())
                present = {p.key: f"{values.get(p.key, '')}" for p in parameters}
                log_sweep(sinks.recording, sweep, source.scene.name, present)
                if not end.interrupted:
                    outputs.keep_serving(sinks)
    return table_status(end)
