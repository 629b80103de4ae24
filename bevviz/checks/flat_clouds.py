"""Check of the fusion on clouds of one plane: a 2D LiDAR shows no height that an image box could enclose."""

from __future__ import annotations

from collections.abc import Iterator

from bevviz.checks.read_input import ReadInput
from bevviz.model.input_findings import InputFinding, Remedy

SETTING = "fusion.method=centroid"


def flat_clouds(read: ReadInput) -> Iterator[InputFinding]:
    """Yield a flat cloud whose clusters the other method of the fusion matches."""
    flat = read.flat
    if flat is None or flat.by_centroid <= flat.matched or flat.matched > flat.detections / 2:
        return
    text = (
        f"LiDAR '{flat.lidar}' measures one plane, which shows no height: {flat.matched or 'none'} of "
        f"{flat.detections} detections {'has' if flat.matched < 2 else 'have'} a cluster"
    )
    tried = f"tried: {flat.by_centroid} of {flat.detections} have one then"
    yield InputFinding("fusion", flat.lidar, text, Remedy(f"--set {SETTING}", (SETTING,), tried))
