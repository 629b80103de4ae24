"""Files in a folder that no loader reads."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

AS_CLOUDS = "save them as PCD, PLY, BIN or NPY"
AS_IMAGES = "save them as PNG or JPEG"
ADVICE = {
    **dict.fromkeys(
        (".las", ".laz", ".e57", ".xyz", ".pts", ".npz", ".vtk", ".feather", ".pkl", ".h5", ".hdf5"),
        AS_CLOUDS,
    ),
    **dict.fromkeys((".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".exr", ".raw"), AS_IMAGES),
    **dict.fromkeys((".mp4", ".avi", ".mkv", ".mov"), "save their images as PNG or JPEG"),
    **dict.fromkeys((".gz", ".zip", ".zst"), "unpack them"),
    ".pcap": "play them through their driver and record its topics",
    ".tfrecord": "convert them, for instance to KITTI's layout",
}
MAX_FILES = 10_000  # files examined in each folder


def describe_unread(folder: Path) -> str:
    """Return a clause about the most frequent unread type in a folder and its subfolders; empty: none."""
    folders = [folder, *(d for d in sorted(folder.iterdir()) if d.is_dir())]
    files = [f for place in folders for f, _ in zip(place.iterdir(), range(MAX_FILES), strict=False)]
    counts = Counter(kind for file in files if (kind := file.suffix.lower()) in ADVICE)
    if not counts:
        return ""
    kind, count = counts.most_common(1)[0]
    return f"{count} {kind} file{'s are' if count > 1 else ' is'} not read: {ADVICE[kind]}"
