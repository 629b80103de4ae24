"""Components of an entity as Arrow arrays, without the checks and copies of Rerun's constructors."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from types import MappingProxyType
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr


class Components(rr.AsComponents):
    """Components of one archetype, and further columns.

    Args:
        archetype: class of Rerun.
        fields: values of its fields. Each is an array, a list or an Arrow array.
        columns: values of further columns, by name.
        group: archetype of the further columns. Empty: they have none.
    """

    def __init__(
        self,
        archetype: Any,
        fields: Mapping[str, Any],
        columns: Mapping[Any, Any] = MappingProxyType({}),
        group: str = "",
    ) -> None:
        self.archetype = archetype
        self._batches = []
        for name, values in fields.items():
            descriptor, kind = _field(archetype, name)
            self._batches.append(described(_arrow(values, kind), descriptor))
        for name, values in columns.items():
            self._batches.append(described(_array(values), _column(name, group)))

    def as_component_batches(self) -> list[rr.DescribedComponentBatch]:
        """Return the components."""
        return self._batches


def described(values: pa.Array, descriptor: rr.ComponentDescriptor) -> rr.DescribedComponentBatch:
    """Return an Arrow array as a component."""
    return rr.DescribedComponentBatch(_Values(values), descriptor)


class _Values:
    """Arrow array in the form of a Rerun component."""

    __slots__ = ("_values",)

    def __init__(self, values: pa.Array) -> None:
        self._values = values

    def as_arrow_array(self) -> pa.Array:
        return self._values


@cache
def _field(archetype: Any, name: str) -> tuple[rr.ComponentDescriptor, pa.DataType]:
    """Return descriptor and Arrow type of a field."""
    [batch] = archetype.from_fields(**{name: []}).as_component_batches()
    return batch.component_descriptor(), batch.as_arrow_array().type


@cache
def _column(name: str, group: str) -> rr.ComponentDescriptor:
    descriptor = rr.ComponentDescriptor(name)
    return descriptor.with_builtin_archetype(group) if group else descriptor


def _arrow(values: Any, kind: pa.DataType) -> pa.Array:
    """Convert the values of a field. A field of 32-bit integers has colours: (N, 3) or (N, 4) bytes."""
    if isinstance(values, pa.Array):
        return values
    if pa.types.is_fixed_size_list(kind):
        flat = np.ascontiguousarray(values, np.float32).ravel()
        return pa.FixedSizeListArray.from_arrays(pa.array(flat), type=kind)
    if pa.types.is_uint32(kind):
        channels = np.asarray(values, np.uint8)
        colors = np.full((len(channels), 4), 255, np.uint8)
        colors[:, : channels.shape[1]] = channels
        return pa.array(colors.view(">u4").ravel().astype(np.uint32))
    return _array(values, kind)


def _array(values: Any, kind: pa.DataType | None = None) -> pa.Array:
    """Convert values. A name from a file may hold half of a character, which becomes a question mark."""
    try:
        return pa.array(values, kind)
    except UnicodeEncodeError:
        return pa.array([text.encode(errors="replace").decode() for text in values], kind)
