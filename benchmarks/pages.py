"""Sections of the pages that benchmarks write."""

from __future__ import annotations

from pathlib import Path


def write_section(page: Path, section: str) -> None:
    """Put a section in the place of the one with the same heading, else at the end."""
    heading = section.strip().splitlines()[0]
    before, found, rest = page.read_text().partition(f"\n{heading}\n")
    _, another, after = rest.partition("\n## ") if found else ("", "", "")
    page.write_text(f"{before.rstrip()}\n\n{section.strip()}\n" + (f"\n## {after}" if another else ""))
