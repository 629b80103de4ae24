"""The loop: order, what overlaps, what is dropped, how it ends, and what it does with errors."""

from __future__ import annotations

import gc
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from typing import Any

import cv2
import pytest

import bevviz.pipeline.run
from bevviz.model.frame import Scene
from bevviz.model.protocols import Items, Observer
from bevviz.pipeline.run import DropPolicy, RunEnd, iterate_results, map_ahead, run
from tests.support.waiting import PATIENCE, until


class Numbers:
    """0, 1, 2 ..., and what goes wrong at one of them."""

    scene = Scene("numbers", "lidar")
    warnings: Sequence[str] = ()

    def __init__(self, total: int = 10, *, fails_at: int = -1, pause: float = 0.0) -> None:
        self.total = total
        self.drawn = 0
        self.stopped = threading.Event()
        self._fails_at, self._pause = fails_at, pause

    def stop(self) -> None:
        self.stopped.set()

    def __iter__(self) -> Iterator[int]:
        for i in range(self.total):
            if i == self._fails_at:
                raise ValueError("cut")
            if self.stopped.wait(self._pause):
                return
            self.drawn += 1
            yield i


class Squares:
    """Tells in which thread it was made."""

    def __init__(self, pause: float = 0.0) -> None:
        self.pause = pause
        self.threads: set[int] = set()

    def perceive(self, item: int, network: Executor | None = None) -> int:
        time.sleep(self.pause)
        self.threads.add(threading.get_ident())
        assert network is None or network.submit(lambda: item).result() == item
        return item * item

    def finish(self, result: int) -> int:
        return result + 1


class Seen(Observer[int]):
    def __init__(self, *, fails_at: int = -1, pause: float = 0.0, queue_size: int | None = None) -> None:
        self.seen: list[int] = []
        self.threads: set[int] = set()
        self.queue_size, self.name = queue_size, "seen"
        self.begun = self.ended = 0
        self._fails_at, self._pause = fails_at, pause

    def begin(self, items: Items[object]) -> None:
        assert items.scene.name == "numbers"
        self.begun += 1

    def observe(self, result: int) -> None:
        time.sleep(self._pause)
        self.threads.add(threading.get_ident())
        if len(self.seen) == self._fails_at:
            raise RuntimeError("full")
        self.seen.append(result)

    def end(self) -> None:
        self.ended += 1


def finished(count: int) -> list[int]:
    return [i * i + 1 for i in range(count)]


def test_every_observer_sees_every_result_in_order() -> None:
    first, second, squares = Seen(), Seen(), Squares()
    assert run(Numbers(100), squares, [first, second]) == RunEnd(100)
    assert first.seen == second.seen == finished(100)
    assert first.threads == second.threads
    assert len(first.threads | squares.threads | {threading.get_ident()}) == 3
    assert (first.begun, first.ended) == (1, 1)
    assert not [t for t in threading.enumerate() if t.name.startswith(("run", "stages", "network"))]


def test_results_before_a_cut_are_observed() -> None:
    seen = Seen()
    with pytest.raises(ValueError, match="cut"):
        run(Numbers(fails_at=4), Squares(), [seen])
    assert seen.seen == finished(4)
    assert seen.ended == 1


def test_an_observer_that_fails_ends_the_run_for_all() -> None:
    before, failing, after = Seen(), Seen(fails_at=3), Seen()
    numbers = Numbers(10_000)
    with pytest.raises(RuntimeError, match="full"):
        run(numbers, Squares(), [before, failing, after])
    assert before.seen == finished(4)
    assert after.seen == finished(3)
    assert [o.ended for o in (before, failing, after)] == [1, 1, 1]
    assert numbers.drawn < 10


def test_an_observer_that_cannot_begin_ends_those_that_did() -> None:
    class Broken(Seen):
        def begin(self, items: Items[object]) -> None:
            raise RuntimeError("no disk")

    first, broken = Seen(), Broken()
    with pytest.raises(RuntimeError, match="no disk"):
        run(Numbers(), Squares(), [first, broken])
    assert (first.ended, broken.ended, first.seen) == (1, 0, [])


