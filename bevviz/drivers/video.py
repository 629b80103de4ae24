"""Video packets of foxglove's CompressedVideo, FFMPEGPacket, Theora's Packet, and CompressedImage.

Key frames and gaps are found in the headers of the packets, without decoding the pictures. Sources: ITU-T
H.264 and H.265, sections 7.3 and 7.4; the AV1 and VP9 bitstream specifications.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from bevviz.messages.decoders import Decoder, MessageError, frame_name, stamp_ns

DEFINITIONS = {  # bags of older releases do not define these types
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": (
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
        "bool is_bigendian\nuint8[] data\n"
    ),
    "theora_image_transport/msg/Packet": (
        "std_msgs/Header header\nuint8[] data\nint32 b_o_s\nint32 e_o_s\nint64 granulepos\nint64 packetno\n"
    ),
}
ANNEX_B = (b"\0\0\0\1", b"\0\0\1")  # start code of every unit of an H.264 or H.265 stream
_CODECS = (
    ("h264", re.compile(r"h\.?264|avc|x264", re.IGNORECASE)),
    ("h265", re.compile(r"h\.?265|hevc|x265", re.IGNORECASE)),
    ("av1", re.compile(r"av1", re.IGNORECASE)),
    ("vp9", re.compile(r"vp9", re.IGNORECASE)),
    ("vp8", re.compile(r"vp8", re.IGNORECASE)),
)
_START = re.compile(b"\0\0\1")
_HEAD = 96  # bytes that are kept of a unit: the header fields read here are within them
_H264_SPS, _H264_SEI, _H264_SLICES, _H264_IDR = 7, 6, (1, 5), 5
_H264_INTRA = (2, 4, 7, 9)  # types of slices that refer to no other picture
_H265_SPS, _H265_SEI, _H265_SLICES, _H265_IRAP = 33, 39, range(32), range(16, 24)
_RECOVERY = 6  # type of the SEI message "recovery point": the following pictures become complete
# Profiles with additional fields in their sequence parameter set.
_HIGH = {100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135}


@dataclass(frozen=True, slots=True)
class VideoPacket:
    """Packet of a video: one encoded picture.

    Attributes:
        topic: topic of the message.
        received: time of receipt, nanoseconds.
        stamp: stamp of the message, nanoseconds.
        frame_id: frame of the camera.
        codec: h264, h265, av1, vp9, vp8 or theora.
        data: encoded bytes.
        is_key: whether decoding can begin with this packet.
        is_header: whether it is a header packet of Theora, which precedes the first picture.
        number: packet number of Theora; None for other codecs.
    """

    topic: str
    received: int
    stamp: int
    frame_id: str
    codec: str
    data: bytes
    is_key: bool
    is_header: bool = False
    number: int | None = None

    @property
    def place(self) -> tuple[int, int]:
        """Position within the topic: time of receipt and stamp."""
        return self.received, self.stamp


def is_video(message: Any) -> bool:
    """Return whether a CompressedImage holds a packet of video."""
    return bytes(message.data[:4]).startswith(ANNEX_B)


def decode_packet(msg: Any, topic: str, received: int) -> VideoPacket:
    """Make a packet from a foxglove CompressedVideo, an FFMPEGPacket, a Theora Packet or a CompressedImage.

    Raises:
        MessageError: the codec is not supported, or the data are not in Annex B format.
    """
    header = getattr(msg, "header", msg)  # foxglove's message has stamp and frame_id itself, without a header
    stamp = stamp_ns(header.stamp if hasattr(header, "stamp") else header.timestamp)
    # Not bytes(msg...): if the field is a number, bytes() would allocate that many zeros.
    data = bytes(memoryview(msg.data))
    if hasattr(msg, "granulepos"):
        first, key = data[:1] >= b"\x80", is_key("theora", data)
        frame_id = frame_name(header.frame_id)
        number = int(msg.packetno)
        return VideoPacket(
            topic, received, stamp, frame_id, "theora", data, key, is_header=first, number=number
        )
    form = str(getattr(msg, "encoding", "") or getattr(msg, "format", ""))
    codec = next((name for name, words in _CODECS if words.search(form)), "")
    if not codec:
        raise MessageError(
            f"{topic}: video of the codec '{form}' is not supported; supported are H.264, H.265, AV1, VP9, "
            "VP8 and Theora"
        )
    if codec in ("h264", "h265") and not data.startswith(ANNEX_B):
        raise MessageError(f"{topic}: {len(data)} bytes of '{form}' are no {codec.upper()} in Annex B's form")
    return VideoPacket(topic, received, stamp, frame_name(header.frame_id), codec, data, is_key(codec, data))


DECODERS = tuple(
    Decoder(types=(name,), kind="CompressedVideo", definitions={name: text})
    for name, text in DEFINITIONS.items()
)


# --- headers of packets -----------------------------------------------------------------------


def units(data: bytes) -> Iterator[bytes]:
    """Yield the first bytes of each unit of an H.264 or H.265 stream in Annex B format."""
    for match in _START.finditer(data):
        yield data[match.end() : match.end() + _HEAD]


def is_key(codec: str, data: bytes) -> bool:
    """Return whether decoding can begin with a packet.

    A packet of H.264 or H.265 must have a sequence parameter set, because some encoders put one before each
    picture, and no picture that refers to other pictures.
    """
    if codec == "h264":
        return _begins_h264(data)
    if codec == "h265":
        return _begins_h265(data)
    if codec == "av1":
        return 1 in _obu_types(data)  # type of a sequence header
    if codec == "vp9":
        profile_3 = data[:1] and data[0] >> 4 & 3 == 3
        frame_header = data[0] << (1 if profile_3 else 0) if data else 255
        return not frame_header & 0b1100  # neither a repeated frame nor one that refers to other frames
    if codec == "vp8":
        return bool(data) and not data[0] & 1
    return bool(data) and data[0] & 0xC0 == 0  # the bit of Theora that marks inter frames


def _begins_h264(data: bytes) -> bool:
    """Return whether decoding of H.264 can begin with a packet."""
    has_parameters = recovers = False
    for unit in filter(None, units(data)):
        kind = unit[0] & 31
        has_parameters |= kind == _H264_SPS
        recovers |= kind == _H264_SEI and _RECOVERY in _sei_types(unit[1:])
        if kind in _H264_SLICES:
            bits = _Bits(unit[1:])
            bits.number()  # first macroblock of the slice
            return has_parameters and (recovers or kind == _H264_IDR or bits.number() in _H264_INTRA)
    return has_parameters


def _begins_h265(data: bytes) -> bool:
    """Return whether decoding of H.265 can begin with a packet."""
    has_parameters = recovers = False
    for unit in filter(None, units(data)):
        kind = unit[0] >> 1 & 63
        has_parameters |= kind == _H265_SPS
        recovers |= kind == _H265_SEI and _RECOVERY in _sei_types(unit[2:])
        if kind in _H265_SLICES:
            return has_parameters and (recovers or kind in _H265_IRAP)
    return has_parameters


def _sei_types(sei: bytes) -> Iterator[int]:
    """Iterate over the types of the messages in an SEI unit.

    The type and the size of a message precede it. Each byte of 255 continues the number.
    """
    bytes_left = iter(sei.replace(b"\0\0\3", b"\0\0"))
    for byte in bytes_left:
        kind, size = byte, next(bytes_left, 0)
        while byte == 255:
            byte, size = size, next(bytes_left, 0)
            kind += byte
        yield kind
        length = size
        while size == 255:
            size = next(bytes_left, 0)
            length += size
        for _ in range(length):
            next(bytes_left, 0)


def _obu_types(data: bytes) -> Iterator[int]:
    """Iterate over the types of the units (OBUs) of an AV1 packet."""
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
    """Counter of missing pictures in an H.264 stream (section 7.4.3). H.264 decoders conceal such gaps.

    Each reference picture has a frame number, one higher than that of the reference picture before it.
    """

    _bits: int = 0  # number of bits of a frame number; 0: not known
    _last: int | None = None

    def missing(self, data: bytes) -> int:
        """Return the number of reference pictures that are missing before this packet."""
        lost = 0
        for unit in units(data):
            kind = unit[0] & 31 if unit else 0
            if kind == _H264_SPS:
                bits_before, self._bits = self._bits, _number_bits(unit)
                self._last = self._last if bits_before == self._bits else None
            elif kind in _H264_SLICES and self._bits:
                bits = _Bits(unit[1:])
                bits.number(), bits.number(), bits.number()  # first macroblock, type, parameter set
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
    """Return the number of bits of a frame number, by the sequence parameter set; 0 if it cannot be read."""
    profile, bits = (sps[1] if len(sps) > 1 else 0), _Bits(sps[4:])
    bits.number()  # number of the parameter set
    if profile in _HIGH:
        if bits.number() == 3:
            bits.take(1)
        bits.number(), bits.number(), bits.take(1)  # bit depths, and the flag for the lossless transform
        if bits.take(1):
            return 0  # there are scaling lists, which are not parsed
    size = bits.number() + 4
    order = bits.number()
    if order == 0:
        bits.number()
    elif order == 1:
        bits.take(1), bits.number(), bits.number()
        for _ in range(bits.number() % 256):
            bits.number()
    bits.number()  # number of reference frames
    return 0 if bits.take(1) else size  # the stream allows gaps


class _Bits:
    """Bit reader for a unit, without the bytes that prevent start codes. Bits beyond the end are zero."""

    def __init__(self, data: bytes) -> None:
        plain = data.replace(b"\0\0\3", b"\0\0")
        self._value, self._left = int.from_bytes(plain), 8 * len(plain)

    def take(self, count: int) -> int:
        """Read an unsigned number of ``count`` bits."""
        self._left -= count
        if self._left < 0:
            return 0
        return self._value >> self._left & (1 << count) - 1

    def number(self) -> int:
        """Read an unsigned Exp-Golomb number."""
        zeros = 0
        while not self.take(1):
            zeros += 1
            if zeros > 32 or self._left <= 0:
                return 0
        return (1 << zeros) - 1 + self.take(zeros)
