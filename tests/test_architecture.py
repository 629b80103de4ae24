"""The page of the architecture agrees with the package."""

from __future__ import annotations

import re
import tomllib
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs/architecture.md").read_text()


def contract() -> list[set[str]]:
    """Layers of the contract, from the top."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    return [set(re.split(r"\W+", layer)) for layer in settings["contracts"][0]["layers"]]


def layers_of_page() -> list[set[str]]:
    """Layers of the page's table, from the top."""
    section = PAGE[PAGE.index("| layer, from the top") : PAGE.index("`blueprints/` beside")]
    cells = re.findall(r"^\| (`.*?) \|", section, re.MULTILINE)
    return [{name.removesuffix(".py").strip("/") for name in re.findall(r"`(.+?)`", cell)} for cell in cells]


def test_the_page_has_the_layers_of_the_contract_in_order() -> None:
    inside = [name for layer in layers_of_page() for name in layer]
    found = [layer - {"__main__", "renamed"} for layer in contract()]
    found = [layer for layer in found if layer]
    assert set(inside) == set().union(*found)
    rank = {name: number for number, layer in enumerate(found) for name in layer}
    order = [{rank[name] for name in layer} for layer in layers_of_page()]
    assert all(max(above) < min(below) for above, below in pairwise(order))


def test_every_file_that_the_page_names_exists() -> None:
    names = re.findall(r"`([a-z_]+(?:/[a-z_]+)*(?:/|\.py))`", PAGE)
    assert len(names) > 30
    for name in names:
        assert (ROOT / "bevviz" / name).exists() or (ROOT / name).exists(), name


def test_every_package_has_a_sentence_that_says_what_it_holds() -> None:
    for package in (ROOT / "bevviz").iterdir():
        if (package / "__init__.py").is_file():
            first = (package / "__init__.py").read_text().partition("\n")[0]
            assert re.fullmatch(r'"""[A-Z].*\.(""")?', first), package.name
