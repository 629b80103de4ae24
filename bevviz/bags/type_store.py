"""What messages are made of: as the bag says, else as the ROS release does."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any, Literal

from rosbags.interfaces import Connection, MessageDefinition, MessageDefinitionFormat
from rosbags.serde.cdr import generate_deserialize_cdr
from rosbags.serde.ros1 import generate_deserialize_ros1
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore
from rosbags.typesys.stores import empty

from bevviz.bags.message import is_ros1
from bevviz.bags.reader import normalized
from bevviz.errors import first_line
from bevviz.messages import decoders, grid_map_msgs, vision_msgs

PREPROCESSED = re.compile(r"^[ \t]*#.*$", re.MULTILINE)  # of IDL: rosbags takes no #include
_MADE: Mapping[str, Callable[[Any, Typestore], Any]] = {
    "deserialize_cdr_le": lambda fields, store: generate_deserialize_cdr(fields, store, "le"),
    "deserialize_cdr_be": lambda fields, store: generate_deserialize_cdr(fields, store, "be"),
    "deserialize_ros1": generate_deserialize_ros1,
}


class MessageTypes:
    """The types of a recording's messages.

    Args:
        tell: gets a sentence on each definition of the bag's that cannot be used.

    Attributes:
        release: of ROS 2, that says what the bag does not.
    """

    def __init__(self, tell: Callable[[str], object]) -> None:
        self.release = Stores.ROS2_JAZZY
        self._tell = tell
        self._stores: dict[tuple[object, ...], Typestore] = {}

    def definition(self, connection: Connection) -> MessageDefinition:
        """What a type is made of: as the bag says, else as the ROS release does; NONE where nobody knows."""
        if connection.msgdef.format != MessageDefinitionFormat.NONE:
            return connection.msgdef
        version: Literal[1, 2] = 1 if is_ros1(connection) else 2
        try:
            msgtype = normalized(connection.msgtype)
            text, _ = self.store(connection).generate_msgdef(msgtype, ros_version=version)
        except (KeyError, TypesysError):
            return connection.msgdef
        return MessageDefinition(MessageDefinitionFormat.MSG, text)

    def fields(self, connection: Connection) -> Mapping[str, Any]:
        """The fields of every type that a connection's messages may be made of, as rosbags has them."""
        return self.store(connection).fielddefs

    def store(self, connection: Connection) -> Typestore:
        """The types that the bag itself defines, else those of the ROS release."""
        ros1, definition = is_ros1(connection), connection.msgdef
        key = (ros1, connection.msgtype, definition)
        if key not in self._stores:
            store = None
            if definition.format != MessageDefinitionFormat.NONE:
                try:
                    store = _defined(connection)
                except Exception as error:  # a definition that rosbags cannot parse
                    self._tell(
                        f"{connection.topic}: the bag's own definition of {connection.msgtype} is not usable "
                        f"({first_line(error).rstrip(':')}); that of {self.release.value} is taken"
                    )
            if store is None:
                store = get_typestore(Stores.ROS1_NOETIC if ros1 else self.release)
                vision_msgs.register(store)
                grid_map_msgs.register(store)
                decoders.register_definitions(store)
            self._stores[key] = store
        return self._stores[key]


def _defined(connection: Connection) -> Typestore:
    """A store of the types that a connection's own definition lists."""
    text, msgtype = connection.msgdef.data, normalized(connection.msgtype)
    if connection.msgdef.format == MessageDefinitionFormat.MSG:
        types = get_types_from_msg(text, msgtype)
    else:
        types = {}
        for part in filter(str.strip, text.split("=" * 80 + "\n")):
            _, _, body = part.partition("\n") if part.startswith("IDL: ") else ("", "", part)
            types.update(get_types_from_idl(PREPROCESSED.sub("", body)))
    store = ReadTypes()
    store.register(types)
    return store


class ReadTypes(Typestore):
    """As rosbags' own, which compiles twelve functions for each type: here one is, when it is wanted.

    Of the types of a usual bag that takes 2 ms where all take 100 to 300 ms. rosbags 0.11 has no public way
    to one of them alone, and ``get_msgdef`` is what its own readers of messages go through.
    """

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
