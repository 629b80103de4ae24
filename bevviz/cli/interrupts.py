"""Ctrl-C and SIGTERM: both end a command, with what was made until then complete."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Event
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)


_came = Event()  # a signal, whatever became of its exception


def came() -> bool:
    """Whether the process was interrupted: an exception among imports comes out of them as another one."""
    return _came.is_set()


def install() -> None:
    """For the whole process, before anything else: a signal among the imports is an interrupt, too."""
    for number in SIGNALS:
        signal.signal(number, _interrupt)


def ignore() -> None:
    """The command is over: nothing that comes now may spoil its exit status."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _interrupt(number: int, stack: object) -> NoReturn:
    _came.set()
    raise KeyboardInterrupt


@contextmanager
def terminable() -> Iterator[Event]:
    """Within, a signal raises KeyboardInterrupt and sets the event.

    Both, since an exception that comes while a library calls back into Python can get lost there. What
    comes after the first is ignored where ``install`` was called: half a file is no use to the impatient.
    """
    ended = Event()

    def interrupt(number: int, stack: object) -> NoReturn:
        ended.set()
        if before[signal.SIGINT] is _interrupt:  # of a process that is a command
            _came.set()
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in SIGNALS}
    try:
        yield ended
    finally:
        for number, handler in before.items():
            over = ended.is_set() and handler is _interrupt
            signal.signal(number, signal.SIG_IGN if over else handler)


def wait_for_interrupt() -> None:
    with suppress(KeyboardInterrupt), terminable():
        signal.pause()
