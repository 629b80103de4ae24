"""Command ``bevviz config``: print the configuration, or explain a parameter."""

from __future__ import annotations

from dataclasses import dataclass

from bevviz.cli.command import command, option
from bevviz.cli.options import ConfigOptions, load_stated

EXAMPLES = """examples:
  bevviz config > my.yaml                 all, to be changed and given to --config
  bevviz config clustering.eps            what it is, its unit and range, and where its value comes from
  bevviz config clustering                every parameter of that stage"""


@dataclass(frozen=True, kw_only=True)
class ConfigCommandOptions:
    """Options of ``config``."""

    key: str | None = option(
        "KEY", "one parameter, or a section, to be explained", positional=True, nargs="?"
    )
    config: ConfigOptions


@command(
    "config",
    description="Print every parameter with its unit and meaning, as YAML that --config reads back; or "
    "explain one.",
    epilog=EXAMPLES,
)
def _config(options: ConfigCommandOptions) -> int:
    from bevviz.config import config_yaml, stated_lines
    from bevviz.config.descriptions import describe_parameters

    chosen = options.config
    config = load_stated(chosen, chosen.file, chosen.set, chosen.preset)
    if options.key is not None:
        print(describe_parameters(options.key, config))
        return 0
    for line in stated_lines(config):
        print(f"# {line}")
    print(config_yaml(config), end="")
    return 0
