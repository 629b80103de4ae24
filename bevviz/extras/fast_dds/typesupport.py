"""Message types for rclpy and Fast DDS, built without a compiler.

A raw subscription and a publisher of serialised messages never convert a message. The middleware needs only
the name, the hash and an upper bound of the size of a type. For a package that is not installed (vision_msgs,
tf2_msgs) this module fills in these few C structs from the definition. The CDR code of rosbags reads and
writes the bytes. The structs are those of ``rosidl_runtime_c/message_type_support_struct.h`` and
``rosidl_typesupport_fastrtps_cpp/message_type_support.h``.
"""

from __future__ import annotations

import ctypes
from typing import Any

from bevviz.errors import UserError
from bevviz.extras.fast_dds.requests import TypeRequests
from bevviz.messages.definitions import store_of

__all__ = ["TypeRequests", "message_type"]

FAST_DDS = "rmw_fastrtps_cpp"
_UNBOUNDED = b"\x00"


def message_type(name: str) -> Any:
    """Return the rclpy class of ``package/msg/Name``, for raw subscriptions and publishers only.

    Raises:
        UserError: the type is unknown, or the middleware is not Fast DDS.
    """
    from rclpy.utilities import get_rmw_implementation_identifier
    from std_msgs.msg import Empty

    package = name.partition("/")[0]
    store_of(name)
    if (middleware := get_rmw_implementation_identifier()) != FAST_DDS:
        raise UserError(
            f"{package} is not installed, and the middleware is {middleware}: install {package}, "
            f"or set RMW_IMPLEMENTATION={FAST_DDS}, with which bevviz needs no {package}"
        )
    base = type(Empty)
    if base._TYPE_SUPPORT is None:
        base.__import_type_support__()
    support = _TypeSupport(name, _pointer(base._TYPE_SUPPORT))
    unused = object()  # placeholder for rclpy's converters; rclpy only checks that they exist
    meta = type(
        "Made",
        (type,),
        {
            "_TYPE_SUPPORT": support.capsule,
            "_CREATE_ROS_MESSAGE": unused,
            "_CONVERT_FROM_PY": unused,
            "_CONVERT_TO_PY": unused,
            "_DESTROY_ROS_MESSAGE": unused,
        },
    )
    return meta(name.rpartition("/")[2], (), {"__doc__": name, "support": support})


# --- C structs ---------------------------------------------------------------------------------

_Handle = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)
_Get = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
_MaxSize = ctypes.CFUNCTYPE(ctypes.c_size_t, ctypes.POINTER(ctypes.c_char))


class _MessageTypeSupport(ctypes.Structure):
    """Struct rosidl_message_type_support_t."""

    _fields_ = (
        ("typesupport_identifier", ctypes.c_void_p),  # compared by address
        ("data", ctypes.c_void_p),
        ("func", _Handle),
        ("get_type_hash_func", _Get),
        ("get_type_description_func", _Get),
        ("get_type_description_sources_func", _Get),
    )


class _Callbacks(ctypes.Structure):
    """Struct message_type_support_callbacks_t. The converting functions stay null."""

    _fields_ = (
        ("message_namespace", ctypes.c_char_p),
        ("message_name", ctypes.c_char_p),
        ("cdr_serialize", ctypes.c_void_p),
        ("cdr_deserialize", ctypes.c_void_p),
        ("get_serialized_size", ctypes.c_void_p),
        ("max_serialized_size", _MaxSize),
        ("key_callbacks", ctypes.c_void_p),
    )


class _Hash(ctypes.Structure):
    """Struct rosidl_type_hash_t."""

    _fields_ = (("version", ctypes.c_uint8), ("value", ctypes.c_uint8 * 32))


class _Sequence(ctypes.Structure):
    """Struct of any rosidl_runtime_c sequence, also of strings."""

    _fields_ = (("data", ctypes.c_char_p), ("size", ctypes.c_size_t), ("capacity", ctypes.c_size_t))


class _TypeDescription(ctypes.Structure):
    """Struct rosidl_runtime_c__type_description__TypeDescription."""

    _fields_ = (("type_name", _Sequence), ("fields", _Sequence), ("referenced", _Sequence))


class _TypeSupport:
    """Type support that keeps its C structs alive.

    Args:
        name: ``package/msg/Name``.
        base: address of the type support of an installed type. Fast DDS registers an introspection but does
            not announce it, so that of the installed type is used.
    """

    def __init__(self, name: str, base: int) -> None:
        package, _, short = name.split("/")
        installed = _MessageTypeSupport.from_address(base)
        fast = installed.func(base, b"rosidl_typesupport_fastrtps_c")
        introspection = installed.func(base, b"rosidl_typesupport_introspection_c")

        version, digest = store_of(name).hash_rihs01(name).removeprefix("RIHS").split("_")
        self._hash = _Hash(int(version), (ctypes.c_uint8 * 32)(*bytes.fromhex(digest)))
        text = name.encode()
        self._description = _TypeDescription(_Sequence(text, len(text), len(text) + 1))
        self._sources = _Sequence()
        self._callbacks = _Callbacks(
            f"{package}::msg".encode(), short.encode(), max_serialized_size=_MaxSize(self._max_size)
        )
        getters = [
            _Get(lambda _, struct=struct: ctypes.addressof(struct))
            for struct in (self._hash, self._description, self._sources)
        ]
        self._fast = _MessageTypeSupport.from_buffer_copy(_MessageTypeSupport.from_address(fast))
        self._fast.data = ctypes.addressof(self._callbacks)

        def handle(_: int, identifier: bytes) -> int | None:
            if identifier == b"rosidl_typesupport_fastrtps_c":
                return ctypes.addressof(self._fast)
            return introspection if identifier == b"rosidl_typesupport_introspection_c" else None

        self._fast.func = _Handle(handle)
        (
            self._fast.get_type_hash_func,
            self._fast.get_type_description_func,
            self._fast.get_type_description_sources_func,
        ) = getters
        self._handle = _MessageTypeSupport.from_buffer_copy(self._fast)
        self._handle.typesupport_identifier = installed.typesupport_identifier
        self.capsule = _capsule(ctypes.addressof(self._handle))

    @staticmethod
    def _max_size(bounds: Any) -> int:
        bounds[0] = _UNBOUNDED
        return 0


def _pointer(capsule: Any) -> int:
    api = ctypes.pythonapi
    api.PyCapsule_GetName.restype, api.PyCapsule_GetName.argtypes = ctypes.c_char_p, [ctypes.py_object]
    api.PyCapsule_GetPointer.restype = ctypes.c_void_p
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    address = api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule))
    assert isinstance(address, int)
    return address


def _capsule(address: int) -> Any:
    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    return new(address, None, None)
