"""Command ``bevviz config``: print the configuration, or explain a parameter."""

from __future__ import annotations

import argparse

from bevviz.cli.options import Commands, add_config, load_config

EXAMPLES = """examples:
  bevviz config > my.yaml                 all, to be changed and given to --config
  bevviz config clustering.eps            what it is, its unit and range, and where its value comes from
  bevviz config clustering                every parameter of that stage"""


def add(commands: Commands) -> None:
    """Add the command ``config``."""
    config = commands.add_parser(
        "config",
        help="print the effective configuration, or explain one parameter",
        description="Print every parameter with its unit and meaning, as YAML that --config reads back; or "
        "explain one.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=EXAMPLES,
    )
    config.add_argument("key", nargs="?", metavar="KEY", help="one parameter, or a section, to be explained")
    add_config(config)
    config.set_defaults(run=_config, keep=None)  # Show ``logging.keep`` as a run would have it.


def _config(options: argparse.Namespace) -> int:
    from bevviz.config import config_yaml, stated_lines
    from bevviz.config.descriptions import describe_parameters

    config = load_config(options)
    if options.key is not None:
        print(describe_parameters(options.key, config))
        return 0
    for line in stated_lines(config):
        print(f"# {line}")
    print(config_yaml(config), end="")
    return 0
