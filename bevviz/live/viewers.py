"""Viewers, each fed by a thread through a process of its own: one that hangs or dies holds nobody up."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from bevviz.live.encoder import Encoder, Packet
from bevviz.live.files import rerun_binary
from bevviz.live.notes import Notes
from bevviz.live.queue import NewestQueue
from bevviz.logging.logger import Context
from bevviz.logging.sinks import answers, check_port, check_viewer, free_port, viewer_address

RETRY = 3.0  # seconds until a viewer that is gone is tried again


@dataclass(frozen=True, slots=True)
class Program:
    """What shows the frames: it reads a recording from its standard input.

    ``lasting``: it runs as long as we do, and is started again once ``is_ready``; else the user may end it.
    ``framed``: each piece follows its length (see ``relay``).
    """

    name: str
    command: Sequence[str]
    lasting: bool = True
    framed: bool = False
    is_ready: Callable[[], bool] = lambda: True


def window() -> Program:
    """The viewer on this machine."""
    command = [rerun_binary(), "-", "--port", "auto", "--memory-limit", "50%", "--hide-welcome-screen"]
    return Program("window", command, lasting=False)


def server(port: int, bind: str, memory: float) -> tuple[Program, str]:
    """A web viewer at ``port`` of the address ``bind``, which keeps ``memory`` MB, and what to open.

    Raises:
        UserError: the port is in use.
    """
    check_port(port)
    data_port = free_port(9876, but=port)
    command = [rerun_binary(), "-", "--serve-web", "--bind", bind, "--port", str(data_port)]
    command += ["--web-viewer-port", str(port), "--server-memory-limit", f"{memory:.0f}MB"]
    command += ["--cors-allow-origin", f"http://*:{port}"]
    host = (
        "localhost" if bind in ("127.0.0.1", "::1") else socket.gethostname() if bind == "0.0.0.0" else bind
    )
    return Program("web", command), viewer_address(host, port, data_port)


def remote(url: str, recording_id: str) -> Program:
    """A viewer elsewhere.

    Raises:
        UserError: no such URL, or no viewer answers there.
    """
    host, port = check_viewer(url)
    command = [sys.executable, "-m", "bevviz.live.relay", url, recording_id]
    return Program("remote", command, framed=True, is_ready=lambda: answers(host, port))


class Viewer:
    """Feeds one program. Packets that it is too slow for are left out and counted.

    After a gap it goes on at a packet that needs none before it.
    """

    def __init__(self, program: Program, queue: int, encoder: Encoder, notes: Notes) -> None:
        self.name = program.name
        self._program = program
        self._encoder, self._notes = encoder, notes
        self._packets: NewestQueue[Packet] = NewestQueue(queue)
        self._ended = threading.Event()
        self._process = self._start()
        self._thread = threading.Thread(target=self._feed, name=self.name, daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        return self._packets.dropped

    def put(self, packet: Packet) -> None:
        self._packets.put(packet)

    def close(self, patience: float = 2.0) -> None:
        """Hand over what waits, if that is soon done. A window stays open, for the user to close."""
        self._packets.close()
        self._thread.join(patience)
        self._ended.set()
        if self._thread.is_alive() or self._program.lasting:
            self._process.terminate()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(1.0)
            self._process.kill()  # a stopped process does not hear anything else
        self._thread.join(patience)

    def _start(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            self._program.command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for us alone
        )

    def _feed(self) -> None:
        self._begin(self._encoder.context)
        dropped, in_step = 0, False
        for packet in self._packets:
            if self._ended.is_set():
                return
            in_step = in_step and dropped == self.dropped
            dropped = self.dropped
            if not (in_step or packet.whole):
                continue
            if not in_step:
                in_step = self._send(self._encoder.prelude(packet.context, blueprint=False))
            in_step = in_step and self._send(packet.data)
            if not in_step and not self._recover(packet):
                return
        self._close_input()

    def _begin(self, context: Context) -> bool:
        if self._program.framed and not self._send(self._encoder.header):
            return False
        return self._send(self._encoder.prelude(context))

    def _recover(self, packet: Packet) -> bool:
        """Wait for the viewer to come back. False: it need not."""
        if self._ended.is_set():
            return False
        if not self._program.lasting:
            self._notes.info("the viewer was closed; the rest goes on")
            self._packets.close()
            return False
        self._notes.warn(
            f"the {self.name} viewer is gone; trying again every {RETRY:.0f} s, the rest goes on"
        )
        while not self._ended.wait(RETRY):
            if not self._program.is_ready():
                continue
            self._process.wait()
            self._process = self._start()
            if self._begin(packet.context):
                self._notes.info(f"the {self.name} viewer is back")
                return True
        return False

    def _send(self, data: bytes) -> bool:
        assert self._process.stdin is not None
        try:
            if self._program.framed:
                self._process.stdin.write(len(data).to_bytes(8, "little"))
            self._process.stdin.write(data)
            self._process.stdin.flush()
        except OSError:
            return False
        return True

    def _close_input(self) -> None:
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()
