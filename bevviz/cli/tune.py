"""Command ``bevviz tune``: run a frame again at each save of the configuration."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bevviz.cli.interrupts import interruptible
from bevviz.cli.options import (
    Commands,
    add_at,
    add_bag,
    add_config,
    add_output,
    collect_settings,
    load_config_from,
    project_layers,
)
from bevviz.cli.outputs import Outputs, print_hints, say, warn
from bevviz.errors import UserError

if TYPE_CHECKING:
    from bevviz.config import Layer
    from bevviz.config.reloading import ReloadableConfig
    from bevviz.model.frame import Frame, Scene


def add(commands: Commands) -> None:
    """Add the command ``tune``."""
    tune = commands.add_parser(
        "tune",
        help="watch a configuration: one frame, run anew at each save",
        description="Run one frame again whenever the configuration's file is saved, and show what that "
        "changed. A file that is not there is made, with every parameter and its meaning.",
    )
    group = add_bag(tune)
    add_at(group, "the scan nearest to this time (default: the first)")
    add_config(tune)
    tune.set_defaults(config=Path("bevviz.yaml"))
    add_output(tune, blueprint="tune")
    tune.set_defaults(run=_tune)


def _tune(options: argparse.Namespace) -> int:
    from bevviz.config import config_yaml, load
    from bevviz.config.reloading import ReloadableConfig
    from bevviz.pipeline.run import DropPolicy, run
    from bevviz.recording.ports import free_port
    from bevviz.sweep.tune import ConfigSaves, FrameTuner, Version, VersionRecorder, create_config_file

    option_settings = collect_settings(options)
    recorded_layers: list[Layer] = []
    if not options.config.exists() and create_config_file(
        options.config, config_yaml(load_config_from(options, None, option_settings, options.preset))
    ):
        say(f"{options.config}: made, with every parameter")
    elif (recorded := getattr(options, "recorded", None)) is not None:
        say(f"{options.config}: is there already, and taken instead of the recording's configuration")
        recorded_layers = [recorded.missing(load(options.config, option_settings, options.preset))]
    settings = ReloadableConfig(
        options.config, [*recorded_layers, *option_settings], options.preset, project_layers(options)
    )
    frame, scene, warnings = _frame(options, settings)
    outputs = Outputs.of(options).or_viewer()
    if not outputs:
        outputs = outputs._replace(serve=free_port(9090))
    processor = FrameTuner(frame)
    processor.check(settings.config)
    last = 0

    def print_version(version: Version, seconds: float) -> None:
        nonlocal last
        last = version.number
        after = f" ({seconds * 1e3:.0f} ms after the save)" if version.number else ""
        print(f"{version.text}{after}", flush=True)
        if not version.number:
            say(f"save {options.config} to run it again; Ctrl-C ends")

    with outputs.opened(scene, settings.config) as sinks:
        print_hints(scene, settings.config)
        warn(warnings)
        saves = ConfigSaves(settings, scene, processor.check, lambda error: say(f"not taken: {error}"))
        recorder = VersionRecorder(sinks.recording, settings.config, print_version)
        with interruptible() as ended:
            run(saves, processor, [recorder], dropping=DropPolicy(), stop=ended)
    say(f"ended at version {last}")
    return 0


def _frame(options: argparse.Namespace, settings: ReloadableConfig) -> tuple[Frame, Scene, Sequence[str]]:
    """Return the decoded frame, the sensors' names, and the warnings about the bag."""
    from bevviz.bags.source import BagSource

    with BagSource(options.paths, settings.config, at=options.at) as source:
        frame = source.frame(options.at_frame or 0) if options.at is None else next(iter(source), None)
        if frame is not None:
            return frame, source.scene, source.warnings
        raise UserError(f"{source.scene.name}: the scan cannot be used: {'; '.join(source.warnings)}")
