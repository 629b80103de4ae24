"""Options of commands: dataclasses that the parser is made of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import pytest

from bevviz.cli.command import Command, Group, command, flag, make_options, option
from bevviz.cli.parser import Parser


@dataclass(frozen=True, kw_only=True)
class PageOptions:
    group: ClassVar = Group("page", epilog="a text at the end")

    port: int | None = option("N", "port of the page (default: %(default)s)", parse=int, const=80)
    browser: bool = flag("open nothing", names=("--no-browser",), default=True)


@dataclass(frozen=True, kw_only=True)
class DrawOptions:
    path: Path = option("PATH", positional=True, required=True)
    output: Path = option("FILE", names=("-o", "--output"), required=True)
    color: Literal["red", "blue"] | None = option()
    label: tuple[str, ...] = option("TEXT", repeat=True)
    at: str | None = option("TIME", one_of="frame")
    at_frame: int | None = option("N", one_of="frame")
    page: PageOptions
    state: int = 3  # no option


@command("draw", description="Draw a page.")
def draw(options: DrawOptions) -> int:
    return options.state


def parser() -> Parser:
    made = Parser(prog="draw")
    assert isinstance(draw, Command)
    draw.fill(made, print)
    return made


def parse(*words: str) -> DrawOptions:
    options: DrawOptions = make_options(DrawOptions, vars(parser().parse_args(["a.png", "-o", "b", *words])))
    return options


def test_options_without_words_have_their_defaults() -> None:
    page = PageOptions(port=None, browser=True)
    assert parse() == DrawOptions(path=Path("a.png"), output=Path("b"), page=page)
    assert parse().label == () and parse().state == 3 and draw.run(parse()) == 3


def test_types_of_the_fields_read_the_words() -> None:
    options = parse("--color", "red", "--label", "x", "--label", "y", "--at-frame", "7", "--no-browser")
    assert (options.color, options.label, options.at_frame) == ("red", ("x", "y"), 7)
    assert not options.page.browser
    assert parse("--port").page.port == 80 and parse("--port", "90").page.port == 90


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a.png"], "-o/--output"),
        (["a.png", "-o", "b", "--color", "green"], "'green' is none of red, blue"),
        (["a.png", "-o", "b", "--at", "1", "--at-frame", "2"], "not allowed with argument --at"),
        (["a.png", "-o", "b", "--state", "1"], "unknown option --state"),
    ],
)
def test_wrong_words_are_refused(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parser().parse_args(words)
    assert message in capsys.readouterr().err


def test_the_help_has_groups_and_the_end_text() -> None:
    text = parser().format_help()
    assert "\npage:\n" in text and "port of the page (default: None)" in text
    assert text.endswith("a text at the end\n")
