from __future__ import annotations

import subprocess
import sys

import pytest

# Each thread drops its last stream while others make theirs. Rerun's own streams lock up here.
PROGRAM = """
import threading
import numpy as np
import rerun as rr
from bevviz.recording.stream import RecordingStream

points = np.zeros((20_000, 3), np.float32)


def work():
    for _ in range(40):
        stream = RecordingStream("test")
        stream.set_sinks(rr.FileSink("/dev/null"))
        stream.log("points", rr.Points3D(points))
        stream.log("text", rr.TextDocument("text"))


threads = [threading.Thread(target=work) for _ in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print("over")
"""


@pytest.mark.long
def test_threads_make_and_drop_recordings_at_the_same_time() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=60)
    assert done.stdout == "over\n"
