"""Compile kernels of a first frame in a process of its own, while the run that needs them compiles others.

The run comes to these kernels last. Where both come to one at once, the later process waits and loads it.
"""

from __future__ import annotations

import os
from importlib import import_module

from numba.core import event, sigutils

from bevviz.support import numba_cache

# Kernels with the types of their arguments, which a test compares with those of a run.
KERNELS = (
    (
        "bevviz.stages.clustering:_core_points",
        "f4[::1], f4[::1], f4[::1], i4[::1], i4[::1], f8[:, ::1], i4[::1], i4[::1], f8, i8",
    ),
    (
        "bevviz.stages.clustering:_join",
        "f4[::1], f4[::1], f4[::1], i4[::1], i4[::1], f8[:, ::1], i4[::1], i4[::1], f8",
    ),
    (
        "bevviz.stages.clustering:_label",
        "f4[::1], f4[::1], f4[::1], i4[::1], i4[::1], i4[::1], i4[::1], i4[::1], i4[::1], f8",
    ),
    (
        "bevviz.stages.clustering:_fill_boxes",
        "f4[:, ::1], i4[::1], i4[::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1]",
    ),
    ("bevviz.model.box_points:rows_in_rectangles", "f4[:, ::1], f8[:, ::1], f8[:, ::1]"),
    ("bevviz.stages.bev:_raster", "i4[::1], f4[:, ::1], b1[::1], i8, i8, b1, b1, b1"),
    ("bevviz.stages.voxel:spread_to_points", "b1[::1], i4[::1]"),
    ("bevviz.stages.voxel:spread_to_points", "u1[::1], i4[::1]"),
    ("bevviz.stages.bev:_paint", "i4[::1], u1[:, :, ::1], u1[::1]"),
    (
        "bevviz.stages.detector.suppression:_suppress",
        "f4[:, ::1], i8[::1], i8[::1], f8, i4[::1], f4[::1]",
    ),
)


def main() -> None:
    """Compile the kernels, until the process ends that started this one."""
    event.unregister("numba:compile", numba_cache.announcer)
    parent = os.getppid()
    for path, types in KERNELS:
        if os.getppid() != parent:
            return
        module, name = path.split(":")
        arguments, _ = sigutils.normalize_signature(f"({types})")
        getattr(import_module(module), name).compile(arguments)


if __name__ == "__main__":
    main()
