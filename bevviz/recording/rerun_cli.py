"""Start Rerun's own program: viewer, web page, tools. It listens at one address and sends no usage data."""

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
from bevviz.recording.ports import is_listening

Process: TypeAlias = "subprocess.Popen[bytes]"

START_TIMEOUT = 30.0  # seconds until a program listens
# Ask Linux to end the program with its parent, in every case. The request survives exec.
_END_WITH_PARENT = (
    "import ctypes,os,sys;ctypes.CDLL(None).prctl(1,15);"
    "os.getppid()==int(sys.argv[1]) and os.execvp(sys.argv[2],sys.argv[2:])"
)


def rerun_program() -> str:
    """Return Rerun's program in the version of the SDK."""
    binary = Path(rr.__file__).parents[1] / "rerun_cli" / "rerun"
    return str(binary) if binary.exists() else "rerun"


def ending_with_parent(command: Sequence[str]) -> list[str]:
    """Return a command that ends with the thread that starts it. A server must not outlive its client."""
    if sys.platform != "linux":
        return list(command)
    return [sys.executable, "-I", "-S", "-c", _END_WITH_PARENT, str(os.getpid()), *command]


def environment() -> dict[str, str]:
    """Return the environment of Rerun's program: no usage data, unless ``FORCE_RERUN_ANALYTICS`` is set.

    Rerun's own setting (``rerun analytics``) holds for all processes of a user, so bevviz does not change it.
    For a single process, the only switch is that Rerun sends nothing in CI.
    """
    variables = dict(os.environ)
    if not variables.get("FORCE_RERUN_ANALYTICS"):
        variables["CI"] = "true"
    return variables


def spawn(command: Sequence[str], stdin: int = subprocess.PIPE) -> Process:
    """Start a command without output, in a session of its own.

    Args:
        command: program and arguments.
        stdin: as in ``subprocess``.

    Raises:
        OSError: the program does not exist.
    """
    return subprocess.Popen(
        command,
        stdin=stdin,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment(),
        start_new_session=True,  # Ctrl-C reaches only this process
    )


def start(
    arguments: Sequence[str], host: str, port: int, *, lasting: bool = False
) -> subprocess.Popen[bytes]:
    """Start Rerun's program and wait until it listens.

    Args:
        arguments: arguments of the program.
        host: address at which it will listen.
        port: port at which it will listen.
        lasting: the program outlives this process, and the user closes it.

    Raises:
        UserError: the program ends, or does not listen.
    """
    command = [rerun_program(), *arguments]
    try:
        process = spawn(command if lasting else ending_with_parent(command), subprocess.DEVNULL)
    except OSError as error:
        raise UserError(f"cannot start {command[0]}: {error.strerror}") from None
    deadline = time.monotonic() + START_TIMEOUT
    try:
        while not is_listening(host, port):
            if process.poll() is not None or time.monotonic() > deadline:
                raise UserError(f"'rerun {' '.join(arguments)}' does not start: try it by hand")
            time.sleep(0.05)
    except BaseException:
        stop(process)
        raise
    return process


def stop(process: Process) -> None:
    """Stop a program that was started without ``lasting``."""
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(2.0)
    process.kill()
    process.wait()


def start_web_viewer(address: str, port: int, source: str) -> Process:
    """Serve the web viewer without data at an address. It loads the data from ``source``.

    The SDK's own web server listens at all addresses, so it is not used.

    Raises:
        UserError: the viewer does not start.
    """
    arguments = ["--serve-web", "--bind", address, "--web-viewer-port", str(port), source]
    return start(arguments, address, port)
