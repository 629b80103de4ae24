"""Provenance: everything that results depend on is in it, and what differs is named."""

from __future__ import annotations

import ast
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter

import bevviz
from bevviz.config import load
from bevviz.recording.provenance import (
    Dependency,
    Provenance,
    dependencies_of,
    differences,
    machine,
    provenance,
    versions,
)
from bevviz.support.files import file_hash

PACKAGE = Path(bevviz.__file__).parent
# What the packages do that are imported, but whose version changes no result.
NEUTRAL = {
    "pydantic": "the configuration's types",
    "pydantic_core": "the configuration's types",
    "annotated-types": "the configuration's types",
    "tqdm": "progress bars",
    "argcomplete": "completion in a shell",
    "jinja2": "pages about results",
    "starlette": "the workbench's server",
    "websockets": "the server for Foxglove",
    "aiohttp": "the transport of remote bags",
    "uvicorn": "the workbench's server",
    "ruamel.yaml": "files of configurations",
    "pyarrow": "containers of what is computed",
    "apsw": "bytes out of SQLite files",
    "backports.zstd": "lossless compression",
    "lz4": "lossless compression",
    "mcap": "writes bags; ours reads them",
    "open3d": "the simulator, whose scans are input like any other",
    "libusb-package": "a library that open3d loads",
    "distributed": "brings jobs to other machines",
    "pandas": "results as tables",
    "ipython": "the viewer in a notebook",
    "mcp": "answers to agents",
    "anyio": "answers to agents",
    "fsspec": "bytes of files over the network",
    "typing_extensions": "types of outputs",
    "typing-extensions": "types of outputs",
    "foxglove-sdk": "shows live results elsewhere",
}


def imported(file: Path) -> Iterator[str]:
    """Modules that a file imports, also inside functions."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module


@pytest.mark.long
def test_every_package_that_results_depend_on_is_listed() -> None:
    modules = {name for file in PACKAGE.rglob("*.py") for name in imported(file)}
    top = {name.split(".")[0] for name in modules} - sys.stdlib_module_names - {"bevviz"}
    owners = {module: [o.lower() for o in found] for module, found in packages_distributions().items()}
    listed = {*versions(), *NEUTRAL}
    ours = {name for name in top if not any(o.startswith("ros-") for o in owners.get(name, ["ros-"]))}
    assert "numba" in ours
    unlisted = {name: owners[name] for name in ours if listed.isdisjoint(owners[name])}
    assert not unlisted, "in bevviz/recording/provenance.py, or in NEUTRAL if it can change no result"


def test_the_simulator_is_no_part_of_what_the_pipeline_makes() -> None:
    assert "open3d" not in versions()
    assert list(versions())[:2] == ["bevviz", "python"]


def test_files_are_told_apart_by_content(tmp_path: Path) -> None:
    model, names = tmp_path / "a.onnx", tmp_path / "names.txt"
    model.write_bytes(b"network")
    names.write_text("car")
    settings = [f"detector.model={model}", f"detector.names={names}"]
    before = provenance(load(settings=settings), "CPU")
    assert str(before.dependencies["detector.model"]) == f"a.onnx (SHA-256 {file_hash(model)})"
    assert not list(differences(before, provenance(load(settings=settings), "CPU")))

    moved = model.replace(tmp_path / "b.onnx")
    settings = [f"detector.model={moved}"]
    after = provenance(load(settings=settings))
    assert list(differences(before, after)) == [
        f"detector.names was names.txt (SHA-256 {file_hash(names)}), is absent",
        "network was CPU, is absent",
    ]
    moved.write_bytes(b"Network")
    (only,) = differences(after, provenance(load(settings=settings)))
    assert only.startswith("detector.model was b.onnx (SHA-256 ")
    assert "detector.model" not in dependencies_of(load())
    assert "detector.names" not in dependencies_of(
        load(settings=[f"detector.model={moved}", "detector.names=coco"])
    )


def test_a_user_stage_is_listed() -> None:
    """A module has a version, a file and its hash: stored, read back and compared like the others."""
    then = Provenance({"my_pkg.ground:segment": Dependency("1.2", "ab" * 32, "ground.py")})
    now = Provenance({"my_pkg.ground:segment": Dependency("1.3", "cd" * 32, "ground.py")})
    assert STORED.validate_json(json.dumps(asdict(then)), strict=True) == then
    assert list(differences(then, now)) == [
        f"my_pkg.ground:segment was 1.2, ground.py (SHA-256 {'ab' * 32}), "
        f"is 1.3, ground.py (SHA-256 {'cd' * 32})"
    ]


STORED = TypeAdapter(Provenance)  # as part of what a report keeps
text = st.text(min_size=1, max_size=8)
dependencies = st.dictionaries(text, st.builds(Dependency, text, text, text), max_size=4)


@given(dependencies, st.dictionaries(text, text, max_size=4))
def test_stored_provenance_is_read_back(some: dict[str, Dependency], here: dict[str, str]) -> None:
    made_with = Provenance(some, here)
    assert STORED.validate_json(json.dumps(asdict(made_with)), strict=True) == made_with
    assert not list(differences(made_with, made_with))
    assert len(list(differences(made_with, Provenance({})))) == len(some) + len(here)


@pytest.mark.parametrize(
    "values", [{}, {"dependencies": 1, "machine": {}}, {"dependencies": {"a": 1}, "machine": {}}]
)
def test_invalid_provenance_is_refused(values: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="validation error"):
        STORED.validate_json(json.dumps(values), strict=True)


def test_the_machine_is_described() -> None:
    assert {"processor", "cores", "memory", "system"} <= set(machine())
    assert "network" not in machine()
    assert machine("CPU")["network"] == "CPU"
