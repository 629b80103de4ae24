"""Command ``bevviz open``: the workbench."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar
from urllib.parse import urlencode

from bevviz.cli.command import Group, command, flag, option
from bevviz.cli.interrupts import interruptible, wait_for_interrupt
from bevviz.cli.options import ConfigOptions, DriveOptions, FrameOptions, TruthOptions, load_config
from bevviz.cli.outputs import announce, has_display, print_hints, say, warn
from bevviz.cli.values import port
from bevviz.errors import UserError

if TYPE_CHECKING:
    from bevviz.config import Config
    from bevviz.why import FrameExplainer
    from bevviz.workbench.session import WorkbenchSession

EMPTY: Mapping[str, str] = MappingProxyType({})
LOOK = 0.5  # seconds between two looks whether the user ends the page
EXAMPLES = """examples:
  bevviz drive.mcap                                     the same as bevviz open drive.mcap
  bevviz open drive.mcap --model yolo11n.onnx           a page: click what you see, and it answers
  bevviz open drive.mcap --model yolo11n.onnx --at 12.5 that scan first
  bevviz open demo.rrd                                  a recording without a bag, shown as it is
  bevviz open drive.mcap --port 8400 --no-browser       over ssh -L 8400:127.0.0.1:8400
  bevviz bag drive.mcap --viewer                        Rerun's own viewer (or --connect URL), no questions"""


@dataclass(frozen=True, kw_only=True)
class FirstFrameOptions(FrameOptions):
    """Options that select the frame that is shown first."""

    at: str | None = option("TIME", "show the scan nearest to this time first", one_of="frame")


@dataclass(frozen=True, kw_only=True)
class PageOptions:
    """Options for the page."""

    group: ClassVar = Group("page")

    port: int | None = option("N", "of the page (default: 9880, else one that is free)", parse=port)
    browser: bool = flag("print the address, open nothing", names=("--no-browser",), default=True)


@dataclass(frozen=True, kw_only=True)
class OpenOptions:
    """Options of ``open``."""

    drive: DriveOptions
    frame: FirstFrameOptions
    truth: TruthOptions
    config: ConfigOptions
    page: PageOptions
    shown: Path | None = None  # recording without a bag


@command(
    "open",
    description="Open a drive in the workbench: a page of this machine alone, with Rerun's viewer and a "
    "panel. A click on a box, a point or a pixel answers why it is what it is; what was missed is "
    "listed; hints and parameters are tried on the shown frame at once.",
    epilog=EXAMPLES,
)
def _open(options: OpenOptions) -> int:
    if options.shown is not None:
        return _show(options.shown, options.page.port)
    return open_page(options, load_config(options))


def open_page(
    options: OpenOptions,
    config: Config,
    shown: Mapping[str, str] = EMPTY,
    opened: Callable[[FrameExplainer], None] = lambda explainer: None,
) -> int:
    """Serve the workbench until the user ends it.

    Args:
        options: options of ``bevviz open``.
        config: configuration of the run.
        shown: state of the page, as its address holds it.
        opened: called once a page shows the first frame, before the run.
    """
    try:
        from bevviz.workbench.labelled_source import LabelledSource
        from bevviz.workbench.server import page_server
    except ImportError as error:
        raise UserError(
            f"the workbench needs further packages ({error.name}): pip install 'bevviz[workbench]'"
        ) from None
    from bevviz.bags.remote import beside
    from bevviz.support.freed_memory import return_freed_memory

    paths, truth, page = options.drive.paths, options.truth, options.page
    at, number = options.frame.at, options.frame.at_frame or 0
    with ExitStack() as stack:
        source = stack.enter_context(LabelledSource(paths, config))
        first = source.checked(number) if at is None else source.number_at(at)
        warn(source.warnings)

        def make() -> WorkbenchSession:
            second_source = stack.enter_context(LabelledSource(paths, config))
            print_hints(source.scene, config)
            from bevviz.drive import Drive
            from bevviz.workbench.session import recorded_session

            labels = truth.truth, truth.kitti_labels
            if labels != (None, None):
                source.truth_of = second_source.truth_of = truth.find(source)
            drive = Drive(source, config)
            return recorded_session(drive, second_source, paths, first, labels, opened)

        def ready(address: str) -> None:
            announce("workbench", f"{address}#{urlencode(shown)}" if shown else address, page.browser)

        with suppress(KeyboardInterrupt), interruptible() as ended:  # The user ends it with a signal.
            drive = "\n".join(str(beside(path)) for path in paths)
            return_freed_memory()
            with page_server(make, "page", page.port, ready, drive) as server:
                while server.is_alive() and not ended.is_set():  # The exception of the signal may get lost.
                    server.join(LOOK)
    return 0


def _show(recording: Path, port: int | None) -> int:
    """Show a recording without a bag. It can be looked at, but not asked."""
    from bevviz.recording import rerun_cli

    say(f"{recording}: no bag behind it, shown as it is")
    if has_display():
        rerun_cli.open_in_viewer(recording)
        return 0
    if larger := rerun_cli.too_large_for_web(recording, recording.stat().st_size):
        warn([larger])
    with rerun_cli.serve_in_browser(recording, port) as address:
        announce("viewer", address)
        wait_for_interrupt()
    return 0
