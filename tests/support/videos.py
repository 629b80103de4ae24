"""Video for tests: encoded by FFmpeg's libraries, written by the ``mcap`` library."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import av
import numpy as np
from mcap.writer import Writer
from rosbags.typesys import get_types_from_msg

from bevviz.model.frame import U8
from tests.support import bags

VIDEO = "/camera/image_rect_color/foxglove"
ENCODERS = {"h264": "libx264", "h265": "libx265", "av1": "libsvtav1", "vp9": "libvpx-vp9"}
DEFINITIONS = {  # as their packages have them
    "foxglove_msgs/msg/CompressedVideo": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
    ),
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": (
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
        "bool is_bigendian\nuint8[] data\n"
    ),
    "theora_image_transport/msg/Packet": (
        "std_msgs/Header header\nuint8[] data\nint32 b_o_s\nint32 e_o_s\nint64 granulepos\nint64 packetno\n"
    ),
}


def numbered(count: int, size: tuple[int, int] = (64, 64)) -> list[U8]:
    """Pictures that tell their number: grey of 8 * number, over a bar that moves."""
    width, height = size
    found = []
    for number in range(count):
        bgr = np.full((height, width, 3), 8 * number % 248, np.uint8)
        bgr[: height // 3, number % width :] = 255
        found.append(bgr)
    return found


def number_of(bgr: U8) -> int:
    return round(float(bgr[bgr.shape[0] // 2 :].mean()) / 8)


def encode(pictures: Sequence[U8], codec: str = "h264", *, group: int = 10, b_frames: int = 0) -> list[bytes]:
    """Encode each picture as a packet, in the order of decoding."""
    context = cast(Any, av.CodecContext.create(ENCODERS[codec], "w"))
    context.height, context.width = pictures[0].shape[:2]
    context.pix_fmt, context.time_base, context.framerate = "yuv420p", Fraction(1, 10), 10
    context.gop_size, context.max_b_frames, context.bit_rate = group, b_frames, 2_000_000
    options = {
        "h264": {"preset": "veryfast", "sc_threshold": "0"},
        "h265": {
            "preset": "veryfast",
            "x265-params": f"log-level=none:keyint={group}:scenecut=0:bframes={b_frames}:repeat-headers=1",
        },
        "av1": {"preset": "10", "svtav1-params": "pred-struct=1:rc=2"},
        "vp9": {"deadline": "realtime", "lag-in-frames": "0"},
    }
    context.options = options[codec]
    packets = []
    for number, bgr in enumerate([*pictures, None]):
        frame = None
        if bgr is not None:
            frame = av.VideoFrame.from_ndarray(bgr, format="bgr24")
            frame.pts = number
        packets += [bytes(packet) for packet in context.encode(frame)]
    return packets


def messages() -> bags.Messages:
    made = bags.Messages()
    for name, text in DEFINITIONS.items():
        made.store.register(get_types_from_msg(text, name))
    return made


def message(made: bags.Messages, kind: str, stamp: int, data: bytes, codec: str = "h264") -> Any:
    """One packet, in a message of that type."""
    header, values = made.header(stamp, bags.CAMERA_FRAME), np.frombuffer(data, np.uint8)
    if kind == "foxglove_msgs/msg/CompressedVideo":
        return made.make(kind, timestamp=header.stamp, frame_id=header.frame_id, data=values, format=codec)
    if kind == "ffmpeg_image_transport_msgs/msg/FFMPEGPacket":
        about = {"width": 64, "height": 48, "encoding": f"{codec};yuv420p", "pts": stamp // 1000}
        return made.make(kind, header=header, flags=0, is_bigendian=False, data=values, **about)
    if kind == "theora_image_transport/msg/Packet":
        number = (stamp - bags.START) // bags.PERIOD
        numbers = {"b_o_s": 0, "e_o_s": 0, "granulepos": 0, "packetno": number}
        return made.make(kind, header=header, data=values, **numbers)
    return made.compressed(stamp, data, codec)


def items(
    made: bags.Messages,
    packets: Sequence[bytes],
    *,
    kind: str = "foxglove_msgs/msg/CompressedVideo",
    codec: str = "h264",
    period: int = bags.PERIOD,
    topic: str = VIDEO,
) -> list[bags.Item]:
    stamps = [bags.START + i * period for i in range(len(packets))]
    made_of = zip(stamps, packets, strict=True)
    return [bags.Item(topic, kind, at, message(made, kind, at, data, codec)) for at, data in made_of]


def write_mcap(path: Path, found: Iterable[bags.Item], made: bags.Messages) -> Path:
    """By the format's own library, as rosbag2 has it."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        channels: dict[str, int] = {}
        for item in sorted(found, key=lambda i: i.received):
            if item.topic not in channels:
                text, _ = made.store.generate_msgdef(item.type, ros_version=2)
                schema = writer.register_schema(item.type, "ros2msg", text.encode())
                channels[item.topic] = writer.register_channel(item.topic, "cdr", schema)
            data = bytes(made.store.serialize_cdr(item.message, item.type))
            writer.add_message(channels[item.topic], item.received, data, item.received)
        writer.finish()  # type: ignore[no-untyped-call]
    return path
