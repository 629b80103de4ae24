"""Definitions of message types.

They come from rosbags, from bevviz, from installed packages, or from a publisher (``type_sources``).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg
from rosbags.typesys.store import Typestore

from bevviz.errors import UserError
from bevviz.messages.encode import typestore


def definition(name: str) -> str | None:
    """Return the definition of ``package/msg/Name`` and the types in it (``ros2msg``); None: not known."""
    try:
        return str(store_of(name).generate_msgdef(name, ros_version=2)[0])
    except (UserError, TypesysError, KeyError):
        return None


@cache
def store_of(name: str) -> Typestore:
    """Return a type store with ``package/msg/Name`` and the types in it.

    Raises:
        UserError: neither rosbags, bevviz nor an installed package defines the type.
    """
    known = typestore()
    if name in known.types:
        return known
    if name in _learned:
        return _learned[name]
    package = name.partition("/")[0]
    try:
        types = _parse_installed(name, {})
        store = Typestore()
        store.fielddefs.update(known.fielddefs)
        store.types.update(known.types)
        store.register(types)
    except FileNotFoundError as error:
        place = Path(error.filename)
        raise UserError(
            f"{name} is not known without its package, and no {place.parent.parent.name}/msg/{place.name} is "
            "in AMENT_PREFIX_PATH: source the workspace that has it"
        ) from None
    except (OSError, UnicodeDecodeError, TypesysError, KeyError, ValueError) as error:
        raise UserError(f"the definition of {name} in {package} cannot be read: {error}") from None
    return store


_learned: dict[str, Typestore] = {}  # type stores made from the definitions that publishers sent, by type


def learn(name: str, sources: Mapping[str, tuple[str, str]], digest: str) -> None:
    """Add the definition of ``package/msg/Name`` that a publisher sent.

    Args:
        name: message type.
        sources: encoding (``msg`` or ``idl``) and text, for the type and for each type in it.
        digest: hash of the type, ``RIHS01_...``.

    Raises:
        UserError: the sources are incomplete, cannot be read, or define another type.
    """
    store = Typestore()
    try:
        for kind, (encoding, text) in sources.items():
            if encoding not in ("msg", "idl"):
                raise UserError(f"it has no source of {kind}")
            types = get_types_from_msg(text, kind) if encoding == "msg" else get_types_from_idl(text)
            store.register({**types})
        actual = store.hash_rihs01(name)
    except (TypesysError, KeyError, ValueError) as error:
        raise UserError(f"its sources of {name} cannot be read: {error}") from None
    if actual != digest:
        raise UserError(f"its sources are of another {name}")
    _learned[name] = store


def _parse_installed(name: str, collected: dict[str, Any]) -> dict[str, Any]:
    """Parse the .msg file of an installed package, and those of the types in it."""
    package, _, short = name.split("/")
    for prefix in (*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix):
        path = Path(prefix, "share", package, "msg", f"{short}.msg")
        if prefix and path.exists():
            break
    types = get_types_from_msg(path.read_text(encoding="utf-8"), name)
    collected.update(types)
    for _, fields in types.values():
        for _, field in fields:
            kind = _type_of_field(field)
            if kind is not None and kind not in collected and kind not in typestore().types:
                _parse_installed(kind, collected)
    return collected


def _type_of_field(field: Any) -> str | None:
    """Return the message type of a field, or of its elements; None for basic types."""
    kind, content = field
    if kind.name == "NAME":
        return str(content)
    return _type_of_field(content[0]) if kind.name in ("ARRAY", "SEQUENCE") else None
