"""Commands run in this process, and the environment of those that run in another process."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from bevviz.cli import main

Capture = pytest.CaptureFixture[str]


def error_of(capsys: Capture, *arguments: str | Path) -> str:
    """Return the one line that a wrong call prints."""
    assert main([str(a) for a in arguments]) == 2
    said = capsys.readouterr().err
    assert said.startswith("bevviz: error: ")
    assert said.count("\n") == 1
    return said


def environment() -> dict[str, str]:
    """Return the environment of a process that finds this checkout and no display."""
    kept = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    return {**kept, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
