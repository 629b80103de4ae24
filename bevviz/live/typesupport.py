"""Message types for rclpy: of installed packages, and of the registered ``bevviz.message_types``."""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any

from bevviz.errors import UserError
from bevviz.support.extensions import load_all


@cache
def message_type(name: str) -> Any:
    """Return the rclpy class of ``package/msg/Name``, for raw subscriptions and publishers only.

    Raises:
        UserError: the type is unknown, or its package is not installed and the middleware is not Fast DDS.
    """
    package, _, short = name.split("/")
    try:
        module = importlib.import_module(f"{package}.msg")
    except ImportError:
        return _built(name)
    message_class = getattr(module, short, None)
    if message_class is None:
        raise UserError(f"the installed {package} has no message {short}")
    from rclpy.type_support import check_for_type_support

    check_for_type_support(message_class)  # loads the C library now, rather than at the first subscription
    return message_class


def _built(name: str) -> Any:
    """Return the class of a type whose package is not installed."""
    problems: list[str] = []
    for types in load_all("message_types", problems.append):
        return types.message_type(name)
    raise UserError("; ".join(problems) or f"{name.partition('/')[0]} is not installed")
