"""Decoder for clouds that cloudini compressed (github.com/facontidavide/cloudini), formats 3 to 5.

A header lists the fields. Chunks of points follow. A chunk holds the differences of a field from point to
point as zigzag varints; floats are multiples of their resolution. Lossless fields are stored unchanged or as
the exclusive or with the previous value. zstd or LZ4 compresses each chunk.

The library pureini 0.10 decodes the same points 1.5 to 4 times as fast, but it is under the GPL-3.0. cloudini
itself has no package for Python.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from backports import zstd
from lz4.block import LZ4BlockError  # type: ignore[import-untyped]
from lz4.block import decompress as lz4_decompress
from numpy.typing import NDArray

from bevviz.errors import first_line
from bevviz.model.frame import F64, I64, U8
from bevviz.support.numba_kernel import kernel

MAGIC = b"CLOUDINI_V"
CHUNK = 32 * 1024  # points of a chunk
MOST_BYTES = 1 << 30  # largest cloud, in bytes
LONGEST_HEADER = 1 << 13  # longest YAML header, in bytes: 20 fields take 1.5 kB, and the YAML parser is slow
TYPES = ("", "INT8", "UINT8", "INT16", "UINT16", "INT32", "UINT32", "FLOAT32", "FLOAT64", "INT64", "UINT64")
SIZES = (0, 1, 1, 2, 2, 4, 4, 4, 8, 8, 8)
FLOAT32, FLOAT64 = 7, 8
NOWHERE = 0xFFFFFFFF  # offset of a field that is encoded but not kept
U64 = NDArray[np.uint64]
ENCODINGS = ("NONE", "LOSSY", "LOSSLESS")
COMPRESSIONS = ("NONE", "LZ4", "ZSTD")
COPIED, DELTAS, MULTIPLES, XORED, PACKED = range(5)  # encodings of a field
CUT = -1  # returned by the kernels if the data are cut or damaged


@dataclass(frozen=True, slots=True)
class Field:
    """Field of a point.

    Attributes:
        name: field name.
        offset: byte within the point, or ``NOWHERE``.
        type: datatype as in a PointField; 9 is int64 and 10 is uint64.
        resolution: step of the quantised values; 0: not quantised.
    """

    name: str
    offset: int
    type: int
    resolution: float

    @property
    def size(self) -> int:
        """Size in bytes."""
        return SIZES[self.type]


@dataclass(frozen=True, slots=True)
class Header:
    """Header of a compressed cloud.

    Attributes:
        version: format, 3 to 5.
        width, height: size of the cloud in points.
        point_step: bytes of a point.
        encoding: index in ``ENCODINGS``.
        compression: index in ``COMPRESSIONS``.
        fields: fields of a point.
    """

    version: int
    width: int
    height: int
    point_step: int
    encoding: int
    compression: int
    fields: Sequence[Field]

    @property
    def points(self) -> int:
        """Number of points."""
        return self.width * self.height

    @property
    def adaptive(self) -> Sequence[Field]:
        """Integer fields that a chunk stores column by column behind its points."""
        if self.version < 5 or ENCODINGS[self.encoding] != "LOSSY":
            return ()
        return [f for f in self.fields if f.type not in (FLOAT32, FLOAT64) and f.size > 1]


EMPTY = Header(5, 0, 1, 0, 0, 0, ())  # cloud without points: its message has no data


def decode(data: bytes) -> tuple[Header, U8]:
    """Decode a compressed cloud. Return its header and the (points * point_step,) bytes of its points.

    Raises:
        ValueError: the data are not cloudini's, of an unsupported version, or damaged.
    """
    header, at = read_header(data)
    fields, adaptive = header.fields, header.adaptive
    if (
        header.points * header.point_step > MOST_BYTES
        or header.point_step > 1 << 16
        or any(f.offset + f.size > header.point_step for f in fields if f in adaptive or f.offset != NOWHERE)
    ):
        raise ValueError("its cloudini header is damaged: no field may end behind the point, 1 GiB is most")
    interleaved = [f for f in fields if f not in adaptive]
    encodings = np.array([_encoding_of(header, field) for field in interleaved], np.int64)
    sizes, offsets = (np.array([getattr(f, n) for f in interleaved], np.int64) for n in ("size", "offset"))
    resolutions = np.array([f.resolution for f in interleaved], np.float64)
    out = np.zeros(header.points * header.point_step, np.uint8)
    first = 0
    while first < header.points:
        count = min(CHUNK, header.points - first)
        (length,) = struct.unpack_from("<I", data, at) if len(data) >= at + 4 else (len(data),)
        chunk = _decompress(header, data[at + 4 : at + 4 + length])
        if len(data) < at + 4 + length:
            raise ValueError("its cloudini data are cut")
        at += 4 + length
        points = out[first * header.point_step :]
        end = _decode_fields(chunk, count, encodings, sizes, offsets, resolutions, points, header.point_step)
        for field in adaptive:
            if end != CUT:
                end = _decode_column(chunk, end, count, field.size, field.offset, points, header.point_step)
        if end != len(chunk):
            raise ValueError("its cloudini data are damaged")
        first += count
    return header, out


def read_header(data: bytes) -> tuple[Header, int]:
    """Parse the header. Return it and the byte at which the chunks begin.

    Raises:
        ValueError: the header is missing, of an unsupported version, or damaged.
    """
    if not data.startswith(MAGIC) or not data[10:12].isdigit():
        raise ValueError("its data do not begin as cloudini's do")
    version = int(data[10:12])
    if not 3 <= version <= 5:
        raise ValueError(f"its data are of cloudini's format {version}; 3 to 5 are read")
    try:
        if data[12:13] == b"\n" and data[13:14] != b"{":
            end = data.index(b"\0", 13, 13 + LONGEST_HEADER)
            return _parse_yaml(version, data[13:end].decode()), end + 1
        return _parse_binary(version, data)
    except (ValueError, LookupError, TypeError, struct.error) as error:
        raise ValueError(f"its cloudini header is damaged ({first_line(error)})") from None


# All messages of a topic have the same header. Parsing it takes longer than decoding the points.
@lru_cache(maxsize=64)
def _parse_yaml(version: int, text: str) -> Header:
    """Parse a header in YAML. Raise ValueError, LookupError or TypeError if it is damaged."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        header = YAML(typ="safe", pure=True).load(text)
    except YAMLError as error:
        raise ValueError(first_line(error)) from None
    fields = [
        Field(str(f["name"]), int(f["offset"]), TYPES.index(f["type"], 1), _single_precision(f["resolution"]))
        for f in header["fields"] or ()
    ]
    width, height, step = (int(header[name]) for name in ("width", "height", "point_step"))
    encoding, compression = header["encoding_opt"], header["compression_opt"]
    return Header(
        version, width, height, step, ENCODINGS.index(encoding), COMPRESSIONS.index(compression), fields
    )


