"""Argument parser with short errors: the nearest name for a wrong one, and the command's usage."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import takewhile
from pathlib import Path
from typing import NoReturn

from bevviz.cli.outputs import print_error
from bevviz.errors import printable
from bevviz.support.text import did_you_mean

COMMAND = "COMMAND"
CUTOFF = 0.66  # least similarity of a name to suggest
_CHOICE = re.compile(r"invalid choice: '(?P<given>.*)' \(choose from (?P<known>.*)\)$", re.DOTALL)


class Parser(argparse.ArgumentParser):
    """Parser of the program or of a command. An error is one line, followed by the command's usage."""

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str], namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse arguments like argparse. The command that got an unknown option reports it first."""
        for option in self._own_options(args):
            name = option.partition("=")[0]
            known = self._option_string_actions
            if name not in known and not any(known_option.startswith(name) for known_option in known):
                self.error(f"unknown option {name}{did_you_mean(name, known, CUTOFF)}")
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"{unknown[0]}: nothing is expected here")
        return parsed, unknown

    def _own_options(self, args: Sequence[str]) -> Iterable[str]:
        """Yield this parser's own options. Those of a subcommand and of ROS are not among them."""
        if any(isinstance(action, argparse._SubParsersAction) for action in self._actions):
            args = list(takewhile(lambda arg: arg.startswith("-"), args))
        own_args = takewhile(lambda arg: arg not in ("--", "--ros-args"), args)
        return (arg for arg in own_args if arg.startswith("--"))

    def error(self, message: str) -> NoReturn:
        """Print an error and the usage on stderr, and exit with status 2."""
        if choice := _CHOICE.search(message):
            wrong, known = choice["given"], re.findall(r"[^\s',]+", choice["known"])
            if message.startswith(f"argument {COMMAND}:"):
                message = _no_command(wrong, known)
            else:
                message = f"{message[: choice.start()]}'{wrong}' is none of {', '.join(known)}"
                message += did_you_mean(wrong, known, CUTOFF)
        print_error(f"{printable(message)}\n{self.short_usage()}")
        self.exit(2)

    def short_usage(self) -> str:
        """Return one line with the required arguments."""
        words = [self.prog]
        for action in self._get_positional_actions():
            name = str(action.metavar or action.dest)
            words.append(f"[{name}]" if action.nargs in ("?", "*") else name)
        words += [
            f"{action.option_strings[-1]} {action.metavar or ''}".strip()
            for action in self._actions
            if action.required and action.option_strings
        ]
        for group in self._mutually_exclusive_groups:
            if group.required:
                alternatives = (
                    f"{action.option_strings[-1]} {action.metavar}" for action in group._group_actions
                )
                words.append(f"({' | '.join(alternatives)})")
        return f"usage: {' '.join(words)} [OPTION ...]    '{self.prog} --help' explains"


def _no_command(argument: str, known: Iterable[str]) -> str:
    """Return the message for an argument that is neither a command nor an existing file."""
    path = Path(argument)
    if path.suffix or len(path.parts) > 1:
        siblings: list[str] = []
        with suppress(OSError, ValueError):
            siblings = [str(other) for other in path.parent.iterdir()]
        return f"{argument}: no such file or folder{did_you_mean(argument, siblings, CUTOFF)}"
    return f"'{argument}' is no command, nor a file{did_you_mean(argument, known, CUTOFF)}"
