"""Search of a fix for the drive of a page, without a browser."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import bevviz
from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.errors import UserError
from bevviz.workbench.fix_search import FixJob
from bevviz.workbench.session import WorkbenchSession, recorded_session
from tests.support.waiting import PATIENCE

FRAMES = 10


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fix") / "demo.mcap"
    assert main(["demo", "--frames", str(FRAMES), "-o", str(path)]) == 0
    return path


@pytest.fixture
def session(bag: Path) -> Iterator[WorkbenchSession]:
    """Yield the session of a drive whose threshold leaves no detection. Its run is not started."""
    values = {"detector.conf_threshold": 0.99}
    with (
        bevviz.open(bag, model="demo", set=values) as drive,
        BagSource([bag], drive.config) as again,
        recorded_session(drive, again, [bag]) as session,
    ):
        yield session


def progress(session: WorkbenchSession) -> FixJob:
    """Return what the page is told of the search."""
    entry = session.progress()["fix"]
    assert entry is not None
    return entry


def ended(session: WorkbenchSession) -> str:
    """Return the state of the search after its end."""
    end = time.monotonic() + PATIENCE
    while session.tools.fix.jobs[-1].going and time.monotonic() < end:
        time.sleep(0.05)
    return session.tools.fix.jobs[-1].state


@pytest.mark.long
def test_the_wrong_parameter_is_found(session: WorkbenchSession, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bevviz.why.fix.TRIALS", 6)
    fix = session.tools.fix
    assert session.progress()["fix"] is None
    fix.begin()
    with pytest.raises(UserError, match="wait for it, or cancel it"):
        fix.begin()
    assert ended(session) == "over"
    found = progress(session)
    assert found.done == found.total == 6
    (setting,) = [one for one in found.settings if one.startswith("detector.conf_threshold=")]
    assert float(setting.partition("=")[2]) < 0.9
    assert "missed objects" in found.text and "--set" not in found.text


def test_a_cancelled_search_can_be_begun_again(session: WorkbenchSession) -> None:
    fix = session.tools.fix
    for _ in range(2):
        fix.begin()
        fix.cancel()
        assert ended(session) == "cancelled"
    assert progress(session).settings == ()


def test_a_drive_without_truth_has_no_fix(bag: Path) -> None:
    with (
        bevviz.open(bag, model="demo") as drive,
        BagSource([bag], drive.config) as again,
        recorded_session(drive, again, [bag]) as session,
    ):
        session.source.has_truth = False
        with pytest.raises(UserError, match="no ground truth"):
            session.tools.fix.begin()
