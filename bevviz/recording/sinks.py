"""Open a recording with its outputs: file, viewer on this machine, viewer elsewhere, browser."""

from __future__ import annotations

import fcntl
import os
import socket
import struct
import sys
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

import rerun as rr
import rerun.blueprint as rrb

from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.model.frame import Scene
from bevviz.recording import blueprints, rerun_cli
from bevviz.recording.ports import (
    FIRST_DATA_PORT,
    LOOPBACK,
    allowed_origins,
    check_port,
    free_port,
    host_for,
    own_address,
    viewer_address,
)
from bevviz.recording.retention import keeps_everything
from bevviz.recording.source_lookup import Origin
from bevviz.recording.stream import RecordingStream
from bevviz.support.contexts import Closable
from bevviz.support.files import UnfinishedFile, atomic_write, write_all

CHUNK_SECONDS = 2.0  # seconds that a frame may wait until a chunk is written
CHUNK_BYTES = 1 << 24  # bytes that may wait until a chunk is written
PIPE_BYTES = 1 << 20
BUFFER_BYTES = 4 << 20  # grows for longer messages
HEADER_BYTES = 12  # bytes of a recording's header: magic, version, options
MESSAGE_HEADER = struct.Struct("<QQ")  # kind and length of the message that follows


@dataclass(frozen=True, slots=True)
class OpenRecording:
    """An open recording.

    Attributes:
        recording: recording stream.
        urls: addresses to open in a browser or viewer, one for each server.
        warnings: one sentence each.
        file: temporary file until the recording is complete; None: the recording goes to no file.
        writer: writer of the file.
    """

    recording: rr.RecordingStream
    urls: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    file: Path | None = None
    writer: FileWriter | None = None

    @property
    def recording_id(self) -> str:
        """Identifier of the recording."""
        identifier = rr.get_recording_id(self.recording)
        assert identifier is not None
        return str(identifier)

    def check(self) -> None:
        """Raise UserError if the file can no longer be written."""
        if self.writer is not None:
            self.writer.check()


@contextmanager
def open_recording(
    scene: Scene,
    config: Config,
    *,
    save: Path | None = None,
    serve: int | None = None,
    bind: str = LOOPBACK,
    connect: str | None = None,
    spawn: bool = False,
    blueprint: str | rrb.Blueprint = "debug",
    recording_id: str | None = None,
    place: Path | None = None,
    keep: bool = True,
    origin: Origin | None = None,
) -> Iterator[OpenRecording]:
    """Open a recording with a blueprint and one or several outputs.

    The file is written under a temporary name next to its target (see ``bevviz.support.files``). After an
    interruption it holds everything that was logged before.

    Args:
        scene: names of the sensors, for the blueprint.
        config: configuration of the run.
        save: .rrd file; an existing one is replaced at the end.
        serve: port of the web viewer on this machine.
        bind: address of this machine at which ``serve`` listens, for the page and for the data.
        connect: URL of a viewer that listens, rerun+http://host:9876/proxy.
        spawn: open the viewer on this machine.
        blueprint: name of a layout, a .py or .rbl file, or a layout.
        recording_id: viewers and catalogs merge recordings with the same identifier; None: a random one, the
            same for all recordings of a process.
        place: final path of the file, if it is not ``save``.
        keep: whether an unfinished file stays after an error.
        origin: source of the recording; None: it is made from ``scene`` and ``config``.

    Raises:
        UserError: the blueprint is unknown, the file cannot be written, another process writes it, the port
            is in use, or no viewer answers. On leaving: not everything could be written.
    """
    layout = blueprints.load(blueprint, scene, config) if isinstance(blueprint, str) else blueprint
    sinks: list[rr.FileSink | rr.GrpcSink | rr.GrpcServerSink] = []
    urls: list[str] = []
    warnings: list[str] = []
    file: Path | None = None
    writer: FileWriter | None = None
    with ExitStack() as stack:
        if save is not None:
            unfinished = stack.enter_context(_open_file(save, keep))
            file = unfinished.path
            writer = stack.enter_context(FileWriter(file))
            sinks.append(writer.sink)
            warnings += unfinished.warnings
        if connect is not None:
            sinks.append(_connect(connect))
        if spawn:
            sinks.append(_start_viewer())
        if serve is not None:
            server, address = stack.enter_context(_serve_web(serve, bind))
            sinks.append(server)
            urls.append(address)
        has_viewer = connect is not None or spawn or serve is not None
        application = blueprints.application_id(blueprint, scene, config)
        batcher = None if has_viewer else chunk_batching(config)
        recording = _new_stream(application, recording_id, batcher)
        # The writer waits until Rerun closes the sink. From here on, every interrupt must close it.
        stack.callback(recording.disconnect)
        try:
            recording.set_sinks(*sinks, default_blueprint=layout)
        except (RuntimeError, ValueError) as error:
            raise UserError(f"cannot open the outputs: {error}") from None
        if writer is not None:
            writer.begin()
        if origin is None:
            origin = Origin.of(scene, config, place or save)
        if origin is not None:
            origin.log(recording)
        try:
            yield OpenRecording(recording, urls, warnings, file, writer)
        finally:
            _flush_and_disconnect(recording)
            if writer is not None:
                writer.close()
        if writer is not None:
            writer.check()


