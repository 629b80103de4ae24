"""Reader of PCD files by pypcd4. Open3D crashes on files with padding between the fields, as PCL writes."""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz.errors import first_line
from bevviz.messages.clouds import MOST_POINTS
from bevviz.support.files import SENSOR_LIMIT, read_bytes

MAX_HEADER_LINES = 50  # lines of a header
MAX_UNPACKED = 1 << 30


def read_pcd(file: Path) -> tuple[NDArray[np.void], int]:
    """Return the points with their fields, and the number of points that the header states.

    A cut file gives its whole points. Padding and fields with several values per point are left out.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is no PCD file, or its points are damaged.
    """
    data = read_bytes(file, SENSOR_LIMIT)
    try:
        header, body = _header(data)
        layout = header.build_dtype()
    except (ValueError, LookupError, TypeError, StopIteration):
        raise ValueError("no header of a PCD, or a damaged one") from None
    if header.points > MOST_POINTS:
        raise ValueError(f"announces {header.points} points: {MOST_POINTS} at most are taken")
    try:
        points = _points(header, layout, body)
    except (ValueError, RuntimeError, LookupError, TypeError, MemoryError, struct.error) as error:
        raise ValueError(first_line(error)) from None
    single = {name for name, count in zip(header.fields, header.count, strict=True) if count == 1}
    names = [n for n in layout.names if n in single and n.isidentifier()]
    if missing := sorted({"x", "y", "z"} - set(names)):
        raise ValueError(f"no field {missing[0]} in it")
    return points[names], header.points


def _header(data: bytes) -> tuple[Any, bytes]:
    """Parse the header. Return it in the form of version 0.7, and the bytes after it.

    Older versions have COLUMNS and neither VIEWPOINT nor COUNT. Some writers state only one of the size and
    the number of points, or list padding with COUNT 0.
    """
    from pypcd4.pypcd4 import MetaData

    lines = data.split(b"\n", MAX_HEADER_LINES)
    end = next(i for i, line in enumerate(lines) if line.startswith(b"DATA")) + 1
    words = [line.decode().split() for line in lines[:end] if line.strip() and not line.startswith(b"#")]
    stated = {key.upper(): values for key, *values in words}
    fields = stated.get("FIELDS") or stated["COLUMNS"]
    count = [int(value) for value in stated.get("COUNT", ["1"] * len(fields))]
    kept = [i for i in range(len(fields)) if count[i]]
    height = int(stated.get("HEIGHT", "1")[0])
    size = int(stated["WIDTH"][0]) * height if "WIDTH" in stated else int(stated["POINTS"][0])
    header = MetaData(
        fields=tuple(f"-{i}" if fields[i] == "_" else fields[i] for i in kept),
        size=tuple(int(stated["SIZE"][i]) for i in kept),
        type=tuple(stated["TYPE"][i] for i in kept),
        count=tuple(count[i] for i in kept),
        points=int(stated["POINTS"][0]) if "POINTS" in stated else size,
        width=size // max(height, 1),
        height=height,
        data=stated["DATA"][0].lower(),
    )
    return header, data[sum(len(line) + 1 for line in lines[:end]) :]


def _points(header: Any, layout: np.dtype[np.void], body: bytes) -> NDArray[np.void]:
    from pypcd4.pypcd4 import PointCloud

    if header.data == "binary":
        return np.frombuffer(body, layout, count=min(header.points, len(body) // layout.itemsize))
    if header.data == "ascii":
        if not body.endswith(b"\n") and len(body.splitlines()) < header.points:
            body = body[: body.rfind(b"\n") + 1]  # The last line is cut.
        if not body.strip():
            return np.zeros(0, layout)
        return np.loadtxt(BytesIO(body), layout, ndmin=1, max_rows=MOST_POINTS)
    if struct.unpack("<I", body[4:8])[0] > MAX_UNPACKED:
        raise ValueError(f"unpacks to more than {MAX_UNPACKED} bytes")
    whole: Any = BytesIO(header.compose_header().encode() + body)
    return np.asarray(PointCloud.from_fileobj(whole).pc_data)
