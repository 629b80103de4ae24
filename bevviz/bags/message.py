"""Messages as a recording stores them, with the definitions of the bag or else of the ROS release."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from backports import zstd
from rosbags.interfaces import Connection, ConnectionExtRosbag1, MessageDefinition, MessageDefinitionFormat
from rosbags.serde.cdr import generate_deserialize_cdr
from rosbags.serde.ros1 import generate_deserialize_ros1
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore
from rosbags.typesys.stores import empty

from bevviz.bags.compression import ZSTD
from bevviz.bags.reader import normalized
from bevviz.errors import first_line
from bevviz.messages import definitions, foxglove
from bevviz.messages.decoders import MessageError, Scan, read_header
from bevviz.messages.guard import guard
from bevviz.support.limits import MAX_DEFINITION, MAX_MESSAGE, MAX_NAME


@dataclass(frozen=True, slots=True)
class RawMessage:
    """One serialised message of a recording.

    Attributes:
        topic: name of the topic.
        received: log time in nanoseconds.
        data: serialised message, possibly compressed with zstd.
        connection: connection that recorded the message.
        scan: scan made of packets or of a file, in place of ``data``; see ``Recording.scans``.
    """

    topic: str
    received: int
    data: bytes | memoryview
    connection: Connection
    scan: Scan | None = None

    @property
    def type(self) -> str:
        """Type of the message as ROS 2 spells it."""
        return normalized(self.connection.msgtype)

    def content(self) -> bytes | memoryview:
        """Return the serialised message. A compressed message is unpacked.

        Raises:
            zstd.ZstdError: the message cannot be unpacked, or it has more than ``MAX_MESSAGE`` bytes.
        """
        if self.data[:4] != ZSTD:
            return self.data
        stream = zstd.ZstdDecompressor()
        data = stream.decompress(self.data, MAX_MESSAGE)
        if not stream.eof:
            raise zstd.ZstdError("the end of the compressed message is missing, or it is too long")
        return data

    def header(self) -> tuple[int, str]:
        """Return the stamp in nanoseconds and the frame_id. Only the Header at the start is decoded.

        Raises:
            MessageError: the message has no header.
        """
        try:
            data = self.content()
        except zstd.ZstdError:
            raise MessageError(f"{self.topic}: a message of {len(self.data)} bytes is damaged") from None
        if foxglove_encoding(self.connection):
            return guard(self, foxglove.header, self.parsed(data), self.connection.msgtype)
        little = is_ros1(self.connection) or data[1:2] != b"\0"
        if is_ros1(self.connection) and foxglove.foxglove_type(self.connection.msgtype):
            data = bytes(4) + data[:MAX_NAME]  # Its stamp has no seq before it.
        return read_header(data, "<" if little else ">", self.topic)

    def parsed(self, data: bytes | memoryview) -> Any:
        """Parse ``data`` as a Foxglove message.

        Raises:
            MessageError: the bytes do not fit the Foxglove type.
        """
        about = self.connection
        return guard(self, foxglove.parse, data, about.msgtype, foxglove_encoding(about), about.msgdef.data)


def foxglove_encoding(connection: Connection) -> str:
    """Return the serialisation of a Foxglove message that ROS cannot decode: protobuf, json, or empty."""
    form = getattr(connection.ext, "serialization_format", "")
    return form if form in foxglove.ENCODINGS and foxglove.foxglove_type(connection.msgtype) else ""


def unread(connection: Connection) -> str:
    """Return why the messages of a connection cannot be decoded; empty: they can."""
    if isinstance(connection.ext, ConnectionExtRosbag1):
        return ""
    if not connection.msgtype:
        return (
            "its channel has no schema, so that the type of its messages is unknown; let its writer add one"
        )
    form = connection.ext.serialization_format
    if form in ("", "cdr", "ros1") or foxglove_encoding(connection):
        return ""
    helps = "CDR" if form in foxglove.ENCODINGS else "protobuf, JSON or CDR"
    return f"encoded as {form}, which is not read of a {connection.msgtype}; write {helps}"


def is_ros1(connection: Connection) -> bool:
    """Tell whether the messages of a connection are serialised as in ROS 1."""
    extra = connection.ext
    return isinstance(extra, ConnectionExtRosbag1) or extra.serialization_format == "ros1"


PREPROCESSED = re.compile(r"^[ \t]*#.*$", re.MULTILINE)  # IDL lines such as #include; rosbags rejects them
_COMPILERS: Mapping[str, Callable[[Any, Typestore], Any]] = {
    "deserialize_cdr_le": lambda fields, store: generate_deserialize_cdr(fields, store, "le"),
    "deserialize_cdr_be": lambda fields, store: generate_deserialize_cdr(fields, store, "be"),
    "deserialize_ros1": generate_deserialize_ros1,
}


class MessageTypes:
    """Message types of a recording.

    Args:
        tell: receives a warning for each definition of the bag that cannot be used.

    Attributes:
        release: ROS 2 release that defines the types without a definition in the bag.
    """

    def __init__(self, tell: Callable[[str], object]) -> None:
        self.release = Stores.ROS2_JAZZY
        self._tell = tell
        self._stores: dict[tuple[object, ...], Typestore] = {}

    def definition(self, connection: Connection) -> MessageDefinition:
        """Return the definition of a type from the bag, or else from the ROS release.

        The format NONE means that neither defines the type.
        """
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
        """Return the fields of all types in the messages of a connection, in the form of rosbags."""
        return self.store(connection).fielddefs

    def store(self, connection: Connection) -> Typestore:
        """Return the types that the bag defines for a connection, or else those of the ROS release."""
        ros1, definition = is_ros1(connection), connection.msgdef
        key = (ros1, connection.msgtype, definition)
        if key not in self._stores:
            store = None
            if definition.format != MessageDefinitionFormat.NONE:
                try:
                    store = _defined(connection)
                except Exception as error:  # rosbags raises many types for a definition that it cannot parse.
                    self._tell(
                        f"{connection.topic}: the bag's own definition of {connection.msgtype} is not usable "
                        f"({first_line(error).rstrip(':')}); that of {self.release.value} is taken"
                    )
            if store is None:
                store = get_typestore(Stores.ROS1_NOETIC if ros1 else self.release)
                definitions.register(store)
            self._stores[key] = store
        return self._stores[key]


def _defined(connection: Connection) -> Typestore:
    """Build a store of the types in the definition of a connection."""
    text, msgtype = connection.msgdef.data.replace("\r\n", "\n"), normalized(connection.msgtype)
    if len(text) > MAX_DEFINITION:
        raise ValueError(f"it has {len(text):,} characters: {MAX_DEFINITION:,} at most are read")
    if connection.msgdef.format == MessageDefinitionFormat.MSG:
        types = get_types_from_msg(text, msgtype)
    else:
        types = {}
        for part in filter(str.strip, text.split("=" * 80 + "\n")):
            _, _, body = part.partition("\n") if part.startswith("IDL: ") else ("", "", part)
            types.update(get_types_from_idl(PREPROCESSED.sub("", body)))
    store = LazyTypeStore()
    store.register(types)
    return store


class LazyTypeStore(Typestore):
    """Type store that compiles only the functions in use. The store of rosbags compiles twelve for each type.

    That takes 2 ms for the types of a usual bag instead of 100 to 300 ms. rosbags 0.11 has no public way to
    compile one function alone. Its own readers of messages call ``get_msgdef``.
    """

    def __init__(self) -> None:
        super().__init__(empty)  # time and duration, which ROS 1 definitions do not include

    def get_msgdef(self, typename: str) -> Any:
        """Return a message definition that compiles its functions at first use."""
        try:  # The functions of nested types are called once for each message in a message.
            return self.cache[typename]
        except KeyError:
            definition = self.cache[typename] = _LazyDefinition(self, typename)  # type: ignore[assignment]
            return definition

    def whole(self, typename: str) -> Any:
        """Return the message definition of rosbags with all twelve functions."""
        made = self.cache.pop(typename)
        try:
            return super().get_msgdef(typename)
        finally:
            self.cache[typename] = made


class _LazyDefinition:
    """Replacement of a rosbags ``Msgdef`` whose functions are compiled at first use."""

    def __init__(self, store: LazyTypeStore, typename: str) -> None:
        self._store, self.name, self.cls = store, typename, store.types[typename]
        self.fields = [(normalize_fieldname(name), kind) for name, kind in store.fielddefs[typename][1]]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        make = _COMPILERS.get(name)
        found = (
            getattr(self._store.whole(self.name), name) if make is None else make(self.fields, self._store)
        )
        setattr(self, name, found)
        return found
