"""The workbench beside a running robot: its newest frames are held, and can be asked about."""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import rerun as rr
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from bevviz.closing import Closing
from bevviz.compare.differences import Change, differences, seen
from bevviz.config import Config, changes, revised, values
from bevviz.errors import UserError
from bevviz.evaluate import Truth, truth_of
from bevviz.frame import FrameResult, Scene
from bevviz.live.encoder import Packet
from bevviz.live.output import Output
from bevviz.live.runtime import Live
from bevviz.logging import blueprints
from bevviz.logging.logger import Context, Logger
from bevviz.logging.sinks import APPLICATION
from bevviz.perceive import describe
from bevviz.session import Session
from bevviz.variants import Variants
from bevviz.why import Answer, Questioner
from bevviz.why.log import mark_answers
from bevviz.workbench.answers import selection
from bevviz.workbench.missed import Find, finds
from bevviz.workbench.pick import Pick, pick
from bevviz.workbench.server import (
    HOSTS,
    SERVER,
    _Guard,
    _listening,
    _routes,
    _Server,
    _Site,
    _until_gone,
    bound,
    viewer_folder,
)

if TYPE_CHECKING:
    from bevviz.workbench.bench import Bench

WHOLE = 3  # packets that need none before them, from the oldest of which on all are kept for pages
KEPT = 4  # frames that pages may hold at once
TRIED = 2  # results of held frames with other values
PATIENCE = 3.0  # seconds that the page's threads may take to end
FOUND = 2000  # things worth a look of frames that were held

Settings = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Piece:
    number: int
    data: bytes  # with the header that every recording begins with
    context: Context | None  # of one that a page can begin with


