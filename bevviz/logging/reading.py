"""Recordings that come from somewhere, read with Rerun's own reader."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bevviz.errors import UserError, first_line


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
