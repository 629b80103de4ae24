"""Import of Open3D."""

from __future__ import annotations

import ctypes
from typing import Any


def load() -> Any:
    """Import and return ``open3d``.

    Open3D's wheel links libusb-1.0, which a minimal system lacks. ``libusb-package`` contains it. Once it is
    loaded globally, the dynamic linker uses it as the system's library.
    """
    import libusb_package

    path = libusb_package.get_library_path()
    if path is not None:
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
    import open3d

    return open3d