def test_an_error_of_the_work_comes_in_its_turn() -> None:
    class Failing(Squares):
        def perceive(self, item: int, network: Executor | None = None) -> int:
            return 1 // (2 - item)

    seen = Seen()
    with pytest.raises(ZeroDivisionError):
        run(Numbers(), Failing(), [seen])
    assert seen.seen == [1, 2]


def test_a_signal_during_work_ends_the_run_after_it() -> None:
    class Interrupting(Seen):
        def observe(self, result: int) -> None:
            if len(self.seen) == 3:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(0.5)  # seen by the thread that waits, in the midst of this
            super().observe(result)

    seen = Interrupting()
    end = run(Numbers(10_000), Squares(), [seen])
    assert end == RunEnd(4, interrupted=True)
    assert seen.seen == finished(4)
    assert seen.ended == 1


def test_a_signal_ends_the_run_after_the_current_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """It may come at any call of the thread that waits, and not only while it sleeps."""
    seen = Seen()

    class Asked(threading.Event):
        asked = 0

        def is_set(self) -> bool:
            if threading.current_thread() is threading.main_thread() and len(seen.seen) > 2:
                self.asked += 1
                if self.asked == 1:
                    raise KeyboardInterrupt
            return super().is_set()

    class Loop(bevviz.pipeline.run._Loop[int, int]):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args)
            self.over = Asked()

    monkeypatch.setattr(bevviz.pipeline.run, "_Loop", Loop)
    end = run(Numbers(100_000), Squares(0.01), [seen])
    assert end.interrupted
    assert seen.seen == finished(end.frames)
    assert seen.ended == 1


def test_a_signal_beside_the_start_leaves_nothing_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    class Late(threading.Thread):
        def start(self) -> None:
            super().start()
            raise KeyboardInterrupt

    seen, numbers = Seen(), Numbers()
    monkeypatch.setattr(threading, "Thread", Late)
    with pytest.raises(KeyboardInterrupt):
        run(numbers, Squares(), [seen])
    assert until(lambda: not [thread for thread in threading.enumerate() if thread.name == "run"])
    assert (seen.begun, seen.ended, numbers.drawn) == (0, 0, 0)


def test_an_interrupt_that_became_another_error_is_one() -> None:
    class Kernel(Squares):
        def finish(self, result: int) -> int:
            if result == 4:
                try:
                    raise KeyboardInterrupt
                except KeyboardInterrupt as error:
                    raise SystemError("<kernel> returned a result with an exception set") from error
            return super().finish(result)

    seen = Seen()
    assert run(Numbers(), Kernel(), [seen]) == RunEnd(2, interrupted=True)


def test_a_run_can_be_stopped() -> None:
    stop = threading.Event()

    class Stopping(Seen):
        def observe(self, result: int) -> None:
            super().observe(result)
            stop.set()

    numbers = Numbers(10_000)
    assert run(numbers, Squares(), [Stopping()], stop=stop) == RunEnd(1)
    assert numbers.drawn <= 5


def test_the_collector_is_left_as_it_was() -> None:
    before = 700, 10, 10
    gc.set_threshold(*before)
    inside: list[Any] = []

    class Looking(Seen):
        def observe(self, result: int) -> None:
            inside.append(gc.get_threshold())

    run(Numbers(2), Squares(), [Looking()])
    assert gc.get_threshold() == before
    assert inside[0] != before


# --- the newest win ----------------------------------------------------------------------------


def test_opencv_has_one_thread_during_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    monkeypatch.setattr(cv2, "getNumThreads", lambda: 7)
    monkeypatch.setattr(cv2, "setNumThreads", calls.append)
    calls.extend(iterate_results(Numbers(), Squares()))
    assert calls == [1, *finished(10), 7]


