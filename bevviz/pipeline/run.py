"""The one loop: frames from a source, through a session, to observers. What overlaps is decided here."""

from __future__ import annotations

import gc
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any, Generic, TypeVar

from bevviz.errors import interrupt_in
from bevviz.model.protocols import Items, Observer, Processor
from bevviz.support.queues import NewestQueue

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)
T_contra = TypeVar("T_contra", contravariant=True)
R = TypeVar("R")
R_contra = TypeVar("R_contra", contravariant=True)

DEPTH = 2  # frames that are drawn ahead of what is observed
BURST = 3  # frames that may come together without one being lost
TICK = 0.2  # seconds between two looks at whether it is over
PATIENCE = 10.0  # seconds that an observer of its own thread may take to end


class Dropping:
    """Whoever is too slow gets the newest. For what cannot wait: a robot.

    Args:
        incoming: frames that may wait for the stages, where they came together.
        results: results that may wait for the observers.
    """

    def __init__(self, incoming: int = BURST, results: int = BURST) -> None:
        self.incoming_size, self.results_size = incoming, results
        self._queues: dict[str, NewestQueue[Any]] = {}

    @property
    def dropped(self) -> Mapping[str, int]:
        """Left out so far, by place."""
        return {place: queue.dropped for place, queue in self._queues.items()}

    def close(self) -> None:
        """Whatever a source does, nobody waits for more of it."""
        for queue in self._queues.values():
            queue.close()

    def queue(self, place: str, size: int, *, catch_up: bool = False) -> NewestQueue[T]:
        """One whose drops are counted."""
        queue: NewestQueue[T] = NewestQueue(size, catch_up=catch_up)
        self._queues[place] = queue
        return queue


@dataclass(frozen=True, slots=True)
class RunEnd:
    """How a run ended."""

    frames: int  # that were observed
    interrupted: bool = False


def run(
    items: Items[T],
    processor: Processor[T, R],
    observers: Sequence[Observer[R]] = (),
    *,
    dropping: Dropping | None = None,
    depth: int = DEPTH,
    stop: threading.Event | None = None,
    tick: Callable[[], None] = lambda: None,
) -> RunEnd:
    """Work through the items, and let the observers see what is made of each.

    The caller's thread only waits: a signal never comes in the midst of the work. Ctrl-C ends the run
    after the frame that is being observed. Errors of the items are raised after what came before them was
    observed.

    Args:
        items: where they come from; with a method ``stop``, it is told when to end.
        processor: what makes a result of each.
        observers: in the order in which they see it.
        dropping: the newest win, and nothing waits; None: every item is worked on.
        depth: items that are drawn ahead of what is observed, where nothing is dropped.
        stop: ends the run when it is set.
        tick: called every ``TICK`` seconds by the thread that waits.

    Raises:
        Exception: of the items, the processor or an observer, after all observers were told the end.
    """
    stop = stop or threading.Event()
    loop = _Loop(items, processor, observers, dropping, depth, stop)
    thread = threading.Thread(target=loop.work, name="run", daemon=True)
    interrupted = False

    def end() -> None:
        """What comes from now on is neither waited for nor counted as left out."""
        _stop(items)
        if dropping is not None:
            dropping.close()

    try:
        thread.start()
    except BaseException:  # Ctrl-C beside the start: whether there is a thread by now cannot be told
        loop.admission.put(False)
        raise
    while True:
        try:
            loop.admission.put(True)  # only the first one counts
            while not loop.over.is_set():
                # Not ``thread.join``, which takes a thread for ended that an interrupt comes beside.
                loop.over.wait(TICK)
                if stop.is_set():
                    end()
                tick()
            end()  # however it ended: nobody comes for more
            thread.join()
            break
        except KeyboardInterrupt:
            if interrupted:
                raise
            interrupted = True
            stop.set()
            end()
        except BaseException:  # of ``tick``
            stop.set()
            end()
            loop.over.wait()
            raise
    if loop.error is not None:
        if interrupt_in(loop.error):
            return RunEnd(loop.frames, True)
        raise loop.error
    return RunEnd(loop.frames, interrupted)


def _stop(items: object) -> None:
    stop = getattr(items, "stop", None)
    if stop is not None:
        stop()


def results(items: Iterable[T], processor: Processor[T, R]) -> Generator[R, None, None]:
    """What is made of each item, in order, to be drawn by the caller. Closing it ends its threads."""
    with (
        ThreadPoolExecutor(1, "network") as network,
        closing(overlapped(items, lambda item: processor.perceive(item, network), DEPTH)) as made,
    ):
        yield from map(processor.finish, made)


