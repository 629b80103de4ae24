"""Ctrl-C, SIGTERM and SIGHUP end a command, with what was made until then complete."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Event

from bevviz.support import cleanup

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


_came = Event()  # a signal, whatever became of its exception


def came() -> bool:
    """Whether the process was interrupted: an exception among imports comes out of them as another one."""
    return _came.is_set()


def install() -> None:
    """For the whole process, before anything else. What ``nohup`` or a shell ignores stays ignored."""
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _interrupt)


def ignore() -> None:
    """The command is over: nothing that comes now may spoil its exit status."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def leave(status: int) -> None:
    """End the process at once where a thread is still at work in compiled code.

    After an interrupt, a thread that compiles a stage would find half of its compiler gone, and abort.
    A thread with a network that exceeded its limits would end in a segmentation fault.
    """
    threads = threading.enumerate()
    is_endless = any(thread.name == cleanup.ENDLESS_THREAD for thread in threads)
    if is_endless or (came() and any(thread.daemon for thread in threads)):
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(status)


def _interrupt(number: int, stack: object) -> None:
    """An exception only where a file needs its end: imports and libraries may swallow one."""
    if not cleanup.any_unfinished():
        cleanup.remove()
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    _came.set()
    raise KeyboardInterrupt


@contextmanager
def terminable() -> Iterator[Event]:
    """Within, a signal raises KeyboardInterrupt and sets the event.

    Both, since an exception that comes while a library calls back into Python can get lost there. What
    comes after the first is ignored where ``install`` was called: half a file is no use to the impatient.
    """
    ended = Event()

    def interrupt(number: int, stack: object) -> None:
        ended.set()
        if _interrupt in before.values():  # of a process that is a command
            _came.set()
        raise KeyboardInterrupt

    before = {
        number: handler for number in SIGNALS if (handler := signal.getsignal(number)) != signal.SIG_IGN
    }
    for number in before:
        signal.signal(number, interrupt)
    try:
        yield ended
    finally:
        for number, handler in before.items():
            over = ended.is_set() and handler is _interrupt
            signal.signal(number, signal.SIG_IGN if over else handler)


def wait_for_interrupt() -> None:
    with suppress(KeyboardInterrupt), terminable():
        signal.pause()
