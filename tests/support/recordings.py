"""Reads a recording back through the SDK, for tests."""

from __future__ import annotations

import math
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import pyarrow as pa
from rerun.chunk import RrdReader

Values = dict[int, Any]  # frame -> what one component was


class Recording:
    """``at[entity][component][frame]``, ``static[entity][component]`` and ``times[timeline][frame]``."""

    def __init__(self, path: Path) -> None:
        self.at: dict[str, dict[str, Values]] = defaultdict(lambda: defaultdict(dict))
        self.static: dict[str, dict[str, Any]] = defaultdict(dict)
        self.times: dict[str, Values] = defaultdict(dict)
        self.rows: dict[str, list[dict[str, Any]]] = defaultdict(list)
        self.blueprints = len(RrdReader(path).blueprints())
        for chunk in RrdReader(path).stream():
            batch = chunk.to_record_batch()
            clocks = {name for name in chunk.timeline_names if name != "frame"}
            batch = batch.cast(
                pa.schema([f.with_type(pa.int64()) if f.name in clocks else f for f in batch.schema])
            )
            names = [name for name in batch.schema.names if not name.startswith("rerun.controls")]
            components = [name for name in names if name not in chunk.timeline_names]
            for row in batch.select(names).to_pylist():
                given = {name: row[name] for name in components if row[name] is not None}
                if chunk.is_static:
                    self.static[chunk.entity_path].update(given)
                    continue
                self.rows[chunk.entity_path].append(row)
                for name, value in given.items():
                    self.at[chunk.entity_path][name][row["frame"]] = value
                for name in chunk.timeline_names:
                    self.times[name][row["frame"]] = row[name]

    def column(self, entity: str, component: str) -> list[Any]:
        """Return the values of a component in order of frame."""
        return [value for _, value in sorted(self.at[entity][component].items())]

    def text(self, entity: str) -> list[str]:
        """Return the contents of a text document in order of frame."""
        return [value[0] for value in self.column(entity, "TextDocument:text")]

    def cleared(self, entity: str) -> set[int]:
        return set(self.at[entity]["Clear:is_recursive"])


def verify(path: Path) -> None:
    """``rerun rrd verify``."""
    command = [sys.executable, "-m", "rerun", "rrd", "verify", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "verified without error" in done.stdout + done.stderr


def without_nan(value: Any) -> Any:
    """Return a value in which every NaN is a text, so that it equals itself."""
    if isinstance(value, dict):
        return {key: without_nan(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [without_nan(inner) for inner in value]
    return "nan" if isinstance(value, float) and math.isnan(value) else value
