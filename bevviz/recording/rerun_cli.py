"""Rerun's own program beside us: viewer, web page, tools. It listens where we say, and reports on nobody."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeAlias

import rerun as rr

from bevviz.errors import UserError
from bevviz.recording.ports import answers

Process: TypeAlias = "subprocess.Popen[bytes]"

PATIENCE = 30.0  # seconds until a program listens
# Linux ends the program with its parent, however that ends. What is asked for lasts through exec.
_TIED = (
    "import ctypes,os,sys;ctypes.CDLL(None).prctl(1,15);"
    "os.getppid()==int(sys.argv[1]) and os.execvp(sys.argv[2],sys.argv[2:])"
)


def program() -> str:
    """Of the very version that came with the SDK."""
    binary = Path(rr.__file__).parents[1] / "rerun_cli" / "rerun"
    return str(binary) if binary.exists() else "rerun"


def tied(command: Sequence[str]) -> list[str]:
    """The command, ended when the thread that starts it is gone: a server must not outlive what it serves."""
    if sys.platform != "linux":
        return list(command)
    return [sys.executable, "-I", "-S", "-c", _TIED, str(os.getpid()), *command]


def environment() -> dict[str, str]:
    """For Rerun's program: it sends and stores nothing of its use, unless ``FORCE_RERUN_ANALYTICS`` is set.

    The setting of its own (``rerun analytics``) is for all of a user's processes and belongs to the user. For
    one process it only has that it leaves CI alone.
    """
    given = dict(os.environ)
    if not given.get("FORCE_RERUN_ANALYTICS"):
        given["CI"] = "true"
    return given


def spawn(command: Sequence[str], stdin: int = subprocess.PIPE) -> Process:
    """Start a command beside us, silently.

    Args:
        command: its words.
        stdin: as ``subprocess`` takes it.

    Raises:
        OSError: there is no such program.
    """
    return subprocess.Popen(
        command,
        stdin=stdin,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment(),
        start_new_session=True,  # Ctrl-C is for us alone
    )


def start(
    arguments: Sequence[str], host: str, port: int, *, lasting: bool = False
) -> subprocess.Popen[bytes]:
    """Start the program and wait until it listens.

    Args:
        arguments: of the program.
        host: address at which it will listen.
        port: at which port.
        lasting: it outlives us, for the user to close.

    Raises:
        UserError: it ends, or does not listen.
    """
    command = [program(), *arguments]
    try:
        process = spawn(command if lasting else tied(command), subprocess.DEVNULL)
    except OSError as error:
        raise UserError(f"cannot start {command[0]}: {error.strerror}") from None
    deadline = time.monotonic() + PATIENCE
    try:
        while not answers(host, port):
            if process.poll() is not None or time.monotonic() > deadline:
                raise UserError(f"'rerun {' '.join(arguments)}' does not start: try it by hand")
            time.sleep(0.05)
    except BaseException:
        end(process)
        raise
    return process


def end(process: Process) -> None:
    """Of one that is not to last."""
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(2.0)
    process.kill()
    process.wait()


def page(address: str, port: int, source: str) -> Process:
    """The web viewer alone, at a port of an address, for data from ``source``. (The SDK's is open to all.)

    Raises:
        UserError: it does not start.
    """
    arguments = ["--serve-web", "--bind", address, "--web-viewer-port", str(port), source]
    return start(arguments, address, port)
