"""Errors that a user sees: one clear line each, never a traceback."""

from __future__ import annotations


class UserError(Exception):
    """What is wrong, in which file, topic or field, and what to do. The command exits with status 2."""
