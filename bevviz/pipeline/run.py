"""The one loop: pass frames from a source through a session to observers, partly in parallel."""

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

from bevviz.errors import interrupt_in, printable
from bevviz.model.protocols import Items, Observer, Processor
from bevviz.support import progress
from bevviz.support.queues import NewestQueue

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)
T_contra = TypeVar("T_contra", contravariant=True)
R = TypeVar("R")
R_contra = TypeVar("R_contra", contravariant=True)

LOOKAHEAD = 2  # frames read ahead of the frame that the observers see
MAX_BURST = 3  # frames that may arrive together without a loss
TICK = 0.2  # seconds between two checks whether the run is over
PATIENCE = 10.0  # seconds that an observer with its own thread may take to end


class DropPolicy:
    """Drop policy for live runs: a slow consumer gets the newest result, since a robot cannot wait.

    Args:
        incoming: frames that may wait for the stages if they arrive together.
        results: results that may wait for the observers.
    """

    def __init__(self, incoming: int = MAX_BURST, results: int = MAX_BURST) -> None:
        self.incoming_size, self.results_size = incoming, results
        self._queues: dict[str, NewestQueue[Any]] = {}

    @property
    def dropped(self) -> Mapping[str, int]:
        """Number of dropped items by queue."""
        return {place: queue.dropped for place, queue in self._queues.items()}

    def close(self) -> None:
        """Close all queues, so that no consumer waits for a source that goes on."""
        for queue in self._queues.values():
            queue.close()

    def queue(self, place: str, size: int, *, catch_up: bool = False) -> NewestQueue[T]:
        """Return a new queue whose drops are counted."""
        queue: NewestQueue[T] = NewestQueue(size, catch_up=catch_up)
        self._queues[place] = queue
        return queue


@dataclass(frozen=True, slots=True)
class RunEnd:
    """End of a run."""

    frames: int  # number of frames that the observers saw
    interrupted: bool = False


def run(
    items: Items[T],
    processor: Processor[T, R],
    observers: Sequence[Observer[R]] = (),
    *,
    dropping: DropPolicy | None = None,
    depth: int = LOOKAHEAD,
    stop: threading.Event | None = None,
    tick: Callable[[], None] = lambda: None,
) -> RunEnd:
    """Process the items, and pass each result to the observers.

    The caller's thread only waits, so that a signal never interrupts the work. Ctrl-C ends the run after the
    frame that the observers see. An error of the items is raised after the observers saw all results before
    it.

    Args:
        items: input of the run. Its method ``stop``, if it has one, is called at the end.
        processor: computation of the result of each item.
        observers: observers in the order in which they see a result.
        dropping: drop policy. None: every item is processed.
        depth: items read ahead of the one that the observers see, if no item is dropped.
        stop: event that ends the run.
        tick: function that the waiting thread calls every ``TICK`` seconds.

    Raises:
        Exception: of the items, the processor or an observer, after ``end`` of all observers.
    """
    stop = stop or threading.Event()
    loop = _Loop(items, processor, observers, dropping, depth, stop)
    thread = threading.Thread(target=loop.work, name="run", daemon=True)
    interrupted = False

    def end() -> None:
        """Stop the input and the queues: later items are neither awaited nor counted as dropped."""
        _stop(items)
        if dropping is not None:
            dropping.close()

    try:
        thread.start()
    except BaseException:  # After Ctrl-C during the start, it is unknown whether the thread exists.
        loop.admission.put(False)
        raise
    while True:
        try:
            loop.admission.put(True)  # only the first one counts
            while not loop.over.is_set():
                # Not ``thread.join``: an interrupt at that moment makes it take a running thread for ended.
                loop.over.wait(TICK)
                if stop.is_set():
                    end()
                tick()
            end()  # After any end, no consumer takes more items.
            thread.join()
            break
        except KeyboardInterrupt:
            if interrupted:
                raise
            interrupted = True
            stop.set()
            end()
        except BaseException:  # an error of ``tick``
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
    """Call the method ``stop`` of the items, if there is one."""
    stop = getattr(items, "stop", None)
    if stop is not None:
        stop()


def iterate_results(items: Iterable[T], processor: Processor[T, R]) -> Generator[R, None, None]:
    """Yield the result of each item, in order. Closing the iterator ends its threads."""
    with (
        ThreadPoolExecutor(1, "network") as network,
        closing(_process(items, processor, network, LOOKAHEAD)) as results,
    ):
        yield from results


def _process(
    items: Iterable[T], processor: Processor[T, R], network: Executor, depth: int
) -> Generator[R, None, None]:
    """Yield the result of each item, in order. Items, ``perceive`` and ``finish`` have a thread each.

    One of the ``depth`` items that are read ahead is in ``finish``. A further item is being read.
    """
    with (
        _single_opencv_thread(),
        closing(_read_ahead(items)) as read,
        closing(map_ahead(read, lambda item: processor.perceive(item, network), depth - 1)) as perceived,
    ):
        yield from map_ahead(perceived, processor.finish, 1, "finish")


@contextmanager
def _single_opencv_thread() -> Iterator[None]:
    """Keep OpenCV to the thread that calls it. Its own threads spin while they wait, beside a run's."""
    import cv2  # takes 0.1 s, and not every import of this module leads to a run

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _read_ahead(items: Iterable[T]) -> Generator[T, None, None]:
    """Yield the items. A thread reads the next one while the caller works on the last one."""
    source, end = iter(items), object()
    reader = ThreadPoolExecutor(1, "read")
    try:
        upcoming: Future[Any] = reader.submit(next, source, end)
        while (item := upcoming.result()) is not end:
            upcoming = reader.submit(next, source, end)
            yield item
    finally:
        reader.shutdown(cancel_futures=True)


