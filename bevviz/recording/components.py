"""Components of an entity as Arrow arrays, without the checks and copies of Rerun's constructors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial
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
        self._components: list[rr.DescribedComponentBatch] = []
        for name, values in fields.items():
            descriptor, convert = _field(archetype, name)
            array = values if isinstance(values, pa.Array) else convert(values)
            self._components.append(Component(array, descriptor))
        for name, values in columns.items():
            self._components.append(Component(_array(values), _column(name, group)))

    def as_component_batches(self) -> list[rr.DescribedComponentBatch]:
        """Return the components."""
        return self._components


class Component(rr.DescribedComponentBatch):
    """Arrow array with the descriptor of its component."""

    def __init__(self, values: pa.Array, descriptor: rr.ComponentDescriptor) -> None:
        self._values, self._descriptor = values, descriptor

    def as_arrow_array(self) -> pa.Array:
        """Return the array."""
        return self._values


@cache
def _field(archetype: Any, name: str) -> tuple[rr.ComponentDescriptor, Callable[[Any], pa.Array]]:
    """Return descriptor of a field, and the converter of its values."""
    [empty] = archetype.from_fields(**{name: []}).as_component_batches()
    kind = empty.as_arrow_array().type
    convert: Callable[[Any], pa.Array] = partial(_array, kind=kind)
    if pa.types.is_fixed_size_list(kind):
        convert = partial(_vectors, kind=kind)
    elif pa.types.is_uint32(kind):  # Only colours are.
        convert = _colors
    return empty.component_descriptor(), convert


@cache
def _column(name: str, group: str) -> rr.ComponentDescriptor:
    descriptor = rr.ComponentDescriptor(name)
    return descriptor.with_builtin_archetype(group) if group else descriptor


def _vectors(values: Any, kind: pa.DataType) -> pa.Array:
    """Convert (N, D) or (D,) numbers."""
    flat = np.ascontiguousarray(values, np.float32).ravel()
    return pa.FixedSizeListArray.from_arrays(pa.array(flat), type=kind)


def _colors(values: Any) -> pa.Array:
    """Convert (N, 3) or (N, 4) bytes."""
    channels = np.asarray(values, np.uint8)
    colors = np.full((len(channels), 4), 255, np.uint8)
    colors[:, : channels.shape[1]] = channels
    return pa.array(colors.view(">u4").ravel().astype(np.uint32))


def _array(values: Any, kind: pa.DataType | None = None) -> pa.Array:
    """Convert values. A name from a file may hold half of a character, which becomes a question mark."""
    try:
        return pa.array(values, kind)
    except UnicodeEncodeError:
        return pa.array([text.encode(errors="replace").decode() for text in values], kind)
