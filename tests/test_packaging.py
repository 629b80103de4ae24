"""Packaging: bounds of dependencies, the constraints file, and notices about parts that others made."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
CONSTRAINTS = [
    Requirement(line)
    for line in (ROOT / "docs" / "constraints.txt").read_text().splitlines()
    if not line.startswith("#")
]
NOTICES = (ROOT / "THIRD_PARTY_NOTICES.md").read_text()


def requirements() -> Iterator[Requirement]:
    """Every requirement of the package, its build, its extras and its dependency groups on others."""
    lists = [
        PROJECT["build-system"]["requires"],
        PROJECT["project"]["dependencies"],
        *PROJECT["project"]["optional-dependencies"].values(),
        *PROJECT["dependency-groups"].values(),
    ]
    for entry in (entry for entries in lists for entry in entries if isinstance(entry, str)):
        if (requirement := Requirement(entry)).name != PROJECT["project"]["name"]:
            yield requirement


def constraints_of(python: str) -> dict[str, Requirement]:
    environment = {
        "python_version": python,
        "python_full_version": f"{python}.9",
        "sys_platform": "linux",
        "implementation_name": "cpython",
        "platform_python_implementation": "CPython",
    }
    applying = [c for c in CONSTRAINTS if c.marker is None or c.marker.evaluate(environment)]
    names = [canonicalize_name(c.name) for c in applying]
    assert len(set(names)) == len(names)
    return dict(zip(names, applying, strict=True))


def test_each_dependency_has_the_same_two_bounds_everywhere() -> None:
    bounds: dict[str, set[str]] = {}
    for requirement in requirements():
        stated = bounds.setdefault(canonicalize_name(requirement.name), set())
        if requirement.specifier:  # an extra such as rerun-sdk[catalog] has the bounds of the package
            stated.add(str(requirement.specifier))
    assert {name: stated for name, stated in bounds.items() if len(stated) != 1} == {}
    open_ended = {n: s for n, (s,) in bounds.items() if "==" not in s and not (">=" in s and "<" in s)}
    assert open_ended == {}


@pytest.mark.parametrize("python", ["3.11", "3.12", "3.13"])
def test_constraints_pin_every_dependency_within_its_bounds(python: str) -> None:
    pinned = constraints_of(python)
    built_with = {Requirement(entry).name for entry in PROJECT["build-system"]["requires"]}
    for requirement in requirements():
        applies = requirement.marker is None or requirement.marker.evaluate(
            {"python_version": python, "sys_platform": "linux"}
        )
        if applies and requirement.name not in built_with:
            (pin,) = pinned[canonicalize_name(requirement.name)].specifier
            assert pin.operator == "==" and requirement.specifier.contains(pin.version), requirement
    assert any(name.startswith("ros-") for name in pinned) == (python != "3.13")


def test_constraints_name_no_index_and_no_hash() -> None:
    text = (ROOT / "docs" / "constraints.txt").read_text()
    assert "://" not in text and "--" not in text


def test_notices_name_every_file_that_is_not_python() -> None:
    carried = [
        path.relative_to(ROOT)
        for folder in ("bevviz", "blueprints")
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and path.suffix != ".py" and "__pycache__" not in path.parts
    ]
    assert Path("bevviz/extras/lidars/hesai_angles.csv") in carried
    named = {Path(name) for name in re.findall(r"^\| `([^`]+)` \|", NOTICES, re.MULTILINE)}
    assert [path for path in carried if path not in named and path.parent not in named] == []


def test_notices_name_every_module_with_message_definitions() -> None:
    modules = [
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "bevviz").rglob("*.py")
        if re.search(r"^DEFINITIONS? =", path.read_text(), re.MULTILINE)
    ]
    assert len(modules) >= 5
    assert [module for module in modules if f"`{module}`" not in NOTICES] == []


def test_files_that_the_notices_name_exist() -> None:
    named = re.findall(r"`((?:bevviz|tools|tests)/[^`]+)`", NOTICES)
    assert [path for path in named if not (ROOT / path).exists()] == []


def test_notices_name_the_gpl_libraries_of_the_image() -> None:
    """The wheel of PyAV says BSD. The terms of its libraries have to be read off their files."""
    import av

    libraries = {file.name.split("-")[0] for file in Path(av.__file__).parents[1].glob("av.libs/*")}
    if not libraries:
        pytest.skip("PyAV is built from source here")
    section = NOTICES.split("## The container image")[1].split("\n## ")[0]
    for name in ("x264", "x265"):
        assert (f"lib{name}" in libraries) == (name in section)
    assert "GPL-3.0-or-later" in (ROOT / "Dockerfile").read_text()
    assert "THIRD_PARTY_NOTICES.md" in (ROOT / "Dockerfile").read_text()


def test_wheel_and_sdist_carry_licence_and_notices() -> None:
    files = {"LICENSE", "THIRD_PARTY_NOTICES.md"}
    assert set(PROJECT["project"]["license-files"]) == files
    assert files <= set(PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["include"])
