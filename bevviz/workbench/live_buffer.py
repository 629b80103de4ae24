"""What the pages of a running robot are shown: the newest pieces of what is logged."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import rerun as rr

from bevviz.live.encoder import Packet
from bevviz.live.output import Output
from bevviz.live.runtime import Live
from bevviz.recording import blueprints
from bevviz.recording.frame_logger import Context
from bevviz.recording.sinks import APPLICATION
from bevviz.workbench.routes import Heard

AHEAD = 10  # pieces that a page is sent before its viewer has drawn the first of them
WHOLE = 3  # packets that need none before them, from the oldest of which on all are kept for pages


@dataclass(frozen=True, slots=True)
class _Piece:
    number: int
    data: bytes  # with the header that every recording begins with
    context: Context | None  # of one that a page can begin with


class Page:
    """How far a page is with what it was sent.

    Args:
        heard: what it says of that, a word for each piece that its viewer has drawn.
        clock: seconds.
    """

    def __init__(self, heard: Heard, clock: Callable[[], float]) -> None:
        self._heard, self._clock = heard, clock
        self._sent: deque[float] = deque()  # times, from the first one on that it has not drawn
        self._drawn = 0
        self._held = threading.Lock()

    def send(self) -> None:
        """A piece is on its way."""
        with self._held:
            self._sent.append(self._clock())

    @property
    def ready(self) -> bool:
        """Whether there may be more."""
        return self._oldest() is None or len(self._sent) < AHEAD

    @property
    def lag(self) -> float:
        """Seconds since the first piece was sent that it has not drawn; 0 while nobody sees it."""
        oldest = self._oldest()
        return 0.0 if oldest is None or self._heard.hidden else self._clock() - oldest

    def _oldest(self) -> float | None:
        with self._held:
            while self._sent and self._drawn < self._heard.count:
                self._sent.popleft()
                self._drawn += 1
            return self._sent[0] if self._sent else None


class LiveFilm(Output):
    """The newest pieces of what is logged, for pages; one that is too slow goes on at the newest.

    Args:
        live: whose results it is.
        queue: packets that may wait.
    """

    def __init__(self, live: Live, queue: int) -> None:
        super().__init__("page", queue)
        self._encoder = live.encoder
        self._sparse = live.config.live.viewer_rate is not None
        self._pages: list[Page] = []
        self._missed = 0  # pieces, by pages that were too slow
        self._pieces: deque[_Piece] = deque()
        self._next = 0
        self._held = threading.Lock()
        self._listeners: list[Callable[[], None]] = []
        self._thread.start()

    def close(self) -> None:
        self._end()
        self._thread.join(1.0)

    @property
    def dropped(self) -> int:
        return super().dropped + self._missed

    @property
    def lag(self) -> float | None:
        """Of the slowest page: what its browser has not drawn counts, too."""
        return max((page.lag for page in self._pages.copy()), default=None)

    @contextmanager
    def shown(self, heard: Heard) -> Iterator[Page]:
        """A page that is there meanwhile."""
        page = Page(heard, self._encoder.clock)
        self._pages.append(page)
        try:
            yield page
        finally:
            self._pages.remove(page)

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
        if number is not None:
            self._missed += begin.number - number
        head = [] if number is not None else [self._layout(begin.context)]
        head.append(self._encoder.prelude(begin.context, blueprint=False))
        return head + [piece.data for piece in pieces if piece.number >= begin.number], following

    def _layout(self, context: Context) -> bytes:
        recording = rr.RecordingStream(APPLICATION, recording_id=self._encoder.recording_id)
        stream = rr.binary_stream(recording)
        layout = blueprints.load("workbench_live", context.scene, context.config)
        recording.send_blueprint(layout, make_active=True)
        return stream.read() or b""

    def _take(self, packet: Packet, fresh: bool) -> bool:
        if self._sparse and not packet.whole:
            return True
        self._put(self._encoder.header + packet.shown, packet.context if packet.whole else None)
        return True

    def _put(self, data: bytes, context: Context | None) -> None:
        with self._held:
            self._pieces.append(_Piece(self._next, data, context))
            self._next += 1
            while sum(piece.context is not None for piece in self._pieces) > WHOLE:
                self._pieces.popleft()
        for listener in tuple(self._listeners):
            listener()
