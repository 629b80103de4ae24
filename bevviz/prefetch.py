"""Reading ahead: the next frame is decoded while the pipeline works on this one."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from queue import Empty, Full, Queue
from threading import Event, Thread
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def prefetch(items: Iterable[T], depth: int) -> Generator[T, None, None]:
    """Yield the items in order, up to ``depth`` of them made ahead by a thread.

    An exception of the source is raised here, after the items that came before it. Closing the iterator
    ends the thread.
    """
    queue: Queue[tuple[T] | BaseException | None] = Queue(depth)
    stopped = Event()

    def put(entry: tuple[T] | BaseException | None) -> None:
        while not stopped.is_set():
            try:
                queue.put(entry, timeout=0.1)
            except Full:
                continue
            return

    def work() -> None:
        try:
            for item in items:
                put((item,))
                if stopped.is_set():
                    return
        except BaseException as error:
            put(error)
        else:
            put(None)

    thread = Thread(target=work, name="prefetch", daemon=True)
    thread.start()
    try:
        while True:
            try:
                entry = queue.get(timeout=0.1)  # with a timeout, so that Ctrl-C is seen
            except Empty:
                continue
            if entry is None:
                return
            if isinstance(entry, BaseException):
                raise entry
            yield entry[0]
    finally:
        stopped.set()
        thread.join()


def overlap(items: Iterable[T], work: Callable[[T], R], depth: int) -> Generator[R, None, None]:
    """Yield what is made of each item, in order. A thread works on it while the caller makes the next ones.

    One thread beside the caller's and not two: they would wait for Python's lock more than they gain.

    An exception of the source is raised after what is made of the items that came before it. Closing the
    iterator ends the thread.

    Args:
        items: drawn in the caller's thread.
        work: called in the other one.
        depth: items that are drawn ahead of what is yielded.
    """
    waiting: deque[Future[R]] = deque()
    cut: Exception | None = None
    source = iter(items)
    worker = ThreadPoolExecutor(1, "overlap")
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
