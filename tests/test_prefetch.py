from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from bevviz.sources.prefetch import prefetch


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
