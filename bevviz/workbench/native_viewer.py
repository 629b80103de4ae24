"""Rerun's native viewer beside the page. It gets the recording, and shows the same time as the page.

The native viewer reports its current time, but not its selection.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any

import numpy as np
from rerun.experimental import ViewerClient
from starlette.websockets import WebSocket, WebSocketDisconnect

from bevviz.errors import UserError, first_line
from bevviz.recording import entities, rerun_cli
from bevviz.recording.ports import FIRST_DATA_PORT, LOOPBACK, free_port
from bevviz.recording.sinks import check_viewer
from bevviz.support.contexts import Closable
from bevviz.workbench.recording_buffer import RecordingBuffer

LOOK = 0.2  # seconds between two queries of the viewer's time
TIMELINES = (entities.STAMP, entities.TRIED)  # timelines that the page knows
MAGIC = 4  # bytes that begin every recording

Event = dict[str, Any]  # same fields as an event of the web viewer


class NativeViewer(Closable):
    """A native viewer, with one thread that sends it the recording and one that watches its time.

    Args:
        films: buffers with the recording. The first one holds the layout.
        recording_id: recording id of all buffers.
        url: address of a running viewer. None: start one on this machine.

    Raises:
        UserError: the viewer cannot be started or reached, or is too old to report its time.
    """

    def __init__(self, films: Sequence[RecordingBuffer], recording_id: str, url: str | None = None) -> None:
        self._films, self._recording_id = films, recording_id
        self._url = url
        self._listeners: list[Callable[[Event], None]] = []
        self._ended, self._wake = threading.Event(), threading.Event()
        self._target: tuple[str, int] | None = None  # timeline and stamp to go to
        self._last: dict[str, Event] = {}  # last event of each type, for a page that connects later
        self._started = threading.Lock()
        self._relay = self._open()

    def close(self) -> None:
        """Stop the relay. The viewer's window stays open until the user closes it."""
        self._ended.set()
        self._wake.set()
        rerun_cli.stop(self._relay)

    def _open(self) -> rerun_cli.Process:
        url = self._url or self._start()
        check_viewer(url)
        client = ViewerClient.connect(url)
        try:
            client.get_state()
        except (RuntimeError, TimeoutError, ValueError) as error:
            raise UserError(f"the viewer at {url} does not tell its time: {first_line(error)}") from None
        relay_future: Future[rerun_cli.Process] = Future()

        def feed() -> None:
            # The relay ends with the thread that starts it. The thread that calls _open may end early,
            # so this thread starts it.
            try:
                relay = self._start_relay(url)
            except OSError as error:
                relay_future.set_exception(error)
                return
            relay_future.set_result(relay)
            self._feed(relay)

        threading.Thread(target=feed, name="native viewer", daemon=True).start()
        relay = relay_future.result()
        threading.Thread(target=self._watch, args=(relay, client), name="native viewer", daemon=True).start()
        return relay

    def _start_relay(self, url: str) -> rerun_cli.Process:
        relay = [sys.executable, "-P", "-m", "bevviz.live.viewer_relay", url, self._recording_id]
        return rerun_cli.spawn(rerun_cli.ending_with_parent(relay))

    def _start(self) -> str:
        port = free_port(FIRST_DATA_PORT)
        arguments = ["--bind", LOOPBACK, "--port", str(port), "--memory-limit", "50%"]
        rerun_cli.start(
            [*arguments, "--expect-data-soon", "--hide-welcome-screen"], LOOPBACK, port, lasting=True
        )
        return f"rerun+http://{LOOPBACK}:{port}/proxy"

    def reopen(self) -> None:
        """Open the viewer again if it was closed. It gets the recording from the beginning.

        Raises:
            UserError: the viewer cannot be started or reached.
        """
        with self._started:
            if self._relay.poll() is not None:
                self._last.clear()
                self._relay = self._open()

    # --- recording -----------------------------------------------------------------------------

    def _feed(self, relay: rerun_cli.Process) -> None:
        """Send the pieces of all buffers to the relay until the viewer is closed."""
        news = threading.Event()
        stop_listening = [film.listen(news.set) for film in self._films]
        rows, header_sent = [0] * len(self._films), False
        assert relay.stdin is not None
        try:
            while not self._ended.is_set() and relay.poll() is None:
                for index, film in enumerate(self._films):
                    while (
                        rows[index] < len(film) and not self._ended.is_set() and (header_sent or index == 0)
                    ):
                        piece = film[rows[index]]
                        for block in (piece,) if header_sent else (piece[:MAGIC], piece):
                            relay.stdin.write(len(block).to_bytes(8, "little"))
                            relay.stdin.write(block)
                        relay.stdin.flush()
                        rows[index] += 1
                        header_sent = True
                news.wait(LOOK)
                news.clear()
        except (OSError, ValueError):
            pass  # The viewer is closed. The thread that watches its time reports that.
        finally:
            for stop in stop_listening:
                stop()

    # --- time ----------------------------------------------------------------------------------

    def seek(self, timeline: str, stamp: int) -> None:
        """Move the viewer to a stamp. Any thread may call this."""
        self._target = timeline, stamp
        self._wake.set()

    def _watch(self, relay: rerun_cli.Process, client: ViewerClient) -> None:
        """Move the viewer to the stamp that the page wants, and report changes of its time."""
        last_shown: tuple[str | None, int | None] = None, None
        opened = False
        while not self._ended.is_set():
            self._wake.wait(LOOK)
            self._wake.clear()
            if relay.poll() is not None:
                self._tell({"type": "viewer_gone"})
                return
            try:
                matching = [
                    recording
                    for recording in client.get_state().recordings
                    if recording.store_id.endswith(self._recording_id)
                ]
                if not matching or matching[0].current_time is None:
                    continue
                if not opened:
                    opened = True
                    self._tell({"type": "recording_open"})
                target = self._target
                if target is not None:
                    client.set_time(
                        target[0],
                        timestamp=np.datetime64(target[1], "ns"),
                        play_state="paused",
                        recording=matching[0].store_id,
                    )
                    if self._target == target:  # Otherwise the page wants a newer time already.
                        self._target = None
                    last_shown = target
                    self._tell({"type": "time_update", "timeline": target[0], "time": target[1]})
                    continue
            except (RuntimeError, TimeoutError, ValueError, ConnectionError):
                continue  # The viewer is busy: ask again. Once it is closed, the relay ends.
            current = matching[0].current_timeline, matching[0].current_time
            if current != last_shown and current[0] in TIMELINES:
                last_shown = current
                self._tell({"type": "time_update", "timeline": current[0], "time": current[1]})

    # --- page ----------------------------------------------------------------------------------

    def listen(self, listener: Callable[[Event], None]) -> Callable[[], None]:
        """Call the listener, from any thread, with every event.

        It is called at once with the last event of each type.

        Returns:
            A function that ends this.
        """
        for event in list(self._last.values()):
            listener(event)
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def _tell(self, event: Event) -> None:
        self._last[event["type"]] = event
        for listener in tuple(self._listeners):
            listener(event)

    async def talk(self, socket: WebSocket) -> None:
        """Send the events to a page, and follow its time."""
        await socket.accept()
        loop, events = asyncio.get_running_loop(), asyncio.Queue[Event]()

        def queue_event(event: Event) -> None:
            with contextlib.suppress(RuntimeError):  # The server has ended.
                loop.call_soon_threadsafe(events.put_nowait, event)

        async def send_events() -> None:
            while True:
                await socket.send_text(json.dumps(await events.get()))

        stop = self.listen(queue_event)
        sender = asyncio.ensure_future(send_events())
        try:
            with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                while True:
                    await self._take(json.loads(await socket.receive_text()), queue_event)
        finally:
            sender.cancel()
            stop()

    async def _take(self, message: Event, queue_event: Callable[[Event], None]) -> None:
        if message.get("type") == "time_ctrl" and str(message.get("timestamp_nanos", "")).isdecimal():
            timeline = message.get("timeline")
            self.seek(timeline if timeline in TIMELINES else entities.STAMP, int(message["timestamp_nanos"]))
        elif message.get("type") == "reopen":
            try:
                await asyncio.to_thread(self.reopen)
            except UserError as error:
                queue_event({"type": "viewer_gone", "text": str(error)})