def _new_stream(
    application: str, recording_id: str | None, batcher: rr.ChunkBatcherConfig | None
) -> rr.RecordingStream:
    recording = RecordingStream(application, recording_id=recording_id, batcher_config=batcher)
    recording.set_log_time_enabled(False)  # frames have their own clocks
    return recording


def chunk_batching(config: Config) -> rr.ChunkBatcherConfig | None:
    """Return the batching of log calls into chunks of a file. None: Rerun's default.

    Small frames get larger chunks, which compress better.
    """
    if keeps_everything(config):
        return None
    batcher = rr.ChunkBatcherConfig()
    batcher.flush_tick, batcher.flush_num_bytes = CHUNK_SECONDS, CHUNK_BYTES
    return batcher


def _flush_and_disconnect(recording: rr.RecordingStream) -> None:
    """Flush and close the recording. An exception that is already being raised takes precedence."""
    pending = sys.exc_info()[0] is not None
    try:
        recording.flush()
    except (RuntimeError, ValueError) as error:
        if not pending:
            raise UserError(f"the end of the recording was lost: {error}") from None
    finally:
        recording.disconnect()


def _open_file(path: Path, keep: bool) -> AbstractContextManager[UnfinishedFile]:
    for name in (path, path.resolve()):  # a typing error must not overwrite a bag, not even through a link
        if name.suffix != ".rrd":
            link = f" (it is a link to {name})" if name != path else ""
            raise UserError(f"--save {path}: expected a file name that ends in .rrd{link}")
    return atomic_write(path, "recording", keep=keep)


def _connect(url: str) -> rr.GrpcSink:
    """Return a sink to a viewer elsewhere. Check the port first, as Rerun reports errors only at the end."""
    check_viewer(url)
    return rr.GrpcSink(url)


def check_viewer(url: str) -> tuple[str, int]:
    """Return host and port of a viewer that answers.

    Raises:
        UserError: the URL is not a viewer's, or the viewer does not answer.
    """
    parts = urlsplit(url)
    scheme = parts.scheme in ("rerun", "rerun+http", "rerun+https")
    try:
        host, port = parts.hostname, parts.port
    except ValueError:
        host, port = None, None
    if not scheme or not host or parts.path != "/proxy":
        raise UserError(f"--connect {url}: expected a URL such as rerun+http://192.168.0.2:9876/proxy")
    port = port or (80 if parts.scheme == "rerun+http" else 443)
    try:
        socket.create_connection((host, port), timeout=5).close()
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(
            f"--connect {url}: no viewer answers there ({reason}); start one with 'rerun'"
        ) from None
    return host, port


