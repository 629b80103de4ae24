"""Loggers of the standard library, silent where nobody listens: apart, as ``bevviz --help`` needs none."""

from __future__ import annotations

import logging

logging.getLogger("bevviz").addHandler(logging.NullHandler())


def logger(name: str) -> logging.Logger:
    """Of a module, by its ``__name__``."""
    return logging.getLogger(name)
