"""Recordings that come from somewhere, read with Rerun's own reader."""

from __future__ import annotations

import subprocess
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bevviz.errors import UserError, first_line
from bevviz.recording import rerun_cli

PANIC = 101  # and above: how a Rust program says that it broke


@contextmanager
def readable(path: Path, otherwise: str = "cannot be read") -> Iterator[None]:
    """Within, whatever reading a damaged recording leads to is one UserError, a panic of Rerun's too."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "RRD file has no footer")  # it was not finished
            yield
    except UserError:
        raise
    except BaseException as error:
        if isinstance(error, Exception) or type(error).__name__ == "PanicException":
            raise UserError(f"{path}: {otherwise}: {first_line(error)}") from error
        raise


def check_decodes(path: Path, otherwise: str = "cannot be read", *, first: int | None = None) -> None:
    """Have a recording that may be damaged decoded by a process of its own.

    Some damage makes Rerun's reader panic in a thread of its own, which ends the process that reads.

    Args:
        path: of the recording.
        otherwise: what to say where the reader breaks.
        first: decode as many bytes from the beginning; None: all.

    Raises:
        UserError: the reader breaks. What it merely refuses it will refuse again, with its reason.
    """
    with path.open("rb") as file:
        given: dict[str, Any] = {"stdin": file} if first is None else {"input": file.read(first)}
        quiet = subprocess.DEVNULL
        command = rerun_cli.tied([rerun_cli.program(), "rrd", "verify"])
        ended = subprocess.run(
            command, **given, stdout=quiet, stderr=quiet, env=rerun_cli.environment(), check=False
        ).returncode
    if ended < 0 or ended >= PANIC:
        raise UserError(f"{path}: {otherwise}: it is damaged, Rerun's own reader breaks on it")
