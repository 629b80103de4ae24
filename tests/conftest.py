"""Where the real data is, and how random the property tests are."""

from __future__ import annotations

import os
import signal
import tomllib
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from hypothesis import settings

# Tests count what a network does: no result of an earlier test or run may answer. The tests of the store
# state a folder of their own.
os.environ["BEVVIZ_STORE"] = ""

# Failed assertions in helpers show their values, too.
pytest.register_assert_rewrite("tests.support")

# The same examples in every CI run, so that a red one is about the change; new ones on a developer's machine.
settings.register_profile("ci", derandomize=True, deadline=None)
settings.register_profile("developer", deadline=None)
settings.load_profile("ci" if os.environ.get("CI") else "developer")

# What a shell starts in the background ignores interrupts, and so would every process that a test interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# The longest files first, so that no worker is left alone with one at the end.
FIRST = (
    *("test_workbench_journeys", "test_live_ros", "test_workbench", "test_torture_benchmark", "test_calib"),
    *("test_example_notebooks", "test_live", "test_batch", "test_workbench_live", "test_benchmarks"),
    *("test_commands", "test_docs", "test_damaged_bags", "test_why", "test_bag"),
)


def pytest_configure() -> None:
    """End the run if the entry points of ``pyproject.toml`` are not installed: commands would be missing."""
    project = tomllib.loads((Path(__file__).resolve().parents[1] / "pyproject.toml").read_text())["project"]
    for group, points in project["entry-points"].items():
        installed = {point.name: point.value for point in entry_points(group=group)}
        if not points.items() <= installed.items():
            pytest.exit(f"{group} of pyproject.toml changed: uv pip install --no-deps --editable .", 4)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that divides the files of tests into shares."""
    parser.addoption("--share", default="0/1", metavar="K/N", help="run every N-th file, from number K on")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave one share of the files, and sort the longest first."""
    number, shares = map(int, config.getoption("share").split("/"))
    if shares > 1:
        marked = config.option.markexpr == "long"
        files = sorted({item.path for item in items if not marked or item.get_closest_marker("long")})
        chosen = set(files[number % shares :: shares])
        config.hook.pytest_deselected(items=[item for item in items if item.path not in chosen])
        items[:] = [item for item in items if item.path in chosen]
    rank = {f"{name}.py": place for place, name in enumerate(FIRST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))


@pytest.fixture(scope="session")
def shared() -> Path:
    """Return the folder of real test data, see README.md."""
    stated = os.environ.get("BEVVIZ_DATA")
    folder = Path(stated) if stated else Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"needs real data: {folder} is not there (BEVVIZ_DATA, see tests/README.md)")
    return folder


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the test in a temporary folder, so that the checkout gets no default outputs. No viewer opens."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
