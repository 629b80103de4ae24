"""``bevviz tune``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from bevviz.cli.interrupts import terminable
from bevviz.cli.options import Commands, add_bag, add_config, add_output
from bevviz.cli.run import has_display, hint, outputs, say
from bevviz.errors import UserError

if TYPE_CHECKING:
    from bevviz.frame import Frame, Scene
    from bevviz.live.settings import Settings
    from bevviz.tune import Tuner

LOOK = 0.01  # seconds between two looks at the file


def add(commands: Commands) -> None:
    tune = commands.add_parser(
        "tune",
        help="watch a configuration: one frame, run anew at each save",
        description="Run one frame again whenever the configuration's file is saved, and show what that "
        "changed. A file that is not there is made, with every parameter and its meaning.",
    )
    group = add_bag(tune)
    group.add_argument("--at", metavar="TIME", help="the scan nearest to this time (default: the first)")
    add_config(tune)
    tune.set_defaults(config=Path("bevviz.yaml"))
    add_output(tune, blueprint="tune")
    tune.set_defaults(run=_tune)


def _tune(options: argparse.Namespace) -> int:
    from bevviz.config import dump, load
    from bevviz.live.settings import Settings
    from bevviz.logging.sinks import free_port
    from bevviz.tune import Tuner, create

    model = [f"detector.model={options.model}"] if options.model else []
    if not options.config.exists() and create(
        options.config, dump(load(None, [*options.set, *model], options.preset))
    ):
        say(f"{options.config}: made, with every parameter")
    settings = Settings(options.config, [*options.set, *model], options.preset)
    frame, scene, warnings = _frame(options, settings)
    viewer, serve = options.viewer, options.serve
    if options.save is None and serve is None and options.connect is None and not viewer:
        viewer = has_display()
        serve = None if viewer else free_port(9090)
    with outputs(scene, settings.config, options, serve=serve, spawn=viewer) as sinks:
        hint(scene, settings.config)
        for warning in warnings:
            say(f"warning: {warning}")
        _watch(options.config, Tuner(frame, settings, sinks.recording, scene))
    return 0


def _frame(options: argparse.Namespace, settings: Settings) -> tuple[Frame, Scene, Sequence[str]]:
    """The frame, decoded once, with the sensors' names and what is to be said of the bag."""
    from bevviz.bags.source import BagSource

    at = {"at": options.at} if options.at is not None else {"frames": (0, 1)}
    with BagSource(options.paths, settings.config, **at) as source:
        for frame in source:
            return frame, source.scene, source.warnings
        raise UserError(f"{source.scene.name}: the scan cannot be used: {'; '.join(source.warnings)}")


def _watch(file: Path, tuner: Tuner) -> None:
    """Run each save until Ctrl-C."""
    print(tuner.last.text, flush=True)
    say(f"save {file} to run it again; Ctrl-C ends")
    with suppress(KeyboardInterrupt), terminable() as ended:
        while not ended.wait(LOOK):
            try:
                version = tuner.poll()
            except UserError as error:
                say(f"not taken: {error}")
                continue
            if version is not None:
                print(f"{version.text} ({version.seconds * 1e3:.0f} ms after the save)", flush=True)
    last = tuner.last
    say(f"ended at version {last.number}")