class _Loop(Generic[T, R]):
    """The thread of a run."""

    def __init__(
        self,
        items: Items[T],
        processor: Processor[T, R],
        observers: Sequence[Observer[R]],
        dropping: Dropping | None,
        depth: int,
        stop: threading.Event,
    ) -> None:
        self.frames = 0
        self.error: BaseException | None = None
        self.admission: SimpleQueue[bool] = SimpleQueue()  # whether it may begin; nothing interrupts a put
        self.over = threading.Event()
        self._items, self._processor, self._observers = items, processor, observers
        self._dropping, self._depth, self._stop = dropping, depth, stop

    def work(self) -> None:
        if not self.admission.get():
            return
        try:
            with few_collections(), ExitStack() as stack:
                network = stack.enter_context(ThreadPoolExecutor(1, "network"))
                observers = [stack.enter_context(self._begun(observer)) for observer in self._observers]
                for result in stack.enter_context(closing(self._results(network))):
                    if self._stop.is_set():
                        break
                    result = self._processor.finish(result)
                    for see in observers:
                        see(result)
                    self.frames += 1
        except BaseException as error:
            self.error = self.error or error
        finally:
            self.over.set()

    def _results(self, network: Executor) -> Generator[R, None, None]:
        def work(item: T) -> R:
            return self._processor.perceive(item, network)

        if self._dropping is None:
            return overlapped(self._until_stopped(), work, self._depth)
        return _newest(self._items, work, self._dropping, self._stop)

    def _until_stopped(self) -> Iterator[T]:
        for item in self._items:
            if self._stop.is_set():
                return
            yield item

    @contextmanager
    def _begun(self, observer: Observer[R]) -> Iterator[Callable[[R], None]]:
        """What takes the results for the observer."""
        observer.begin(self._items)
        try:
            if observer.beside is None:
                yield observer.see
            else:
                with self._in_own_thread(observer, observer.beside) as put:
                    yield put
        finally:
            observer.end()

    @contextmanager
    def _in_own_thread(self, observer: Observer[R], size: int) -> Iterator[Callable[[R], None]]:
        queue: NewestQueue[R] = NewestQueue(size)
        if self._dropping is not None:
            queue = self._dropping.queue(observer.name, size)

        def work() -> None:
            try:
                for result in queue:
                    observer.see(result)
            except BaseException as error:
                self.error = error
                self._stop.set()

        thread = threading.Thread(target=work, name=observer.name, daemon=True)
        thread.start()
        try:
            yield queue.put
        finally:
            queue.close()
            thread.join(PATIENCE)


def overlapped(items: Iterable[T], work: Callable[[T], R], depth: int) -> Generator[R, None, None]:
    """Yield what is made of each item, in order. A thread works on it while the caller makes the next ones.

    One thread beside the caller's and not two: they would wait for Python's lock more than they gain.

    An exception of the items is raised after what is made of those that came before it. Closing the
    iterator ends the thread.

    Args:
        items: drawn in the caller's thread.
        work: called in the other one.
        depth: items that are drawn ahead of what is yielded.
    """
    waiting: deque[Future[R]] = deque()
    cut: Exception | None = None
    source = iter(items)
    worker = ThreadPoolExecutor(1, "stages")
    try:
        while cut is None:
            try:
                waiting.append(worker.submit(work, next(source)))
            except StopIteration:
                break
            except Exception as error:
                cut = error
            if len(waiting) > depth:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
        if cut is not None:
            raise cut
    finally:
        worker.shutdown(cancel_futures=True)


def _newest(
    items: Iterable[T], work: Callable[[T], R], dropping: Dropping, stop: threading.Event
) -> Generator[R, None, None]:
    """Yield what is made of the newest items: drawing, work and the caller each in a thread of its own."""
    incoming: NewestQueue[T] = dropping.queue("incoming", dropping.incoming_size, catch_up=True)
    done: NewestQueue[R] = dropping.queue("results", dropping.results_size)
    errors: list[BaseException] = []

    def guarded(work: Callable[[], None], queue: NewestQueue[T] | NewestQueue[R]) -> threading.Thread:
        def body() -> None:
            try:
                work()
            except BaseException as error:
                errors.append(error)
            finally:
                queue.close()

        thread = threading.Thread(target=body, name=work.__name__, daemon=True)
        thread.start()
        return thread

    def receive() -> None:
        for item in items:
            if stop.is_set():
                return
            incoming.put(item)

    def stages() -> None:
        for item in incoming:
            if stop.is_set():
                return
            done.put(work(item))

    guarded(receive, incoming)  # it may block in its source for good
    worker = guarded(stages, done)
    try:
        yield from done
    finally:
        incoming.close()
        worker.join(PATIENCE)
    if errors:
        raise errors[0]


@contextmanager
def few_collections() -> Iterator[None]:
    """Frames make many objects and few cycles: looking for these takes a tenth of all the time.

    What is there by now, mostly what was imported, is not looked through again and again.
    """
    before, enabled = gc.get_threshold(), gc.isenabled()
    gc.freeze()
    gc.set_threshold(50_000, 10, 10)
    gc.enable()
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()
        if not enabled:
            gc.disable()
