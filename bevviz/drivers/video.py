"""Video packets of foxglove's CompressedVideo, FFMPEGPacket, Theora's Packet, and CompressedImage."""

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
ANNEX_B = (b"\0\0\0\1", b"\0\0\1")  # start code of every unit of an H.264 or H.265 stream
_CODECS = (
    ("h264", re.compile(r"h\.?264|avc|x264", re.IGNORECASE)),
    ("h265", re.compile(r"h\.?265|hevc|x265", re.IGNORECASE)),
    ("av1", re.compile(r"av1", re.IGNORECASE)),
    ("vp9", re.compile(r"vp9", re.IGNORECASE)),
    ("vp8", re.compile(r"vp8", re.IGNORECASE)),
)


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
