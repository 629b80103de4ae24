"""What a message type is made of: rosbags' definitions and those known here, else the installed package's."""

from __future__ import annotations

import os
import sys
from functools import cache
from pathlib import Path
from typing import Any

from rosbags.typesys import TypesysError, get_types_from_msg
from rosbags.typesys.store import Typestore

from bevviz.errors import UserError
from bevviz.ros.encode import typestore


def definition(name: str) -> str | None:
    """Of ``package/msg/Name`` and all that it contains (``ros2msg``); None: nobody knows it here."""
    try:
        return str(store_of(name).generate_msgdef(name, ros_version=2)[0])
    except (UserError, TypesysError, KeyError):
        return None


@cache
def store_of(name: str) -> Typestore:
    """One that has ``package/msg/Name`` and all that it contains.

    Raises:
        UserError: it is neither among those known here nor in an installed package.
    """
    known = typestore()
    if name in known.types:
        return known
    package = name.partition("/")[0]
    try:
        found = _installed(name, {})
        store = Typestore()
        store.fielddefs.update(known.fielddefs)
        store.types.update(known.types)
        store.register(found)
    except FileNotFoundError as error:
        place = Path(error.filename)
        raise UserError(
            f"{name} is not known without its package, and no {place.parent.parent.name}/msg/{place.name} is "
            "in AMENT_PREFIX_PATH: source the workspace that has it"
        ) from None
    except (OSError, UnicodeDecodeError, TypesysError, KeyError, ValueError) as error:
        raise UserError(f"the definition of {name} in {package} cannot be read: {error}") from None
    return store


def _installed(name: str, found: dict[str, Any]) -> dict[str, Any]:
    """The types of an installed package's .msg file and of those that it names."""
    package, _, short = name.split("/")
    for prefix in (*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix):
        path = Path(prefix, "share", package, "msg", f"{short}.msg")
        if prefix and path.exists():
            break
    types = get_types_from_msg(path.read_text(encoding="utf-8"), name)
    found.update(types)
    for _, fields in types.values():
        for _, field in fields:
            kind = _named(field)
            if kind is not None and kind not in found and kind not in typestore().types:
                _installed(kind, found)
    return found


def _named(field: Any) -> str | None:
    """The message type of a field, or of its elements, as rosbags describes fields."""
    kind, content = field
    if kind.name == "NAME":
        return str(content)
    return _named(content[0]) if kind.name in ("ARRAY", "SEQUENCE") else None
