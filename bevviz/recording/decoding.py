"""Guards around Rerun's reader for recordings that may be damaged."""

from __future__ import annotations

import subprocess
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bevviz.errors import UserError, first_line
from bevviz.recording import rerun_cli

PANIC_STATUS = 101  # and above: exit status of a Rust program that panicked


@contextmanager
def reader_errors_as_user_errors(path: Path, otherwise: str = "cannot be read") -> Iterator[None]:
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
        command = rerun_cli.ending_with_parent([rerun_cli.rerun_program(), "rrd", "verify"])
        status = subprocess.run(
            command, **input_arguments, stdout=null, stderr=null, env=rerun_cli.environment(), check=False
        ).returncode
    if status < 0 or status >= PANIC_STATUS:
        raise UserError(f"{path}: {otherwise}: it is damaged, Rerun's own reader breaks on it")
