"""What is to be known of packets of video before they are decoded: where that can begin, what is missing.

ITU-T H.264 and H.265, sections 7.3 and 7.4; the AV1 and VP9 bitstream specifications.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

_START = re.compile(b"\0\0\1")
_HEAD = 96  # bytes of a unit that are looked at
_H264_SPS, _H264_SEI, _H264_SLICES, _H264_IDR = 7, 6, (1, 5), 5
_H264_INTRA = (2, 4, 7, 9)  # types of slices that need no other picture
_H265_SPS, _H265_SEI, _H265_SLICES, _H265_IRAP = 33, 39, range(32), range(16, 24)
_RECOVERY = 6  # of the messages in an SEI: from here on pictures become whole
_HIGH = {100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135}  # profiles with more in their SPS


def units(data: bytes) -> Iterator[bytes]:
    """The beginning of each unit of an H.264 or H.265 stream in the form of Annex B."""
    for found in _START.finditer(data):
        yield data[found.end() : found.end() + _HEAD]


def is_key(codec: str, data: bytes) -> bool:
    """Whether decoding can begin with a packet.

    Of H.264 and H.265, that it has a sequence parameter set, and no picture that needs others: there are
    encoders that put one before each picture.
    """
    if codec == "h264":
        return _begins_h264(data)
    if codec == "h265":
        return _begins_h265(data)
    if codec == "av1":
        return 1 in _obus(data)  # a sequence header
    if codec == "vp9":
        profile_3 = data[:1] and data[0] >> 4 & 3 == 3
        rest = data[0] << (1 if profile_3 else 0) if data else 255
        return not rest & 0b1100  # neither an existing frame shown again, nor one that needs others
    if codec == "vp8":
        return bool(data) and not data[0] & 1
    return bool(data) and data[0] & 0xC0 == 0  # Theora


def _begins_h264(data: bytes) -> bool:
    said = recovers = False
    for unit in filter(None, units(data)):
        kind = unit[0] & 31
        said |= kind == _H264_SPS
        recovers |= kind == _H264_SEI and _RECOVERY in _messages(unit[1:])
        if kind in _H264_SLICES:
            bits = _Bits(unit[1:])
            bits.number()  # place of the slice
            return said and (recovers or kind == _H264_IDR or bits.number() in _H264_INTRA)
    return said


def _begins_h265(data: bytes) -> bool:
    said = recovers = False
    for unit in filter(None, units(data)):
        kind = unit[0] >> 1 & 63
        said |= kind == _H265_SPS
        recovers |= kind == _H265_SEI and _RECOVERY in _messages(unit[2:])
        if kind in _H265_SLICES:
            return said and (recovers or kind in _H265_IRAP)
    return said


def _messages(sei: bytes) -> Iterator[int]:
    """Types of the messages in an SEI; each is behind its type and its size, of which 255 are a byte."""
    plain = iter(sei.replace(b"\0\0\3", b"\0\0"))
    for byte in plain:
        kind, size = byte, next(plain, 0)
        while byte == 255:
            byte, size = size, next(plain, 0)
            kind += byte
        yield kind
        rest = size
        while size == 255:
            size = next(plain, 0)
            rest += size
        for _ in range(rest):
            next(plain, 0)


def _obus(data: bytes) -> Iterator[int]:
    """Types of the units of an AV1 packet."""
    at = 0
    while at < len(data):
        header = data[at]
        yield header >> 3 & 15
        at += 2 if header & 4 else 1
        if not header & 2:
            return
        size = shift = 0
        while at < len(data):
            size |= (data[at] & 127) << shift
            shift, at = shift + 7, at + 1
            if not data[at - 1] & 128:
                break
        at += size


@dataclass(slots=True)
class Continuity:
    """Tells that pictures of an H.264 stream are missing, which its decoders paint over (section 7.4.3).

    Each picture that others may refer to has the number after the last one's.
    """

    _bits: int = 0  # of a number; 0: not known
    _last: int | None = None

    def missing(self, data: bytes) -> int:
        """How many pictures that are referred to are missing before this packet."""
        lost = 0
        for unit in units(data):
            kind = unit[0] & 31 if unit else 0
            if kind == _H264_SPS:
                bits_before, self._bits = self._bits, _number_bits(unit)
                self._last = self._last if bits_before == self._bits else None
            elif kind in _H264_SLICES and self._bits:
                bits = _Bits(unit[1:])
                bits.number(), bits.number(), bits.number()  # place, type and parameter set of the slice
                number = bits.take(self._bits)
                if kind == _H264_IDR:
                    self._last = number
                elif self._last is not None:
                    step = (number - self._last) % (1 << self._bits)
                    lost += max(0, step - 1)
                    if unit[0] & 0x60 or step > 1:
                        self._last = number if unit[0] & 0x60 else (number - 1) % (1 << self._bits)
                break
        return lost


def _number_bits(sps: bytes) -> int:
    """Bits of a picture's number; 0: not to be told."""
    profile, bits = (sps[1] if len(sps) > 1 else 0), _Bits(sps[4:])
    bits.number()  # of the parameter set
    if profile in _HIGH:
        if bits.number() == 3:
            bits.take(1)
        bits.number(), bits.number(), bits.take(1)  # depths, and whether nothing is transformed
        if bits.take(1):
            return 0  # scaling lists
    size = bits.number() + 4
    order = bits.number()
    if order == 0:
        bits.number()
    elif order == 1:
        bits.take(1), bits.number(), bits.number()
        for _ in range(bits.number() % 256):
            bits.number()
    bits.number()  # of pictures that are referred to
    return 0 if bits.take(1) else size  # gaps may be meant


class _Bits:
    """The bits of a unit, without the bytes that keep start codes out of it. Zeros follow its end."""

    def __init__(self, data: bytes) -> None:
        plain = data.replace(b"\0\0\3", b"\0\0")
        self._value, self._left = int.from_bytes(plain), 8 * len(plain)

    def take(self, count: int) -> int:
        self._left -= count
        if self._left < 0:
            return 0
        return self._value >> self._left & (1 << count) - 1

    def number(self) -> int:
        """Unsigned, as Exp-Golomb has it."""
        zeros = 0
        while not self.take(1):
            zeros += 1
            if zeros > 32 or self._left <= 0:
                return 0
        return (1 << zeros) - 1 + self.take(zeros)
