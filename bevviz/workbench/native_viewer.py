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
from bevviz.support.contexts import Closing
from bevviz.workbench.recording_buffer import Film

LOOK = 0.2  # seconds between two queries of the viewer's time
TIMELINES = (entities.STAMP, entities.TRIED)  # timelines that the page knows
MAGIC = 4  # bytes that begin every recording

Event = dict[str, Any]  # same fields as an event of the web viewer


class NativeViewer(Closing):
    """A native viewer, with one thread that sends it the recording and one that watches its time.

    Args:
        films: buffers with the recording. The first one holds the layout.
        recording_id: recording id of all buffers.
        url: address of a running viewer. None: start one on this machine.

    Raises:
        UserError: the viewer cannot be started or reached, or is too old to report its time.
    """

    def __init__(self, films: Sequence[Film], recording_id: str, url: str | None = None) -> None:
        self._films, self._recording_id = films, recording_id
        self._given = url
        self._listeners: list[Callable[[Event], None]] = []
        self._ended, self._wake = threading.Event(), threading.Event()
        self._wanted: tuple[str, int] | None = None  # timeline and stamp to go to
        self._last: dict[str, Event] = {}  # last event of each type, for a page that connects later
        self._started = threading.Lock()
        self._relay = self._open()

    def close(self) -> None:
        """Stop the relay. The viewer's window stays open until the user closes it."""
        self._ended.set()
        self._wake.set()
        rerun_cli.end(self._relay)

    def _open(self) -> rerun_cli.Process:
        url = self._given or self._start()
        check_viewer(url)
        client = ViewerClient.connect(url)
        try:
            client.get_state()
        except (RuntimeError, TimeoutError, ValueError) as error:
            raise UserError(f"the viewer at {url} does not tell its time: {first_line(error)}") from None
        begun: Future[rerun_cli.Process] = Future()

        def feed() -> None:
            # The relay ends with the thread that starts it. The thread that calls _open may end early,
            # so this thread starts it.
            try:
                relay = self._start_relay(url)
            except OSError as error:
                begun.set_exception(error)
                return
            begun.set_result(relay)
            self._feed(relay)

        threading.Thread(target=feed, name="native viewer", daemon=True).start()
        relay = begun.result()
        threading.Thread(target=self._watch, args=(relay, client), name="native viewer", daemon=True).start()
        return relay

    def _start_relay(self, url: str) -> rerun_cli.Process:
        relay = [sys.executable, "-P", "-m", "bevviz.live.viewer_relay", url, self._recording_id]
        return rerun_cli.spawn(rerun_cli.tied(relay))

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
        more = threading.Event()
        ends = [film.listen(more.set) for film in self._films]
        rows, begun = [0] * len(self._films), False
        assert relay.stdin is not None
        try:
            while not self._ended.is_set() and relay.poll() is None:
                for place, film in enumerate(self._films):
                    while rows[place] < len(film) and not self._ended.is_set() and (begun or place == 0):
                        piece = film[rows[place]]
                        for part in (piece,) if begun else (piece[:MAGIC], piece):
                            relay.stdin.write(len(part).to_bytes(8, "little"))
                            relay.stdin.write(part)
                        relay.stdin.flush()
                        rows[place] += 1
                        begun = True
                more.wait(LOOK)
                more.clear()
        except (OSError, ValueError):
            pass  # The viewer is closed. The thread that watches its time reports that.
        finally:
            for end in ends:
                end()

    # --- time ----------------------------------------------------------------------------------

    def seek(self, timeline: str, stamp: int) -> None:
        """Move the viewer to a stamp. Any thread may call this."""
        self._wanted = timeline, stamp
        self._wake.set()

    def _watch(self, relay: rerun_cli.Process, client: ViewerClient) -> None:
        """Move the viewer to the stamp that the page wants, and report changes of its time."""
        shown: tuple[str | None, int | None] = None, None
        opened = False
        while not self._ended.is_set():
            self._wake.wait(LOOK)
            self._wake.clear()
            if relay.poll() is not None:
                self._tell({"type": "viewer_gone"})
                return
            try:
                mine = [
                    one for one in client.get_state().recordings if one.store_id.endswith(self._recording_id)
                ]
                if not mine or mine[0].current_time is None:
                    continue
                if not opened:
                    opened = True
                    self._tell({"type": "recording_open"})
                wanted = self._wanted
                if wanted is not None:
                    client.set_time(
                        wanted[0],
                        timestamp=np.datetime64(wanted[1], "ns"),
                        play_state="paused",
                        recording=mine[0].store_id,
                    )
                    if self._wanted == wanted:  # Otherwise the page wants a newer time already.
                        self._wanted = None
                    shown = wanted
                    self._tell({"type": "time_update", "timeline": wanted[0], "time": wanted[1]})
                    continue
            except (RuntimeError, TimeoutError, ValueError, ConnectionError):
                continue  # The viewer is busy: ask again. Once it is closed, the relay ends.
            now = mine[0].current_timeline, mine[0].current_time
            if now != shown and now[0] in TIMELINES:
                shown = now
                self._tell({"type": "time_update", "timeline": now[0], "time": now[1]})

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
        loop, news = asyncio.get_running_loop(), asyncio.Queue[Event]()

        def told(event: Event) -> None:
            with contextlib.suppress(RuntimeError):  # The server has ended.
                loop.call_soon_threadsafe(news.put_nowait, event)

        async def tell() -> None:
            while True:
                await socket.send_text(json.dumps(await news.get()))

        end = self.listen(told)
        telling = asyncio.ensure_future(tell())
        try:
            with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                while True:
                    await self._take(json.loads(await socket.receive_text()), told)
        finally:
            telling.cancel()
            end()

    async def _take(self, message: Event, told: Callable[[Event], None]) -> None:
        if message.get("type") == "time_ctrl" and str(message.get("timestamp_nanos", "")).isdecimal():
            timeline = message.get("timeline")
            self.seek(timeline if timeline in TIMELINES else entities.STAMP, int(message["timestamp_nanos"]))
        elif message.get("type") == "reopen":
            try:
                await asyncio.to_thread(self.reopen)
            except UserError as error:
                told({"type": "viewer_gone", "text": str(error)})
