"""Readers of cloud files: BIN, NPY, PCD and PLY.

The library pypcd4 reads PCD files. Open3D crashes on those with padding between the fields, as PCL writes,
fills cut PLY files with uninitialised memory and drops integer properties. The library plyfile is under the
GPL. The format of PLY is Turk's (The PLY Polygon File Format, 1994).
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz.errors import UserError, first_line
from bevviz.messages.encode import POINT_FIELD
from bevviz.model.frame import F32, F64, I64
from bevviz.support.files import LFS_HINT, LFS_POINTER, open_regular, read_head
from bevviz.support.files import read_bytes as read_limited
from bevviz.support.limits import MAX_UNPACKED, MOST_POINTS, SENSOR_LIMIT

CLOUDS = (".pcd", ".ply", ".bin", ".npy")
SAMPLE_BYTES = 500_000  # bytes of a BIN file from which the number of columns is estimated
MAX_COLUMNS = 64  # columns of an NPY file; height grids and transposed tables have more
# Nearest types that a PointCloud2 can hold.
NEAREST_TYPES = {"i8": "<f8", "u8": "<f8", "f2": "<f4", "b1": "u1"}
MAX_HEADER_LINES = 50  # lines of a PCD's header
MAX_PLY_HEADER = 1 << 16  # bytes
PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
PLY_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
# Estimates of the columns of a BIN file.
MOST_BIN_COLUMNS = 12
BINS = 64  # of a histogram of values
MIN_VALUES = 1000  # values; fewer give no estimate
MIN_INFORMATION = 0.1  # nats; below it no number of columns stands out
CLOSE_TO_BEST = 0.7  # share of the best information: a multiple of the right number has slightly more
NEARLY_ZERO = 1e-30  # Integers below some hundred millions are smaller if read as float32.
MAX_ODD_SHARE = 0.1  # share of physically impossible values above which the numbers have another type


def read_cloud(file: Path, fields: Sequence[str]) -> tuple[NDArray[np.void], int]:
    """Return (N,) points with x, y, z and further fields, and the number that the header states, else 0.

    Args:
        file: PCD, PLY, BIN (float32) or NPY file.
        fields: columns of a BIN or NPY file.

    Raises:
        UserError: the file cannot be read or is damaged.
    """
    suffix = file.suffix.lower()
    try:
        if suffix == ".bin":
            return read_points(file, fields), 0
        if is_pointer(file):
            raise UserError(f"{file}: {LFS_HINT}")
        if suffix == ".npy":
            loaded = _load_array(file)
            if loaded.dtype.names:
                return _encodable(loaded.reshape(-1)), 0
            if loaded.ndim != 2 or not 3 <= loaded.shape[1] <= MAX_COLUMNS:
                raise ValueError(f"has the shape {loaded.shape}, not (N, 3) to (N, {MAX_COLUMNS})")
            names = [*fields, *(f"field_{i}" for i in range(len(fields), loaded.shape[1]))][: loaded.shape[1]]
            return as_points(loaded.astype(np.float32), names), 0
        points, announced = read_pcd(file) if suffix == ".pcd" else read_ply(file)
        return _encodable(points), announced
    except (OSError, ValueError, EOFError, RuntimeError) as error:
        raise UserError(f"{file}: cannot be read as a cloud: {first_line(error)}") from None


def _encodable(points: NDArray[np.void]) -> NDArray[np.void]:
    """Convert fields to little-endian types that a PointCloud2 can hold."""
    names = points.dtype.names or ()
    types = {name: points.dtype[name].newbyteorder("<") for name in names}
    types = {name: np.dtype(NEAREST_TYPES.get(kind.str[1:], kind)) for name, kind in types.items()}
    if missing := [name for name, kind in types.items() if kind.str[1:] not in POINT_FIELD]:
        raise ValueError(f"field {missing[0]} is of the type {types[missing[0]]}")
    if all(types[name] == points.dtype[name] for name in names):
        return points
    return points.astype(np.dtype(list(types.items())))


def read_bytes(path: Path, first: int = 0) -> bytes:
    """Read a scan, an image or labels.

    Args:
        path: file.
        first: number of bytes to read from the start; 0: all.

    Raises:
        UserError: the file cannot be read, is larger than ``SENSOR_LIMIT``, or is a Git LFS pointer.
    """
    try:
        data = read_head(path, first) if first else read_limited(path, SENSOR_LIMIT)
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None
    if data.startswith(LFS_POINTER):
        raise UserError(f"{path}: {LFS_HINT}")
    return data


def is_pointer(path: Path) -> bool:
    """Tell whether a file is a pointer that Git LFS has not replaced yet.

    Raises:
        OSError: the file cannot be read.
    """
    return read_head(path, len(LFS_POINTER)) == LFS_POINTER


def why_no_points(file: Path) -> str:
    """Return why a file with a cloud suffix is no cloud, such as labels or matrices; empty: it may be one."""
    suffix = file.suffix.lower()
    if suffix == ".bin":
        return "whole numbers, no points of float32" if are_whole(read_head(file, SAMPLE_BYTES)) else ""
    shape = array_shape(file) if suffix == ".npy" else ()
    if shape and (len(shape) != 2 or shape[1] > MAX_COLUMNS or (shape[0] in (3, 4) and shape[1] in (3, 4))):
        return f"of the shape {shape}, no points"
    return ""


# --- BIN: rows of float32 ---------------------------------------------------------------------


def read_points(path: Path, fields: Sequence[str]) -> NDArray[np.void]:
    """Return the (N,) whole points of a BIN file with these columns of float32.

    Raises:
        UserError: the file cannot be read, or it is a Git LFS pointer.
    """
    data = read_bytes(path)
    whole = np.frombuffer(data, "<f4", len(data) // (4 * len(fields)) * len(fields))
    return as_points(whole.reshape(-1, len(fields)), fields)


def as_points(values: F32, names: Sequence[str]) -> NDArray[np.void]:
    """View (N, C) float32 values as (N,) points with named fields. Contiguous values are not copied."""
    layout = np.dtype([(name, "<f4") for name in names])
    return np.ascontiguousarray(values, "<f4").view(layout).reshape(-1)


def count_columns(values: F32) -> int | None:
    """Estimate the number of columns of a flattened point table; None if the values give no estimate.

    With the right number, each column has its own distribution (heights are not distances). With another
    number, they are mixed. The score is the mutual information of column and value, minus its bias (Miller
    1955). The order of the points does not matter.

    Args:
        values: (N,) float32 values, row after row.
    """
    finite = values[np.isfinite(values)]
    if len(finite) < MIN_VALUES:
        return None
    edges = np.unique(np.quantile(finite, np.linspace(0, 1, BINS + 1)[1:-1]))
    bins = np.searchsorted(edges, values, side="right")  # NaN is in the last bin.
    information = np.array(
        [_information(bins, columns, len(edges) + 1) for columns in range(3, MOST_BIN_COLUMNS + 1)]
    )
    if information.max() < MIN_INFORMATION:
        return None
    return 3 + int(np.argmax(information >= CLOSE_TO_BEST * information.max()))


def are_doubles(data: bytes) -> bool:
    """Tell whether numbers are float64: as float32, many would be too large or too small for a sensor."""
    whole = data[: len(data) // 8 * 8]
    return (
        _odd_share(np.frombuffer(whole, "<f4")) > MAX_ODD_SHARE > 10 * _odd_share(np.frombuffer(whole, "<f8"))
    )


def are_whole(data: bytes) -> bool:
    """Tell whether numbers are integers such as labels: read as float32, they would be almost zero."""
    size = np.abs(np.frombuffer(data[: len(data) // 4 * 4], "<f4"))
    nonzero = size > 0
    return bool(nonzero.any()) and float(np.mean(size[nonzero] < NEARLY_ZERO)) > 0.5


def _odd_share(values: F32 | F64) -> float:
    size = np.abs(values[np.isfinite(values)])
    return float(np.mean((size > 1e10) | ((size < 1e-10) & (size > 0)))) if len(size) else 0.0


def _information(bins: I64, columns: int, count: int) -> float:
    """Return the mutual information in nats of the column and the bin of a value."""
    rows = len(bins) // columns
    cells = bins[: rows * columns].reshape(rows, columns) + np.arange(columns) * count
    joint = np.bincount(cells.ravel(), minlength=columns * count).reshape(columns, count) / cells.size
    independent = joint.sum(axis=1, keepdims=True) * joint.sum(axis=0, keepdims=True)
    nonzero = joint > 0
    information = float((joint[nonzero] * np.log(joint[nonzero] / independent[nonzero])).sum())
    return information - (columns - 1) * (count - 1) / (2 * cells.size)


# --- NPY --------------------------------------------------------------------------------------


def array_shape(file: Path) -> tuple[int, ...]:
    """Return the shape of the array in an NPY file; empty if it has named columns or cannot be read."""
    try:
        array = _load_array(file)
    except (OSError, ValueError, EOFError):
        return ()
    return () if array.dtype.names else array.shape


def _load_array(file: Path) -> NDArray[Any]:
    """Map an NPY file into memory. Refuse a file with fewer numbers than its header states.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is no NPY file, is cut, or is larger than ``SENSOR_LIMIT``.
    """
    with open_regular(file) as opened:
        if os.fstat(opened.fileno()).st_size > SENSOR_LIMIT:
            raise ValueError(f"it has more than {SENSOR_LIMIT:,} bytes, which are read at most")
    loaded = np.load(file, mmap_mode="r", allow_pickle=False)
    if not isinstance(loaded, np.ndarray):
        raise ValueError("is an archive of arrays (NPZ), no NPY file")
    return loaded


# --- PCD --------------------------------------------------------------------------------------


def read_pcd(file: Path) -> tuple[NDArray[np.void], int]:
    """Return the points with their fields, and the number of points that the header states.

    A cut file gives its whole points. Padding and fields with several values per point are left out.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is no PCD file, or its points are damaged.
    """
    data = read_limited(file, SENSOR_LIMIT)
    try:
        header, body = _pcd_header(data)
        layout = header.build_dtype()
    except (ValueError, LookupError, TypeError, StopIteration):
        raise ValueError("no header of a PCD, or a damaged one") from None
    if header.points > MOST_POINTS:
        raise ValueError(f"announces {header.points} points: {MOST_POINTS} at most are taken")
    try:
        points = _pcd_points(header, layout, body)
    except (ValueError, RuntimeError, LookupError, TypeError, MemoryError, struct.error) as error:
        raise ValueError(first_line(error)) from None
    single = {name for name, count in zip(header.fields, header.count, strict=True) if count == 1}
    names = [n for n in layout.names if n in single and n.isidentifier()]
    if missing := sorted({"x", "y", "z"} - set(names)):
        raise ValueError(f"no field {missing[0]} in it")
    return points[names], header.points


def _pcd_header(data: bytes) -> tuple[Any, bytes]:
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


def _pcd_points(header: Any, layout: np.dtype[np.void], body: bytes) -> NDArray[np.void]:
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


# --- PLY --------------------------------------------------------------------------------------


def read_ply(file: Path) -> tuple[NDArray[np.void], int]:
    """Return the vertices with their properties, and the number of vertices that the header states.

    A cut file gives its whole vertices.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is no PLY file, has no x, y, z, or has lists before or in its vertices.
    """
    data = read_limited(file, SENSOR_LIMIT)
    order, elements, at = _ply_header(data)
    skipped = 0
    for name, count, properties in elements:
        if any(kind not in PLY_TYPES for _, kind in properties):
            kind = next(kind for _, kind in properties if kind not in PLY_TYPES)
            raise ValueError(f"properties of the type {kind} in its element {name} are not read")
        layout = np.dtype([(label, PLY_ORDERS[order] + PLY_TYPES[kind]) for label, kind in properties])
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


def _ply_header(data: bytes) -> tuple[str, list[tuple[str, int, list[tuple[str, str]]]], int]:
    """Return the format, the elements (name, count, properties), and the end of the header.

    CloudCompare writes ``scalar_`` before field names. CARLA calls the intensity ``I``.
    """
    end = data.find(b"end_header", 0, MAX_PLY_HEADER)
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
    if order not in PLY_ORDERS or any(count < 0 for _, count, _ in elements):
        raise ValueError("no header of a PLY, or a damaged one")
    return order, elements, newline + 1
