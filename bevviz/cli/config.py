"""``bevviz config``."""

from __future__ import annotations

import argparse

from bevviz.cli.options import Commands, add_config, load_config


def add(commands: Commands) -> None:
    config = commands.add_parser(
        "config",
        help="print the effective configuration",
        description="Print every parameter with its unit and meaning, as YAML that --config reads back.",
    )
    add_config(config)
    config.set_defaults(run=_config)


def _config(options: argparse.Namespace) -> int:
    from bevviz.config import dump

    print(dump(load_config(options)), end="")
    return 0
