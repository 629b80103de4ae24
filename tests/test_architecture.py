"""Rules of the code: the architecture page agrees with the package, and test files keep their order."""

from __future__ import annotations

import ast
import re
import tomllib
from itertools import pairwise
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs/architecture.md").read_text()
EXTRAS = sorted(path.parent.name for path in ROOT.glob("bevviz/extras/*/__init__.py"))
MAX_NAME = 60  # characters of the name of a test
TESTS_OF_BENCHMARKS = ("test_benchmarks.py", "test_ideal_benchmark.py", "test_torture_benchmark.py")


def contract() -> list[set[str]]:
    """Layers of the contract, from the top."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    return [set(re.split(r"\W+", layer)) for layer in settings["contracts"][0]["layers"]]


def layers_of_page() -> list[set[str]]:
    """Layers of the page's table, from the top."""
    section = PAGE[PAGE.index("| layer, from the top") : PAGE.index("`blueprints/` beside")]
    cells = re.findall(r"^\| (`.*?) \|", section, re.MULTILINE)
    return [{name.removesuffix(".py").strip("/") for name in re.findall(r"`(.+?)`", cell)} for cell in cells]


def test_every_name_on_the_page_is_in_the_code() -> None:
    files = [*ROOT.glob("bevviz/**/*.py"), *ROOT.glob("blueprints/*.py"), ROOT / "pyproject.toml"]
    words = set(re.findall(r"\w+", "\n".join(file.read_text() for file in files)))
    for name in re.findall(r"`([^` ]+)`", PAGE):
        is_path = any((folder / name).exists() for folder in (ROOT, ROOT / "bevviz"))
        known = name == "lint-imports" or all(word in words for word in re.findall(r"\w{4,}", name))
        assert is_path or ("/" not in name.strip("/") and known), name


def test_the_page_has_the_layers_of_the_contract_in_order() -> None:
    inside = [name for layer in layers_of_page() for name in layer]
    found = [layer - {"__main__"} for layer in contract()]
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


def test_every_extra_is_registered_tested_and_described() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    values = [value for group in project["entry-points"].values() for value in group.values()]
    (everything,) = (Requirement(entry) for entry in project["optional-dependencies"]["all"])
    for name in EXTRAS:
        assert any(value.startswith(f"bevviz.extras.{name}.") for value in values), name
        assert name in project["optional-dependencies"] and name in everything.extras
        assert list((ROOT / "tests/extras" / name).glob("test_*.py")), name
        assert (ROOT / "docs/extras" / f"{name}.md").exists()
        assert f"| [`{name}`](extras/{name}.md) |" in (ROOT / "docs/extras.md").read_text()


def imported_modules(path: Path) -> set[str]:
    """Return the modules, and the names in modules, that a file imports anywhere."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


def test_test_files_import_helpers_from_support_only() -> None:
    files = [path for folder in ("tests", "benchmarks", "tools") for path in (ROOT / folder).rglob("*.py")]
    assert len(files) > 150
    for path in files:
        imported = imported_modules(path)
        name = path.relative_to(ROOT).as_posix()
        outside = {m for m in imported if m.startswith("tests.") and not m.startswith("tests.support")}
        assert not outside, f"{name} imports {sorted(outside)}: move the shared helpers to tests/support"
        if name.startswith("tests/") and path.name not in TESTS_OF_BENCHMARKS:
            of_benchmarks = {m for m in imported if m.partition(".")[0] == "benchmarks"}
            assert not of_benchmarks, f"{name} imports {sorted(of_benchmarks)}"


def test_names_of_tests_are_short_enough_to_read() -> None:
    for path in (ROOT / "tests").rglob("test_*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                assert len(node.name) < MAX_NAME, f"{path.name}: {node.name} has {len(node.name)} characters"
