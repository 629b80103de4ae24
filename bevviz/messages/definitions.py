"""What a message type is made of: rosbags' definitions and those known here, else the installed package's.

Else what its publisher said, see ``type_sources``.
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
    if name in _learned:
        return _learned[name]
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


_learned: dict[str, Typestore] = {}  # type -> what is known of it since a publisher was asked


def learn(name: str, sources: Mapping[str, tuple[str, str]], digest: str) -> None:
    """What ``package/msg/Name`` is made of, from somebody who has it.

    Args:
        sources: of each type that it contains, itself among them, the encoding (``msg`` or ``idl``) and text.
        digest: the type's hash, ``RIHS01_...``.

    Raises:
        UserError: they are of another type, incomplete or cannot be read.
    """
    store = Typestore()
    try:
        for kind, (encoding, text) in sources.items():
            if encoding not in ("msg", "idl"):
                raise UserError(f"it has no source of {kind}")
            types = get_types_from_msg(text, kind) if encoding == "msg" else get_types_from_idl(text)
            store.register({**types})
        found = store.hash_rihs01(name)
    except (TypesysError, KeyError, ValueError) as error:
        raise UserError(f"its sources of {name} cannot be read: {error}") from None
    if found != digest:
        raise UserError(f"its sources are of another {name}")
    _learned[name] = store


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
