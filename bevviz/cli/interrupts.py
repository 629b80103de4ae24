"""Signal handling: Ctrl-C, SIGTERM and SIGHUP end a command and leave complete files."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Event

from bevviz.support import cleanup

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
INSISTING = (signal.SIGINT, signal.SIGTERM)  # signals that end at once the second time

ECHO = 0.3  # seconds; a launcher may pass on the Ctrl-C that a terminal sends to all its processes

_first_signal: list[float] = []  # seconds, monotonic
_came = Event()  # Set by every signal, even if its exception got lost.


def signal_came() -> bool:
    """Return whether a signal came. An exception raised during an import can arrive as another one."""
    return _came.is_set()


def install() -> None:
    """Install the handlers for the whole process. Call it first.

    Signals that ``nohup`` or a shell ignores stay ignored.
    """
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _interrupt)


def ignore() -> None:
    """Ignore signals after the command, so that they cannot change its exit status."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def leave(status: int) -> None:
    """End the process at once if a thread still runs compiled code.

    After an interrupt, a thread that compiles a stage would lose its compiler and abort. A thread with a
    network that exceeded its limits would end in a segmentation fault.
    """
    threads = threading.enumerate()
    is_endless = any(thread.name == cleanup.ENDLESS_THREAD for thread in threads)
    if is_endless or (signal_came() and any(thread.daemon for thread in threads)):
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(status)


def _interrupt(number: int, stack: object) -> None:
    """Raise KeyboardInterrupt if a file has to be completed, else end the process.

    Imports and libraries may swallow the exception. So it is raised only if it is needed.
    """
    if not cleanup.is_any_unfinished():
        cleanup.remove_all()
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    _came.set()
    raise KeyboardInterrupt


def _end_at_once(number: int, stack: object) -> None:
    """End the process with nothing written or closed, unless the signal is an echo of the first one."""
    if time.monotonic() - _first_signal[0] > ECHO:
        cleanup.remove_all()
        os._exit(128 + number)


@contextmanager
def interruptible(*, twice: bool = False) -> Iterator[Event]:
    """Raise KeyboardInterrupt and set the yielded event when a signal comes.

    The event is needed because an exception can get lost while a library calls back into Python. After
    ``install``, later signals are ignored: they would leave an incomplete file.

    Args:
        twice: a second Ctrl-C or SIGTERM ends the process at once, also after this context.
    """
    ended = Event()

    def interrupt(number: int, stack: object) -> None:
        if twice and ended.is_set():
            if number in INSISTING:
                _end_at_once(number, stack)
            return
        ended.set()
        _first_signal.append(time.monotonic())
        if _interrupt in previous.values():  # This process is a command.
            _came.set()
        raise KeyboardInterrupt

    previous = {
        number: handler for number in SIGNALS if (handler := signal.getsignal(number)) != signal.SIG_IGN
    }
    for number in previous:
        signal.signal(number, interrupt)
    try:
        yield ended
    finally:
        for number, handler in previous.items():
            if ended.is_set() and handler is _interrupt:
                insists = twice and number in INSISTING
                handler = _end_at_once if insists else signal.SIG_IGN
            signal.signal(number, handler)


def wait_for_interrupt() -> None:
    """Wait for a signal."""
    with suppress(KeyboardInterrupt), interruptible():
        signal.pause()
