"""Command ``bevviz calib``: check the camera's mounting and stamps."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bevviz.cli.options import Commands, add_bag, add_config, add_output, add_selection, load_config, open_bag
from bevviz.cli.outputs import Outputs, add_json, print_result, say, warn
from bevviz.support import progress

if TYPE_CHECKING:
    from bevviz.calib import Calibration, Shots
    from bevviz.config import Config
    from bevviz.model.frame import Scene
    from bevviz.model.json_forms import CalibForm

FRAMES = 30  # Number of frames to use without --every.


def add(commands: Commands) -> None:
    """Add the command ``calib``."""
    calib = commands.add_parser(
        "calib",
        help="is it the calibration or the clock?",
        description="Compare the edges of clouds and images: how wrong are the camera's mounting and stamps?",
    )
    group = add_bag(calib, detector=False)
    add_selection(group)
    calib.set_defaults(every=None)
    group.add_argument("--camera", metavar="NAME", help="only this camera, as 'bevviz info' names it")
    add_config(calib)
    output = add_output(calib, blueprint="calib")
    output.add_argument("--write", type=Path, metavar="FILE.yaml", help="write the corrected configuration")
    add_json(output)
    calib.set_defaults(run=_calib)


def _calib(options: argparse.Namespace) -> int:

    from bevviz.calib import calibrate, gather
    from bevviz.errors import UserError

    config = load_config(options)
    if options.write is not None and options.write.suffix not in (".yaml", ".yml"):
        raise UserError(f"--write {options.write}: expected a file name that ends in .yaml")
    every = options.every
    options.every = every or 1
    with open_bag(options, config) as source:
        scene, total = source.scene, source.total
        names = _cameras(scene, options.camera, source.roles.no_camera)
    options.every = every or max(1, total // FRAMES)
    with open_bag(options, config) as source:
        bar = progress.bar(source, total=source.total, unit="frame", desc="find edges")
        shots = gather(bar, names, source.pose)
        warn(source.warnings)
    results = []
    for name in names:
        bar_format = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}{postfix}"
        with progress.bar(total=100, desc=f"align {name}", bar_format=bar_format) as steps:

            def show(share: float, step: str, steps: Any = steps) -> None:
                steps.set_postfix_str(step, refresh=False)
                steps.update(round(100 * share) - steps.n)

            results.append(calibrate(shots[name], show, config.sync.offsets))
    tree: CalibForm = {"cameras": [result.to_dict() for result in results]}
    print_result(options, "calib", tree, lambda: "\n".join(map(_text, results)))
    if options.write is not None:
        _write(results, options.write)
    _log(results, shots, scene, config, options)
    return 0


def _cameras(scene: Scene, requested: str | None, reason: str) -> tuple[str, ...]:
    from bevviz.errors import UserError

    if not scene.cameras:
        raise UserError(f"{scene.name}: no camera to calibrate ({reason})")
    if requested is None:
        return scene.cameras
    if requested not in scene.cameras:
        raise UserError(
            f"--camera {requested}: there is no such camera; there are {', '.join(scene.cameras)}"
        )
    return (requested,)


def _text(result: Calibration) -> str:
    """Return the result of one camera for the terminal."""
    measured = f"{result.measured_from}; an interval is two standard deviations to either side"
    lines = [result.answer, f"\n{result.table()}\n", measured, *result.notes]
    if result.moved:
        lines.append(f"\nWith that put right, for --config:\n\n{result.config}")
    return "\n".join(lines)


def _write(results: list[Calibration], path: Path) -> None:
    from bevviz.calib.result import correction_yaml
    from bevviz.support.files import save_text

    save_text(path, correction_yaml(results), "--write")
    say(f"configuration in {path}{'' if any(r.moved for r in results) else ': all as it is stated'}")


def _log(
    results: list[Calibration],
    shots: dict[str, Shots],
    scene: Scene,
    config: Config,
    options: argparse.Namespace,
) -> None:
    """Log the results to the requested outputs, or to the viewer if there is a display."""
    from bevviz.calib.log import log_calibration

    outputs = Outputs.of(options).or_viewer()
    if not outputs:
        say("no display: --save FILE.rrd keeps the pictures and curves, --serve shows them in a browser")
        return
    with outputs.opened(scene, config) as sinks:
        for result in results:
            log_calibration(sinks.recording, result, shots[result.camera].shots, config.logging)
        if outputs.save is not None:
            say(f"pictures and curves in {outputs.save}")
        outputs.keep_serving(sinks)
