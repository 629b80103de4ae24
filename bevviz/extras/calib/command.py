"""Command ``bevviz calib``: check the camera's mounting and stamps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bevviz.cli.command import command, option
from bevviz.cli.options import ConfigOptions, RangeOptions, SensorOptions, load_config, open_bag
from bevviz.cli.outputs import Outputs, json_option, layout_option, print_result, say, warn
from bevviz.cli.values import positive
from bevviz.support import progress

if TYPE_CHECKING:
    from bevviz.config import Config
    from bevviz.extras.calib.result import Calibration
    from bevviz.extras.calib.score import Pose, Shots
    from bevviz.model.frame import Frame, Scene

FRAMES = 30  # Number of frames to use without --every.


@dataclass(frozen=True, kw_only=True)
class CalibFrames(RangeOptions):
    """Options that select the frames and the camera."""

    every: int = option("N", "run each N-th scan only", parse=positive, default=0)  # for FRAMES of them
    camera: str | None = option("NAME", "only this camera, as 'bevviz info' names it")


@dataclass(frozen=True, kw_only=True)
class CalibOutputs(Outputs):
    """Outputs of ``calib``."""

    blueprint: str = layout_option("calib")
    write: Path | None = option("FILE.yaml", "write the corrected configuration", file="written at the end")
    json: Path | None = json_option()


@dataclass(frozen=True, kw_only=True)
class CalibOptions:
    """Options of ``calib``."""

    drive: SensorOptions
    frames: CalibFrames
    config: ConfigOptions
    output: CalibOutputs


@command(
    "calib",
    help="is it the calibration or the clock?",
    description="Compare the edges of clouds and images: how wrong are the camera's mounting and stamps?",
    forms=("bevviz.extras.calib.result:CalibrationResults",),
)
def _calib(options: CalibOptions) -> int:
    from bevviz.checks import InputChecks
    from bevviz.errors import UserError
    from bevviz.extras.calib.result import CalibrationResults

    config = load_config(options)
    output = options.output
    if output.write is not None and output.write.suffix not in (".yaml", ".yml"):
        raise UserError(f"--write {output.write}: expected a file name that ends in .yaml")
    frames = replace(options.frames, every=options.frames.every or 1)
    with open_bag(options.drive, frames, config) as source:
        scene, total = source.scene, source.total
        names = _cameras(scene, frames.camera, source.roles.no_camera)
    if not options.frames.every:
        frames = replace(frames, every=max(1, total // FRAMES))
    with open_bag(options.drive, frames, config) as source:
        checks = InputChecks(source, config)

        def watched() -> Iterator[Frame]:
            yield from checks.watched(source)
            warn(checks.warnings)

        results, shots = calibrate_cameras(watched(), source.total, names, source.pose, config.sync.offsets)
    tree = CalibrationResults([result.result() for result in results])
    print_result(output.json, "calib", tree, lambda: "\n".join(map(_text, results)))
    if output.write is not None:
        _write(results, output.write)
    _log(results, shots, scene, config, output.or_viewer())
    return 0


def calibrate_cameras(
    frames: Iterable[Frame],
    total: int | None,
    cameras: Sequence[str],
    pose: Pose,
    offsets: Mapping[str, float],
) -> tuple[list[Calibration], dict[str, Shots]]:
    """Calibrate each camera, with bars of progress. Return the results, and the shots of each camera.

    Args:
        frames: frames in order of stamp.
        total: number of frames. None: it is not known.
        cameras: names of the cameras.
        pose: see ``gather``.
        offsets: stated offsets of the clocks.
    """
    from bevviz.extras.calib.score import gather
    from bevviz.extras.calib.solve import calibrate

    bar = progress.bar(frames, total=total, unit="frame", desc="find edges")
    shots, results = gather(bar, cameras, pose), []
    for name in cameras:
        bar_format = "{desc}: {percentage:3.0f}%|{bar}| {elapsed}{postfix}"
        with progress.bar(total=100, desc=f"align {name}", bar_format=bar_format) as steps:

            def show(share: float, step: str, steps: Any = steps) -> None:
                steps.set_postfix_str(step, refresh=False)
                steps.update(round(100 * share) - steps.n)

            results.append(calibrate(shots[name], show, offsets))
    return results, shots


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
    from bevviz.extras.calib.result import correction_yaml
    from bevviz.support.files import save_text

    save_text(path, correction_yaml(results), "--write")
    say(f"configuration in {path}{'' if any(r.moved for r in results) else ': all as it is stated'}")


def _log(
    results: list[Calibration], shots: dict[str, Shots], scene: Scene, config: Config, outputs: Outputs
) -> None:
    """Log the results to the requested outputs, or to the viewer if there is a display."""
    from bevviz.extras.calib.log import log_calibration

    if not outputs:
        say("no display: --save FILE.rrd keeps the pictures and curves, --serve shows them in a browser")
        return
    with outputs.opened(scene, config) as sinks:
        for result in results:
            log_calibration(sinks.recording, result, shots[result.camera].shots, config.logging)
        if outputs.save is not None:
            say(f"pictures and curves in {outputs.save}")
        outputs.keep_serving(sinks)
