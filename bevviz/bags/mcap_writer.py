"""Writer of raw messages into an MCAP file, byte for byte as recorded, by the mcap package."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from functools import partial
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import Self, cast

from mcap.records import Header
from mcap.writer import CompressionType
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    Qos,
    QosTime,
)
from ruamel.yaml import YAML

from bevviz.bags.completion import McapOutput, resume, start_writer
from bevviz.bags.mcap import PUBLISHERS
from bevviz.errors import UserError
from bevviz.support import cleanup
from bevviz.support.files import claim_target, rename_new
from bevviz.support.version import __version__

_SCHEMAS = {"protobuf": "protobuf", "json": "jsonschema"}  # schema encodings of messages other than ROS's


class McapWriter:
    """Context manager that writes messages in order of log time. The file appears after a successful end.

    Until then its name is NAME.partial-XXXXXXXX.mcap. A killed process leaves this file, and it can be read.
    If ``write`` finds the disk full, the caller can leave the context without an error. The messages written
    so far then become a complete file.

    ROS 1 messages are not converted. They get the encoding ``ros1``, which MCAP has besides ``cdr``.

    Args:
        path: the ``.mcap`` file.
        define: returns the message definition of a connection.
        ros1: write the profile ``ros1`` instead of ``ros2``.
        compress: compress chunks with zstd.
        replace: overwrite an existing file. Without it, an existing file stays. A bag that cannot be renamed
            or completed then keeps its unfinished name.

    Raises:
        UserError: the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        define: Callable[[Connection], MessageDefinition],
        *,
        ros1: bool = False,
        compress: bool = True,
        replace: bool = True,
    ) -> None:
        self._path = path.resolve()
        self._replace = replace
        self._define = define
        self._header = Header("ros1" if ros1 else "ros2", f"bevviz {__version__}")
        self._compression = CompressionType.ZSTD if compress else CompressionType.NONE
        self._schemas: dict[tuple[str, MessageDefinition, str], int] = {}
        self._channels: dict[tuple[str, str, MessageDefinition, str], int] = {}
        self._counts: Counter[int] = Counter()  # messages by channel
        self._is_full = False  # the disk

    def __enter__(self) -> Self:
        unfinished = claim_target(self._path, "bag")
        self._partial_path = unfinished.path
        cleanup.register(self, partial(self._partial_path.unlink, missing_ok=True))
        self._output = McapOutput(unfinished.handle)
        try:
            self._writer = start_writer(self._output, self._header, self._compression)
        except OSError as error:
            cleanup.unregister(self)
            unfinished.discard()
            raise self._error(error) from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        keep = kind is None and not self._replace
        try:
            if kind is None:
                if self._is_full:
                    resume(self._output.handle)
                else:
                    self._writer.finish()  # type: ignore[no-untyped-call]
                if self._replace:
                    self._partial_path.replace(self._path)
                else:
                    rename_new(self._partial_path, self._path)
        except FileExistsError:
            raise UserError(f"{self._path}: is already there; the bag is {self._partial_path.name}") from None
        except OSError as failure:
            where = f"; what was written is in {self._partial_path.name}" if keep else ""
            raise self._error(failure, where) from None
        finally:
            if not keep:
                self._partial_path.unlink(missing_ok=True)
            cleanup.unregister(self)
            os.close(self._output.handle)  # releases the lock as well

    @property
    def size(self) -> int:
        """Bytes in the file so far, without the open chunk."""
        return self._output.end

    def attach(self, name: str, data: bytes) -> None:
        """Attach a file to the bag. Call it before the first message.

        Raises:
            UserError: the disk is full.
        """
        if self._channels:
            raise ValueError("what is attached comes before the messages")
        try:
            self._writer.add_attachment(0, 0, name, "application/octet-stream", data)
        except OSError as error:
            raise self._error(error) from None

    def write(
        self, connection: Connection, time: int, data: bytes | memoryview, sent: int | None = None
    ) -> None:
        """Append a message.

        Args:
            connection: connection that recorded the message. Its topic, type, encoding and quality of service
                are kept.
            time: log time in nanoseconds.
            data: serialised message.
            sent: time of publication in nanoseconds; None: unknown, so the log time.

        Raises:
            UserError: the disk is full.
        """
        whole_chunks = self._output.end
        try:
            key = connection.topic, connection.msgtype, connection.msgdef, _encoding(connection)
            channel = self._channels.get(key)
            if channel is None:
                channel = self._channels[key] = self._add_channel(connection)
            sequence = self._counts[channel] & 0xFFFFFFFF
            self._counts[channel] += 1
            published = time if sent is None else sent
            self._writer.add_message(channel, time, cast(bytes, data), published, sequence)
        except OSError as error:
            self._output.truncate(whole_chunks)  # So the summary still has room.
            self._is_full = True
            raise self._error(error) from None

    def _error(self, error: OSError, where: str = "") -> UserError:
        return UserError(f"{self._path}: cannot write the bag: {error.strerror}{where}")

    def _add_channel(self, connection: Connection) -> int:
        extra, definition, form = connection.ext, self._define(connection), _encoding(connection)
        key = connection.msgtype, definition, form
        if key not in self._schemas:
            self._schemas[key] = self._add_schema(connection.msgtype, definition, form)
        metadata = {}
        if isinstance(extra, ConnectionExtRosbag2) and extra.offered_qos_profiles:
            # A player then offers a latched topic to late subscribers, as the robot did.
            profiles = BytesIO()
            YAML(typ="safe", pure=True).dump([_profile(qos) for qos in extra.offered_qos_profiles], profiles)
            metadata["offered_qos_profiles"] = profiles.getvalue().decode()
        if connection.digest.startswith("RIHS"):
            metadata["topic_type_hash"] = connection.digest
        if isinstance(connection.owner, str):
            metadata[PUBLISHERS] = connection.owner
        return self._writer.register_channel(connection.topic, form, self._schemas[key], metadata)

    def _add_schema(self, msgtype: str, definition: MessageDefinition, form: str) -> int:
        kind = {
            MessageDefinitionFormat.MSG: "ros1msg" if form == "ros1" else "ros2msg",
            MessageDefinitionFormat.IDL: "ros2idl",
            MessageDefinitionFormat.NONE: _SCHEMAS.get(form, ""),
        }[definition.format]
        name = msgtype.replace("/msg/", "/") if form == "ros1" else msgtype
        content = definition.data.encode("latin-1" if form in _SCHEMAS else "utf-8")
        return int(self._writer.register_schema(name, kind, content))


def _encoding(connection: Connection) -> str:
    """Return the encoding of a channel: that of the connection, cdr unless MCAP names it otherwise."""
    form = getattr(connection.ext, "serialization_format", "ros1")  # A connection of ROS 1 has no such field.
    return form if form in ("ros1", *_SCHEMAS) else "cdr"


def _profile(qos: Qos) -> dict[str, object]:
    """Convert a quality of service to the layout of metadata.yaml version 9."""

    def duration(time: QosTime) -> dict[str, int]:
        return {"sec": time.sec, "nsec": time.nsec}

    return {
        "history": qos.history.name.lower(),
        "depth": qos.depth,
        "reliability": qos.reliability.name.lower(),
        "durability": qos.durability.name.lower(),
        "deadline": duration(qos.deadline),
        "lifespan": duration(qos.lifespan),
        "liveliness": qos.liveliness.name.lower(),
        "liveliness_lease_duration": duration(qos.liveliness_lease_duration),
        "avoid_ros_namespace_conventions": qos.avoid_ros_namespace_conventions,
    }
