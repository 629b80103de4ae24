"""Outputs of a run, and viewers as outputs. Each has its own thread, so that a slow one delays no other."""

from __future__ import annotations

import subprocess
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from bevviz.live.encoder import Encoder, Packet
from bevviz.live.status import Notes
from bevviz.recording import rerun_cli
from bevviz.recording.frame_logger import RecordingContext
from bevviz.recording.ports import (
    FIRST_DATA_PORT,
    LOOPBACK,
    allowed_origins,
    check_port,
    free_port,
    host_for,
    is_listening,
    own_address,
    viewer_address,
)
from bevviz.recording.sinks import check_viewer
from bevviz.support.queues import NewestQueue

RETRY = 3.0  # seconds between two attempts to reach a lost viewer
BEHIND = 3.0  # seconds of lag at which the user is warned, until it is less than ``LATE``
LATE = 1.0  # seconds of lag from which on no old packets are sent


class Output(ABC):
    """Consumer of packets. Packets that overflow its queue are dropped and counted.

    After a gap it continues at a whole packet.

    Args:
        name: name in the health of the run.
        queue: most packets that may wait.
        sparse: take whole packets only, for a viewer that is too slow for all packets.
    """

    def __init__(self, name: str, queue: int, *, sparse: bool = False) -> None:
        self.name, self._sparse = name, sparse
        self._packets: NewestQueue[Packet] = NewestQueue(queue)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @property
    def dropped(self) -> int:
        """Packets dropped so far."""
        return self._packets.dropped

    @property
    def lag(self) -> float | None:
        """Seconds that the viewer is behind. None: there is no viewer, or its lag is unknown."""
        return None

    def put(self, packet: Packet) -> None:
        """Queue a packet. It never waits."""
        if packet.whole or not self._sparse:
            self._packets.put(packet)

    @abstractmethod
    def close(self) -> None:
        """Write the waiting packets and end."""

    @abstractmethod
    def _take(self, packet: Packet, fresh: bool) -> bool:
        """Write a packet. Return False if that failed; the output then continues at a whole packet.

        ``fresh``: the packet is the first after a gap.
        """

    def _end(self) -> None:
        """Accept no more packets."""
        self._ended.set()
        self._packets.close()

    def _run(self) -> None:
        """Write the queued packets until the queue is closed."""
        dropped, in_step = 0, False
        for packet in self._packets:
            if self._ended.is_set():
                return
            in_step = in_step and dropped == self.dropped
            dropped = self.dropped
            if in_step or packet.whole:
                in_step = self._take(packet, fresh=not in_step)


@dataclass(frozen=True, slots=True)
class Program:
    """Program that shows the frames. It reads a recording from its standard input.

    ``lasting``: it runs until the end, and is restarted once ``is_ready``. Otherwise the user may close it.
    ``framed``: each piece follows its length (see ``viewer_relay``).
    """

    name: str
    command: Sequence[str]
    lasting: bool = True
    framed: bool = False
    is_ready: Callable[[], bool] = lambda: True


def window() -> Program:
    """Return the program of the viewer window on this machine."""
    command = [rerun_cli.rerun_program(), "-", "--bind", LOOPBACK, "--port", "auto"]
    command += ["--memory-limit", "50%", "--hide-welcome-screen"]
    return Program("window", command, lasting=False)


def server(port: int, bind: str, memory: float) -> tuple[Program, str]:
    """Return the program of a web viewer, and the URL to open.

    It listens at ``port`` of the address ``bind`` and keeps ``memory`` MB.

    Raises:
        UserError: the port is in use, or the address does not belong to this machine.
    """
    address = own_address(bind)
    check_port(port)
    data_port = free_port(FIRST_DATA_PORT, but=port)
    command = [rerun_cli.rerun_program(), "-", "--serve-web", "--bind", address, "--port", str(data_port)]
    command += ["--web-viewer-port", str(port), "--server-memory-limit", f"{memory:.0f}MB", "--newest-first"]
    for origin in allowed_origins(address, port):
        command += ["--cors-allow-origin", origin]
    return Program("web", rerun_cli.ending_with_parent(command)), viewer_address(
        host_for(address), port, data_port
    )


