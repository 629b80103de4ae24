"""Command ``ros2 bevviz``: run bevviz with the same arguments."""

import argparse
import os
from typing import Any

from ros2cli.command import CommandExtension

from bevviz_ros import environment, program


class BevvizCommand(CommandExtension):  # type: ignore[misc]
    """Show why a robot's perception missed an object (arguments as of 'bevviz')."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        """Take all arguments, the options of bevviz among them."""
        parser.add_argument("arguments", nargs=argparse.REMAINDER, help="see 'bevviz --help'")

    def main(self, *, parser: Any, args: Any) -> int:
        """Become bevviz. Return 1 if it is not there."""
        path = program()
        try:
            os.execve(path, [path, *args.arguments], environment())
        except OSError as error:
            print(f"{path}: {error.strerror}: install bevviz there, or name it in BEVVIZ_PROGRAM")
            return 1
