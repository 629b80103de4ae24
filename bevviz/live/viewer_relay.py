"""Relay frames to a remote viewer in a separate process: ``python -m bevviz.live.viewer_relay URL ID``.

Rerun's connection waits for ever once its peer is gone. With this process, the run only sees the process end.

Standard input holds pieces of a recording. Each follows its length (8 bytes, little endian). The first piece
is the header with which every file begins. Then come preludes, which contain the header, and packets, which
do not.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, NoReturn

import rerun as rr
from rerun.chunk import RrdReader

from bevviz.recording.blueprints import SavedBlueprint
from bevviz.recording.ports import is_listening
from bevviz.recording.sinks import check_viewer
from bevviz.recording.stream import RecordingStream

PROBE = 2.0  # seconds between two checks of the viewer
MAGIC = 4  # bytes at the start that identify a recording


def main(url: str, application: str, recording_id: str) -> NoReturn:
    """Relay standard input to a viewer until it ends."""
    host, port = check_viewer(url)
    threading.Thread(target=_watch, args=(host, port), daemon=True).start()
    recording = RecordingStream(application, recording_id=recording_id)
    recording.set_log_time_enabled(False)
    recording.set_sinks(rr.GrpcSink(url))
    pieces = _pieces(sys.stdin.buffer)
    header = next(pieces, b"")
    for piece in pieces:
        _forward(piece if piece[:MAGIC] == header[:MAGIC] else header + piece, recording)
    with suppress(RuntimeError):
        recording.flush(timeout_sec=PROBE)
    os._exit(0)  # a normal exit would wait for a viewer that hangs


def _pieces(stream: BinaryIO) -> Iterator[bytes]:
    while length := stream.read(8):
        yield stream.read(int.from_bytes(length, "little"))


def _forward(data: bytes, recording: rr.RecordingStream) -> None:
    """Send the content of a complete recording to the viewer."""
    file = os.memfd_create("piece")
    try:
        with open(file, "wb", closefd=False) as whole:
            whole.write(data)
        path = Path(f"/proc/self/fd/{file}")
        reader = RrdReader(path)
        if reader.blueprints():
            recording.send_blueprint(SavedBlueprint(path))
        for store in reader.recordings():
            recording.send_chunks(reader.stream(store=store))
    finally:
        os.close(file)


def _watch(host: str, port: int) -> None:
    """End this process when the viewer no longer answers."""
    while is_listening(host, port):
        time.sleep(PROBE)
    os._exit(1)


if __name__ == "__main__":
    main(*sys.argv[1:])