class LiveFilm(Output):
    """The newest pieces of what is logged, for pages; one that is too slow goes on at the newest.

    Args:
        live: whose results it is.
        queue: packets that may wait.
    """

    def __init__(self, live: Live, queue: int) -> None:
        super().__init__("page", queue)
        self._encoder = live.encoder
        self._pieces: deque[_Piece] = deque()
        self._next = 0
        self._held = threading.Lock()
        self._listeners: list[Callable[[], None]] = []
        self._thread.start()

    def close(self) -> None:
        self._end()
        self._thread.join(1.0)

    def listen(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call it, from some thread, whenever there is more. Returns what ends that."""
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def add(self, data: bytes | None) -> None:
        """A recording of its own that belongs to the same one; None is nothing."""
        if data:
            self._put(data, None)

    def since(self, number: int | None) -> tuple[list[bytes], int]:
        """What a page is to be given next.

        Args:
            number: of the piece that it has not yet; None: it has nothing.

        Returns:
            Recordings, and the number to go on with. Where pieces were missed they begin anew.
        """
        with self._held:
            pieces = list(self._pieces)
            following = self._next
        begin = next((piece for piece in reversed(pieces) if piece.context is not None), None)
        if number is not None and (not pieces or number >= pieces[0].number):
            return [piece.data for piece in pieces if piece.number >= number], following
        if begin is None or begin.context is None:
            return [], -1 if number is None else number
        head = [] if number is not None else [self._layout(begin.context.scene)]
        head.append(self._encoder.prelude(begin.context, blueprint=False))
        return head + [piece.data for piece in pieces if piece.number >= begin.number], following

    def _layout(self, scene: Scene) -> bytes:
        recording = rr.RecordingStream(APPLICATION, recording_id=self._encoder.recording_id)
        stream = rr.binary_stream(recording)
        recording.send_blueprint(blueprints.load("workbench_live", scene), make_active=True)
        return stream.read() or b""

    def _take(self, packet: Packet, fresh: bool) -> bool:
        self._put(self._encoder.header + packet.data, packet.context if packet.whole else None)
        return True

    def _put(self, data: bytes, context: Context | None) -> None:
        with self._held:
            self._pieces.append(_Piece(self._next, data, context))
            self._next += 1
            while sum(piece.context is not None for piece in self._pieces) > WHOLE:
                self._pieces.popleft()
        for listener in tuple(self._listeners):
            listener()


class Robot:
    """What a page asks of a drive: names, configuration, networks."""

    def __init__(self, live: Live) -> None:
        self._live = live

    def __len__(self) -> int:
        return 0

    @property
    def scene(self) -> Scene:
        return self._live.scene

    @property
    def config(self) -> Config:
        return self._live.config

    @property
    def session(self) -> Session:
        return self._live.session


class LiveBench(Closing):
    """A robot on the bench: its newest frames can be asked about, its parameters changed for all to come.

    Questions are to be asked from one thread.

    Args:
        live: before its run.

    Attributes:
        found: what is worth a look in frames that were held.
    """

    def __init__(self, live: Live) -> None:
        self.live, self.drive = live, Robot(live)
        self.film = LiveFilm(live, live.config.live.output_queue)
        self.truth_of: Callable[..., Truth | None] | None = None
        self.opening: int | None = None  # the page is at the newest frame
        self.found: list[Find] = []
        self._newest: deque[FrameResult] = deque(maxlen=live.config.live.held)
        self._kept: OrderedDict[int, FrameResult] = OrderedDict()
        self._lock = threading.Lock()  # of the two
        self._tried: OrderedDict[tuple[int, Settings], FrameResult] = OrderedDict()
        self._before = values(live.config)
        self._set: Settings = ()
        self._variants = Variants(live.session.loader)
        self._asked: Questioner | None = None
        self._listeners: list[Callable[[], None]] = []
        recording = rr.RecordingStream(APPLICATION, recording_id=live.encoder.recording_id)
        recording.set_log_time_enabled(False)
        self._marks = rr.binary_stream(recording)
        self._marker = Logger(recording, live.config, live.scene)
        live.attach(self.film, self._see)

    def close(self) -> None:
        self.film.close()

    def listen(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call it, from any thread, whenever there is a new frame. Returns what ends that."""
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def quiet(self) -> AbstractContextManager[None]:
        """A robot does not wait."""
        return nullcontext()

    def progress(self) -> dict[str, Any]:
        """How it goes."""
        status = self.live.status
        drops = ", ".join(f"{count} {where}" for where, count in status.drops.items() if count)
        return {
            "type": "progress",
            "done": status.frames,
            "total": None,
            "over": True,
            "error": "",
            "warnings": [f"{1e3 * status.p50:.0f} ms", f"dropped: {drops or 'none'}"],
        }

    def _see(self, result: FrameResult) -> None:
        with self._lock:
            self._newest.append(result)
        if result.frame.truth is not None and self.truth_of is None:
            self.truth_of = _own_truth
        for listener in tuple(self._listeners):
            listener()

    # --- frames --------------------------------------------------------------------------------

    def number_at(self, stamp: int) -> int:
        """Number of the frame that a viewer shows at that time.

        Raises:
            UserError: it is not held any more.
        """
        frames = sorted((r.frame.stamp, r.frame.index) for r in self._held())
        if not frames:
            raise UserError("no frame has come yet")
        there = [index for at, index in frames if at <= stamp + 1000]  # pages count in doubles
        if not there:
            raise UserError(
                f"that frame is gone: the newest {self._newest.maxlen} can be asked about "
                "(live.held); hold one with H, and ask then"
            )
        return there[-1]

    def _held(self) -> list[FrameResult]:
        with self._lock:
            return [*self._kept.values(), *self._newest]

    def hold(self, stamp: int) -> FrameResult:
        """Keep the frame that a viewer shows, to ask about it for as long as one likes; a few at most.

        Of a viewer that lags behind it is the oldest one that is there still.

        Raises:
            UserError: there is none yet.
        """
        frames = sorted((r.frame.stamp, r.frame.index) for r in self._held())
        shown = [index for at, index in frames if at <= stamp + 1000]
        if not frames:
            raise UserError("no frame has come yet")
        result = self.look(shown[-1] if shown else frames[0][1])
        index = result.frame.index
        with self._lock:
            new = index not in self._kept
            self._kept[index] = result
            self._kept.move_to_end(index)
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
        if new:
            truth = self.truth_of(result.frame) if self.truth_of is not None else None
            self.found += finds(result, truth)[: FOUND - len(self.found)]
        for listener in tuple(self._listeners):
            listener()
        return result

    def look(self, number: int, settings: Settings = ()) -> FrameResult:
        """A held frame as it was made, or with other values.

        Raises:
            UserError: it is gone; an unknown parameter, or a wrong value.
        """
        result = next((r for r in self._held() if r.frame.index == number), None)
        if result is None:
            raise UserError(f"frame {number} is gone: hold one with H, and ask then")
        if not settings:
            return result
        config = revised(self.live.config, settings)
        if config == result.config:
            return result
        key = number, settings
        if key not in self._tried:
            self._tried[key] = describe(self._variants.perceive(result.frame, config))
            while len(self._tried) > TRIED:
                self._tried.popitem(last=False)
        return self._tried[key]

    # --- questions -----------------------------------------------------------------------------

    def picked(
        self, number: int, settings: Settings, path: str, instance: int | None, position: Sequence[float]
    ) -> Pick | None:
        """What a click in the frame is on, see ``pick``."""
        return pick(self.look(number), self.look(number).tracks, path, instance, position)

    def ask(self, number: int, settings: Settings, what: Pick, hints: bool = False) -> Answer:
        """Why it was reported, or was not; what is asked about is shown in every view.

        Raises:
            UserError: there is no such thing in the frame.
        """
        result = self.look(number, settings)
        if self._asked is None or self._asked.traces.result is not result:
            session = self.live.session
            self._asked = Questioner(result, session.loader, session.stages.class_names)
        found = self._asked.ask(selection(what))
        if not found:
            raise UserError(f"there is nothing to say about {what}")
        if hints:
            return self._asked.with_hints(found[0])
        mark_answers(self._marker, result.frame, found[:1])
        self.film.add(self._marks.read())
        return found[0]

    # --- orders --------------------------------------------------------------------------------

    def attempt(self, number: int, settings: Settings) -> dict[str, Any]:
        """Change parameters of the running session for good, and tell what they do to a frame.

        Raises:
            UserError: an unknown parameter, or a wrong value; nothing is changed.
        """
        own = {setting.partition("=")[0] for setting in settings}
        undone = [key for key in (one.partition("=")[0] for one in self._set) if key not in own]
        before = self.look(number)
        self.live.update([*(f"{key}={json.dumps(self._before[key])}" for key in undone), *settings])
        self._set = settings
        after = describe(self._variants.perceive(before.frame, self.live.config))
        found = differences(number, before.frame.stamp, seen(before), seen(after))
        counts = found.counts
        return {
            "changes": {key: str(c) for key, c in changes(before.config, after.config).items()},
            "before": Counter(before.objects.names if before.objects else ()),
            "after": Counter(after.objects.names if after.objects else ()),
            "gone": counts[Change.ONLY_A],
            "new": counts[Change.ONLY_B],
            "changed": counts[Change.MOVED] + counts[Change.CLASS],
            "failures": [f"{failure.stage}: {failure.reason}" for failure in after.failures],
        }

    def snap(self) -> str:
        """Save the flight recorder. Returns what to say.

        Raises:
            UserError: it holds nothing, or cannot be written.
        """
        return f"saved in {self.live.save()}"

    def mark(self, stamp: int, text: str) -> str:
        """A note at a frame, in every recording and on the terminal. Returns what to say."""
        number = self.number_at(stamp)
        said = f"mark at frame {number}: {text.strip() or 'look here'}"
        self.live.notes.info(said)
        return said


class LivePage(Closing):
    """The page, served by threads of its own, until it is closed.

    Args:
        bench: the robot.
        port: of the page; None: one that is free.

    Raises:
        UserError: the port is in use, or the viewer is not installed.

    Attributes:
        address: what to open.
    """

    def __init__(self, bench: LiveBench, port: int | None) -> None:
        self._bench = bench
        viewer, token = viewer_folder(), secrets.token_urlsafe(16)
        listening = bound(port)
        port = listening.getsockname()[1]
        site = LiveSite(bench, viewer, token, port)
        routes = [*_routes(site), WebSocketRoute("/live", site.orders)]
        app = _Guard(Starlette(routes=routes), token, port)
        self.address = f"http://{HOSTS[0]}:{port}/?token={token}"
        ready = threading.Event()
        self._server = _Server(uvicorn.Config(app, **SERVER), ready.set)
        self._listening = listening
        self._thread = threading.Thread(
            target=lambda: self._server.run(sockets=[listening]), name="page", daemon=True
        )
        self._thread.start()
        ready.wait(PATIENCE)

    def close(self) -> None:
        self._server.should_exit = True
        self._thread.join(PATIENCE)
        self._listening.close()
        self._bench.close()


def _own_truth(frame: Any) -> Truth | None:
    return None if frame.truth is None else truth_of(frame, frame.truth)


class LiveSite(_Site):
    """The page of a running robot."""

    def __init__(self, bench: LiveBench, viewer: Path, token: str, port: int) -> None:
        super().__init__(cast("Bench", bench), viewer, token, port, native=False)  # as far as a page asks
        self._live = bench

    async def page(self, request: Request) -> Response:
        response = await super().page(request)
        text = (
            bytes(response.body)
            .decode()
            .replace("</body>", '<script type="module" src="/page/live.js"></script>\n</body>')
        )
        own = {name: value for name, value in response.headers.items() if name != "content-length"}
        return Response(text, headers=own)

    async def film(self, socket: WebSocket) -> None:
        """The newest pieces, as they are made."""
        await socket.accept()
        film, number = self._live.film, None
        with _listening(film.listen) as more, contextlib.suppress(WebSocketDisconnect, RuntimeError):
            gone = asyncio.ensure_future(_until_gone(socket))
            try:
                while not gone.done():
                    more.clear()
                    pieces, following = await asyncio.to_thread(film.since, number)
                    number = None if following < 0 else following
                    for piece in pieces:
                        await socket.send_bytes(piece)
                    waiting = asyncio.ensure_future(more.wait())
                    await asyncio.wait({waiting, gone}, return_when=asyncio.FIRST_COMPLETED)
                    waiting.cancel()
            finally:
                gone.cancel()

    async def orders(self, socket: WebSocket) -> None:
        """Hold, snap and mark."""
        await socket.accept()
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            while True:
                text = await socket.receive_text()
                try:
                    said = await asyncio.to_thread(self._order, json.loads(text))
                except UserError as error:
                    said = {"type": "said", "text": str(error), "wrong": True}
                except (ValueError, KeyError, TypeError, AttributeError):
                    said = {"type": "said", "text": "that message cannot be understood", "wrong": True}
                await socket.send_text(json.dumps(said))

    def _order(self, message: dict[str, Any]) -> dict[str, Any]:
        what = message["type"]
        if what == "snap":
            return {"type": "said", "text": self._live.snap()}
        stamp = round(float(message["time"]))
        if what == "hold":
            frame = self._live.hold(stamp).frame
            return {"type": "held", "frame": frame.index, "stamp": str(frame.stamp)}
        if what == "mark":
            return {"type": "said", "text": self._live.mark(stamp, str(message.get("text", "")))}
        raise ValueError(what)
