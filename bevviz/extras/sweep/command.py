"""Command ``bevviz sweep``: run one or two parameters over a range."""

from __future__ import annotations

from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from bevviz.cli.command import command, option
from bevviz.cli.options import ConfigOptions, DriveOptions, RangeOptions, TruthOptions, load_config, open_bag
from bevviz.cli.outputs import Outputs, json_option, print_hints, print_result, warn
from bevviz.cli.run import run_with_progress, table_status


@dataclass(frozen=True, kw_only=True)
class SweepOutputs(Outputs):
    """Outputs of ``sweep``."""

    json: Path | None = json_option()
    csv: Path | None = option("FILE", "the table, with each stage and class", file="written at the end")


@dataclass(frozen=True, kw_only=True)
class SweepOptions:
    """Options of ``sweep``."""

    drive: DriveOptions
    frames: RangeOptions
    truth: TruthOptions
    config: ConfigOptions
    output: SweepOutputs


@command(
    "sweep",
    help="a parameter over a range: counts, times, precision and recall",
    description="Run every value of one or two parameters on the same frames. --set takes ranges "
    "(clustering.eps=0.3:0.9:0.1) and lists (ground.method=polar,plane) besides plain values.",
    forms=("bevviz.extras.sweep.run:SweepResult",),
)
def _sweep(options: SweepOptions) -> int:
    from bevviz.checks import InputChecks
    from bevviz.config import flatten
    from bevviz.extras.sweep.log import layout, log_sweep
    from bevviz.extras.sweep.run import Sweep, combine, parse
    from bevviz.pipeline.session import common_frames

    parameters, constant = parse(options.config.set)
    unswept = replace(options, config=replace(options.config, set=tuple(constant)))
    configured = partial(load_config, unswept)
    configs = combine(parameters, configured)
    config = common_frames(configs.values())
    with open_bag(options.drive, options.frames, config) as source:
        sweep = Sweep(parameters, configs, options.truth.find(source))
        outputs = options.output
        with ExitStack() as stack:
            # The run may take long. Report an output that cannot be opened before it.
            opened = outputs.opened(source.scene, source.config, layout(sweep)) if outputs else nullcontext()
            sinks = stack.enter_context(opened)
            print_hints(source.scene, config)
            checks = InputChecks(source, config)
            end = run_with_progress(source, sweep, [checks])
            warn(checks.warnings)
            print_result(outputs.json, "sweep", sweep.result(), sweep.table)
            if outputs.csv is not None:
                sweep.write_csv(outputs.csv)
            if sinks is not None:
                values = flatten(configured().model_dump())
                present = {p.key: f"{values.get(p.key, '')}" for p in parameters}
                log_sweep(sinks.recording, sweep, source.scene.name, present)
                if not end.interrupted:
                    outputs.keep_serving(sinks)
    return table_status(end)
