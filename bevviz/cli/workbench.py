"""``bevviz open``."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import TYPE_CHECKING

from bevviz.cli.interrupts import terminable
from bevviz.cli.options import Commands, add_bag, add_config, add_truth, load_config, port
from bevviz.cli.outputs import has_display, hint, say, warn
from bevviz.errors import UserError

if TYPE_CHECKING:
    from bevviz.workbench.bench import Bench
    from bevviz.workbench.native import NativeViewer

EXAMPLES = """examples:
  bevviz drive.mcap                                     the same as bevviz open drive.mcap
  bevviz open drive.mcap --model yolo11n.onnx           a page: click what you see, and it answers
  bevviz open drive.mcap --model yolo11n.onnx --at 12.5 that scan first
  bevviz open drive.mcap --port 8400 --no-browser       over ssh -L 8400:127.0.0.1:8400"""


def add(commands: Commands) -> None:
    command = commands.add_parser(
        "open",
        help="the workbench: a page where a click on anything answers why",
        description="Open a drive in the workbench: a page of this machine alone, with Rerun's viewer and a "
        "panel. A click on a box, a point or a pixel answers why it is what it is; what was missed is "
        "listed; hints and parameters are tried on the shown frame at once.",
        epilog=EXAMPLES,
    )
    group = add_bag(command)
    group.add_argument("--at", metavar="TIME", help="show the scan nearest to this time first")
    add_truth(command)
    add_config(command)
    page = command.add_argument_group("page")
    page.add_argument("--port", type=port, metavar="N", help="of the page (default: one that is free)")
    page.add_argument(
        "--no-browser", dest="browser", action="store_false", help="print the address, open nothing"
    )
    page.add_argument(
        "--viewer", action="store_true", help="Rerun's viewer in a window, the page is the panel alone"
    )
    page.add_argument(
        "--connect", metavar="URL", help="the same with a viewer that runs: rerun+http://127.0.0.1:9876/proxy"
    )
    command.set_defaults(run=_open)


def _open(options: argparse.Namespace) -> int:
    try:
        from bevviz.workbench.server import serve
    except ImportError as error:
        raise UserError(
            f"the workbench needs further packages ({error.name}): pip install 'bevviz[workbench]'"
        ) from None
    with terminable(), _bench(options) as bench:
        hint(bench.drive.scene, bench.drive.config)
        warn(bench.drive.warnings)

        def ready(address: str) -> None:
            say(f"workbench at {address}")
            if options.browser and has_display():
                import webbrowser

                webbrowser.open(address)
            say("open until Ctrl-C; only this machine can reach it")

        with suppress(KeyboardInterrupt), _native(options, bench) as native:  # the way to end it
            serve(bench, options.port, ready, native)
    return 0


def _native(options: argparse.Namespace, bench: Bench) -> AbstractContextManager[NativeViewer | None]:
    """The viewer beside the page, where one is asked for."""
    from bevviz.workbench.native import NativeViewer

    if options.connect is None and not options.viewer:
        return nullcontext()
    if options.connect is None and not has_display():
        raise UserError("--viewer: no display; without it the page has a viewer of its own")
    return NativeViewer(bench.film, bench.recording_id, options.connect)


def _bench(options: argparse.Namespace) -> Bench:
    from contextlib import ExitStack

    from bevviz.bags.source import BagSource
    from bevviz.drive import Drive
    from bevviz.evaluate import truth_source
    from bevviz.workbench.bench import Bench

    config = load_config(options)
    with ExitStack() as stack:
        source = stack.enter_context(BagSource(options.paths, config))
        again = stack.enter_context(BagSource(options.paths, config))
        truth_of = truth_source(source.roles, options.truth, options.kitti_labels, len(source.scans))
        first = source.number_at(options.at) if options.at is not None else 0
        bench = Bench(Drive(source, config), again, truth_of, first)
        stack.pop_all()  # the bench closes them
    return bench