def test_slow_work_takes_the_newest() -> None:
    dropping, seen = DropPolicy(), Seen()
    numbers = Numbers(40, pause=0.01)
    end = run(numbers, Squares(pause=0.05), [seen], dropping=dropping)
    assert seen.seen == sorted(seen.seen)
    assert end.frames == len(seen.seen)
    assert 5 <= len(seen.seen) < 20
    assert dropping.dropped["incoming"] == 40 - len(seen.seen)


def test_a_slow_background_observer_delays_nobody() -> None:
    dropping, fast, slow = DropPolicy(), Seen(), Seen(pause=0.1, queue_size=2)
    run(Numbers(30, pause=0.01), Squares(), [slow, fast], dropping=dropping)
    assert len(fast.seen) == 30
    assert slow.seen == sorted(slow.seen)
    assert slow.seen[-1] == fast.seen[-1], "what waits at the end is still seen"
    assert dropping.dropped["seen"] == 30 - len(slow.seen) > 10
    assert slow.threads.isdisjoint(fast.threads)


def test_an_error_of_a_background_observer_ends_the_run() -> None:
    with pytest.raises(RuntimeError, match="full"):
        run(Numbers(10_000, pause=0.01), Squares(), [Seen(fails_at=2, queue_size=1)], dropping=DropPolicy())


@pytest.mark.parametrize("dropping", [None, DropPolicy()], ids=["waited for", "dropping"])
@pytest.mark.parametrize("fails_at", [-1, 2], ids=["whole", "failed"])
def test_a_source_is_told_the_end_however_it_ended(dropping: DropPolicy | None, fails_at: int) -> None:
    source = Numbers(5)
    with suppress(RuntimeError):
        run(source, Squares(), [Seen(fails_at=fails_at)], dropping=dropping)
    assert source.stopped.is_set()


def test_a_source_that_waits_for_good_can_be_ended() -> None:
    class Silent(Numbers):
        def __iter__(self) -> Iterator[int]:
            yield 0
            threading.Event().wait(60)

        def stop(self) -> None:
            pass  # it does not listen

    stop = threading.Event()
    threading.Timer(0.3, stop.set).start()
    start = time.monotonic()
    assert run(Silent(), Squares(), [Seen()], dropping=DropPolicy(), stop=stop).frames == 1
    assert time.monotonic() - start < 5


# --- drawn by the caller -----------------------------------------------------------------------


def test_results_can_be_iterated() -> None:
    assert list(iterate_results(Numbers(20), Squares())) == finished(20)


def test_closing_ends_the_threads() -> None:
    numbers = Numbers(10_000)
    drawn = iterate_results(numbers, Squares())
    assert next(drawn) == 1
    drawn.close()
    assert numbers.drawn <= 4
    assert not [
        t for t in threading.enumerate() if t.name.startswith(("read", "stages", "finish", "network"))
    ]


def test_prefetched_items_come_in_order() -> None:
    made = list(map_ahead(range(100), lambda i: (i * i, threading.get_ident()), 2))
    assert [square for square, _ in made] == [i * i for i in range(100)]
    assert threading.get_ident() not in {thread for _, thread in made}


@pytest.mark.parametrize("depth", [0, 2])
def test_a_cut_source_gives_what_preceded_the_cut(depth: int) -> None:
    got = []
    with pytest.raises(ValueError, match="cut"):
        for item in map_ahead(Numbers(fails_at=2), str, depth):
            got.append(item)  # noqa: PERF402
    assert got == ["0", "1"]


def test_work_and_prefetching_overlap() -> None:
    """The second item is only made once the first is worked on: taking turns would wait for ever."""
    begun = threading.Event()

    def items() -> Iterator[int]:
        yield 1
        assert begun.wait(PATIENCE)
        yield 2

    def work(item: int) -> int:
        begun.set()
        return item

    assert list(map_ahead(items(), work, 2)) == [1, 2]
