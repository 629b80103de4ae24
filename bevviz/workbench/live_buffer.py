"""Buffer of the newest recorded data of a running robot, for its pages."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import rerun as rr

from bevviz.live.encoder import Packet
from bevviz.live.outputs import Output
from bevviz.live.runtime import Live
from bevviz.recording import blueprints
from bevviz.recording.frame_logger import RecordingContext
from bevviz.recording.stream import RecordingStream
from bevviz.workbench.buffers import News, PageState

AHEAD = 10  # pieces that may be sent before the page's viewer has drawn the first of them
WHOLE = 3  # self-contained packets that are kept, with all packets after the oldest of them


@dataclass(frozen=True, slots=True)
class _Piece:
    """One piece of the recording."""

    number: int
    data: bytes  # with the header that every recording begins with
    context: RecordingContext | None  # only for a piece that a page can begin with


class LiveReader:
    """Reader of one page. It knows how many pieces the page was sent, and how many its viewer has drawn.

    Args:
        buffer: the buffer.
        state: state of the page, with its acknowledgements.
        clock: returns the time in seconds.

    Attributes:
        opened: time when the page was opened.
    """

    def __init__(self, buffer: LiveBuffer, state: PageState, clock: Callable[[], float]) -> None:
        self._buffer, self._state, self._clock = buffer, state, clock
        self.news = buffer.news
        self.opened = clock()
        self._next: int | None = None  # number of the next piece. None: the page has nothing yet
        self._sent: deque[float] = deque()  # send times of the pieces that are not drawn yet
        self._drawn = 0
        self._lock = threading.Lock()

    def take(self) -> Sequence[bytes]:
        """Return the pieces to send now, if the page can take some."""
        if not self.ready:
            return ()
        pieces, following = self._buffer.since(self._next)
        self._next = None if following < 0 else following
        for _ in pieces:
            self.send()
        return pieces

    def send(self) -> None:
        """Count a piece that is sent."""
        with self._lock:
            self._sent.append(self._clock())

    @property
    def ready(self) -> bool:
        """Whether the page can take another piece."""
        return self._oldest() is None or len(self._sent) < AHEAD

    @property
    def lag(self) -> float:
        """Seconds since the oldest undrawn piece was sent. 0 while the page is in the background."""
        oldest = self._oldest()
        return 0.0 if oldest is None or self._state.hidden else self._clock() - oldest

    def _oldest(self) -> float | None:
        """Return the send time of the oldest undrawn piece, if there is one."""
        with self._lock:
            while self._sent and self._drawn < self._state.count:
                self._sent.popleft()
                self._drawn += 1
            return self._sent[0] if self._sent else None


class LiveBuffer(Output):
    """Buffer of the newest pieces of the recording. A page that is too slow continues at the newest piece.

    Args:
        live: the live run.
        queue: number of packets that may wait.

    Attributes:
        news: tells of each new piece.
    """

    def __init__(self, live: Live, queue: int) -> None:
        super().__init__("page", queue, sparse=live.config.live.viewer_rate is not None)
        self._encoder = live.encoder
        self._pages: list[LiveReader] = []
        self._missed = 0  # pieces that slow pages have skipped
        self._pieces: deque[_Piece] = deque()
        self._next = 0
        self._lock = threading.Lock()
        self.news = News()
        self._thread.start()

    def close(self) -> None:
        """Stop the thread."""
        self._end()
        self._thread.join(1.0)

    @property
    def dropped(self) -> int:
        """Number of dropped packets and skipped pieces."""
        return super().dropped + self._missed

    @property
    def lag(self) -> float | None:
        """Lag of the slowest page, in seconds. It includes what its browser has not drawn."""
        return max((page.lag for page in self._pages.copy()), default=None)

    @property
    def opened(self) -> float:
        """Time when the newest page was opened, in monotonic seconds. 0: no page is open."""
        return max((page.opened for page in self._pages.copy()), default=0.0)

    @contextmanager
    def shown(self, state: PageState) -> Iterator[LiveReader]:
        """Return a context in which a page is connected."""
        page = LiveReader(self, state, self._encoder.clock)
        self._pages.append(page)
        try:
            yield page
        finally:
            self._pages.remove(page)

    def add(self, data: bytes | None) -> None:
        """Append data of a further stream into the same recording. None is ignored."""
        if data:
            self._put(data, None)

    def since(self, number: int | None) -> tuple[list[bytes], int]:
        """Return the pieces that a page gets next.

        Args:
            number: number of the next piece for the page. None: it has nothing yet.

        Returns:
            The pieces, and the number to continue with. After skipped pieces they start with a self-contained
            piece.
        """
        with self._lock:
            pieces = list(self._pieces)
            following = self._next
        start = next((piece for piece in reversed(pieces) if piece.context is not None), None)
        if number is not None and (not pieces or number >= pieces[0].number):
            return [piece.data for piece in pieces if piece.number >= number], following
        if start is None or start.context is None:
            return [], -1 if number is None else number
        if number is not None:
            self._missed += start.number - number
        head = [] if number is not None else [self._layout(start.context)]
        head.append(self._encoder.prelude(start.context, blueprint=False))
        return head + [piece.data for piece in pieces if piece.number >= start.number], following

    def _layout(self, context: RecordingContext) -> bytes:
        encoder = self._encoder
        recording = RecordingStream(encoder.application, recording_id=encoder.recording_id)
        stream = rr.binary_stream(recording)
        layout = blueprints.load("workbench_live", context.scene, context.config)
        recording.send_blueprint(layout, make_active=True)
        return stream.read() or b""

    def _take(self, packet: Packet, fresh: bool) -> bool:
        self._put(self._encoder.header + packet.shown, packet.context if packet.whole else None)
        return True

    def _put(self, data: bytes, context: RecordingContext | None) -> None:
        with self._lock:
            self._pieces.append(_Piece(self._next, data, context))
            self._next += 1
            while sum(piece.context is not None for piece in self._pieces) > WHOLE:
                self._pieces.popleft()
        self.news.tell()
