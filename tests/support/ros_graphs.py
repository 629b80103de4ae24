"""ROS graphs for tests: each of its own, whoever else tests on this machine."""

from __future__ import annotations

import fcntl
import os
import pickle
import random
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.played_drive import drive_of
from tests.support.ros_player import Play

ROOT = Path(__file__).parents[2]
DOMAINS = range(1, 102)  # the ports of higher ones are taken by the system


@contextmanager
def own_domain() -> Iterator[str]:
    """Yield a ROS domain that no other test uses at the same time, so that no other node is in it."""
    folder = Path(tempfile.gettempdir()) / "bevviz-test-domains"
    folder.mkdir(exist_ok=True)
    for number in random.sample(DOMAINS, len(DOMAINS)):
        handle = os.open(folder / str(number), os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            continue
        try:
            yield str(number)
        finally:
            os.close(handle)
        return
    raise RuntimeError(f"every domain is in use, see {folder}")


@contextmanager
def own_graph() -> Iterator[pytest.MonkeyPatch]:
    """Set up the environment of a separate ROS graph that is limited to this machine."""
    with own_domain() as number, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", number)
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield patch


@contextmanager
def playing(play: Play) -> Iterator[None]:
    """Run a robot in its own process."""
    command = [sys.executable, "-m", "tests.support.ros_player"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe) as process:
        try:
            assert process.stdin is not None and process.stdout is not None
            pickle.dump(drive_of(play), process.stdin)
            process.stdin.close()
            assert process.stdout.readline() == b"playing\n"
            yield
        finally:
            process.terminate()  # the graph learns of it at once, as of a node that is shut down


def alone(folder: Path) -> dict[str, str]:
    """Return the environment of a ``bevviz live`` that no other run finds. Runs are found by folders."""
    return {"PYTHONPATH": str(ROOT), "XDG_RUNTIME_DIR": str(folder), "TMPDIR": str(folder)}
