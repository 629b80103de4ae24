"""The command line: parse the arguments, run the command, report errors.

Commands import their modules when they run, so that ``--help`` is instant.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bevviz.cli import interrupts, outputs
from bevviz.cli.command import Command, commands_in, make_options
from bevviz.cli.options import follow_recording, join_negative_numbers
from bevviz.cli.outputs import check_outputs, join_json_option, print_error
from bevviz.cli.parser import COMMAND, Parser
from bevviz.errors import UserError, first_line, interrupt_in
from bevviz.support.extensions import load_all, registered

if TYPE_CHECKING:
    from logging import Logger

# Commands in the order of the help text: the module that has it, and its line.
CORE = {
    "open": ("workbench", "the workbench: a page where a click on anything answers why"),
    "bag": ("bag", "run the pipeline over a recorded bag"),
    "info": ("info", "what is in a bag, and what is missing for a full run"),
    "why": ("why", "why an object was reported, or was not"),
    "compare": ("compare", "what if? two configurations, or the robot"),
    "evaluate": ("evaluate", "how right it is, where the truth is known; a gate for CI"),
    "report": ("report", "a bug report that stands on its own, and its check"),
    "cut": ("cut", "a window of a drive with chosen topics, as a bag"),
    "live": ("live", "run the pipeline beside a robot"),
    "snap": ("live", "save the last seconds of a running 'bevviz live'"),
    "config": ("config", "print the effective configuration, or explain one parameter"),
    "store": ("store", "the results that are kept on disk, so that no command makes them twice"),
    "trust": ("trust", "let the functions of a project file, or of a YAML file, run"),
    "completion": ("completion", "what a shell needs to complete commands, options and parameters"),
}
EPILOG = """examples:
  bevviz demo                                 the synthetic drive, in the viewer
  bevviz drive.mcap --model yolo11n.onnx      the workbench: a page where a click on anything answers why
  bevviz info drive.mcap                      what is in a bag, and what is missing for a full run
  bevviz bag drive.mcap --model yolo11n.onnx  run the pipeline over a bag, in the viewer
  bevviz bag drive.mcap --save drive.rrd      the same, saved to send with a bug report
  bevviz why drive.mcap --at 12.5             why an object was not reported then
  bevviz report drive.mcap --at 12.5          a bug report that stands on its own
  bevviz recover drive.mcap -o sound.mcap     a sound copy of a damaged bag
  bevviz cut drive.mcap -o part.mcap --start 10 --end 20   ten seconds of it
  bevviz compare drive.mcap --model yolo11n.onnx --set-b clustering.eps=0.8   what if?
  bevviz sweep drive.mcap --model yolo11n.onnx --set clustering.eps=0.3:0.9:0.1   which value?
  bevviz evaluate drive.mcap --model yolo11n.onnx --min recall=0.8                how right? a gate for CI
  bevviz batch bags/ -o runs                  many bags, and the worst frames of all of them
  bevviz causes runs                          what the missed objects of that batch have in common
  bevviz fix runs --cause 1 -o fix.yaml       parameters that find them, tried on other drives
  bevviz live --model yolo11n.onnx --serve    the same beside a running robot, in a browser
  bevviz snap                                 save what it saw in the last 30 seconds
  bevviz calib drive.mcap                     is it the calibration or the clock?
  bevviz config --preset reference            every parameter, with its unit and meaning
  bevviz config clustering.eps                one of them explained, and where its value is stated
  bevviz trust                                let functions run that the folder's bevviz.toml names
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run bevviz.

    Returns:
        Exit status: 0 done, 1 no result, 2 wrong input, 3 an error of bevviz itself, 130 interrupted.
    """
    status = _main(arguments)
    if arguments is None:
        interrupts.leave(status)
    return status


def _main(arguments: Sequence[str] | None) -> int:
    # Imports and frames make many objects and few cycles. At Python's default threshold of 700 the collector
    # takes a tenth of the run time.
    gc.set_threshold(50_000, 10, 10)
    # Products of a cloud and a 3 x 3 matrix are too small for threads, and idle threads of OpenBLAS spin.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Our models need no plugins of pydantic, which would look for them in every installed package.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    if arguments is None:
        interrupts.install()
    try:
        command_line = join_json_option(
            join_negative_numbers(sys.argv[1:] if arguments is None else arguments)
        )
        word = command_line[0] if command_line else ""
        if _is_input(word):
            word, command_line = "open", ["open", *command_line]
        parser, _ = make_parser(word)
        if "_ARGCOMPLETE" in os.environ:
            from bevviz.cli.completion import complete

            complete(parser)
        if not command_line:
            parser.print_help()
            return 2
        parsed = vars(parser.parse_args(command_line))
        if parsed["verbose"]:
            _log_to_stderr()
        outputs.set_up_notes(quiet=parsed["quiet"])
        command: Command[Any] = parsed["command"]
        requested = make_options(parsed["options"], parsed)
        check_outputs(requested)
        options = follow_recording(requested)
        if options is not requested:
            check_outputs(options)  # The bag of the recording is read, too.
        return command.run(options)
    except UserError as error:
        _log().debug("what led to the error", exc_info=error)
        print_error(error)
        return 2
    except KeyboardInterrupt:
        print("bevviz: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # The reader of our output has gone, as in `bevviz info bag | head`.
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, PTH123
        return 0
    except Exception as error:
        if interrupt_in(error) or interrupts.signal_came():
            print("bevviz: interrupted", file=sys.stderr)
            return 130
        from bevviz.support.files import full_disk_error

        if (disk_message := full_disk_error(error)) is not None:
            _log().debug("what led to the error", exc_info=error)
            print_error(disk_message)
            return 2
        _log().error("an error that nobody foresaw", exc_info=error)
        description = f"{type(error).__name__}: {first_line(error)}"
        print_error(f"{description}; --verbose shows where, please report it", "error of bevviz itself")
        return 3
    finally:
        if arguments is None:
            interrupts.ignore()
            if "velodyne_decoder" not in sys.modules:  # It would complain that it is not cleared.
                gc.freeze()  # A last search for cycles would take a third of a second.


def _is_input(word: str) -> bool:
    """Return whether the first word of the command line is an input, and no command."""
    is_command = not word or word in CORE or word in registered("commands")
    return not is_command and ("://" in word or Path(word).exists())


def _find_commands(word: str) -> Iterator[tuple[str, str, Command[Any] | None]]:
    """Yield name, line in the list, and the command if it is the first ``word`` of the command line.

    A module of the core is imported only for its command. For such a command the registered ones are left
    out, because finding them takes 20 ms.
    """
    for name, (module, line) in CORE.items():
        commands = commands_in(import_module(f"bevviz.cli.{module}")) if word in ("", name) else []
        yield name, line, next((command for command in commands if command.name == name), None)
    if word in CORE:
        return
    for extension in load_all("commands", _warn, but=CORE):
        for command in commands_in(extension):
            yield command.name, command.help, command if word in ("", command.name) else None


def _warn(text: str) -> None:
    outputs.warn([text])


class _ShowVersion(argparse.Action):
    """Option that prints the version, which is looked up only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from bevviz.support.version import __version__

        print(f"bevviz {__version__}")
        parser.exit()


