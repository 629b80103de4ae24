"""Command ``bevviz demo``: the synthetic drive."""

from __future__ import annotations

import filecmp
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import bevviz
from bevviz.cli.bag import BagOutputs
from bevviz.cli.command import command, flag, option
from bevviz.cli.options import ConfigOptions, DriveOptions, TruthOptions
from bevviz.cli.outputs import say
from bevviz.cli.run import process
from bevviz.cli.values import positive
from bevviz.errors import UserError
from bevviz.support import progress
from bevviz.support.files import atomic_write, write_all

if TYPE_CHECKING:
    from bevviz.config import Config, Preset
    from bevviz.extras.demo.drive import SyntheticSource
    from bevviz.why import FrameExplainer

FRAMES = 100
BAG = Path("demo.mcap")  # drive of the workbench
# The drive in the package, which sample.py made; the reference preset misses a child in it.
SHIPPED = Path(bevviz.__file__).parent / "data" / "demo.mcap"
SHIPPED_FRAMES = 16
SHIPPED_CHILD = 5  # frame in which the child is seen best
SHIPPED_MISSED = {"at": "1750000000500000000", "pick": "truth//98"}  # stamp of that frame, and the child
FURTHER = 10  # frames of a simulated drive after those in which its faults are seen best

# A test compares this text with bevviz.extras.demo.faults. Importing that module would slow down --help.
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


@dataclass(frozen=True, kw_only=True)
class SimulatorOptions:
    """Options for another drive than the one that ships with bevviz."""

    frames: int | None = option("N", "simulate a drive of N scans at 10 Hz (default: 100)", parse=positive)
    seed: int = option("SEED", "simulate another street (default: 0)", default=0)
    plant: tuple[str, ...] = option(
        "NAME",
        "simulate a fault that perception gets wrong, see below; several times for several",
        repeat=True,
    )
    weave: bool = flag("simulate a vehicle that swerves, as it should to calibrate sensors")

    def __bool__(self) -> bool:
        """Return whether such a drive is asked for."""
        return bool(self.plant or self.frames or self.seed or self.weave)

    def source(self, frames: int) -> SyntheticSource:
        """Return the simulated drive; ``frames`` is its length if none is stated."""
        from bevviz.extras.demo.drive import SyntheticSource

        return SyntheticSource(self.frames or frames, self.seed, plant=self.plant, weave=self.weave)


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """Options of ``demo``."""

    simulator: SimulatorOptions
    bag: Path | None = option(
        "FILE.mcap",
        "write the drive as a ROS 2 bag instead of running on it",
        names=("-o", "--output"),
        file="written",
    )
    config: ConfigOptions
    output: BagOutputs


@command(
    "demo",
    help="a missed pedestrian in a synthetic drive, and why",
    description="Take a simulated drive past cars, pedestrians and cyclists, say why one of them is "
    "missed, and open the workbench on it. With an output: run the pipeline on the drive instead. The "
    "options of the simulator make another drive, with Open3D.",
    epilog=PLANTS,
)
def _demo(options: DemoOptions) -> int:
    outputs, simulator, bag = options.output, options.simulator, options.bag
    if bag is not None:
        frames = _make_bag(simulator, bag)
        print(f"{bag}: {frames} scans; 'bevviz bag {bag} --model demo' runs on it")
        return 0
    if not outputs and find_spec("rerun_notebook") is not None:
        return _show_missed(options)
    from bevviz.drive import Drive

    config = _config(options.config, options.config.preset)
    if simulator:
        return process(Drive(simulator.source(FRAMES), config), outputs, Path("demo.rrd"))
    from bevviz.bags.source import BagSource

    with BagSource([SHIPPED], config) as source:
        return process(Drive(source, config), outputs, Path("demo.rrd"))


def _config(options: ConfigOptions, preset: Preset | None) -> Config:
    """Return the configuration. It ignores the project's sensors and network, to be the same everywhere."""
    from bevviz.config import Layer, load

    return load(options.file, options.set, preset, layers=[Layer("demo", {"detector.model": "demo"})])


def _make_bag(simulator: SimulatorOptions, path: Path, frames: int = FRAMES) -> int:
    """Copy the shipped drive, or simulate one of ``frames`` scans. Return the number of its scans."""
    if not simulator:
        if path.suffix != ".mcap":
            raise UserError(f"{path}: a bag is written as MCAP, so its name must end in .mcap")
        if path.exists():
            raise UserError(f"{path} exists already; remove it or give another name")
        with atomic_write(path, "drive") as unfinished:
            write_all(unfinished.handle, SHIPPED.read_bytes())
        return SHIPPED_FRAMES
    from bevviz.extras.demo.bag import write_bag

    source = simulator.source(frames)
    write_bag(source, path, progress.bar(source, total=source.total, unit="scan", desc="simulate"))
    return source.total


def _show_missed(options: DemoOptions) -> int:
    """Open the workbench on a missed object, and say why it is missed as soon as the page shows it."""
    from bevviz.cli.workbench import FirstFrameOptions, OpenOptions, PageOptions, open_page

    chosen, simulator = options.config, options.simulator
    config = _config(chosen, chosen.preset or (None if chosen.file else "reference"))
    number = _frame_of_interest(simulator)
    if BAG.exists() and not simulator:
        say(f"{BAG} is there already and is opened again; remove it for a new one")
    else:
        _make_bag(simulator, BAG, number + FURTHER)
    is_shipped = filecmp.cmp(BAG, SHIPPED, shallow=False)

    def say_missed(explainer: FrameExplainer) -> None:
        for answer in explainer.missed()[:1]:
            seconds = explainer.traces.result.frame.index / 10
            print(f"{seconds:.1f} s into {BAG}: {explainer.with_hints(answer).text}", flush=True)

    page = OpenOptions(
        drive=DriveOptions(paths=(BAG,)),
        frame=FirstFrameOptions(at_frame=number if simulator or is_shipped else 0),
        truth=TruthOptions(),
        config=options.config,
        page=PageOptions(),
    )
    return open_page(page, config, {"bag": BAG.name, **SHIPPED_MISSED} if is_shipped else {}, say_missed)


def _frame_of_interest(simulator: SimulatorOptions) -> int:
    """Return the frame in which the first planted fault is seen best."""
    if not simulator:
        return SHIPPED_CHILD
    from bevviz.extras.demo.faults import FAULTS

    return next((round(10 * FAULTS[name].time) for name in simulator.plant if name in FAULTS), 0)
