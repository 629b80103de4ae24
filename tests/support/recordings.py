"""Reads a recording back through the SDK, for tests."""

from __future__ import annotations

import math
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from functools import cache, cached_property
from pathlib import Path
from typing import Any, TypeVar

import pyarrow as pa
from rerun.chunk import Chunk, RrdReader

from tests.support.waiting import until

T = TypeVar("T")
Values = dict[int, Any]  # frame -> what one component was


class ByEntity(Mapping[str, T]):
    """Contents by entity. An entity is decoded when it is read; one that was not logged is empty.

    Lists of points and images take most of the time, and few tests read them.
    """

    def __init__(self, entities: Mapping[str, object], decode: Callable[[str], T]) -> None:
        self._entities, self._decode = entities, cache(decode)

    def __getitem__(self, entity: str) -> T:
        return self._decode(entity)

    def __contains__(self, entity: object) -> bool:
        return entity in self._entities

    def __iter__(self) -> Iterator[str]:
        return iter(self._entities)

    def __len__(self) -> int:
        return len(self._entities)

    def __repr__(self) -> str:
        return repr(dict(self))


class Recording:
    """``at[entity][component][frame]``, ``static[entity][component]`` and ``times[timeline][frame]``."""

    def __init__(self, path: Path) -> None:
        self.blueprints = len(RrdReader(path).blueprints())
        self._static: dict[str, list[Chunk]] = defaultdict(list)
        self._moving: dict[str, list[Chunk]] = defaultdict(list)
        for chunk in RrdReader(path).stream():
            chunks = self._static if chunk.is_static else self._moving
            chunks[chunk.entity_path].append(chunk)
        self.rows = ByEntity(self._moving, self._rows_of)
        self.static = ByEntity(self._static, self._static_of)
        logged = {entity: None for entity, chunks in self._moving.items() if any(map(_has_values, chunks))}
        self.at = ByEntity(logged, self._values_of)

    @cached_property
    def times(self) -> dict[str, Values]:
        """Times of every frame on each timeline."""
        found: dict[str, Values] = defaultdict(dict)
        for chunks in self._moving.values():
            for chunk in chunks:
                for row in _rows(chunk, chunk.timeline_names):
                    for name, value in row.items():
                        found[name][row["frame"]] = value
        return found

    def _rows_of(self, entity: str) -> list[dict[str, Any]]:
        return [row for chunk in self._moving.get(entity, ()) for row in _rows(chunk)]

    def _static_of(self, entity: str) -> dict[str, Any]:
        rows = (row for chunk in self._static.get(entity, ()) for row in _rows(chunk))
        return {name: value for row in rows for name, value in row.items() if value is not None}

    def _values_of(self, entity: str) -> dict[str, Values]:
        found: dict[str, Values] = defaultdict(dict)
        for chunk in self._moving.get(entity, ()):
            for row in _rows(chunk):
                for name in row.keys() - set(chunk.timeline_names):
                    if row[name] is not None:
                        found[name][row["frame"]] = row[name]
        return found

    def column(self, entity: str, component: str) -> list[Any]:
        """Return the values of a component in order of frame."""
        return [value for _, value in sorted(self.at[entity][component].items())]

    def text(self, entity: str) -> list[str]:
        """Return the contents of a text document in order of frame."""
        return [value[0] for value in self.column(entity, "TextDocument:text")]

    def cleared(self, entity: str) -> set[int]:
        return set(self.at[entity]["Clear:is_recursive"])


def _has_values(chunk: Chunk) -> bool:
    batch = chunk.to_record_batch()
    names = [name for name in batch.schema.names if not name.startswith("rerun.controls")]
    return any(
        batch.column(name).null_count < batch.num_rows for name in names if name not in chunk.timeline_names
    )


def _rows(chunk: Chunk, names: list[str] | None = None) -> list[dict[str, Any]]:
    """Decode the columns of these names, or all. Times are numbers."""
    batch = chunk.to_record_batch()
    if names is None:
        names = [name for name in batch.schema.names if not name.startswith("rerun.controls")]
    batch = batch.select(names)
    clocks = {name for name in chunk.timeline_names if name != "frame"}
    schema = pa.schema([f.with_type(pa.int64()) if f.name in clocks else f for f in batch.schema])
    rows: list[dict[str, Any]] = batch.cast(schema).to_pylist()
    return rows


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


def verify_when_indexed(path: Path) -> None:
    """Verify a recording of a live run, once a process in the background has made its index."""

    def is_indexed() -> bool:
        try:
            verify(path)
        except AssertionError as error:
            assert "no RRD manifests" in str(error), error
            return False
        return True

    until(is_indexed, f"the index of {path}", every=1.0)
