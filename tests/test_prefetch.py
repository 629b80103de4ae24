from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from bevviz.prefetch import overlap, prefetch


def test_order_is_kept() -> None:
    assert list(prefetch(range(100), 2)) == list(range(100))


def test_an_error_comes_after_what_preceded_it() -> None:
    def items() -> Iterator[int]:
        yield 1
        yield 2
        raise ValueError("cut")

    got = []
    with pytest.raises(ValueError, match="cut"):
        for item in prefetch(items(), 2):
            got.append(item)  # noqa: PERF402
    assert got == [1, 2]


def test_no_more_is_made_than_was_asked_and_the_thread_ends() -> None:
    made = []

    def items() -> Iterator[int]:
        for i in range(10_000):
            made.append(i)
            yield i

    ahead = prefetch(items(), 2)
    assert next(ahead) == 0
    ahead.close()
    assert len(made) <= 5  # one taken, two waiting, one in each hand
    assert all(thread.name != "prefetch" for thread in threading.enumerate())


# --- overlap -----------------------------------------------------------------------------------


def test_what_is_made_comes_in_order_from_another_thread() -> None:
    made = list(overlap(range(100), lambda i: (i * i, threading.get_ident()), 2))
    assert [square for square, _ in made] == [i * i for i in range(100)]
    assert {thread for _, thread in made} - {threading.get_ident()} == {thread for _, thread in made}


@pytest.mark.parametrize("depth", [0, 2])
def test_a_cut_source_gives_what_preceded_the_cut(depth: int) -> None:
    def items() -> Iterator[int]:
        yield 1
        yield 2
        raise ValueError("cut")

    got = []
    with pytest.raises(ValueError, match="cut"):
        for item in overlap(items(), str, depth):
            got.append(item)  # noqa: PERF402
    assert got == ["1", "2"]


def test_an_error_of_the_work_comes_in_its_turn() -> None:
    got = []
    with pytest.raises(ZeroDivisionError):
        for item in overlap([2, 1, 0, 1], lambda i: 2 // i, 2):
            got.append(item)  # noqa: PERF402
    assert got == [1, 2]


def test_the_work_goes_on_while_the_next_is_made() -> None:
    """The second item is only made once the first is worked on: taking turns would wait for ever."""
    begun = threading.Event()

    def items() -> Iterator[int]:
        yield 1
        assert begun.wait(10)
        yield 2

    def work(item: int) -> int:
        begun.set()
        return item

    assert list(overlap(items(), work, 2)) == [1, 2]


def test_closing_ends_the_thread_and_draws_no_more() -> None:
    made = []

    def items() -> Iterator[int]:
        for i in range(10_000):
            made.append(i)
            yield i

    results = overlap(items(), str, 2)
    assert next(results) == "0"
    results.close()
    assert len(made) == 3
    assert not any(thread.name.startswith("overlap") for thread in threading.enumerate())
