"""Compiled loops: where there is no place to keep them, and what time they count as."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numba
import pytest

from bevviz.extras.demo.command import SHIPPED
from bevviz.support import compile_ahead, progress
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

COMPILED = """
import sys
from numba.core import event
from bevviz.cli import main
from bevviz.support import compile_ahead, numba_cache
with event.install_recorder("numba:compile") as recorder:
    if len(sys.argv) == 1:
        compile_ahead.main()
    else:
        event.unregister("numba:compile", numba_cache.announcer)
        main(sys.argv[1:])
kernels = [record.data["dispatcher"] for _, record in recorder.buffer if record.is_start]
print(*[f"{each.__module__}:{each.__name__}" for each in kernels if each.__module__.startswith("bevviz.")])
"""


@pytest.mark.long
def test_processes_compile_each_kernel_once(tmp_path: Path) -> None:
    """Two processes compile the list at once, and the first frame of the demo needs none of it again."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
    command = [sys.executable, "-c", COMPILED]

    def start(*arguments: str) -> subprocess.Popen[str]:
        return subprocess.Popen([*command, *arguments], stdout=subprocess.PIPE, text=True, env=environment)

    both = [start(), start()]
    listed = {path for path, _ in compile_ahead.KERNELS}
    compiled = [path for process in both for path in process.communicate()[0].split()]
    assert listed <= {*compiled}
    assert {path: n for path, n in Counter(compiled).items() if n > 1} == {
        "bevviz.stages.clustering:_root": 2,  # two types of arguments
        "bevviz.stages.voxel:spread_to_points": 2,
    }
    settings = ("--model", "demo", "--preset", "reference", "--frames", "5:6")
    run = start("bag", str(SHIPPED), *settings, "--save", str(tmp_path / "frame.rrd"))
    again = [path for path in run.communicate()[0].split() if path in compiled]
    assert again == ["bevviz.stages.voxel:spread_to_points"]  # rings of 16 bits


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


def test_compiling_is_announced_once(monkeypatch: pytest.MonkeyPatch) -> None:
    said, started = list[str](), list[list[str]]()
    monkeypatch.setattr(subprocess, "Popen", lambda command, **_: started.append(command))
    progress.set_receiver(said.append)
    try:
        listener = _CompileAnnouncer()
        for module in ("somebody.else", "bevviz.stages.voxel", "bevviz.stages.ground"):
            listener.on_start(SimpleNamespace(data={"dispatcher": SimpleNamespace(__module__=module)}))
    finally:
        progress.set_receiver(lambda text: None)
    (line,) = said
    assert line.startswith("compiling the stages for this machine")
    ((*_, module),) = started
    assert module == compile_ahead.__name__