def _single_precision(resolution: object) -> float:
    """Return a resolution in single precision, as cloudini stores it; 0 if there is none."""
    return float(np.float32(0 if resolution is None else str(resolution)))


def _parse_binary(version: int, data: bytes) -> tuple[Header, int]:
    """Parse a binary header. Return it and the byte at which the chunks begin."""
    width, height, step, encoding, compression, count = struct.unpack_from("<IIIBBH", data, 12)
    at, fields = 28, list[Field]()
    for _ in range(count):
        (length,) = struct.unpack_from("<H", data, at)
        name = data[at + 2 : at + 2 + length].decode()
        offset, kind, resolution = struct.unpack_from("<IBf", data, at + 2 + length)
        at += 2 + length + 9
        fields.append(Field(name, offset, kind, max(resolution, 0.0)))
    if max(encoding, compression) > 2 or any(not 0 < field.type < len(TYPES) for field in fields):
        raise ValueError("a type, an encoding or a compression that there is none of")
    return Header(version, width, height, step, encoding, compression, fields), at


def _encoding_of(header: Header, field: Field) -> int:
    """Return how a field is encoded: ``COPIED``, ``DELTAS``, ``MULTIPLES``, ``XORED`` or ``PACKED``."""
    encoding = ENCODINGS[header.encoding]
    if encoding == "NONE" or field.size == 1:
        return COPIED
    if field.type not in (FLOAT32, FLOAT64):
        return DELTAS
    if field.resolution and encoding == "LOSSY":
        return MULTIPLES
    if field.type == FLOAT32:
        return XORED if encoding == "LOSSLESS" else COPIED
    return XORED if field.resolution or header.version < 4 else PACKED


