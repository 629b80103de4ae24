"""Reader of PLY files. Open3D fills cut files with uninitialised memory and drops integer properties.

The format is Turk's (The PLY Polygon File Format, 1994). The library plyfile is under the GPL.
"""

from __future__ import annotations

from io import BytesIO
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevviz.messages.clouds import MOST_POINTS
from bevviz.support.files import SENSOR_LIMIT, read_bytes

MAX_HEADER = 1 << 16  # bytes
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_ply(file: Path) -> tuple[NDArray[np.void], int]:
    """Return the vertices with their properties, and the number of vertices that the header states.

    A cut file gives its whole vertices.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is no PLY file, has no x, y, z, or has lists before or in its vertices.
    """
    data = read_bytes(file, SENSOR_LIMIT)
    order, elements, at = _header(data)
    skipped = 0
    for name, count, properties in elements:
        if any(kind not in TYPES for _, kind in properties):
            kind = next(kind for _, kind in properties if kind not in TYPES)
            raise ValueError(f"properties of the type {kind} in its element {name} are not read")
        layout = np.dtype([(label, ORDERS[order] + TYPES[kind]) for label, kind in properties])
        if name == "vertex":
            break
        skipped += count if order == "ascii" else count * layout.itemsize
    else:
        raise ValueError("no element vertex in it")
    if missing := sorted({"x", "y", "z"} - set(layout.names or ())):
        raise ValueError(f"no property {missing[0]} in it")
    if count > MOST_POINTS:
        raise ValueError(f"announces {count} points: {MOST_POINTS} at most are taken")
    if order != "ascii":
        complete = max(0, len(data) - at - skipped) // layout.itemsize
        return np.frombuffer(data, layout, min(count, complete), at + skipped if complete else 0), count
    lines = [*islice((line for line in BytesIO(data[at:]) if line.strip()), skipped, skipped + count)]
    if lines and len(lines[-1].split()) < len(properties):
        lines.pop()  # The last line is cut.
    return np.loadtxt(BytesIO(b"".join(lines)), layout, ndmin=1) if lines else np.zeros(0, layout), count


def _header(data: bytes) -> tuple[str, list[tuple[str, int, list[tuple[str, str]]]], int]:
    """Return the format, the elements (name, count, properties), and the end of the header.

    CloudCompare writes ``scalar_`` before field names. CARLA calls the intensity ``I``.
    """
    end = data.find(b"end_header", 0, MAX_HEADER)
    newline = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or newline < 0:
        raise ValueError("is empty" if not data else "no header of a PLY, or a damaged one")
    order, elements = "", list[tuple[str, int, list[tuple[str, str]]]]()
    try:
        for line in data[:end].decode("utf-8", "replace").splitlines()[1:]:
            match line.split():
                case ["format", order, *_]:
                    pass
                case ["element", name, count]:
                    elements.append((name, int(count), []))
                case ["property", "list", _, _, label]:
                    elements[-1][2].append((label, "list"))
                case ["property", kind, label]:
                    elements[-1][2].append((label.removeprefix("scalar_").lower(), kind))
    except (ValueError, IndexError):
        raise ValueError("no header of a PLY, or a damaged one") from None
    if order not in ORDERS or any(count < 0 for _, count, _ in elements):
        raise ValueError("no header of a PLY, or a damaged one")
    return order, elements, newline + 1