def remote(url: str, application: str, recording_id: str) -> Program:
    """Return the program that relays a recording to a remote viewer.

    Raises:
        UserError: the URL is wrong, or no viewer answers there.
    """
    host, port = check_viewer(url)
    command = [sys.executable, "-P", "-m", "bevviz.live.viewer_relay", url, application, recording_id]
    return Program("remote", command, framed=True, is_ready=lambda: is_listening(host, port))


class Viewer(Output):
    """Output that feeds one program. A late viewer gets the newest whole packet and none before it."""

    def __init__(
        self, program: Program, queue: int, encoder: Encoder, notes: Notes, *, sparse: bool = False
    ) -> None:
        super().__init__(program.name, queue, sparse=sparse)
        self._program = program
        self._encoder, self._notes = encoder, notes
        self._lag = 0.0  # seconds, lag of the last packet that was handed over
        self._sending: float | None = encoder.clock()  # time of the packet that is being handed over
        self._process = self._start()
        self._thread.start()

    @property
    def lag(self) -> float:
        """Seconds from the logging of a frame until the viewer's process has read it.

        The backlog in that process, and in a browser behind it, is unknown.
        """
        waiting, sending = self._packets.oldest, self._sending
        if sending is None and waiting is not None:
            sending = waiting.time
        return self._lag if sending is None else self._encoder.clock() - sending

    def put(self, packet: Packet) -> None:
        """Queue a packet. Clear the queue first if the viewer is late."""
        if packet.whole and self.lag > LATE:
            self._packets.clear()
        super().put(packet)

    def close(self, patience: float = 2.0) -> None:
        """Send the waiting packets, if that takes a short time. A window stays open for the user."""
        self._packets.close()
        self._thread.join(patience)
        self._ended.set()
        if self._thread.is_alive() or self._program.lasting:
            self._process.terminate()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(1.0)
            self._process.kill()  # a stopped process reacts to SIGKILL only
        self._thread.join(patience)

    def _start(self) -> subprocess.Popen[bytes]:
        return rerun_cli.spawn(self._program.command)

    def _run(self) -> None:
        """Send the beginning of a recording, then the packets."""
        self._begin(self._encoder.context)
        self._sending = None
        super()._run()
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()

    def _take(self, packet: Packet, fresh: bool) -> bool:
        """Send a packet and measure the lag."""
        self._sending = packet.time
        taken = self._show(packet, fresh)
        self._lag, self._sending = (self._encoder.clock() - packet.time if taken else 0.0), None
        return taken

    def _show(self, packet: Packet, fresh: bool) -> bool:
        """Send a packet, after a prelude if it follows a gap."""
        if fresh and not self._send(self._encoder.prelude(packet.context, blueprint=False)):
            return self._recover(packet.context)
        return self._send(packet.shown) or self._recover(packet.context)

    def _begin(self, context: RecordingContext) -> bool:
        if self._program.framed and not self._send(self._encoder.header):
            return False
        return self._send(self._encoder.prelude(context))

    def _recover(self, context: RecordingContext) -> bool:
        """Wait for the viewer to come back, unless the user has closed it. Return False: a gap follows."""
        if self._ended.is_set():
            return False
        if not self._program.lasting:
            self._notes.info("the viewer was closed; the rest goes on")
            self._end()
            return False
        self._notes.warn(f"the {self.name} viewer is gone; tried again every {RETRY:.0f} s, the rest goes on")
        while not self._ended.wait(RETRY):
            if not self._program.is_ready():
                continue
            self._process.wait()
            self._process = self._start()
            if self._begin(context):
                self._notes.info(f"the {self.name} viewer is back")
                break
        return False

    def _send(self, data: bytes) -> bool:
        """Write bytes to the program. Return whether that succeeded."""
        assert self._process.stdin is not None
        try:
            if self._program.framed:
                self._process.stdin.write(len(data).to_bytes(8, "little"))
            self._process.stdin.write(data)
            self._process.stdin.flush()
        except OSError:
            return False
        return True