def _start_viewer() -> rr.GrpcSink:
    """Start a viewer for this machine only. The SDK's own function opens it to the network."""
    port = free_port(FIRST_DATA_PORT)
    arguments = ["--bind", LOOPBACK, "--port", str(port), "--memory-limit", "50%"]
    arguments += [
        "--server-memory-limit",
        rerun_cli.SERVER_MEMORY,
        "--expect-data-soon",
        "--hide-welcome-screen",
    ]
    try:
        rerun_cli.start(arguments, LOOPBACK, port, lasting=True)
    except UserError as error:
        raise UserError(f"cannot start the viewer: {error}; --save or --serve need none") from None
    return rr.GrpcSink(f"rerun+http://{LOOPBACK}:{port}/proxy")


@contextmanager
def _serve_web(port: int, bind: str) -> Iterator[tuple[rr.GrpcServerSink, str]]:
    """Serve the web viewer at ``port``, and its data at another port. Yield the sink and the page's URL."""
    address = own_address(bind)
    check_port(port)
    data_port, host = free_port(FIRST_DATA_PORT, but=port), host_for(address)
    server = rr.GrpcServerSink(
        address,
        data_port,
        server_memory_limit=rerun_cli.SERVER_MEMORY,
        cors_allow_origin=allowed_origins(address, port),
    )
    page = rerun_cli.start_web_viewer(address, port, f"rerun+http://{host}:{data_port}/proxy")
    try:
        yield server, viewer_address(host, port, data_port)
    finally:
        rerun_cli.stop(page)


# --- the file ----------------------------------------------------------------------------------


class FileWriter(Closable):
    """Writer of Rerun's log data to a file.

    Rerun's own writer ends silently at the first error, and the next flush then waits for ever. Here Rerun
    writes into a pipe. A thread copies the pipe to the file. After a write error it discards the data.
    The thread writes whole messages only, so a file that ends early can be read up to its end.

    Args:
        file: existing file.
    """

    def __init__(self, file: Path) -> None:
        self._failure: OSError | None = None
        self._written = 0  # bytes
        self._handle = os.open(file, os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        self._read_end, self._write_end = os.pipe()
        if sys.platform == "linux":
            with suppress(OSError):
                fcntl.fcntl(self._read_end, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self.sink = rr.FileSink(f"/dev/fd/{self._write_end}")
        self._thread = threading.Thread(target=self._run, name="file", daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """Close our end of the pipe, so that the pipe ends with the sink.

        Call it when Rerun has opened the sink.
        """
        os.close(self._write_end)
        self._write_end = -1

    def check(self) -> None:
        """Raise UserError if the file can no longer be written."""
        if self._failure is not None:
            raise UserError(f"the recording ends early, its disk takes no more: {self._failure.strerror}")

    def close(self) -> None:
        """Wait until everything is written. A second call does nothing.

        Call it when Rerun has closed the sink.
        """
        if self._handle < 0:
            return
        with suppress(OSError):  # An interrupt may have come after the end was closed, before that was noted.
            if self._write_end >= 0:
                self.begin()
        self._thread.join()
        for end in (self._handle, self._read_end):
            with suppress(OSError):
                os.close(end)
        self._handle = -1

    def _run(self) -> None:
        buffer = memoryview(bytearray(BUFFER_BYTES))
        size = 0  # bytes in the buffer
        message_end = HEADER_BYTES  # bytes up to the end of the last message seen so far
        while count := os.readv(self._read_end, [buffer[size:]]):
            size += count
            complete = 0
            while size >= message_end:
                complete = message_end
                if size < complete + MESSAGE_HEADER.size:
                    break
                _, length = MESSAGE_HEADER.unpack_from(buffer, complete)
                message_end = complete + MESSAGE_HEADER.size + length
            self._write(buffer[:complete])
            rest = bytes(buffer[complete:size])
            size, message_end = len(rest), message_end - complete
            if size + PIPE_BYTES > len(buffer):
                buffer = memoryview(bytearray(2 * len(buffer)))
            buffer[:size] = rest
        self._write(buffer[:size])  # the footer is no message

    def _write(self, data: memoryview) -> None:
        """Write all of the data. After an error, cut the file back to its last whole write."""
        if self._failure is not None:
            return
        try:
            write_all(self._handle, data)
        except OSError as error:
            self._failure = error
            with suppress(OSError):
                os.ftruncate(self._handle, self._written)
        self._written += len(data)
