"""Video in messages: foxglove's CompressedVideo, FFMPEGPacket, Theora's Packet, and CompressedImage."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from bevviz.drivers.bitstream import is_key
from bevviz.messages.decoders import Decoder
from bevviz.messages.decoding import MessageError, frame_name, stamp_ns

DEFINITIONS = {  # bags of older releases do not define these types
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": (
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
        "bool is_bigendian\nuint8[] data\n"
    ),
    "theora_image_transport/msg/Packet": (
        "std_msgs/Header header\nuint8[] data\nint32 b_o_s\nint32 e_o_s\nint64 granulepos\nint64 packetno\n"
    ),
}
ANNEX_B = (b"\0\0\0\1", b"\0\0\1")  # what every unit of an H.264 or H.265 stream begins with
_CODECS = (
    ("h264", re.compile(r"h\.?264|avc|x264", re.IGNORECASE)),
    ("h265", re.compile(r"h\.?265|hevc|x265", re.IGNORECASE)),
    ("av1", re.compile(r"av1", re.IGNORECASE)),
    ("vp9", re.compile(r"vp9", re.IGNORECASE)),
    ("vp8", re.compile(r"vp8", re.IGNORECASE)),
)


@dataclass(frozen=True, slots=True)
class Packet:
    """One picture of a video, as far as it differs from those before it."""

    topic: str
    received: int
    stamp: int
    frame_id: str
    codec: str  # h264, h265, av1, vp9, vp8 or theora
    data: bytes
    is_key: bool  # decoding can begin here
    is_header: bool = False  # no picture: what Theora says before the first one
    number: int | None = None  # of Theora, which counts its packets

    @property
    def place(self) -> tuple[int, int]:
        """In its topic."""
        return self.received, self.stamp


def is_video(message: Any) -> bool:
    """Whether a CompressedImage holds a packet of video."""
    return bytes(message.data[:4]).startswith(ANNEX_B)


def decode_packet(msg: Any, topic: str, received: int) -> Packet:
    """The packet of a foxglove CompressedVideo, an FFMPEGPacket, a Theora Packet or a CompressedImage.

    Raises:
        MessageError: a codec that is not known.
    """
    header = getattr(msg, "header", msg)  # foxglove's has its two fields itself
    stamp = stamp_ns(header.stamp if hasattr(header, "stamp") else header.timestamp)
    data = bytes(memoryview(msg.data))  # of a number, bytes() would make as many zeros
    if hasattr(msg, "granulepos"):
        first, key = data[:1] >= b"\x80", is_key("theora", data)
        frame_id = frame_name(header.frame_id)
        number = int(msg.packetno)
        return Packet(topic, received, stamp, frame_id, "theora", data, key, is_header=first, number=number)
    form = str(getattr(msg, "encoding", "") or getattr(msg, "format", ""))
    codec = next((name for name, words in _CODECS if words.search(form)), "")
    if not codec:
        raise MessageError(
            f"{topic}: video of the codec '{form}' is not supported; supported are H.264, H.265, AV1, VP9, "
            "VP8 and Theora"
        )
    if codec in ("h264", "h265") and not data.startswith(ANNEX_B):
        raise MessageError(f"{topic}: {len(data)} bytes of '{form}' are no {codec.upper()} in Annex B's form")
    return Packet(topic, received, stamp, frame_name(header.frame_id), codec, data, is_key(codec, data))


DECODERS = tuple(
    Decoder(types=(name,), kind="CompressedVideo", definitions={name: text})
    for name, text in DEFINITIONS.items()
)
