"""Command ``bevviz completion``: complete commands, options and parameters in a shell."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any, Literal

from bevviz.cli.command import command, option

EXAMPLES = """in the shell's start-up file:
  eval "$(bevviz completion bash)"          # ~/.bashrc
  eval "$(bevviz completion zsh)"           # ~/.zshrc
  bevviz completion fish | source           # ~/.config/fish/config.fish"""


@dataclass(frozen=True, kw_only=True)
class CompletionOptions:
    """Options of ``completion``."""

    shell: Literal["bash", "zsh", "fish"] = option("SHELL", "bash, zsh, fish", positional=True, required=True)


@command(
    "completion",
    description="Print what a shell evaluates to complete commands, options and the keys of --set.",
    epilog=EXAMPLES,
)
def _completion(options: CompletionOptions) -> int:
    from argcomplete.shell_integration import shellcode

    print(shellcode(["bevviz"], shell=options.shell))
    return 0


def complete(parser: argparse.ArgumentParser) -> None:
    """Answer a completion request of the shell and end the process."""
    import argcomplete

    for action in _actions(parser):
        if {"--set", "--set-a", "--set-b"} & {*action.option_strings} or action.dest == "key":
            action.completer = _keys  # type: ignore[attr-defined]
        elif "--blueprint" in action.option_strings:
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
