"""Compiled loops: where there is no place to keep them, and what time they count as."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import numba
import pytest

from bevviz.support import progress
from bevviz.support.compile_clock import common_clock, thread_clock
from bevviz.support.numba_cache import _CompileAnnouncer
from bevviz.support.numba_kernel import kernel

NOWHERE = """
from numba.core.caching import CacheImpl
CacheImpl._locator_classes = []  # as where neither the package nor a home can be written
import numpy as np
from bevviz.support import numba_cache
from bevviz.stages.clustering import dbscan
assert not numba_cache.CACHED
points = np.array([[0, 0, 0], [0.1, 0, 0], [9, 0, 0]], np.float32)
print(dbscan(points, 0.5, 2).tolist())
"""


IN_BOXES = """
import sys
import numpy as np
from bevviz.model.box_points import inside_each
from bevviz.model.frame import Boxes3D
three = np.ones((1, 3), np.float32)
print([rows.tolist() for _, rows in inside_each(three, Boxes3D(three, three, np.zeros(1, np.float32)))])
print("scipy.linalg" in sys.modules)
"""


@pytest.mark.long
def test_loaded_loops_import_no_scipy() -> None:
    """The import would take half a second before the first frame of the workbench."""
    runs = [  # The first one may compile.
        subprocess.run([sys.executable, "-c", IN_BOXES], capture_output=True, text=True, check=True)
        for _ in range(2)
    ]
    assert runs[1].stdout.splitlines() == ["[[0]]", "False"]


@pytest.mark.long
def test_without_a_cache_folder_loops_are_recompiled() -> None:
    done = subprocess.run([sys.executable, "-c", NOWHERE], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "[0, 0, -1]"), done.stderr


def test_kernels_take_named_arguments_and_call_each_other() -> None:
    @kernel
    def scaled(x: float, factor: float = 2.0) -> float:
        return factor * x

    @kernel
    def both(x: float) -> float:
        return scaled(x) + scaled(x, factor=10.0)

    assert scaled(3.0, factor=4.0) == 12.0
    assert both(3.0) == 36.0


def test_stage_times_exclude_compilation() -> None:
    def twice(x: float) -> float:
        return 2 * x

    compiled = numba.njit(twice)
    wall, own, common = time.perf_counter(), thread_clock(), common_clock()
    assert compiled(1.5) == 3.0
    wall, own, common = time.perf_counter() - wall, thread_clock() - own, common_clock() - common
    assert wall > 0.02  # it was compiled
    assert own < wall / 2 and common < wall / 2
    start = thread_clock()
    time.sleep(0.05)
    assert thread_clock() - start >= 0.05


def test_compiling_in_another_thread_is_not_counted() -> None:
    def thrice(x: float) -> float:
        return 3 * x

    compiled = numba.njit(thrice)
    start, common = thread_clock(), common_clock()
    wall = time.perf_counter()
    thread = threading.Thread(target=compiled, args=(1.0,))
    thread.start()
    thread.join()
    wall = time.perf_counter() - wall
    assert thread_clock() - start >= wall > common_clock() - common


def test_compiling_is_announced_once() -> None:
    said: list[str] = []
    progress.set_receiver(said.append)
    try:
        listener = _CompileAnnouncer()
        for module in ("somebody.else", "bevviz.stages.voxel", "bevviz.stages.ground"):
            listener.on_start(SimpleNamespace(data={"dispatcher": SimpleNamespace(__module__=module)}))
    finally:
        progress.set_receiver(lambda text: None)
    (line,) = said
    assert line.startswith("compiling the stages for this machine")
