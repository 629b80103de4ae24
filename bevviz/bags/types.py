"""Types of messages that are only read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from rosbags.serde.cdr import generate_deserialize_cdr
from rosbags.serde.ros1 import generate_deserialize_ros1
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore
from rosbags.typesys.stores import empty

_MADE: Mapping[str, Callable[[Any, Typestore], Any]] = {
    "deserialize_cdr_le": lambda fields, store: generate_deserialize_cdr(fields, store, "le"),
    "deserialize_cdr_be": lambda fields, store: generate_deserialize_cdr(fields, store, "be"),
    "deserialize_ros1": generate_deserialize_ros1,
}


class ReadTypes(Typestore):
    """As rosbags' own, which compiles twelve functions for each type: here one is, when it is wanted."""

    def __init__(self) -> None:
        super().__init__(empty)  # time and duration, which no ROS 1 definition says

    def get_msgdef(self, typename: str) -> Any:
        if typename not in self.cache:
            self.cache[typename] = _Read(self, typename)  # type: ignore[assignment]
        return self.cache[typename]

    def whole(self, typename: str) -> Any:
        """With all twelve."""
        made = self.cache.pop(typename)
        try:
            return super().get_msgdef(typename)
        finally:
            self.cache[typename] = made


class _Read:
    """A ``Msgdef`` of rosbags."""

    def __init__(self, store: ReadTypes, typename: str) -> None:
        self._store, self.name, self.cls = store, typename, store.types[typename]
        self.fields = [(normalize_fieldname(name), kind) for name, kind in store.fielddefs[typename][1]]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        make = _MADE.get(name)
        found = (
            getattr(self._store.whole(self.name), name) if make is None else make(self.fields, self._store)
        )
        setattr(self, name, found)
        return found
