"""Signals before a command has anything to lose, and what of its files is there when one has ended it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from bevviz.cli import main, workbench
from bevviz.support import cleanup
from tests.support.commands import environment
from tests.support.kept_drives import BAG
from tests.support.waiting import PATIENCE

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def heed_signals() -> None:
    """Restore the default handlers in a child process.

    ``nohup`` ignores SIGHUP, and a shell without job control ignores Ctrl-C for a process in the background.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def python(script: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", script],
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        preexec_fn=heed_signals,
    )


def test_an_interrupt_during_imports_ends_the_process(tmp_path: Path) -> None:
    """Among imports Python answers one with a traceback."""
    script = (
        "import sys, _signal\n"
        "before = set(sys.modules)\n"
        "def ask(number, handler, real=_signal.signal):\n"
        "    print(*sorted(set(sys.modules) - before)); real(number, handler); raise SystemExit\n"
        "_signal.signal = ask\n"
        "import bevviz.__main__\n"
    )
    done = python(script, tmp_path)
    assert done.stdout.split() == ["bevviz", "bevviz.__main__"], done.stderr


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_ends_a_command_without_open_files(tmp_path: Path, number: signal.Signals) -> None:
    """At once, by the signal, whatever would have become of an exception; temporary folders go."""
    script = (
        "import os, tempfile; tempfile.tempdir = os.getcwd()\n"
        "from bevviz.cli import interrupts\n"
        "from bevviz.support.scratch_folder import ScratchFolder\n"
        "interrupts.install(); ScratchFolder().new()\n"
        "assert os.listdir()\n"
        "try:\n"
        f"    os.kill(os.getpid(), {number})\n"
        "except BaseException: print('swallowed')\n"
        "print('went on')\n"
    )
    done = python(script, tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (-number, "", "")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("number", SIGNALS)
def test_an_open_recording_is_completed_on_a_signal(tmp_path: Path, number: signal.Signals) -> None:
    script = (
        "import os; from pathlib import Path\n"
        "from bevviz.cli import interrupts\n"
        "from bevviz.support.files import atomic_write\n"
        "interrupts.install()\n"
        "try:\n"
        "    with atomic_write(Path('a.txt'), 'file') as given:\n"
        f"        given.path.write_text('half'); os.kill(os.getpid(), {number})\n"
        "except KeyboardInterrupt: print(interrupts.signal_came())\n"
    )
    assert python(script, tmp_path).stdout == "True\n"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize("number", SIGNALS)
def test_an_ignored_signal_stays_ignored(tmp_path: Path, number: signal.Signals) -> None:
    """As ``nohup`` does it with SIGHUP, and a shell with Ctrl-C for what is in the background."""
    script = (
        "import os, signal\n"
        f"signal.signal({number}, signal.SIG_IGN)\n"
        "import bevviz.__main__; from bevviz.cli import interrupts\n"
        "interrupts.install()\n"
        "with interrupts.interruptible() as ended:\n"
        f"    os.kill(os.getpid(), {number})\n"
        f"os.kill(os.getpid(), {number}); print(ended.is_set())\n"
    )
    assert python(script, tmp_path).stdout == "False\n"


def test_a_page_ends_if_the_exception_of_a_signal_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python loses one that is raised in a destructor."""

    def announce(*_: object) -> None:
        with suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(workbench, "announce", announce)
    assert main(["open", str(BAG)]) == 0


def test_deleted_files_are_no_longer_tracked() -> None:
    removed: list[str] = []
    cleanup.register("mine", lambda: removed.append("mine"))
    cleanup.register("other", lambda: removed.append("other"))
    cleanup.unregister("mine")
    cleanup.remove_all()
    cleanup.unregister("other")
    assert removed == ["other"]
    with cleanup.must_finish(), cleanup.must_finish():
        assert cleanup.is_any_unfinished()
    assert not cleanup.is_any_unfinished()


def test_a_bar_leaves_no_semaphore_where_its_process_is_killed() -> None:
    code = (
        "import multiprocessing, os, signal\nfrom bevviz.support import progress\n"
        "multiprocessing.set_start_method('spawn')\n"  # as it is in a worker
        "assert sum(progress.bar([1, 2])) == 3\nos.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (-signal.SIGKILL, "")


INTERRUPTED_AT = """
import faulthandler, os, sys
from pathlib import Path
from bevviz.recording import sinks
from bevviz.support import cleanup

FILES = {sinks.__file__}


def interrupt_at(moment, work):
    # Raise at one line of this thread, as the handler of a signal does. Return the number of lines.
    lines = 0

    def trace(frame, event, value):
        nonlocal lines
        if frame.f_code.co_filename not in FILES:
            return None
        if event == "line" and cleanup.is_any_unfinished():
            lines += 1
            if lines == moment:
                raise KeyboardInterrupt
        return trace

    faulthandler.dump_traceback_later(30, exit=True)
    sys.settrace(trace)
    try:
        work()
    except KeyboardInterrupt:
        pass
    finally:
        sys.settrace(None)
        faulthandler.cancel_dump_traceback_later()
    return lines
"""


@pytest.mark.long
def test_an_interrupt_at_any_line_ends_an_open_recording(tmp_path: Path) -> None:
    """Rerun holds the pipe to the file open until its sink is closed, and the writer waits for that."""
    script = INTERRUPTED_AT + (
        "import rerun as rr\n"
        "from bevviz.config import load\n"
        "from bevviz.model.frame import Scene\n"
        "from bevviz.recording.source_lookup import Origin\n"
        "SCENE = Scene('test', 'lidar', ('lidar',))\n"
        "def work():\n"
        "    with sinks.open_recording(SCENE, load(), save=Path('a.rrd')) as opened:\n"
        "        opened.recording.log('a', rr.TextLog('b'))\n"
        "total = interrupt_at(0, work)\n"
        "for moment in range(1, total + 1):\n"
        "    interrupt_at(moment, work)\n"
        "print(total)\n"
    )
    done = python(script, tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    assert int(done.stdout) > 30


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_ends_a_live_run_at_once(tmp_path: Path, number: signal.Signals) -> None:
    """SIGHUP does not: a closed terminal sends it to a process that ends already."""
    script = (
        "import os, time; from contextlib import suppress\n"
        "from bevviz.cli import interrupts\n"
        "interrupts.ECHO = 0; interrupts.install()\n"
        "with suppress(KeyboardInterrupt), interrupts.interruptible(twice=True):\n"
        f"    os.kill(os.getpid(), {signal.SIGTERM})\n"
        f"os.kill(os.getpid(), {signal.SIGHUP}); print('closing', flush=True)\n"
        f"os.kill(os.getpid(), {number}); print('went on')\n"
    )
    done = python(script, tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (128 + number, "closing\n", "")


def test_a_request_to_save_during_imports_ends_nothing(tmp_path: Path) -> None:
    script = (
        "import os, signal, sys\n"
        "class Ask:\n"
        "    def find_spec(self, name, *rest):\n"
        "        if name == 'bevviz.cli': os.kill(os.getpid(), signal.SIGUSR1)\n"
        "sys.meta_path.insert(0, Ask())\n"
        "import bevviz.__main__; print('went on')\n"
    )
    done = python(script, tmp_path)
    assert (done.returncode, done.stdout) == (0, "went on\n"), done.stderr
