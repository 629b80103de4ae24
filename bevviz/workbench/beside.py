"""The workbench beside a running robot: its newest frames are held, and can be asked about."""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import rerun as rr
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from bevviz.closing import Closing
from bevviz.config import Config, revised, values
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
from bevviz.workbench.answers import selection, surroundings
from bevviz.workbench.entries import Entries
from bevviz.workbench.guard import HOSTS, Guard
from bevviz.workbench.missed import finds, with_reasons
from bevviz.workbench.pick import Pick, pick
from bevviz.workbench.server import Server, bound, viewer_folder
from bevviz.workbench.site import Site, heard_on, routes_of
from bevviz.workbench.trial import attempt
from bevviz.workbench.visit import Visit, listening

if TYPE_CHECKING:
    from bevviz.workbench.bench import Bench
    from bevviz.workbench.opening import Opening

WHOLE = 3  # packets that need none before them, from the oldest of which on all are kept for pages
KEPT = 4  # frames that pages may hold at once
TRIED = 2  # results of held frames with other values
PATIENCE = 3.0  # seconds that the page's threads may take to end
LISTED = ("missed", "false", "unmatched", "unnamed")

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
        entries: what is worth a look in the frame that was held last.
    """

    def __init__(self, live: Live) -> None:
        self.live, self.drive = live, Robot(live)
        self.film = LiveFilm(live, live.config.live.output_queue)
        self.truth_of: Callable[..., Truth | None] | None = None
        self.opening: int | None = None  # the page is at the newest frame
        self.entries, self.notes_changed = Entries(), -1
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
            "reports": [],
            "trial": None,
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
            self._kept[index] = result
            self._kept.move_to_end(index)
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
        found = finds(result, None if self.truth_of is None else self.truth_of(result.frame))
        self.entries.replace(LISTED)
        self.entries.add(with_reasons(found, result, self._new_questioner(result)))
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

    def ask(self, number: int, settings: Settings, what: Pick) -> tuple[Answer, list[Answer]]:
        """Why it was reported, or was not, and what else is there; it is shown in every view.

        Raises:
            UserError: there is no such thing in the frame.
        """
        result = self.look(number, settings)
        questioner, there = self._candidates(result, what)
        found = there or questioner.ask(selection(what))
        if not found:
            raise UserError(f"there is nothing to say about {what}")
        answer = found[0]
        if not there and (around := surroundings(what, answer)) is not None:
            there = questioner.candidates(around)
        mark_answers(self._marker, result.frame, [answer], result.config.bev)
        self.film.add(self._marks.read())
        return answer, [other for other in there if other.subject.key != answer.subject.key]

    def hints(self, number: int, settings: Settings, what: Pick) -> Answer:
        """The same with what would change it, which takes longer.

        Raises:
            UserError: as ``ask``.
        """
        questioner, there = self._candidates(self.look(number, settings), what)
        return questioner.with_hints((there or questioner.ask(selection(what)))[0])

    def _candidates(self, result: FrameResult, what: Pick) -> tuple[Questioner, list[Answer]]:
        if self._asked is None or self._asked.traces.result is not result:
            self._asked = self._new_questioner(result)
        return self._asked, list(self._asked.candidates(selection(what))) if what.is_place else []

    def _new_questioner(self, result: FrameResult) -> Questioner:
        session = self.live.session
        return Questioner(result, session.loader, session.stages.class_names)

    def go_on(self) -> None:
        """A robot has not waited."""

    # --- orders --------------------------------------------------------------------------------

    @property
    def settings(self) -> Settings:
        """That pages have changed."""
        return self._set

    def attempt(self, number: int, settings: Settings, what: Pick | None = None) -> dict[str, Any]:
        """Change parameters of the running session for good, and tell what they do to a frame.

        Raises:
            UserError: an unknown parameter, or a wrong value; nothing is changed.
        """
        before = self.look(number)
        self.change(settings)
        after = describe(self._variants.perceive(before.frame, self.live.config))
        asked = what.row if what is not None and what.kind == "truth" else -1
        truth = None if self.truth_of is None else self.truth_of(before.frame)
        return attempt(before, after, truth, asked)

    def change(self, settings: Settings) -> None:
        """Change parameters of the running session; those of before that are none of these are as at first.

        Raises:
            UserError: an unknown parameter, or a wrong value; nothing is changed.
        """
        own = {setting.partition("=")[0] for setting in settings}
        undone = [key for key in (one.partition("=")[0] for one in self._set) if key not in own]
        back = [f"{key}={json.dumps(self._before[key])}" for key in undone]
        if back or settings != self._set:
            self.live.update([*back, *settings])
        self._set = settings

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
        site = LiveSite(bench, viewer, version("rerun-sdk"), token, port)
        routes = [*routes_of(site), WebSocketRoute("/live", site.orders)]
        self.address = f"http://{HOSTS[0]}:{port}/?token={token}"
        ready = threading.Event()
        self._server = Server(Guard(Starlette(routes=routes), token, port), ready.set)
        self._listening = listening
        self._thread = threading.Thread(
            target=lambda: self._server.run(sockets=[listening]), name="page", daemon=True
        )
        self._thread.start()
        ready.wait(PATIENCE)

    def close(self) -> None:
        self._server.end()
        self._thread.join(PATIENCE)
        self._listening.close()
        self._bench.close()


class _Open:
    """A bench that is there from the beginning."""

    error = None

    def __init__(self, bench: LiveBench) -> None:
        self._bench = bench

    async def bench(self) -> LiveBench:
        return self._bench


def _own_truth(frame: Any) -> Truth | None:
    return None if frame.truth is None else truth_of(frame, frame.truth)


class LiveVisit(Visit):
    """A page of a running robot."""

    def __init__(self, bench: LiveBench, socket: WebSocket, desk: ThreadPoolExecutor, run: str) -> None:
        super().__init__(cast("Bench", bench), socket, desk, run)  # as far as it is asked below
        self._live = bench
        for name in ("drive", "cancel", "report", "note", "unnote"):
            self._handlers[name] = self._refuse

    async def _refuse(self, number: int, message: dict[str, Any]) -> None:
        raise UserError("that is for a drive that is over: save what was seen, and open the recording's bag")

    async def _ask(self, number: int, message: dict[str, Any]) -> None:
        """A click is on what is shown; what is asked about again is so with the values of now."""
        again = list(self._live.settings) if "pick" in message else []
        await super()._ask(number, {**message, "set": again})

    async def _settle(self, number: int, message: dict[str, Any]) -> None:
        """Nothing is made ready: the next frame comes at once."""


class LiveSite(Site):
    """The page of a running robot."""

    def __init__(self, bench: LiveBench, viewer: Path, version: str, token: str, port: int) -> None:
        super().__init__(cast("Opening", _Open(bench)), viewer, version, token, port, "live")
        self._live = bench

    def _visit(self, bench: Bench, socket: WebSocket) -> Visit:
        return LiveVisit(self._live, socket, self._desk, self._run)

    async def page(self, request: Request) -> Response:
        response = await super().page(request)
        script = b'<script type="module" src="/page/live.js"></script>\n</body>'
        response.body = bytes(response.body).replace(b"</body>", script)
        response.headers["Content-Length"] = str(len(response.body))
        return response

    async def film(self, socket: WebSocket) -> None:
        """The newest pieces, as they are made; what was asked is among them."""
        await socket.accept()
        film, number = self._live.film, None
        if socket.query_params.get("lane") == "desk":
            with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                await socket.receive_text()
            return
        with listening(film.listen) as more, contextlib.suppress(WebSocketDisconnect, RuntimeError):
            async with heard_on(socket, more) as heard:
                while not heard.gone:
                    more.clear()
                    pieces, following = await asyncio.to_thread(film.since, number)
                    number = None if following < 0 else following
                    for piece in pieces:
                        await socket.send_bytes(piece)
                    await more.wait()

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
