"""Checks of the input: every command shows one list."""

from __future__ import annotations

from pathlib import Path

import pytest

import bevviz
from bevviz.cli import main
from bevviz.model.input_findings import InputFinding, Remedy
from tests.support.small_bags import frozen_after


def test_a_run_names_the_sensor_and_its_fault(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """``bag``, ``info`` and Python say the same sentence."""
    path = frozen_after(2.0, tmp_path / "drive")
    sentence = "camera camera: frozen image since 2.0 s"
    assert main(["bag", str(path), "--save", str(tmp_path / "drive.rrd")]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert f"bevviz: warning: {sentence}" in lines
    assert "bevviz: anomalies: 1 sensor (camera camera: frozen image at 2.0 s)" in lines
    with bevviz.open(path) as drive:
        assert sentence not in drive.warnings
        list(drive)
        assert drive.warnings.count(sentence) == 1
        (finding,) = [finding for finding in drive.checks.findings if str(finding) == sentence]
    assert (finding.kind, finding.subject) == ("sensor", "camera camera: frozen image")


def test_a_finding_reads_as_one_sentence() -> None:
    assert str(InputFinding("clock", "/scan", "/scan is 0.5 s late")) == "/scan is 0.5 s late"
    remedy = Remedy("sync.offsets={/scan: -0.5}", tried="pairs 50 of 50 frames")
    assert str(InputFinding("clock", "/scan", "/scan is 0.5 s late", remedy)) == (
        "/scan is 0.5 s late: sync.offsets={/scan: -0.5} (pairs 50 of 50 frames)"
    )