class _Loop(Generic[T, R]):
    """Work of a run in a thread of its own."""

    def __init__(
        self,
        items: Items[T],
        processor: Processor[T, R],
        observers: Sequence[Observer[R]],
        dropping: DropPolicy | None,
        depth: int,
        stop: threading.Event,
    ) -> None:
        self.frames = 0
        self.error: BaseException | None = None
        self.admission: SimpleQueue[bool] = SimpleQueue()  # whether to begin; no interrupt breaks a put
        self.over = threading.Event()
        self._items, self._processor, self._observers = items, processor, observers
        self._dropping, self._depth, self._stop = dropping, depth, stop

    def work(self) -> None:
        """Run the loop until the items end, ``stop`` is set or an error occurs."""
        if not self.admission.get():
            return
        try:
            with ExitStack() as stack:
                network = stack.enter_context(ThreadPoolExecutor(1, "network"))
                observers = [stack.enter_context(self._observing(observer)) for observer in self._observers]
                # What the observers have loaded until here is not searched again and again either.
                stack.enter_context(rare_garbage_collections())
                for result in stack.enter_context(closing(self._results(network))):
                    if self._stop.is_set():
                        break
                    for observe in observers:
                        observe(result)
                    self.frames += 1
        except BaseException as error:
            self.error = self.error or error
        finally:
            self.over.set()

    def _results(self, network: Executor) -> Generator[R, None, None]:
        """Yield the result of each item, or of the newest ones."""
        if self._dropping is None:
            yield from _process(self._until_stopped(), self._processor, network, self._depth)
            return

        def work(item: T) -> R:
            return self._processor.perceive(item, network)

        with closing(_newest(self._items, work, self._dropping, self._stop)) as perceived:
            yield from map(self._processor.finish, perceived)

    def _until_stopped(self) -> Iterator[T]:
        """Yield the items until ``stop`` is set."""
        for item in self._items:
            if self._stop.is_set():
                return
            yield item

    @contextmanager
    def _observing(self, observer: Observer[R]) -> Iterator[Callable[[R], None]]:
        """Begin an observer, yield the function that passes it a result, and end it."""
        observer.begin(self._items)
        try:
            if observer.queue_size is None:
                yield observer.observe
            else:
                with self._observing_in_thread(observer, observer.queue_size) as put:
                    yield put
        finally:
            observer.end()

    @contextmanager
    def _observing_in_thread(self, observer: Observer[R], size: int) -> Iterator[Callable[[R], None]]:
        """Run an observer in its own thread, and yield the function that queues a result for it."""
        queue: NewestQueue[R] = NewestQueue(size)
        if self._dropping is not None:
            queue = self._dropping.queue(observer.name, size)

        def work() -> None:
            try:
                for result in queue:
                    observer.observe(result)
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


def map_ahead(
    items: Iterable[T], work: Callable[[T], R], depth: int, name: str = "stages"
) -> Generator[R, None, None]:
    """Yield the result of each item, in order. A thread works on it while the caller makes the next items.

    An exception of the items is raised after the results of the items before it. Closing the iterator ends
    the thread.

    Args:
        items: items, drawn in the caller's thread.
        work: function that runs in the other thread.
        depth: items drawn ahead of the result that is yielded.
        name: name of the thread.
    """
    futures: deque[Future[R]] = deque()
    item_error: BaseException | None = None
    source = iter(items)
    worker = ThreadPoolExecutor(1, name)
    try:
        while item_error is None:
            try:
                futures.append(worker.submit(work, next(source)))
            except StopIteration:
                break
            except (Exception, KeyboardInterrupt) as error:  # a stage may raise both
                item_error = error
            if len(futures) > depth:
                yield futures.popleft().result()
        while futures:
            yield futures.popleft().result()
        if item_error is not None:
            raise item_error
    finally:
        worker.shutdown(cancel_futures=True)


def _newest(
    items: Iterable[T], work: Callable[[T], R], dropping: DropPolicy, stop: threading.Event
) -> Generator[R, None, None]:
    """Yield the results of the newest items. Input, work and caller have a thread each."""
    incoming: NewestQueue[T] = dropping.queue("incoming", dropping.incoming_size, catch_up=True)
    done: NewestQueue[R] = dropping.queue("results", dropping.results_size)
    errors: list[BaseException] = []

    def guarded(work: Callable[[], None], queue: NewestQueue[T] | NewestQueue[R]) -> threading.Thread:
        """Start a thread that collects the error of ``work`` and closes its queue."""

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

    guarded(receive, incoming)  # This thread may block in its source for ever.
    worker = guarded(stages, done)
    try:
        yield from done
    finally:
        incoming.close()
        worker.join(PATIENCE)
    if errors:
        raise errors[0]


@contextmanager
def rare_garbage_collections() -> Iterator[None]:
    """Make garbage collections rare.

    Frames make many objects and few cycles, and collections would take a tenth of the time.
    Existing objects, mostly from imports, are not searched again and again.
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


class Progress(Observer[object]):
    """Observer that shows the number of results on the terminal.

    Args:
        what: name of the work. Empty: the name of the source.
        unit: name of one item.
    """

    def __init__(self, what: str = "", unit: str = "frame") -> None:
        self._what, self._unit = what, unit
        self._bar: Any = None

    def begin(self, items: Items[object]) -> None:
        """Show the bar."""
        description = self._what or printable(items.scene.name)
        self._bar = progress.bar(total=items.total, unit=self._unit, desc=description)

    def observe(self, result: object) -> None:
        """Count one result."""
        self._bar.update()

    def end(self) -> None:
        """Close the bar."""
        self._bar.close()
