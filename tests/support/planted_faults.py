"""The synthetic drive with every planted fault, and the results of its frames under each preset."""

from __future__ import annotations

from functools import cache

import numpy as np

from bevviz.config import load
from bevviz.extras.demo.drive import Snapshot, SyntheticSource
from bevviz.extras.demo.faults import FAULTS
from bevviz.model.results import FrameResult
from bevviz.pipeline.session import Session


@cache
def drive() -> SyntheticSource:
    """With every fault, each at its own time."""
    return SyntheticSource(frames=75, plant=list(FAULTS))


@cache
def at(name: str) -> Snapshot:
    return drive().snapshot(round(FAULTS[name].time * 10))


@cache
def run(name: str, preset: str) -> FrameResult:
    settings = ["detector.model=demo", *(["fusion.split=false"] if preset == "lidar" else [])]
    config = load(None, settings, "reference" if preset == "reference" else "default")
    session = Session(config)
    return session.run(at(name).frame)


def planted(name: str, label: str, ahead: float) -> tuple[int, ...]:
    """Rows of the ground truth: who of that class stands on the right half of the road there."""
    truth = at(name).frame.truth
    assert truth is not None
    x, y, _ = truth.boxes.center.T
    there = (np.abs(x - ahead) < 1.0) & (y < -1.2) & (y > -4.2) & (np.array(truth.labels) == label)
    return tuple(np.flatnonzero(there).tolist())
