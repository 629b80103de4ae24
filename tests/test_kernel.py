"""Compiled loops where there is no place to keep them."""

from __future__ import annotations

import subprocess
import sys

NOWHERE = """
from numba.core.caching import CacheImpl
CacheImpl._locator_classes = []  # as where neither the package nor a home can be written
import numpy as np
from bevviz.stages import kernel
from bevviz.stages.clustering import dbscan
assert not kernel.CACHED
points = np.array([[0, 0, 0], [0.1, 0, 0], [9, 0, 0]], np.float32)
print(dbscan(points, 0.5, 2).tolist())
"""


def test_without_a_place_they_are_compiled_anew() -> None:
    done = subprocess.run([sys.executable, "-c", NOWHERE], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "[0, 0, -1]"), done.stderr
