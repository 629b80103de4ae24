"""Command ``bevviz open``: the workbench."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING
from urllib.parse import urlencode

from bevviz.cli.interrupts import interruptible, wait_for_interrupt
from bevviz.cli.options import Commands, add_at, add_bag, add_config, add_truth, load_config, port
from bevviz.cli.outputs import announce, has_display, print_hints, say, warn
from bevviz.errors import UserError

if TYPE_CHECKING:
    from bevviz.config import Config
    from bevviz.workbench.session import WorkbenchSession

EMPTY: Mapping[str, str] = MappingProxyType({})
EXAMPLES = """examples:
  bevviz drive.mcap                                     the same as bevviz open drive.mcap
  bevviz open drive.mcap --model yolo11n.onnx           a page: click what you see, and it answers
  bevviz open drive.mcap --model yolo11n.onnx --at 12.5 that scan first
  bevviz open demo.rrd                                  a recording without a bag, shown as it is
  bevviz open drive.mcap --port 8400 --no-browser       over ssh -L 8400:127.0.0.1:8400
  bevviz bag drive.mcap --viewer                        Rerun's own viewer (or --connect URL), no questions"""


def add(commands: Commands) -> None:
    """Add the command ``open``."""
    command = commands.add_parser(
        "open",
        help="the workbench: a page where a click on anything answers why",
        description="Open a drive in the workbench: a page of this machine alone, with Rerun's viewer and a "
        "panel. A click on a box, a point or a pixel answers why it is what it is; what was missed is "
        "listed; hints and parameters are tried on the shown frame at once.",
        epilog=EXAMPLES,
    )
    group = add_bag(command)
    add_at(group, "show the scan nearest to this time first")
    add_truth(command)
    add_config(command)
    page = command.add_argument_group("page")
    page.add_argument(
        "--port", type=port, metavar="N", help="of the page (default: 9880, else one that is free)"
    )
    page.add_argument(
        "--no-browser", dest="browser", action="store_false", help="print the address, open nothing"
    )
    command.set_defaults(run=_open, shows_recordings=True)


def _open(options: argparse.Namespace) -> int:
    if (recording := getattr(options, "shown", None)) is not None:
        return _show(recording, options)
    return open_page(options, load_config(options))


def open_page(options: argparse.Namespace, config: Config, shown: Mapping[str, str] = EMPTY) -> int:
    """Serve the workbench until the user ends it.

    Args:
        options: options of ``bevviz open``.
        config: configuration of the run.
        shown: state of the page, as its address holds it.
    """
    try:
        from bevviz.workbench.server import serve
        from bevviz.workbench.startup import LabelledSource
    except ImportError as error:
        raise UserError(
            f"the workbench needs further packages ({error.name}): pip install 'bevviz[workbench]'"
        ) from None
    from bevviz.bags.remote import beside

    with ExitStack() as stack:
        source = stack.enter_context(LabelledSource(options.paths, config))
        number = options.at_frame or 0
        first = source.checked(number) if options.at is None else source.number_at(options.at)
        warn(source.warnings)

        def make() -> WorkbenchSession:
            _arrow_without_pandas()
            second_source = stack.enter_context(LabelledSource(options.paths, config))
            print_hints(source.scene, config)
            from bevviz.drive import Drive
            from bevviz.evaluate import truth_source
            from bevviz.workbench.recorded_drive import recorded_session

            truth_of = truth_source(source.roles, options.truth, options.kitti_labels, len(source.scans))
            if options.truth is not None or options.kitti_labels is not None:
                source.truth_of = second_source.truth_of = truth_of
            labels = options.truth, options.kitti_labels
            drive = Drive(source, config)
            return recorded_session(drive, second_source, options.paths, truth_of, first, labels)

        def ready(address: str) -> None:
            announce("workbench", f"{address}#{urlencode(shown)}" if shown else address, options.browser)

        with suppress(KeyboardInterrupt), interruptible():  # The user ends it with a signal.
            drive = "\n".join(str(beside(path)) for path in options.paths)
            serve(make, drive, options.port, ready)
    return 0


def _show(recording: Path, options: argparse.Namespace) -> int:
    """Show a recording without a bag. It can be looked at, but not asked."""
    from bevviz.recording import rerun_cli

    say(f"{recording}: no bag behind it, shown as it is")
    if has_display():
        rerun_cli.open_in_viewer(recording)
        return 0
    if larger := rerun_cli.too_large_for_web(recording, recording.stat().st_size):
        warn([larger])
    with rerun_cli.serve_in_browser(recording, options.port) as address:
        announce("viewer", address)
        wait_for_interrupt()
    return 0


def _arrow_without_pandas() -> None:
    """Make pyarrow skip its import of pandas, which takes half a second and is not needed.

    pyarrow looks for pandas at its first array. It looks again when one of its pandas functions is called.
    """
    if "pandas" in sys.modules:
        return
    finder = _NoPandas()
    sys.meta_path.insert(0, finder)
    try:
        import pyarrow

        pyarrow.array([True])
    finally:
        sys.meta_path.remove(finder)


class _NoPandas:
    """Import finder that hides pandas."""

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(name)