def _decompress(header: Header, chunk: bytes) -> U8:
    """Decompress a chunk. Raise ValueError if it is damaged or larger than a chunk can be."""
    compression = COMPRESSIONS[header.compression]
    limit = CHUNK * (sum(11 for _ in header.fields) + header.point_step) + 4096
    try:
        if compression == "LZ4":
            chunk = lz4_decompress(chunk, uncompressed_size=limit)
        elif compression == "ZSTD":
            stream = zstd.ZstdDecompressor()
            chunk = stream.decompress(chunk, limit)
            if not stream.eof:
                raise ValueError("it is cut, or too long")
    except (LZ4BlockError, zstd.ZstdError, ValueError) as error:
        raise ValueError(f"its compressed data is damaged ({first_line(error)})") from None
    return np.frombuffer(chunk, np.uint8)


@kernel
def _read_varint(data: U8, at: int) -> tuple[np.uint64, int]:
    """Read a varint. Return it and the next byte, ``CUT`` if the data end within it."""
    value, shift = np.uint64(0), np.uint64(0)
    while 0 <= at < len(data) and shift < 64:
        byte = np.uint64(data[at])
        at += 1
        value |= (byte & np.uint64(0x7F)) << shift
        if not byte & np.uint64(0x80):
            return value, at
        shift += np.uint64(7)
    return value, CUT


@kernel
def _unzigzag(value: np.uint64) -> np.int64:
    """Decode a zigzag number. It is stored plus one, because 0 stands for NaN."""
    value -= np.uint64(1)
    return np.int64(value >> np.uint64(1)) ^ -np.int64(value & np.uint64(1))


@kernel
def _decode_fields(
    data: U8, count: int, encodings: I64, sizes: I64, offsets: I64, resolutions: F64, out: U8, step: int
) -> int:
    """Decode the fields that are stored point by point. Return the byte behind them."""
    at, fields = 0, len(encodings)
    previous, bits = np.zeros(fields, np.int64), np.zeros(fields, np.uint64)
    leading, meaningful = np.zeros(fields, np.int64), np.zeros(fields, np.int64)
    single, double = np.zeros(1, np.float32), np.zeros(1, np.float64)
    single_bits, double_bits = single.view(np.uint32), double.view(np.uint64)
    for point in range(count):
        for field in range(fields):
            encoding, size = encodings[field], sizes[field]
            if encoding in (COPIED, XORED):
                if at + size > len(data):
                    return CUT
                value = _load(data, at, size)
                at += size
                if encoding == XORED:
                    bits[field] ^= value
                    value = bits[field]
            elif encoding == PACKED:
                at = _decode_double(data, at, point == 0, field, bits, leading, meaningful)
                value = bits[field]
            else:
                value, at = _read_varint(data, at)
                if at == CUT or (value == 0 and encoding == DELTAS):
                    return CUT
                missing = value == 0
                previous[field] = 0 if missing else previous[field] + _unzigzag(value)
                if encoding == DELTAS:
                    value = np.uint64(previous[field])
                elif size == 4:
                    number = np.float32(previous[field]) * np.float32(resolutions[field])
                    single[0] = np.float32(np.nan) if missing else number
                    value = np.uint64(single_bits[0])
                else:
                    double[0] = np.nan if missing else previous[field] * resolutions[field]
                    value = double_bits[0]
            if at == CUT:
                return CUT
            if offsets[field] != NOWHERE:
                _store(out, point * step + offsets[field], size, value)
    return at


