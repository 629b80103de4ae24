"""Loggers of the standard library, silent by default. ``bevviz --help`` does not import this module."""

from __future__ import annotations

import logging

logging.getLogger("bevviz").addHandler(logging.NullHandler())


def logger(name: str) -> logging.Logger:
    """Return the logger of a module, by its ``__name__``."""
    return logging.getLogger(name)