def make_parser(word: str = "") -> tuple[argparse.ArgumentParser, Mapping[str, argparse.ArgumentParser]]:
    """Return the parser of the program, and those of the commands by name.

    Args:
        word: first of the command line. Only this command gets its options. Empty: all do.
    """
    parser = Parser(
        prog="bevviz",
        description="See what a LiDAR-camera perception pipeline saw, made and decided, in Rerun.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--version", action=_ShowVersion, nargs=0, help="show program's version number and exit"
    )
    subparsers = parser.add_subparsers(required=True, metavar=COMMAND)
    for name, line, command in _find_commands(word):
        command_parser = subparsers.add_parser(name, help=line)
        if command is not None:
            command.fill(command_parser, _warn)
    for command_parser in subparsers.choices.values():
        command_parser.add_argument(
            "--verbose", action="store_true", help="also say on stderr where in the code something failed"
        )
        command_parser.add_argument(
            "--quiet", action="store_true", help="no progress and no notes: only results, and what is wrong"
        )
    return parser, subparsers.choices


def _log() -> Logger:
    from bevviz.support.loggers import logger

    return logger(__name__)


def _log_to_stderr() -> None:
    import logging

    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(name)s: %(levelname)s: %(message)s"))
    logger = logging.getLogger("bevviz")
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)
