"""Command ``bevviz completion``: complete commands, options and parameters in a shell."""

from __future__ import annotations

import argparse
from typing import Any

from bevviz.cli.options import Commands

EXAMPLES = """in the shell's start-up file:
  eval "$(bevviz completion bash)"          # ~/.bashrc
  eval "$(bevviz completion zsh)"           # ~/.zshrc
  bevviz completion fish | source           # ~/.config/fish/config.fish"""


def add(commands: Commands) -> None:
    """Add the command ``completion``."""
    completion = commands.add_parser(
        "completion",
        help="what a shell needs to complete commands, options and parameters",
        description="Print what a shell evaluates to complete commands, options and the keys of --set.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=EXAMPLES,
    )
    shells = ("bash", "zsh", "fish")
    completion.add_argument("shell", choices=shells, metavar="SHELL", help=", ".join(shells))
    completion.set_defaults(run=_completion)


def _completion(options: argparse.Namespace) -> int:
    from argcomplete.shell_integration import shellcode

    print(shellcode(["bevviz"], shell=options.shell))
    return 0


def complete(parser: argparse.ArgumentParser) -> None:
    """Answer a completion request of the shell and end the process."""
    import argcomplete

    for action in _actions(parser):
        if "--set" in action.option_strings or action.dest in ("set_a", "set_b", "key"):
            action.completer = _keys  # type: ignore[attr-defined]
        elif action.dest == "blueprint":
            action.completer = _blueprints  # type: ignore[attr-defined]
    argcomplete.autocomplete(parser, always_complete_options="long")


def _actions(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    actions = list(parser._actions)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            actions += [nested for command in action.choices.values() for nested in _actions(command)]
    return actions


def _keys(prefix: str, action: argparse.Action, **_: Any) -> list[str]:
    """Return the keys of all parameters, with ``=`` if a value follows."""
    from bevviz.config import TUTORIAL_NAMES, parameters

    sign = "=" if action.option_strings else ""
    return [f"{key}{sign}" for key in (*parameters(), *TUTORIAL_NAMES)]


def _blueprints(**_: Any) -> list[str]:
    from bevviz.recording.blueprints import names

    return list(names())
