"""Run Rerun's own program: viewer, web page, check of a recording. It sends no usage data."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeAlias

import rerun as rr

from bevviz.errors import UserError, first_line
from bevviz.recording.ports import (
    FIRST_DATA_PORT,
    LOOPBACK,
    check_port,
    free_port,
    is_listening,
    viewer_address,
)

Process: TypeAlias = "subprocess.Popen[bytes]"

SERVER_MEMORY = "25%"  # of the machine's memory, for a server's buffer for late viewers, and for the viewer
START_TIMEOUT = 30.0  # seconds until a program listens
PANIC_STATUS = 101  # and above: exit status of a Rust program that panicked
WEB_VIEWER_BYTES = 2.3e9  # bytes that fit into the web viewer, as WebAssembly has 4 GiB of memory
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


# --- recordings that may be damaged -------------------------------------------------------------


@contextmanager
def reader_errors_as_user_errors(path: Path, otherwise: str) -> Iterator[None]:
    """Raise a ``UserError`` for any error in this context, including a panic of Rerun's reader."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "RRD file has no footer")  # the recording was not finished
            yield
    except UserError:
        raise
    except BaseException as error:
        if isinstance(error, Exception) or type(error).__name__ == "PanicException":
            raise UserError(f"{path}: {otherwise}: {first_line(error)}") from error
        raise


def check_decodes(path: Path, otherwise: str = "cannot be read", *, first: int | None = None) -> None:
    """Decode a recording in a separate process, to find damage that breaks Rerun's reader.

    Some damage makes the reader panic in a thread of its own, which ends the whole process.

    Args:
        path: recording to decode.
        otherwise: error text for a reader that breaks.
        first: decode this many bytes from the beginning; None: all.

    Raises:
        UserError: the reader breaks. An ordinary error of the reader is ignored here. It occurs again, with
            its reason, when the recording is read.
    """
    with path.open("rb") as file:
        input_arguments: dict[str, Any] = {"stdin": file} if first is None else {"input": file.read(first)}
        null = subprocess.DEVNULL
        command = ending_with_parent([rerun_program(), "rrd", "verify"])
        status = subprocess.run(
            command, **input_arguments, stdout=null, stderr=null, env=environment(), check=False
        ).returncode
    if status < 0 or status >= PANIC_STATUS:
        raise UserError(f"{path}: {otherwise}: it is damaged, Rerun's own reader breaks on it")


# --- saved recordings --------------------------------------------------------------------------


def too_large_for_web(recording: Path, size: int) -> str:
    """Return a warning if a browser cannot show the whole recording, else "". ``size`` is in bytes."""
    if size <= WEB_VIEWER_BYTES:
        return ""
    limit = f"{WEB_VIEWER_BYTES / 1e9:.1f} GB"
    return (
        f"{recording.name} has {size / 1e9:.1f} GB, and a browser's viewer can hold {limit}: its beginning "
        f"is missing; Rerun's own viewer reads what it shows from the file (rerun {recording}); --keep "
        "inspect saves a fifth"
    )


def open_in_viewer(recording: Path) -> None:
    """Open the recording in a viewer, which stays open after this process.

    Raises:
        UserError: the viewer does not start.
    """
    port = free_port(FIRST_DATA_PORT)
    arguments = [str(recording), "--bind", LOOPBACK, "--port", str(port), "--hide-welcome-screen"]
    start(arguments, LOOPBACK, port, lasting=True)


@contextmanager
def serve_in_browser(recording: Path, port: int | None = None) -> Iterator[str]:
    """Serve the recording to browsers of this machine while the context is open. Yield the page's address.

    Args:
        recording: .rrd file.
        port: port of the page; None: the first free one from 9090.

    Raises:
        UserError: the port is in use, or the viewer does not start.
    """
    if port is not None:
        check_port(port, "--port")
    page_port = port or free_port(9090)
    data_port = free_port(FIRST_DATA_PORT, but=page_port)
    arguments = [str(recording), "--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(page_port)]
    arguments += ["--port", str(data_port), "--server-memory-limit", SERVER_MEMORY]
    process = start(arguments, LOOPBACK, page_port)
    try:
        yield viewer_address("localhost", page_port, data_port)
    finally:
        stop(process)