@kernel
def _decode_double(
    data: U8, at: int, first: bool, field: int, bits: U64, leading: I64, meaningful: I64
) -> int:
    """Decode a double by Gorilla (Pelkonen et al. 2015), from a whole byte on. Return the byte behind it."""
    bit = at * 8
    if first:
        value, bit = _read_bits(data, bit, 64)
        bits[field] = value
        return bit // 8 if bit != CUT else CUT
    changed, bit = _read_bits(data, bit, 1)
    if bit != CUT and changed:
        fresh, bit = _read_bits(data, bit, 1)
        if bit != CUT and fresh:
            lead, bit = _read_bits(data, bit, 5)
            length, bit = _read_bits(data, bit, 6)
            leading[field], meaningful[field] = np.int64(lead), np.int64(length) + 1
        trailing = 64 - leading[field] - meaningful[field]
        if bit == CUT or meaningful[field] == 0 or trailing < 0:
            return CUT
        value, bit = _read_bits(data, bit, meaningful[field])
        bits[field] ^= value << np.uint64(trailing)
    return (bit + 7) // 8 if bit != CUT else CUT


@kernel
def _read_bits(data: U8, bit: int, count: int) -> tuple[np.uint64, int]:
    """Read a number of ``count`` bits, the lowest first. Return it and the bit behind it."""
    value = np.uint64(0)
    if bit == CUT or bit + count > len(data) * 8:
        return value, CUT
    taken = 0
    while taken < count:
        shift = (bit + taken) & 7
        step = min(8 - shift, count - taken)
        part = (np.uint64(data[(bit + taken) >> 3]) >> np.uint64(shift)) & np.uint64((1 << step) - 1)
        value |= part << np.uint64(taken)
        taken += step
    return value, bit + count


@kernel
def _decode_column(data: U8, at: int, count: int, size: int, offset: int, out: U8, step: int) -> int:
    """Decode an integer field of all points of a chunk: differences, a palette, or runs of either.

    Return the byte behind it.
    """
    if at >= len(data):
        return CUT
    mode = data[at]
    at += 1
    value, row = np.uint64(0), 0
    if mode == 0:
        for row in range(count):
            number, at = _read_varint(data, at)
            if at == CUT or number == 0:
                return CUT
            value += np.uint64(_unzigzag(number))
            _store(out, row * step + offset, size, value)
        return at
    if mode == 1:
        if at + 2 > len(data):
            return CUT
        palette_size, width = np.int64(_load(data, at, 2)), 0
        palette = at + 2
        at = int(palette + palette_size * size)
        while (palette_size - 1) >> width > 0:
            width += 1
        bit, end = at * 8, at + (width * count + 7) // 8
        if palette_size == 0 or end > len(data):
            return CUT
        for row in range(count):
            index, bit = _read_bits(data, bit, width)
            if np.int64(index) >= palette_size:
                return CUT
            _store(out, row * step + offset, size, _load(data, palette + int(index) * size, size))
        return end
    if mode > 3 or at + 4 > len(data):
        return CUT
    runs = np.int64(_load(data, at, 4))
    at += 4
    for _ in range(runs):
        if mode == 2:
            if at + size > len(data):
                return CUT
            value, difference = _load(data, at, size), np.uint64(0)
            at += size
        else:
            number, at = _read_varint(data, at)
            if at == CUT or number == 0:
                return CUT
            difference = np.uint64(_unzigzag(number))
        length, at = _read_varint(data, at)
        if at == CUT or length > np.uint64(count - row):
            return CUT
        for _ in range(np.int64(length)):
            value += difference
            _store(out, row * step + offset, size, value)
            row += 1
    return at if row == count else CUT


@kernel
def _load(data: U8, at: int, size: int) -> np.uint64:
    """Read an unsigned little-endian number of ``size`` bytes."""
    value = np.uint64(0)
    for i in range(size):
        value |= np.uint64(data[at + i]) << np.uint64(8 * i)
    return value


@kernel
def _store(out: U8, at: int, size: int, value: np.uint64) -> None:
    """Write an unsigned little-endian number of ``size`` bytes."""
    for i in range(size):
        out[at + i] = np.uint8((value >> np.uint64(8 * i)) & np.uint64(0xFF))
